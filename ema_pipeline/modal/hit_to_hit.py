"""Hits in, modes out: what moves from hit to hit is estimated first, aligned, and then carried by the modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from ema_pipeline.choices import ModeChoice
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.channel_delays import channel_delays
from ema_pipeline.modal.chosen import wanted
from ema_pipeline.modal.data import analysis_band
from ema_pipeline.modal.drift.align import NOTICED, Alignment, PeakMovement, align
from ema_pipeline.modal.drift.local import DecayChange
from ema_pipeline.modal.drift.shifts import wider
from ema_pipeline.modal.drift.windows import Hits
from ema_pipeline.modal.force_zeros import without_zeros
from ema_pipeline.modal.gain_changes import gain_changes
from ema_pipeline.modal.hum_removal import hum_of
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.mains_hum import without_hum
from ema_pipeline.modal.plain_residues import plain_residues
from ema_pipeline.modal.serial import widening
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.stated_window import without_growing
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.processes import release_memory
from ema_pipeline.threads import single_blas_thread

Progress = Callable[[float, str], None]
Real = NDArray[np.float64]

CHANCE = 0.01
"""Probability by chance of a trend with the force that is taken for one."""

FEWEST_HITS = 6
"""Hits without which a trend with the force is not looked for."""

SURE = 3.0
"""Standard deviations from which a change within the decay is believed."""

OVERLAP = 2.0
"""In the sum of the decay rates of two modes: nearer, one is part of what the other's peak shows."""

BROADENING = 0.05
"""Relative error of the decay rate of one pole fitted to a decay whose frequency changes, over the square of the change
as it is measured, in decay rates: from simulated beams whose frequencies rise by 0.1 to 1 %."""

MOST_DECAYS = 2.0
"""Change in decay rates up to which it grows: the width of the peak."""

WORTH_SAYING = 0.5
"""A mode is flagged for its movement where that makes up so much of its standard deviation."""


@dataclass(frozen=True)
class HitModes:
    """Modes identified from hits.

    Attributes
    ----------
    modal : ModalModel
    frfs : FrfSet
        From which they were identified: aligned where hits differ in frequency, without faults of sensors.
    alignment : Alignment
    """

    modal: ModalModel
    frfs: FrfSet
    alignment: Alignment


def identify_hits(
    hits: Hits,
    measured: Callable[[], FrfSet],
    frf_settings: FrfSettings,
    settings: ModalSettings,
    progress: Progress | None = None,
    included: Sequence[ModeChoice] = (),
) -> HitModes:
    """Identify modes from hits whose frequencies may differ from hit to hit.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits, as often as it is called.
    measured : callable
        Gives the FRFs of these hits as measured, so that they need not be kept beside the aligned ones.
    frf_settings : FrfSettings
        With which they were estimated.
    settings : ModalSettings
    progress : callable, optional
    included : sequence of ModeChoice, optional
        Modes that the user wants, whatever the selection says.

    Returns
    -------
    HitModes
        The intervals of frequencies hold their scatter over hits.
    """
    found = _identified(hits, measured, frf_settings, settings, progress, included)
    with single_blas_thread():
        hum = hum_of(found.modal, hits, found.frfs)
    if hum is None:
        return found
    del found
    cleaned = hum.taken_off(hits)

    def without_tones() -> FrfSet:
        return estimate_frfs(cleaned(), frf_settings, coherence=False)

    again = _identified(cleaned, without_tones, frf_settings, settings, progress, included)
    return replace(again, modal=replace(again.modal, notes=(*again.modal.notes, hum.note)))


def _identified(
    hits: Hits,
    measured: Callable[[], FrfSet],
    frf_settings: FrfSettings,
    settings: ModalSettings,
    progress: Progress | None,
    included: Sequence[ModeChoice],
) -> HitModes:
    """The same of hits as they are."""
    frfs = measured()
    with single_blas_thread():
        alignment = align(hits, frfs, frf_settings, analysis_band(frfs, settings))
        if alignment.shifts is not None:
            del frfs
            frfs = estimate_frfs(hits(), frf_settings, alignment.shifts, coherence=False)
        residues = plain_residues(frfs, analysis_band(frfs, settings))
        faults = [
            one for one in (gain_changes(frfs, residues), channel_delays(frfs, residues)) if one is not None
        ]
        for fault in faults:
            frfs = fault.taken_out(frfs)
    release_memory()
    asked = wanted(included, frfs.response_decay_rad_s)
    modal = identify(frfs, settings, progress, alignment.known_peaks(), asked)
    modal = without_growing(without_hum(modal, hits, frfs, asked), frfs)
    modal = without_zeros(modal, hits, frfs, asked)
    decay = frfs.response_decay_rad_s
    if alignment.n_hits == 1:
        modal = within_decay(of_one_hit(modal, settings.repeatability), alignment, decay)
    modal = replace(modal, sensor_notes=tuple(fault.note for fault in faults))
    return HitModes(with_movement(modal, alignment, decay), frfs, alignment)


