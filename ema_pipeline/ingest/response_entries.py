"""Checks of a record's entry that several kinds of test share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError

if TYPE_CHECKING:
    from ema_pipeline.ingest.description import RecordDescription, TestDescription


def check_no_sine(record: RecordDescription, where: str) -> None:
    """A record of another kind says nothing of a sine; EmaError otherwise."""
    if record.frequency_hz is not None or record.amplitude_m is not None:
        raise EmaError(f'{where}: frequency_hz and amplitude_m belong to kind = "hysteresis"; remove them')


def check_responses(test: TestDescription, record: RecordDescription, where: str) -> None:
    """Every response channel measures one DOF, and no two the same; EmaError otherwise."""
    taken: dict[str, str] = {}
    for channel in test.responses:
        dof = test.dof_of(channel, record)
        if dof is None:
            raise EmaError(
                f"{where}: response channel '{channel.name}' has no dof; add dof to the channel or "
                f'dofs = {{ {channel.name} = "body.direction" }} to the record'
            )
        if dof.point in taken:
            raise EmaError(
                f"{where}: channels '{taken[dof.point]}' and '{channel.name}' both measure {dof.point}; "
                "correct one dof"
            )
        taken[dof.point] = channel.name
