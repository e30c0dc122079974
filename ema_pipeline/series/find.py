"""The tests of a tree of folders, and fingerprints of their raw data that need no reading of them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import DESCRIPTION_FILE
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.toml_text import read_toml


@dataclass(frozen=True)
class FoundTest:
    """One raw folder.

    Attributes
    ----------
    name : str
        Path below the tree, with ``/``: identifies the test in the series.
    raw : Path
    """

    name: str
    raw: Path


def find_tests(tree: Path, out: Path) -> list[FoundTest]:
    """All raw folders at or below `tree`, by name.

    A folder whose sub-folders each describe another configuration, or another part of one test, is one test. Hidden
    folders, results folders and `out` are passed over.

    Raises
    ------
    EmaError
        If there is no such folder, or no test in it.
    """
    if not tree.is_dir():
        raise EmaError(f"{tree}: there is no such folder; give the folder that holds the tests")
    found = [
        FoundTest("." if raw == tree else raw.relative_to(tree).as_posix(), raw)
        for raw in _below(tree, out.resolve())
    ]
    if not found:
        raise EmaError(f"{tree}: no test.toml here or below; 'ema init RAW' drafts one")
    return sorted(found, key=lambda t: t.name)


def _below(folder: Path, out: Path) -> Iterator[Path]:
    if (folder / DESCRIPTION_FILE).exists():
        yield folder
        return
    below = _sub_folders(folder, out)
    if _is_campaign([b for b in below if (b / DESCRIPTION_FILE).exists()]):
        yield folder
        return
    for one in below:
        yield from _below(one, out)


def _sub_folders(folder: Path, out: Path) -> list[Path]:
    try:
        entries = [e for e in os.scandir(folder) if e.is_dir() and not e.name.startswith(".")]
    except OSError:
        return []
    paths = sorted(Path(e.path) for e in entries)
    return [p for p in paths if p.resolve() != out and not (p / RESULTS_FILE).exists()]


def _is_campaign(folders: Sequence[Path]) -> bool:
    """True for several tests that state configurations, or parts of one test, which are all different."""
    stated = []
    for folder in folders:
        keys = {}
        with suppress(EmaError):  # what is wrong with it is said once it is run
            keys = read_toml(folder / DESCRIPTION_FILE)
        names = [str(keys[key]) for key in ("configuration", "part") if keys.get(key)]
        stated.append(" ".join(names))
    return len(stated) > 1 and "" not in stated and len(set(stated)) == len(stated)


def raw_fingerprint(raw: Path) -> str:
    """Hash of names, sizes and times of all files of a raw folder: equal means unchanged."""
    digest = hashlib.sha256()
    for path, directories, files in os.walk(raw):
        directories[:] = sorted(d for d in directories if not d.startswith("."))
        for name in sorted(files):
            with suppress(OSError):
                found = os.stat(os.path.join(path, name))
                entry = (os.path.relpath(os.path.join(path, name), raw), found.st_size, found.st_mtime_ns)
                digest.update(repr(entry).encode())
    return digest.hexdigest()
