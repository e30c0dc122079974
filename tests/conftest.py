"""Shared fixtures."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


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
