"""Modes that the user excludes from the list, or includes from the stabilisation chart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.choices import Choices, ModeChoice
from ema_pipeline.errors import EmaError
from ema_pipeline.modal.left_out import taken_out
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.types import ModalModel

REACH = 0.01
"""Relative distance in frequency within which a mode or a pole is the one that was named."""

SAME = 0.5
"""Decay rates within which a pole of the chart belongs to a mode of the list."""

COLUMN = 0.2
"""Decay rates within which poles of the chart stand in one column."""

STD = 0.3
"""Standard deviation of decay and frequency of an included pole that the fit cannot place, in its decay rate."""

EXCLUDED = "excluded by the user"
INCLUDED = "included by the user"


def nearest_mode(modal: ModalModel, frequency_hz: float) -> int | None:
    """Index of the mode at a frequency; None where none lies within `REACH`."""
    if not modal.modes:
        return None
    distance = [abs(m.frequency_hz - frequency_hz) for m in modal.modes]
    best = int(np.argmin(distance))
    return best if distance[best] <= REACH * frequency_hz else None


def without(modal: ModalModel, excluded: Sequence[ModeChoice]) -> ModalModel:
    """The modes without those that the user excluded; the others stay as they were identified.

    The synthesised FRFs keep the share of excluded modes, which the others were fitted beside.
    """
    gone: list[int] = []
    notes: list[str] = []
    for choice in excluded:
        left = [k for k in range(len(modal.modes)) if k not in gone]
        at = nearest_mode(replace(modal, modes=tuple(modal.modes[k] for k in left)), choice.frequency_hz)
        if at is None:
            notes.append(f"no mode is found near {choice.frequency_hz:.5g} Hz, which the user excluded")
        else:
            gone.append(left[at])
    if not excluded:
        return modal
    dropped = [modal.modes[k] for k in sorted(gone)]
    fewer = taken_out(modal, gone, "mode", EXCLUDED)
    said = (f"the mode at {m.frequency_hz:.5g} Hz is {EXCLUDED}" for m in dropped)
    return replace(fewer, notes=(*fewer.notes, *said, *notes))


def flagged_included(modal: ModalModel, included: Sequence[ModeChoice]) -> ModalModel:
    """The modes with a word on those that the user included."""
    modes = list(modal.modes)
    notes = []
    for choice in included:
        at = nearest_mode(modal, choice.frequency_hz)
        if at is None:
            notes.append(f"the FRFs give no mode at {choice.frequency_hz:.5g} Hz, which the user included")
        else:
            modes[at] = replace(modes[at], flags=(*modes[at].flags, INCLUDED))
    return replace(modal, modes=tuple(modes), notes=(*modal.notes, *notes))


def chosen(modal: ModalModel, choices: Choices) -> ModalModel:
    """The modes as the user wants them."""
    return without(flagged_included(modal, choices.included_modes), choices.excluded_modes)


def wanted(included: Sequence[ModeChoice], decay_rad_s: float) -> KnownPeaks:
    """Poles that the user included, as the FRFs show them.

    Parameters
    ----------
    included : sequence of ModeChoice
    decay_rad_s : float
        Decay of the exponential window, which the FRFs still hold.
    """
    size = 2 * np.pi * np.array([m.frequency_hz for m in included], dtype=float)
    damping = np.array([m.damping_ratio for m in included], dtype=float)
    poles = size * (-damping + 1j * np.sqrt(1 - damping**2)) - decay_rad_s
    return KnownPeaks(poles, -SAME * poles.real, np.repeat(-STD * poles.real[:, None], 2, axis=1))


def pole_of_chart(modal: ModalModel, configuration: str, frequency_hz: float) -> ModeChoice:
    """The mode that a column of the stabilisation chart stands for.

    Stable poles go before others; the column's median stands for it.

    Raises
    ------
    EmaError
        Where there is no chart, no pole within `REACH`, or a mode of the list already.
    """
    chart = modal.chart
    if not chart.order.size:
        raise EmaError(f"{configuration}: there is no stabilisation chart to take a mode from")
    physical = chart.damping_ratio > 0
    near = physical & (np.abs(chart.frequency_hz - frequency_hz) <= REACH * frequency_hz)
    if not near.any():
        others = chart.frequency_hz[chart.stable & physical]
        hint = (
            f"; the nearest is at {others[np.argmin(np.abs(others - frequency_hz))]:.6g} Hz"
            if others.size
            else ""
        )
        raise EmaError(
            f"{configuration}: the stabilisation chart has no pole within {100 * REACH:.0f} % of {frequency_hz:.6g} Hz"
            + hint
        )
    if (near & chart.stable).any():
        near &= chart.stable
    middle = np.flatnonzero(near)[np.argmin(np.abs(chart.frequency_hz[near] - frequency_hz))]
    width = chart.damping_ratio[middle] * chart.frequency_hz[middle]
    column = near & (np.abs(chart.frequency_hz - chart.frequency_hz[middle]) <= COLUMN * width)
    found = ModeChoice(
        configuration,
        float(np.median(chart.frequency_hz[column])),
        float(np.median(chart.damping_ratio[column])),
    )
    for k, mode in enumerate(modal.modes):
        if abs(mode.frequency_hz - found.frequency_hz) <= SAME * mode.damping_ratio * mode.frequency_hz:
            raise EmaError(
                f"{configuration}: mode {k + 1} at {mode.frequency_hz:.6g} Hz represents these poles already"
            )
    return found
