"""Circles held against the modes of another estimator, with a plain word where they disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.circle.modes import circle_fits, seen_in_frfs
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.types import CircleFit, ModalModel, Mode

CLOSE_BANDWIDTHS = 3.0
"""A neighbour within so many half-power bandwidths bends the circle and shortens its arc."""

FEW_LINES = 2.0
"""Half-power bandwidth times record length. The response left at the end of a record is exp(-π) = 4 % of its
start for one line in the half-power band, 0.2 % for two."""

_WIDTHLESS = 1.0
"""1 σ of a circle's damping ratio, over that, from which it says nothing: the fit has ended at a width of zero."""

_DISTORTED = 0.015  # systematic misfit over the radius
_SYSTEMATIC = 0.3  # correlation of the misfit from line to line; white noise gives slightly less than 0
_STRONGLY_DISTORTED = 0.05  # flagged even where frequency and damping agree
_OVER_NOISE = 3.0  # misfit over what the scatter from hit to hit explains


@dataclass(frozen=True)
class CircleAverage:
    """What the circles of one mode say together.

    Attributes
    ----------
    frequency_hz, frequency_std_hz, damping_ratio, damping_std : float
        Medians over FRFs; standard deviations of the medians, from the circles' own or from their scatter,
        whichever is larger.
    """

    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float


def average(circles: Sequence[CircleFit]) -> CircleAverage:
    """Median over the circles of one mode; at least one is needed."""
    frequency, frequency_std = _median(
        [c.natural_frequency_hz for c in circles], [c.natural_frequency_std_hz for c in circles]
    )
    damping, damping_std = _median([c.damping_ratio for c in circles], [c.damping_std for c in circles])
    return CircleAverage(frequency, frequency_std, damping, damping_std)


def average_told(circles: Sequence[CircleFit]) -> CircleAverage | None:
    """The same of those whose damping ratio is not as well zero; None where there are none."""
    telling = [c for c in circles if c.damping_std < _WIDTHLESS * c.damping_ratio]
    return average(telling) if telling else None


def attach_circles(frfs: FrfSet, modal: ModalModel, settings: CircleSettings | None = None) -> ModalModel:
    """Give each mode its circle fits, and a flag where they disagree with it.

    Parameters
    ----------
    frfs : FrfSet
    modal : ModalModel
    settings : CircleSettings, optional

    Returns
    -------
    ModalModel
        The same modes with `circles` set. A mode whose circles differ from it by more than the combined
        standard deviations (and the tolerances of the settings) allow has a flag with the likely reason: a
        close neighbour, too few lines, a distorted circle (nonlinearity), or none that is known.
    """
    settings = settings or CircleSettings()
    fitted = circle_fits(frfs, modal, settings)
    modes = []
    for index, circles in enumerate(fitted):
        mode = replace(modal.modes[index], circles=circles)
        difference = disagreement(mode, settings)
        if circles:
            flag = _flag(frfs, modal, index, circles, difference)
            mode = replace(mode, flags=(*mode.flags, flag) if flag else mode.flags)
        modes.append(mode)
    return replace(modal, modes=tuple(modes))


def disagreement(mode: Mode, settings: CircleSettings) -> str:
    """How a mode differs from its own circles, e.g. ``"damping 1.2 % against 1 %"``; empty if it does not."""
    circle = average_told(mode.circles)
    if circle is None:
        return ""
    half_width = abs(mode.damping_ratio) * mode.frequency_hz
    words = []
    allowed = settings.flag_sigma * _combined(circle.frequency_std_hz, mode.frequency_std_hz)
    allowed += settings.frequency_tolerance * half_width
    if abs(circle.frequency_hz - mode.frequency_hz) > allowed:
        words.append(f"{circle.frequency_hz:.6g} against {mode.frequency_hz:.6g} Hz")
    allowed = settings.flag_sigma * _combined(circle.damping_std, mode.damping_std)
    allowed += settings.damping_tolerance * abs(mode.damping_ratio)
    if abs(circle.damping_ratio - mode.damping_ratio) > allowed:
        words.append(f"damping {100 * circle.damping_ratio:.3g} % against {100 * mode.damping_ratio:.3g} %")
    return ", ".join(words)


