"""Shared fixtures."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from ema_pipeline import threads

# pytest-xdist gives every core a process; linear algebra with a thread per core in each would make them wait for
# each other. Set before NumPy is loaded; programs that the tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# For the same reason a test process works on its share of the cores, as configurations side by side do: a diagnosis
# that forks where no core is free takes a sixth longer. Results are the same; `all_cores` is for tests of sharing.
threads.share_cores(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))

FIRST = ("test_view", "test_modal_real", "test_changes", "test_series", "test_merge", "test_api")
"""Modules whose tests take longest. With short ones at the end no process waits long for the last of another, and
what a module prepares is not prepared again by a process that takes half of its tests over."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long modules first, the others in their order."""
    rank = {name: k for k, name in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(FIRST)))


@pytest.fixture
def all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work shared among processes and threads as a user has it, on two cores and more."""
    monkeypatch.setattr(threads, "_sharers", 1)


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Folder with real measurements and simulated rigs, named by the environment variable EMA_TEST_DATA."""
    folder = os.environ.get("EMA_TEST_DATA")
    if not folder:
        pytest.skip("EMA_TEST_DATA is not set: real measurements are not at hand")
    path = Path(folder)
    if not path.is_dir():
        pytest.skip(f"EMA_TEST_DATA={folder} is not a folder")
    return path


@pytest.fixture(scope="module")
def without_figures() -> Iterator[None]:
    """Reports without their interactive figures, which take as long as half of a small run.

    For modules that look at what is computed, not at the page; the figures have tests of their own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ema_pipeline.report.html.figures_of", lambda context, results: {})
        yield


@pytest.fixture(scope="module")
def browser():
    """Debian's Chromium, driven by Playwright."""
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="Playwright is not installed: pip install playwright"
    )
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    sandbox = [] if os.geteuid() else ["--no-sandbox"]  # Chromium refuses its sandbox to root
    with sync_api.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=sandbox)
        yield started
        started.close()
