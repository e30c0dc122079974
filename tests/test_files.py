"""Files are written whole or not at all, and read within limits."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.files import ScratchFile, read_bounded, reason, replace_file, replacing


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    replace_file(path, "one")
    replace_file(path, b"two")
    assert path.read_bytes() == b"two"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    replace_file(path, "one")

    def write_half() -> None:
        with replacing(path) as scratch:
            scratch.write_text("tw", encoding="utf-8")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(EmaError, match=r"a\.txt: cannot be written \(No space left on device\); free space"):
        write_half()
    assert path.read_text(encoding="utf-8") == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_another_error_while_writing_is_left_as_it_is(tmp_path: Path) -> None:
    def write_half() -> None:
        with replacing(tmp_path / "a.txt"):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()


def test_too_large_files_and_files_that_are_none_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(bytes(1000))
    assert len(read_bounded(path, 1000)) == 1000
    with pytest.raises(EmaError, match=r"a\.txt: has 0\.001 MB"):
        read_bounded(path, 999)
    with pytest.raises(EmaError, match="is a folder"):
        read_bounded(tmp_path, 999)
    with pytest.raises(EmaError, match="cannot be read"):
        read_bounded(tmp_path / "none", 999)
    with pytest.raises(EmaError, match="cannot be read"):
        read_bounded(Path("a\0b"), 999)


def test_a_scratch_file_keeps_its_failure_until_it_is_asked(tmp_path: Path) -> None:
    file = ScratchFile(Path("/dev/full"))
    assert file.write(b"abc") == 3
    with pytest.raises(OSError, match="No space left"):
        file.check()
    assert file.write(b"abc") == 3  # HDF5 may go on as if nothing had happened
    file.close()


def test_a_folder_that_cannot_be_copied_says_why_of_its_first_file() -> None:
    text = "[Errno 28] No space left on device"
    assert reason(shutil.Error([("a/b", "c/b", text), ("a/d", "c/d", text)])) == text


@pytest.mark.parametrize("name", ["", "folder"])
def test_a_folder_is_not_replaced_by_a_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(EmaError, match="is a folder; name a file in it"):
        replace_file(Path(name), "one")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
