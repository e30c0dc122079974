"""The live page of a raw folder in the making: the same as ``ema watch``, in a browser."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench import ema, write_bench
from live_page import Page, opened

HOSTILE = "<img src=x onerror=document.title=1>"
ROUTES = ("/", "/events", "/hits.js", "/nowhere")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four files on each of two points, the last one bounces."""
    return write_bench(tmp_path_factory.mktemp("hits"), hits=4, format="csv", double_hits=("m3.x#4",))


@pytest.fixture
def folder(source: Path, tmp_path: Path) -> Path:
    """A folder whose test.toml knows the channels and no record; its title is hostile."""
    (tmp_path / "live").mkdir()
    text = (source / "test.toml").read_text(encoding="utf-8").split("[[records]]")[0]
    lines = [f"title = '{HOSTILE}'" if line.startswith("title") else line for line in text.splitlines()]
    (tmp_path / "live" / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path / "live"


@pytest.fixture
def page(folder: Path) -> Iterator[Page]:
    served = Page(folder, "--point", "m1.x", "--point", "m3.x", "--hits", "2")
    yield served
    if served.process.poll() is None:
        assert served.stop() == 0


def _put(file: Path, folder: Path, name: str = "") -> None:
    """As an analyser writes it: the name appears, then the content grows."""
    target, content = folder / (name or file.name), file.read_bytes()
    with target.open("wb") as out:
        out.write(content[: len(content) // 2])
        out.flush()
        out.write(content[len(content) // 2 :])


def test_nobody_else_is_let_in(page: Page) -> None:
    cookie = page.enter().partition(";")[0]
    for path in ROUTES:
        assert page.ask("GET", path).status == 403
        assert page.ask("GET", path, Cookie=cookie, Host="localhost").status == 403
        assert page.ask("GET", path, Cookie=cookie, Origin="http://evil.example").status == 403
    answer = page.ask("GET", "/", Cookie=cookie)
    assert answer.status == 200
    assert "script-src 'self';" in answer.headers["content-security-policy"]
    assert page.ask("POST", "/events", Cookie=cookie, Origin=page.origin).status == 405


def test_each_file_is_on_the_page_and_the_next_point_is_asked_for(
    browser,
    page: Page,
    source: Path,
    folder: Path,
) -> None:
    from playwright.sync_api import expect

    files = sorted(source.glob("*.csv"))
    first, third = ([f for f in files if f.name.startswith(point)] for point in ("m1", "m3"))
    context = browser.new_context()
    tab = opened(context, page.address)
    expect(tab.locator("#next")).to_have_text("Strike m1.x (hit 1 of 2)")
    expect(tab.locator("#last")).to_have_text("No file yet.")

    _put(first[0], folder)
    expect(tab.locator("#next")).to_have_text("Strike m1.x (hit 2 of 2)", timeout=5_000)
    expect(tab.locator("#files tr").first).to_contain_text(first[0].name)
    expect(tab.locator("#files tr").first).to_contain_text("N")
    _put(first[1], folder)
    expect(tab.locator("#next")).to_have_text("Strike m3.x (hit 1 of 2)", timeout=5_000)
    expect(tab.locator("#points li").first).to_contain_text("✓ m1.x")
    expect(tab.locator("#points li").first).to_contain_text("coherence 0.9")

    _put(third[3], folder)  # it bounces
    expect(tab.locator("#files tr.bad")).to_contain_text("second impact", timeout=5_000)
    expect(tab.locator("#next")).to_have_text("Strike m3.x (hit 1 of 2)")
    (folder / "m3_x_9.csv").write_text("no record\n", encoding="utf-8")
    expect(tab.locator("#files tr").first).to_contain_text("m3_x_9.csv", timeout=5_000)
    expect(tab.locator("#files tr.bad")).to_have_count(2)
    expect(tab.locator("#last")).not_to_contain_text("m3_x_9.csv: m3_x_9.csv")
    _put(third[0], folder)
    _put(third[1], folder, "m3_x_<b>.csv")  # names are text
    expect(tab.locator("#next")).to_have_text("All points are done", timeout=5_000)
    expect(tab.locator("#count")).to_have_text("6 judged, 4 of use")
    assert tab.locator("#files b").count() == 0
    assert tab.locator("h1").inner_text() == HOSTILE
    assert tab.locator("img").count() == 0

    second = opened(context, page.origin)  # a tab that comes later shows the same
    expect(second.locator("#files tr")).to_have_count(6)
    assert tab.faults == second.faults == []
    listed = [r["file"] for r in tomllib.loads((folder / "test.toml").read_text(encoding="utf-8"))["records"]]
    assert sorted(listed) == sorted(p.name for p in folder.glob("*.csv") if p.name != "m3_x_9.csv")
    context.close()
    assert page.stop() == 0


def test_page_and_command_on_one_folder_list_each_file_once(page: Page, source: Path, folder: Path) -> None:
    from ema_pipeline.watch.live import judged_files
    from ema_pipeline.watch.session import Session

    for file in sorted(source.glob("*.csv"))[:3]:
        _put(file, folder)
    told = 0
    for one in judged_files(Session(folder)):
        told += one is not None
        if told == 3:
            break
    assert page.stop() == 0
    listed = [r["file"] for r in tomllib.loads((folder / "test.toml").read_text(encoding="utf-8"))["records"]]
    assert len(listed) == len(set(listed)) == 3


def test_folder_that_is_neither_results_nor_raw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ema(capsys, "view", tmp_path, "--no-browser")
    assert (code, err.count("\n")) == (1, 1)
    (tmp_path / "test.toml").write_text("channels = 3\n", encoding="utf-8")
    code, _, err = ema(capsys, "view", tmp_path, "--no-browser")
    assert (code, err.count("\n")) == (1, 1)
    assert "channels" in err