def of_one_hit(modal: ModalModel, repeatability: float) -> ModalModel:
    """The modes of one hit with intervals that hold what it cannot show.

    Parameters
    ----------
    modal : ModalModel
    repeatability : float
        Relative standard deviation of frequencies from hit to hit.
    """
    if not repeatability:
        return modal
    modes = tuple(
        replace(m, frequency_std_hz=float(np.hypot(m.frequency_std_hz, repeatability * m.frequency_hz)))
        for m in modal.modes
    )
    note = (
        f"one hit cannot show how frequencies differ from hit to hit: {100 * repeatability:.2g} % (1 "
        "sigma) is assumed, modal.identify.repeatability"
    )
    return replace(modal, modes=modes, notes=(*modal.notes, note))


def within_decay(modal: ModalModel, alignment: Alignment, decay_rad_s: float) -> ModalModel:
    """The modes of one hit with intervals that hold what their frequencies do within the decay.

    Parameters
    ----------
    modal : ModalModel
    alignment : Alignment
    decay_rad_s : float
        Decay of the exponential window, which the peaks still hold.
    """
    poles = np.array([m.pole - decay_rad_s for m in modal.modes])
    changes = [_change_of(poles, k, alignment) for k in range(len(poles))]
    modes = []
    for k, mode in enumerate(modal.modes):
        change = changes[k]
        if change is not None:
            modes.append(_changing(mode, change, abs(poles[k])))
            continue
        doubtful = [
            (other, c)
            for other, c, near in zip(modal.modes, changes, _overlaps(poles, k), strict=True)
            if c is not None and near and not c.single
        ]
        modes.append(_beside(mode, *max(doubtful, key=lambda pair: pair[1].width)) if doubtful else mode)
    return replace(modal, modes=tuple(modes))


def _overlaps(poles: NDArray[np.complex128], k: int) -> NDArray[np.bool_]:
    """True for modes that are part of what the peak of mode `k` shows, (n_modes,)."""
    reach = -OVERLAP * (poles.real + poles.real[k])
    return np.asarray((np.abs(poles - poles[k]) < reach) & (np.arange(len(poles)) != k))


def _change_of(poles: NDArray[np.complex128], k: int, alignment: Alignment) -> DecayChange | None:
    """What the frequency of a mode does within the decay; None where nothing is sure."""
    seen = poles[k]
    near = [c for c in alignment.changes if abs(c.pole - seen) < -seen.real]
    change = min(near, key=lambda c: abs(c.pole - seen), default=None)
    sure = change is not None and abs(change.change) > max(SURE * change.std, NOTICED * -seen.real)
    return change if sure else None


def _changing(mode: Mode, change: DecayChange, size: float) -> Mode:
    """A mode whose frequency changes within the decay; as for modes that move with the force, no one value holds."""
    moved = 0.5 * min(abs(change.change), change.width) / (2 * np.pi)
    broader = BROADENING * min(abs(2 * change.change / change.width), MOST_DECAYS) ** 2
    return replace(
        mode,
        frequency_std_hz=float(np.hypot(mode.frequency_std_hz, moved)),
        damping_std=float(np.hypot(mode.damping_std, broader * mode.damping_ratio)),
        flags=(*mode.flags, _decay_words(change, size)),
    )


def _beside(mode: Mode, other: Mode, change: DecayChange) -> Mode:
    """A mode in the flank of one whose decay no single pole describes: what the fit leaves of that one bends it."""
    moved = 0.5 * change.width / (2 * np.pi)
    words = f"lies in the flank of the mode at {other.frequency_hz:.5g} Hz, whose decay one mode does not describe"
    return replace(
        mode,
        frequency_std_hz=float(np.hypot(mode.frequency_std_hz, moved)),
        damping_std=float(np.hypot(mode.damping_std, BROADENING * MOST_DECAYS**2 * mode.damping_ratio)),
        flags=(*mode.flags, words),
    )


def _decay_words(change: DecayChange, size: float) -> str:
    if not change.single:
        return "one mode does not describe its decay: another lies under the peak, or the structure is far from linear"
    way = "falls" if change.change > 0 else "rises"
    return f"moves within the decay: {way} by {100 * abs(change.change) / size:.2g} % as it gets weaker"


