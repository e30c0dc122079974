"""What the charts and the FRFs show and the list of modes lacks: named, each with its reason."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.fit import Estimate
from ema_pipeline.modal.mode_acceptance import PLAIN_DAMPING
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.pole_tracks import link
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.types import LeftOut, ModalModel

STABLE = 0.8
"""Share of model orders from which a column of poles is named where it has no mode."""

NEAR = 2.0
"""Distance from a mode, in the larger of the decay rates, within which a column follows that mode."""

MOST = 8
"""Sentences at most; the frequencies of further ones share one."""

NO_PEAK_MODE = "a clear peak of the FRFs, but the FRFs do not need it once the other modes are fitted"
NO_COLUMN_MODE = "the fit of all FRFs drops it: noise, or the residual of other modes, explains it as well"


def left_out(
    charts: Sequence[PoleSet], plain: KnownPeaks, estimate: Estimate, decay_rad_s: float
) -> tuple[LeftOut, ...]:
    """Peaks and stable columns without a mode.

    Parameters
    ----------
    charts : sequence of PoleSet
        Poles of all orders of each sub-band, of its core only.
    plain : KnownPeaks
    estimate : Estimate
        The modes.
    decay_rad_s : float
        Decay of the exponential window, which all poles still hold.
    """
    found = [_entry(complex(p), decay_rad_s, "peak", NO_PEAK_MODE) for p in plain.absent(estimate).poles]
    columns = []
    for chart in charts:
        tracks = link(chart)
        for index, share in zip(tracks.representative, tracks.votes, strict=True):
            pole = complex(chart.pole[index])
            if (
                share >= STABLE
                and chart.damping_ratio[index] < PLAIN_DAMPING
                and _alone(pole, estimate.poles)
            ):
                columns.append((share, pole))
    for share, pole in sorted(columns, key=lambda c: -c[0]):
        evidence = f"stable in {100 * min(share, 1.0):.0f} % of the model orders"
        found.append(_entry(pole, decay_rad_s, evidence, NO_COLUMN_MODE))
    return tuple(sorted(found, key=lambda entry: entry.frequency_hz))


def taken_out(modal: ModalModel, gone: Collection[int], evidence: str, reason: str) -> ModalModel:
    """The modes without some of them, which are named among what is left out.

    Parameters
    ----------
    modal : ModalModel
    gone : collection of int
        Places of the modes in the list.
    evidence, reason : str
        As in `LeftOut`.
    """
    kept = [k for k in range(len(modal.modes)) if k not in gone]
    place = np.full(len(modal.modes) + 1, -1, dtype=np.int64)  # the last entry stands for poles of no mode
    place[kept] = np.arange(len(kept))
    named = [
        LeftOut(m.frequency_hz, m.damping_ratio, evidence, reason)
        for m in (modal.modes[k] for k in sorted(gone))
    ]
    return replace(
        modal,
        modes=tuple(modal.modes[k] for k in kept),
        chart=replace(modal.chart, selected=place[modal.chart.selected]),
        left_out=tuple(sorted((*modal.left_out, *named), key=lambda entry: entry.frequency_hz)),
    )


def taken_out_and_named(modal: ModalModel, gone: Collection[int], evidence: str, reason: str) -> ModalModel:
    """`taken_out`, with a sentence on each of them among the notes."""
    fewer = taken_out(modal, gone, evidence, reason)
    named = tuple(entry for entry in fewer.left_out if entry.reason == reason)
    return replace(fewer, notes=(*fewer.notes, *sentences(named)))


def sentences(entries: tuple[LeftOut, ...]) -> list[str]:
    """One sentence on each of the first few, and one on the others."""
    told = [f"{e.frequency_hz:.5g} Hz ({e.evidence}) has no mode: {e.reason}" for e in entries[:MOST]]
    further = ", ".join(f"{e.frequency_hz:.5g}" for e in entries[MOST:])
    return [*told, f"no modes either at {further} Hz, for like reasons"] if further else told


def _alone(pole: complex, modes: NDArray[np.complex128]) -> bool:
    reach = NEAR * np.maximum(-modes.real, -pole.real)
    return bool(np.all(np.abs(modes - pole) > reach))


def _entry(pole: complex, decay: float, evidence: str, reason: str) -> LeftOut:
    physical = pole + decay
    size = abs(physical)
    return LeftOut(size / (2 * np.pi), -physical.real / size, evidence, reason)