def _flag(frfs: FrfSet, modal: ModalModel, index: int, circles: Sequence[CircleFit], difference: str) -> str:
    """The flag of one mode, with the first reason that applies; empty where there is nothing to say."""
    known = _known_reason(frfs, modal, index)
    systematic, size = distortion(circles)
    noise = _noise(frfs, circles)
    beyond_noise = size > _OVER_NOISE * noise if np.isfinite(noise) else systematic > _SYSTEMATIC
    distorted = f"nonlinearity suspected: circle distorted by {100 * size:.2g} % of its radius"
    if difference:
        reason = known or (distorted if beyond_noise and size > _DISTORTED else "unexplained")
        return f"circle fit differs ({difference}): {reason}"
    if not known and np.isfinite(noise) and beyond_noise and size > _STRONGLY_DISTORTED:
        return distorted
    return ""


def _known_reason(frfs: FrfSet, modal: ModalModel, index: int) -> str:
    """What a circle fit cannot be expected to cope with: a close neighbour, or too few lines."""
    seen = [seen_in_frfs(m.pole, frfs.response_decay_rad_s) for m in modal.modes]
    own = seen[index]
    near = [
        other.frequency_hz
        for k, other in enumerate(seen)
        if k != index
        and abs(other.frequency_hz - own.frequency_hz)
        < 2 * CLOSE_BANDWIDTHS * max(own.half_width_hz, other.half_width_hz)
    ]
    if near:
        nearest = min(near, key=lambda f: abs(f - own.frequency_hz))
        return f"close neighbour at {nearest:.5g} Hz"
    lines = 2 * own.half_width_hz * frfs.record_s
    if lines < FEW_LINES:
        return (
            f"leakage: response not decayed within the record, {lines:.2g} lines in the half-power band; "
            "use a longer record"
        )
    return ""


def distortion(circles: Sequence[CircleFit]) -> tuple[float, float]:
    """How systematic and how large the misfit of the circles is.

    Returns
    -------
    correlation : float
        Median over circles of the correlation of the misfit from one line to the next: about 0 for noise,
        towards 1 where the points leave the circle smoothly.
    size : float
        Median root-mean-square misfit over the radius.
    """
    correlations, sizes = [], []
    for circle in circles:
        error = np.abs(circle.points - circle.centre) - circle.radius
        power = float(np.sum(error**2))
        if error.size > 1 and power > 0:
            correlations.append(float(np.sum(error[1:] * error[:-1])) / power)
            sizes.append(float(np.sqrt(power / error.size)) / circle.radius)
    if not sizes:
        return 0.0, 0.0
    return float(np.median(correlations)), float(np.median(sizes))


def _noise(frfs: FrfSet, circles: Sequence[CircleFit]) -> float:
    """Median radial noise over the radius, from the scatter over hits; NaN where that is not known."""
    power = {"acceleration": 1, "velocity": 0, "displacement": -1}
    sizes = []
    for circle in circles:
        o, i = frfs.outputs.index(circle.output), frfs.inputs.index(circle.input)
        lines = np.searchsorted(frfs.frequency_hz, circle.frequency_hz)
        scale = (2 * np.pi * circle.frequency_hz) ** (-2 * power[frfs.quantities[o]])
        sizes.append(float(np.sqrt(np.mean(frfs.variance[o, i, lines] * scale) / 2)) / circle.radius)
    return float(np.median(sizes))


def _median(values: Sequence[float], stds: Sequence[float]) -> tuple[float, float]:
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(np.asarray(values) - middle)))
    # the median of n normal values has √(π/2n) of their standard deviation
    factor = np.sqrt(np.pi / 2 / len(values)) if len(values) > 2 else 1 / np.sqrt(len(values))
    return middle, float(max(np.median(stds), scatter) * factor)


def _combined(*stds: float) -> float:
    return float(np.sqrt(sum(s**2 for s in stds if np.isfinite(s))))