def with_movement(modal: ModalModel, alignment: Alignment, decay_rad_s: float = 0.0) -> ModalModel:
    """The modes with intervals that hold the scatter over hits, and with a word where a mode moves.

    Parameters
    ----------
    modal : ModalModel
    alignment : Alignment
    decay_rad_s : float
        Decay of the exponential window, which the peaks still hold.
    """
    if not alignment.peaks:
        return modal
    modes = tuple(_moving(m, alignment, decay_rad_s) for m in modal.modes)
    note = _common_note(alignment)
    return replace(modal, modes=modes, notes=(*modal.notes, *([note] if note else [])))


def _moving(mode: Mode, alignment: Alignment, decay_rad_s: float) -> Mode:
    peak = peak_of(mode, alignment, decay_rad_s)
    n = alignment.n_hits
    own = peak.own_spread if peak is not None and peak.single else 0.0
    # drift was taken off each hit, as well as it is known; its own movement a mode shows in strong hits above all
    of_own = _mean_std(own, peak.hits, peak.shift - peak.common) if peak is not None else 0.0
    common = alignment.common_std
    if peak is not None:
        common = float(np.hypot(peak.common_std, 0.0 if alignment.aligned else peak.drift))
    mean_std = float(np.hypot(common, of_own * _of_few(n)))
    trend = _with_force(peak) if peak is not None and own > 0 else 0.0
    if trend:
        # a mode that moves with the force has no one frequency: the interval holds what it moves by
        mean_std = float(np.hypot(mean_std, own))
    added = mode.frequency_hz * mean_std
    std = float(np.hypot(mode.frequency_std_hz, added))
    flags = mode.flags
    worth = bool(trend) or added > WORTH_SAYING * std
    if peak is not None and own > NOTICED * peak.damping_ratio and worth:
        flags = (*flags, _words(own, trend))
    return replace(mode, frequency_std_hz=std, flags=flags)


def _mean_std(spread: float, hits: float, moved: Real) -> float:
    """Standard deviation of a mean over so many hits: hits that follow one another may have moved alike."""
    return spread / float(np.sqrt(hits)) * widening(moved[np.isfinite(moved)])


def peak_of(mode: Mode, alignment: Alignment, decay_rad_s: float) -> PeakMovement | None:
    """The peak that a mode makes, None where it makes none that was looked at."""
    seen = mode.pole - decay_rad_s
    near = [p for p in alignment.peaks if abs(p.pole.imag - seen.imag) < -(p.pole.real + seen.real)]
    return min(near, key=lambda p: abs(p.pole - seen), default=None)


def _with_force(peak: PeakMovement) -> float:
    """Relative movement from the softest to the hardest third of the hits; 0 where it is no trend."""
    moved = peak.shift - peak.common
    shown = np.isfinite(moved)
    if np.count_nonzero(shown) < FEWEST_HITS or np.ptp(peak.force[shown]) == 0:
        return 0.0
    force, moved = peak.force[shown], moved[shown]
    if _by_chance(force, moved) > CHANCE:
        return 0.0
    low, high = np.quantile(force, [1 / 3, 2 / 3])
    return float(moved[force >= high].mean() - moved[force <= low].mean())


def _by_chance(a: Real, b: Real) -> float:
    """Probability by chance of as large a rank correlation (Spearman's) of two samples; NaN if one is constant."""
    ranked = [
        np.searchsorted(np.sort(x), x, "left") + np.searchsorted(np.sort(x), x, "right") for x in (a, b)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.corrcoef(ranked)[0, 1]
        t = r * np.sqrt(max((len(a) - 2) / ((1 + r) * (1 - r)), 0.0))
    return 2 * float(stdtr(len(a) - 2, -abs(t)))


def _of_few(n_hits: int) -> float:
    """How much wider than a normal one the interval of a mean of few values is.

    The spread is one of maximum likelihood, which leaves out that the mean was estimated too.
    """
    free = max(n_hits - 1, 1)
    return float(np.sqrt(n_hits / free)) * wider(free)


def _words(spread: float, trend: float) -> str:
    if trend:
        way = "falls" if trend < 0 else "rises"
        return f"moves with the force: {way} by {100 * abs(trend):.2g} % from soft to hard hits"
    return f"moves by {100 * spread:.2g} % (1 sigma) from hit to hit"


def _common_note(alignment: Alignment) -> str:
    damping = min(p.damping_ratio for p in alignment.peaks)
    if alignment.common_spread <= NOTICED * damping:
        return ""
    return (
        f"all frequencies move together by {100 * alignment.common_spread:.2g} % (1 sigma) from hit to "
        "hit: hits were aligned, and the intervals of frequencies include it"
    )
