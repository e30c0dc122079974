"""Checks of what test.toml says of a continuous test: its force channels and its records."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.response_entries import check_no_sine, check_responses

if TYPE_CHECKING:
    from ema_pipeline.ingest.description import RecordDescription, TestDescription

WITHOUT_PERIOD = ("random",)
"""Excitations that have neither a period nor frames."""


def record_name(record: RecordDescription) -> str:
    """Name of a record: as stated, or that of its file."""
    return record.name or record.file


def check_driven_test(test: TestDescription) -> None:
    """Check the channels of a continuous test.

    Raises
    ------
    EmaError
        Without a force channel, and for one that drives no DOF.
    """
    if not test.forces:
        raise EmaError(
            f"{test.file}: no force channel; a continuous test needs the measured force of every shaker, "
            'a [[channels]] table with quantity = "force" and dof'
        )
    for channel in test.forces:
        where = f"{test.file}: channel '{channel.name}'"
        if channel.dof is None:
            raise EmaError(f'{where}: has no dof; add the dof that this force drives, dof = "body.direction"')
        if channel.uncalibrated and len(test.forces) > 1:
            raise EmaError(f"{where}: several forces must all be calibrated; give sensitivity_mv and unit")
    driven = Counter(c.dof.point for c in test.forces if c.dof is not None)
    point, count = driven.most_common(1)[0]
    if count > 1:
        raise EmaError(f"{test.file}: {count} force channels drive {point}; correct a dof")
    names = Counter(record_name(r) for r in test.records)
    if names:
        name, count = names.most_common(1)[0]
        if count > 1:
            raise EmaError(f"{test.file}: {count} records are called '{name}'; give each a name of its own")


def check_driven(test: TestDescription, record: RecordDescription, where: str) -> None:
    """Check one record of a continuous test.

    Raises
    ------
    EmaError
        For keys of other kinds of test, channels without a DOF, and parts that are none.
    """
    if record.impact is not None:
        raise EmaError(
            f"{where}: a continuous record has no impact; remove it, the force channels have the dofs"
        )
    check_no_sine(record, where)
    check_responses(test, record, where)
    first, last = record.first_sample or 0, record.last_sample
    if last is not None and last <= first:
        raise EmaError(f"{where}: last_sample {last} does not lie behind first_sample {first}; correct one")
    if record.period_samples is not None and record.excitation in WITHOUT_PERIOD:
        raise EmaError(
            f'{where}: excitation = "{record.excitation}" has no period; remove period_samples, or set '
            'excitation = "multisine" or "periodic"'
        )
