"""A raw folder: one test, or the tests of its sub-folders, one per configuration or several parts of one test."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.files import read_bounded
from ema_pipeline.ingest.description import DESCRIPTION_FILE, RIG_FILE, TestDescription, read_description
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.toml_text import LARGEST_BYTES


@dataclass(frozen=True)
class Campaign:
    """All tests of a raw folder.

    Attributes
    ----------
    root : Path
        The raw folder.
    tests : tuple of TestDescription
        One per ``test.toml``; those of one configuration are its parts (two hammers, two sets of sensors) and have
        distinct names of parts.
    rig_file : Path or None
        A ``rig.toml`` that lies beside the test descriptions.
    """

    root: Path
    tests: tuple[TestDescription, ...]
    rig_file: Path | None = None

    @property
    def rig(self) -> str | None:
        """The rig that the tests name, if any."""
        return next((t.rig for t in self.tests if t.rig is not None), None)


def read_campaign(raw: Path) -> Campaign:
    """Read a raw folder: one ``test.toml``, or sub-folders that hold one each.

    Parameters
    ----------
    raw : Path
        Folder with ``test.toml``, or with sub-folders that each hold one.

    Raises
    ------
    EmaError
        Where there is no such folder or no description in it, where a description is wrong, or where
        the descriptions of a campaign contradict each other.
    """
    folders = description_folders(raw)
    if not folders:
        raise EmaError(_no_description(raw))
    tests = tuple(read_description(folder) for folder in folders)
    if len(tests) > 1:
        tests = tuple(_named(t) for t in tests)
    _check_campaign(raw, tests)
    return Campaign(root=raw, tests=tests, rig_file=_find_rig_file(raw, folders))


def _no_description(raw: Path) -> str:
    if (raw / RESULTS_FILE).is_file():
        return f"{raw}: holds results, no raw data; name the raw folder, or run single stages on {raw}"
    campaigns = sorted({p.parts[-3] for p in raw.glob(f"*/*/{DESCRIPTION_FILE}")})
    if campaigns:
        several = ", ".join(campaigns[:5])
        return f"{raw}: holds several tests ({several}); name one, or all with 'ema series run {raw} --out S'"
    return f"{raw}: no test.toml here or in its sub-folders; 'ema init {raw}' drafts one"


def description_folders(raw: Path) -> list[Path]:
    """Return the folders of `raw` that hold a ``test.toml``: itself, or its sub-folders.

    Raises
    ------
    EmaError
        Where `raw` is not a folder, or holds a description beside sub-folders with descriptions.
    """
    if not raw.exists():
        raise EmaError(f"{raw}: there is no such folder; give the folder that holds test.toml")
    if not raw.is_dir():
        raise EmaError(f"{raw}: is a file, not a folder; give the folder that holds test.toml")
    below = sorted(p.parent for p in raw.glob(f"*/{DESCRIPTION_FILE}") if not p.parent.name.startswith("."))
    if not (raw / DESCRIPTION_FILE).exists():
        return below
    if below:
        raise EmaError(
            f"{raw}: holds test.toml and so does its sub-folder '{below[0].name}'; keep one description per "
            "folder, and for a campaign only those in the sub-folders"
        )
    return [raw]


def _named(test: TestDescription) -> TestDescription:
    """The test with the name of its folder as that of its configuration, unless it is a part of one test."""
    if test.configuration or test.part:
        return test
    return test.model_copy(update={"configuration": test.folder.name})


def _check_campaign(raw: Path, tests: tuple[TestDescription, ...]) -> None:
    seen: dict[tuple[str | None, str], TestDescription] = {}
    parts: dict[str | None, TestDescription] = {}
    for test in tests:
        other = seen.setdefault((test.configuration, test.part), test)
        if other is not test and test.part:
            raise EmaError(
                f"{raw}: '{other.folder.name}' and '{test.folder.name}' are both part '{test.part}'; rename one"
            )
        other = parts.setdefault(test.configuration, test)
        if other is not test and not (other.part and test.part):
            raise EmaError(
                f"{raw}: '{other.folder.name}' and '{test.folder.name}' both describe configuration "
                f"'{test.configuration}'; name them differently, put their records under one test.toml, or merge two "
                "set-ups of one test with 'ema merge'"
            )
    rigs = sorted({t.rig for t in tests if t.rig is not None})
    if len(rigs) > 1:
        raise EmaError(f"{raw}: its tests name different rigs ({', '.join(rigs)}); one campaign has one rig")


def _find_rig_file(raw: Path, folders: list[Path]) -> Path | None:
    if (raw / RIG_FILE).is_file():
        return raw / RIG_FILE
    found = [folder / RIG_FILE for folder in folders if (folder / RIG_FILE).is_file()]
    for other in found[1:]:
        if read_bounded(other, LARGEST_BYTES) != read_bounded(found[0], LARGEST_BYTES):
            raise EmaError(f"{found[0]} and {other} differ; put one rig.toml into {raw}")
    return found[0] if found else None
