"""What moves from hit to hit, and where every hit has to be read so that all belong together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.estimate import Shifts
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.drift.follow import FollowedPeak, follow_peak
from ema_pipeline.modal.drift.local import DecayChange, change_in_decay
from ema_pipeline.modal.drift.shifts import Movement, movement
from ema_pipeline.modal.drift.windows import HitKey, Hits, peak_windows, spectra_of_hits
from ema_pipeline.modal.peaks import KnownPeaks

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

FEWEST_HITS = 2

NOTICED = 0.03
"""Movement in half-power half-widths from which hits are aligned: a smaller one widens a peak by less than a
thousandth."""

CLEAR = 3.0
"""Common movement over how well it is known in a hit, from which hits are aligned even where it widens no peak: a fit
that weighs hits by their noise finds each mode where it was when those hits struck that show it best."""

LEAST = 3e-4
"""Movement in half-power half-widths that is left in any case."""

MOVES = 0.05
"""Movement of one peak beyond that of all, in half-power half-widths, from which a fit makes twins of it."""

REACH = 2.0
"""Decay rates within which no second mode is looked for at a peak that one mode makes."""

PLATEAU = 0.4
"""Share of the way to the next peak that moves with a peak: its flanks too must stay where it is."""

FLANKS = 5.0
"""Half-power half-widths of a peak that move with it at most: what lies between distant peaks may be another mode."""

MOST_HITS = 0.6
"""Share of the hits in which a sensor measured that was not moved; a channel may have been rejected in some."""


@dataclass(frozen=True)
class PeakMovement:
    """How the frequency and damping of one mode that makes a peak, alone or with another, differ from hit to hit.

    Attributes
    ----------
    frequency_hz, damping_ratio : float
        That all hits share, as the FRFs show them.
    pole : complex
        That fits all hits best, rad/s, as the FRFs show it: hits that show the peak best count most. What all modes
        share is taken off.
    hits : float
        Number of hits that would tell the pole as well if all showed it alike.
    spread : ndarray, (2,)
        Standard deviations of decay and frequency over hits, rad/s, what all modes share taken off.
    single : bool
        True where one mode alone makes the peak, as far as the hits can tell.
    proven : bool
        True where hits on several points show it.
    shift : ndarray, (n_hits,)
        Relative movement of the frequency in every hit, what is common to all modes included; NaN where a hit
        does not show the peak.
    common : ndarray, (n_hits,)
        The part of it that all modes share.
    shift_std : ndarray, (n_hits,)
        From noise alone.
    force : ndarray, (n_hits,)
        Size of the force peak.
    own_spread : float
        Standard deviation of the movement beyond the common one.
    drift : float
        Common movement of the hits that show the peak best, which the FRFs as measured have in them.
    common_std : float
        How well it is known against rest, widened so that normal intervals of few hits and points hold.
    """

    frequency_hz: float
    damping_ratio: float
    pole: complex
    hits: float
    spread: Real
    single: bool
    proven: bool
    shift: Real
    common: Real
    shift_std: Real
    force: Real
    own_spread: float
    drift: float
    common_std: float


@dataclass(frozen=True)
class Alignment:
    """What had moved, and how hits are brought together.

    Attributes
    ----------
    common_spread : float
        Standard deviation over hits of the factor that all frequencies share.
    common_std : float
        That of its mean over hits, widened so that normal intervals of few hits and points hold.
    n_hits : int
    peaks : tuple of PeakMovement
    shifts : callable or None
        With which FRFs are estimated at common frequencies; None where nothing moves enough to be noticed.
    changes : tuple of DecayChange
        What peaks do within the decay after one hit, where there is but one.
    """

    common_spread: float
    common_std: float
    n_hits: int
    peaks: tuple[PeakMovement, ...]
    shifts: Shifts | None = None
    changes: tuple[DecayChange, ...] = ()

    @property
    def aligned(self) -> bool:
        """True where hits have to be brought together."""
        return self.shifts is not None

    def known_peaks(self) -> KnownPeaks:
        """Peaks that move, and of which hits on several points show that one mode is there.

        Peaks that stay where they are need no such help, and may hide a second mode.
        """
        proven = [p for p in self.peaks if p.proven and p.own_spread > MOVES * p.damping_ratio]
        poles = np.array([p.pole for p in proven], dtype=np.complex128)
        spread = np.array([p.own_spread for p in proven])
        std = np.array([p.spread for p in proven]).reshape(-1, 2)
        return KnownPeaks(poles, REACH * -poles.real + 2 * spread * poles.imag, std)


def align(hits: Hits, frfs: FrfSet, settings: FrfSettings, band_hz: tuple[float, float]) -> Alignment:
    """Estimate what moves from hit to hit.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits.
    frfs : FrfSet
        Of these hits.
    settings : FrfSettings
        With which they were estimated.
    band_hz : tuple of float
        Band in which peaks are looked at.
    """
    nothing = Alignment(0.0, 0.0, int(frfs.hits.max(axis=0, initial=0).sum()), ())
    windows = peak_windows(frfs, band_hz)
    if not windows:
        return nothing
    keys, spectra = spectra_of_hits(hits, frfs, settings, windows)
    spectra = [_of_fixed_sensors(frf) for frf in spectra]
    rest_s = frfs.rest_s
    omega = 2 * np.pi * frfs.frequency_hz
    one_point = len({k.point for k in keys}) == 1
    found = [
        follow_peak(w, frf, omega[w.lines], rest_s, one_point=one_point)
        for w, frf in zip(windows, spectra, strict=True)
    ]
    if len(keys) == 1:
        one = [
            change_in_decay(w, frf[0], complex(p.of_hits[0, 0]), omega[w.lines], rest_s)
            for w, frf, p in zip(windows, spectra, found, strict=True)
            if p is not None and p.shown[0]
        ]
        return replace(nothing, changes=tuple(change for change in one if change is not None))
    peaks = [p for p in found if p is not None and 2 * p.shown.sum() >= len(keys)]
    if len(keys) < FEWEST_HITS or not peaks:
        return nothing
    moved, looked_at = _movements(peaks, keys)
    warps = _warps(looked_at, moved, frfs.frequency_hz)
    if not warps:
        return Alignment(moved.spread, moved.mean_std, len(keys), looked_at)
    by_hit = {key.name: warps[k] for k, key in enumerate(keys)}

    def shift_of(hit: HitSamples) -> Real:
        return by_hit[hit.hit.file, hit.hit.number]

    return Alignment(moved.spread, moved.mean_std, len(keys), looked_at, shift_of)


def _of_fixed_sensors(frf: Complex) -> Complex:
    """What sensors show that measured in most hits, where others were moved between them: all of it without any.

    A sensor that was moved shows more or less of the flanks of other modes at each place, which would seem to move the
    peak.

    Parameters
    ----------
    frf : complex ndarray, (n_hits, n_outputs, n_lines)
    """
    fixed = np.isfinite(frf).all(axis=-1).mean(axis=0) >= MOST_HITS
    return frf[:, fixed] if fixed.any() else frf


def _movements(
    peaks: list[FollowedPeak], keys: tuple[HitKey, ...]
) -> tuple[Movement, tuple[PeakMovement, ...]]:
    """What all peaks have in common, and each mode that makes one by itself; `own` of the first is by mode."""
    size = np.array([np.linalg.norm(p.residues, axis=(1, 2)) for p in peaks]).T
    shift = np.array([p.moved.imag for p in peaks]).T
    std = np.array([p.std for p in peaks]).T
    points = sorted({k.point for k in keys})
    place = np.array([points.index(k.point) for k in keys])
    typical = np.array([np.median(s[np.isfinite(e)]) for s, e in zip(size.T, std.T, strict=True)])
    moved = movement(shift, std, size / np.maximum(typical, 1e-300), place, [p.share for p in peaks])
    force = np.array([k.force for k in keys])
    looked_at, own = [], []
    for c, peak in enumerate(peaks):
        for m, pole in enumerate(peak.poles):
            # hits that show a mode best have a drift of their own on average: it is told at the mean drift of all hits
            power = np.where(peak.shown, np.sum(np.abs(peak.residues[:, :, m]) ** 2, axis=1), 0.0)
            share = power / max(float(power.sum()), 1e-300)
            drift = float(share @ moved.common)
            pole = complex(pole * (1 - drift))
            # own movement is told from the pole: the mean over hits is off where some show another mode's flank
            own.append(moved.own[:, c] - share @ moved.own[:, c])
            own_spread = float(moved.own_spread[c])
            decay = pole.imag * np.sqrt(float(share @ peak.moved.real**2))
            looked_at.append(
                PeakMovement(
                    frequency_hz=abs(pole) / (2 * np.pi),
                    damping_ratio=-pole.real / abs(pole),
                    pole=pole,
                    hits=float(power.sum() ** 2 / max(float(np.sum(power**2)), 1e-300)),
                    spread=np.array([decay, own_spread * pole.imag]),
                    single=len(points) == 1 or peak.single,
                    proven=len(points) > 1 and peak.single,
                    shift=np.where(peak.shown, moved.common + own[-1], np.nan),
                    common=moved.common,
                    shift_std=std[:, c],
                    force=force,
                    own_spread=own_spread,
                    drift=drift,
                    common_std=moved.error.mean_std(share),
                )
            )
    return replace(moved, own=np.array(own).T), tuple(looked_at)


def _warps(looked_at: tuple[PeakMovement, ...], moved: Movement, frequency_hz: Real) -> dict[int, Real]:
    """Shift of every line of every hit; empty where nothing moves enough to be noticed."""
    damping = np.array([p.damping_ratio for p in looked_at])
    clear = moved.spread > CLEAR * float(np.median(moved.common_std))
    least = (LEAST if clear else NOTICED) * float(damping.min())
    common = moved.common if moved.spread > least else np.zeros(len(moved.common))
    alone = np.array(
        [p.single and p.own_spread > NOTICED * p.damping_ratio for p in looked_at], dtype=np.bool_
    )
    if not common.any() and not alone.any():
        return {}
    own = np.where(alone, moved.own, 0.0)
    order = np.argsort([p.frequency_hz for p in looked_at])
    centre = np.array([looked_at[c].frequency_hz for c in order])
    gap = np.diff(centre, prepend=0.0, append=float(frequency_hz[-1]))
    flank = FLANKS * damping[order] * centre
    below, above = np.minimum(PLATEAU * gap[:-1], flank), np.minimum(PLATEAU * gap[1:], flank)
    # between distant peaks lines stay where they are, between near ones they go from one plateau to the next
    rest = np.concatenate([[True], 2 * (above[:-1] + below[1:]) < gap[1:-1], [True]])
    nodes = np.stack([centre - 2 * below, centre - below, centre + above, centre + 2 * above], axis=1)
    used = np.ones(nodes.shape, dtype=np.bool_)
    used[:, 0], used[:, 3] = rest[:-1], rest[1:]
    out = {}
    for h in range(len(common)):
        values = own[h, order][:, None] * [0.0, 1.0, 1.0, 0.0]
        out[h] = common[h] + np.interp(frequency_hz, nodes[used], values[used])
    return out
