"""Pole, circles and single hits held against each other: where they disagree, the interval grows to cover them.

The fit of all FRFs weighs hits and lines by what it leaves over. Where a structure is not quite linear, or not quite
the same in all hits, what is left over is no noise, and the pole may go far from what the peak itself shows. Circles
and the poles of single hits look at the peak alone. They are compared with it where no neighbour bends them and enough
lines show the peak.

References
----------
DerSimonian, R. & Laird, N., "Meta-analysis in clinical trials", Controlled Clinical Trials 7, 1986.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.modal.circle.compare import CLOSE_BANDWIDTHS, FEW_LINES, average_told
from ema_pipeline.modal.drift.align import Alignment, PeakMovement
from ema_pipeline.modal.hit_to_hit import peak_of
from ema_pipeline.modal.identify import ANCHORED
from ema_pipeline.modal.types import ModalModel, Mode

SIGMA = 3.0
"""Combined standard deviations past which two estimates disagree."""

FREQUENCY_TOLERANCE = 0.1
"""Difference in half-power half-widths that is always allowed."""

DAMPING_TOLERANCE = 0.1
"""Relative difference in damping that is always allowed: circles are that good."""


@dataclass(frozen=True)
class NamedEstimate:
    """One estimate of a number: its source, value, and standard deviation."""

    source: str
    value: float
    std: float


def pooled(
    modal: ModalModel, alignment: Alignment | None, record_s: float, decay_rad_s: float = 0.0
) -> ModalModel:
    """The modes with intervals that cover what circles and single hits say.

    Parameters
    ----------
    modal : ModalModel
        With circles.
    alignment : Alignment or None
        With the poles of single hits.
    record_s : float
    decay_rad_s : float
        Decay of the exponential window, which the peaks of the alignment still hold.
    """
    modes = []
    for index, mode in enumerate(modal.modes):
        peak = peak_of(mode, alignment, decay_rad_s) if alignment is not None else None
        alone = _stands_alone(modal, index)
        modes.append(_weighed(mode, peak, record_s, decay_rad_s) if alone else mode)
    return replace(modal, modes=tuple(modes))


def _stands_alone(modal: ModalModel, index: int) -> bool:
    """True where no neighbour bends circles and single-mode fits."""
    own = modal.modes[index]
    half = [m.damping_ratio * m.frequency_hz for m in modal.modes]
    return all(
        abs(m.frequency_hz - own.frequency_hz) > 2 * CLOSE_BANDWIDTHS * max(half[k], half[index])
        for k, m in enumerate(modal.modes)
        if k != index
    )


def _weighed(mode: Mode, peak: PeakMovement | None, record_s: float, decay_rad_s: float) -> Mode:
    """One mode against its other estimates."""
    frequencies = [NamedEstimate("all FRFs", mode.frequency_hz, mode.frequency_std_hz)]
    dampings = [NamedEstimate("all FRFs", mode.damping_ratio, mode.damping_std)]
    seen = mode.damping_ratio * mode.frequency_hz + decay_rad_s / (2 * np.pi)
    circle = average_told(mode.circles)
    if circle is not None and 2 * seen * record_s >= FEW_LINES:
        frequencies.append(NamedEstimate("circles", circle.frequency_hz, circle.frequency_std_hz))
        dampings.append(NamedEstimate("circles", circle.damping_ratio, circle.damping_std))
    if peak is not None and ANCHORED not in mode.flags:
        pole = peak.pole + decay_rad_s
        few = float(np.sqrt(peak.hits))
        frequencies.append(
            NamedEstimate("single hits", abs(pole) / (2 * np.pi), peak.spread[1] / (2 * np.pi * few))
        )
        dampings.append(
            NamedEstimate("single hits", -pole.real / abs(pole), peak.spread[0] / (abs(pole) * few))
        )
    half_width = mode.damping_ratio * mode.frequency_hz
    f, f_std, f_text = pool(frequencies, FREQUENCY_TOLERANCE * half_width, "Hz", 1.0)
    z, z_std, z_text = pool(dampings, DAMPING_TOLERANCE * mode.damping_ratio, "%", 100.0)
    if not f_text and not z_text:
        return mode
    texts = "; ".join(t for t in (f_text, z_text) if t)
    pole = 2 * np.pi * f * complex(-z, max(1 - z**2, 0.0) ** 0.5)
    return replace(
        mode,
        frequency_hz=f,
        frequency_std_hz=f_std,
        damping_ratio=z,
        damping_std=z_std,
        pole=pole,
        flags=(*mode.flags, f"estimates disagree, the interval covers them ({texts})"),
    )


def pool(found: list[NamedEstimate], tolerance: float, unit: str, scale: float) -> tuple[float, float, str]:
    """Value, standard deviation and a word on the disagreement; the first estimate where there is none.

    One other estimate alone only widens the interval; two that both contradict the first one move the value too.
    """
    first, others = found[0], found[1:]
    against = [
        w
        for w in others
        if abs(w.value - first.value) > np.hypot(tolerance, SIGMA * np.hypot(w.std, first.std))
    ]
    if not against:
        return first.value, first.std, ""
    said = ", ".join(f"{w.source} {scale * w.value:.5g} {unit}" for w in found)
    if len(against) < 2:
        half = 0.5 * max(abs(w.value - first.value) for w in against)
        return first.value, float(np.hypot(first.std, half)), said
    value, std = _random_effects(found)
    return value, max(std, float(np.std([w.value for w in found], ddof=1))), said


def _random_effects(found: list[NamedEstimate]) -> tuple[float, float]:
    """Mean of estimates that differ by more than their standard deviations, and its standard deviation."""
    value = np.array([w.value for w in found])
    variance = np.maximum(np.array([w.std for w in found]) ** 2, (1e-9 * np.abs(value)) ** 2)
    weight = 1 / variance
    mean = np.sum(weight * value) / np.sum(weight)
    excess = np.sum(weight * (value - mean) ** 2) - (len(value) - 1)
    between = max(excess / (np.sum(weight) - np.sum(weight**2) / np.sum(weight)), 0.0)
    weight = 1 / (variance + between)
    return float(np.sum(weight * value) / np.sum(weight)), float(1 / np.sqrt(np.sum(weight)))
