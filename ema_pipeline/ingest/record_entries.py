"""Checks of what test.toml says of its records: their files, DOFs, and the keys of each kind of test."""

from __future__ import annotations

import os
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.files import check_regular
from ema_pipeline.ingest.driven_entries import check_driven
from ema_pipeline.ingest.response_entries import check_no_sine, check_responses

if TYPE_CHECKING:
    from ema_pipeline.ingest.description import RecordDescription, TestDescription


def check_records(test: TestDescription) -> None:
    """Check every record of a test; EmaError names the record, what is wrong with it, and the remedy."""
    if not test.records:
        raise EmaError(f"{test.file}: no records; add a [[records]] table for each record file")
    seen: set[str] = set()
    for record in test.records:
        where = f"{test.file}: record '{record.file}'"
        key = str(PurePosixPath(record.file))
        if key in seen and test.kind != "continuous":
            raise EmaError(f"{where}: is listed twice; its hits would count twice, keep one")
        seen.add(key)
        _check_file(test, record, where)
        known = [c.name for c in test.channels]
        for name in record.dofs:
            if name not in known:
                raise EmaError(f"{where}: dofs names an unknown channel '{name}'{did_you_mean(name, known)}")
            if name == test.force.name and test.kind == "hammer":
                raise EmaError(f"{where}: dofs names the hammer channel '{name}'; its dof is 'impact'")
        if test.kind == "continuous":
            check_driven(test, record, where)
        else:
            _check_not_driven(record, where)
            (_check_hammer if test.kind == "hammer" else _check_sine)(test, record, where)


def _check_file(test: TestDescription, record: RecordDescription, where: str) -> None:
    relative = Path(record.file)
    if relative.is_absolute() or ".." in relative.parts:
        raise EmaError(f"{where}: lies outside {test.folder}; copy it there and name it without '..'")
    path = test.path_of(record)
    if not os.path.exists(path):  # False for names that no file can have, where Path.exists raises
        try:
            others = [p.name for p in path.parent.iterdir() if p.is_file() and p.name != test.file.name]
        except OSError:
            others = []
        close = get_close_matches(path.name, others, n=1, cutoff=0.6)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise EmaError(f"{where}: there is no such file{hint}; correct 'file' or remove the record")
    try:
        check_regular(path)
    except EmaError as error:
        raise EmaError(f"{where}: {error}") from None


_DRIVEN_KEYS = ("excitation", "period_samples", "level", "first_sample", "last_sample")


def _check_not_driven(record: RecordDescription, where: str) -> None:
    given = next((key for key in _DRIVEN_KEYS if getattr(record, key) is not None), None)
    if given is not None or record.use != "fit" or record.transient_samples:
        named = given or ("use" if record.use != "fit" else "transient_samples")
        raise EmaError(f'{where}: {named} belongs to kind = "continuous"; remove it or set kind')


def _check_hammer(test: TestDescription, record: RecordDescription, where: str) -> None:
    if record.impact is None:
        raise EmaError(f'{where}: impact is missing; add the dof that the hammer strikes, impact = "sun.y"')
    check_no_sine(record, where)
    check_responses(test, record, where)


def _check_sine(test: TestDescription, record: RecordDescription, where: str) -> None:
    for key in ("frequency_hz", "amplitude_m"):
        if getattr(record, key) is None:
            raise EmaError(f"{where}: {key} is missing; a hysteresis record needs it")
    if record.impact is not None:
        raise EmaError(f"{where}: a hysteresis record has no impact; remove it or drop kind")
