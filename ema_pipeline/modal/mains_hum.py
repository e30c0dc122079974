"""Mains hum in the records, which a fit follows with poles: told from modes by what single hits show.

Hum is there before the blow, does not decay, and has another phase in every hit; a mode begins with the blow, decays,
and answers all hits on a point alike. FRFs averaged over hits hide this: hum of changing phase makes a peak that seems
to decay within the record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.channel_checks import HUM_HZ
from ema_pipeline.modal.basis import pole_values
from ema_pipeline.modal.drift.windows import Hits
from ema_pipeline.modal.left_out import taken_out_and_named
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.types import ModalModel, Mode

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

HARMONICS = 13
"""Multiples of the mains' frequency looked at: those beyond are weak, and soon as dense as what the mains drifts by."""

MAINS_DRIFT = 1e-3
"""Relative: ±0.05 Hz, within which grids are held."""

FEWEST_TONES, MOST_TONES = 9, 129
"""Frequencies of the mains tried in every hit."""

TONE_STEP = 0.025
"""Periods over the record by which these differ: a tone that is not quite met leaves what looks like a mode."""

TRACE = 1e-6
"""Share by which tones decay over the record."""

REACH, FEWEST_LINES, MOST_LINES = 4.0, 8, 60
"""Lines looked at on either side: in decay rates of the mode, and at least and at most."""

MAX_OUTPUTS = 16
"""Responses looked at, those that show the mode best."""

NEEDED = 4.0
"""Power of a tone, or of a mode, beside the other, over that of noise, from which single hits need it."""

MINOR = 0.05
"""Share of the tone's own power below which what is left for a mode may be a tone that is no pure one."""

COHERENT = 0.5
"""Share of a mode's power that all hits on a point have in common: about 1 of a mode, 0 of hum."""

GOES_ON = 0.3
"""Share of a mode left at the end of the record above which it may be a tone where hits do not tell: noise makes tones
seem to decay."""

WIDEST_LINES = 6.0
"""Lines from a multiple of the mains' frequency within which a broad peak may be hum: the half-width of a mode of 12 %
damping reaches one from anywhere."""

REASON = "single hits show a tone at a multiple of the mains' frequency, not a decay after the blow: hum"


@dataclass(frozen=True)
class _Candidate:
    """A mode beside a multiple of the mains' frequency, and where the hits are read for it.

    Attributes
    ----------
    index : int
        Of the mode.
    tone_hz : float
    lines : slice
    outputs : tuple of str
        Points of the sensors that show it best.
    neighbours : complex ndarray
        Poles of other modes that reach into the lines.
    """

    index: int
    tone_hz: float
    lines: slice
    outputs: tuple[str, ...]
    neighbours: Complex


@dataclass(frozen=True)
class _HitLines:
    """What one hit shows of a candidate: responses (n_outputs, n_lines), NaN where not measured; force at the mode."""

    responses: Complex
    force: complex
    point: str
    delay_s: float
    window_rad_s: float


@dataclass(frozen=True)
class _Evidence:
    """Powers over that of noise: of the tone beside the mode, of the mode beside the tone; the mode's coherence."""

    tone: float
    mode: float
    coherence: float


def without_hum(modal: ModalModel, hits: Hits, frfs: FrfSet, wanted: KnownPeaks) -> ModalModel:
    """The modes without those that are mains hum, which are named among what is left out.

    Parameters
    ----------
    modal : ModalModel
    hits : callable
        Gives the accepted hits, as they were recorded.
    frfs : FrfSet
        Of these hits.
    wanted : KnownPeaks
        Modes that the user asked for, which stay.
    """
    rest_s = frfs.rest_s
    looked_at = [
        candidate
        for k, mode in enumerate(modal.modes)
        if not wanted.hold(mode.pole) and (candidate := _candidate(modal, k, frfs, rest_s)) is not None
    ]
    if not looked_at:
        return modal
    shown = _read(looked_at, hits, frfs)
    gone = [
        c.index
        for c, lines in zip(looked_at, shown, strict=True)
        if _is_hum(modal.modes[c.index], c, lines, frfs, rest_s)
    ]
    if not gone:
        return modal
    return taken_out_and_named(modal, gone, "a tone", REASON)


def _tone(frequency_hz: float, reach_hz: float) -> float:
    """Multiple of 50 or 60 Hz within reach; NaN without one."""
    near = [m * round(frequency_hz / m) for m in HUM_HZ if 1 <= round(frequency_hz / m) <= HARMONICS]
    tone = min(near, key=lambda t: abs(t - frequency_hz), default=np.nan)
    return tone if abs(tone - frequency_hz) < reach_hz else np.nan


def _at_mains(mode: Mode, rest_s: float) -> bool:
    """True at a multiple of the mains' frequency: within its drift or half a line, the width of a tone cut off."""
    return bool(np.isfinite(_tone(mode.frequency_hz, max(MAINS_DRIFT * mode.frequency_hz, 0.5 / rest_s))))


def _candidate(modal: ModalModel, index: int, frfs: FrfSet, rest_s: float) -> _Candidate | None:
    mode = modal.modes[index]
    # hum whose phases differ makes as broad a peak as it seems to decay
    half_width = -mode.pole.real / (2 * np.pi)
    broad = min(half_width, WIDEST_LINES / rest_s)
    tone = _tone(mode.frequency_hz, max(MAINS_DRIFT * mode.frequency_hz, 0.5 / rest_s, broad))
    if not np.isfinite(tone):
        return None
    step = float(frfs.frequency_hz[1])
    half = int(np.clip(REACH * half_width / step, FEWEST_LINES, MOST_LINES))
    centre = round(mode.pole.imag / (2 * np.pi * step))
    lines = slice(max(1, centre - half), min(len(frfs.frequency_hz), centre + half + 1))
    size = {d.point: float(np.nan_to_num(abs(s))) for d, s in zip(modal.dofs, mode.shape, strict=True)}
    outputs = sorted((d.point for d in frfs.outputs), key=lambda p: -size.get(p, 0.0))[:MAX_OUTPUTS]
    neighbours = [
        m.pole
        for k, m in enumerate(modal.modes)
        if k != index and abs(m.pole - mode.pole) < 4 * np.pi * half * step and not _at_mains(m, rest_s)
    ]
    return _Candidate(index, tone, lines, tuple(outputs), np.array(neighbours, dtype=np.complex128))


def _read(candidates: list[_Candidate], hits: Hits, frfs: FrfSet) -> list[list[_HitLines]]:
    """What every hit shows of every candidate, without the windows of the FRFs."""
    out: list[list[_HitLines]] = [[] for _ in candidates]
    for hit in hits():
        force = np.asarray(rfft(hit.force)) * hit.hit.impact.sign
        delay = (hit.hit.peak - hit.hit.start) / hit.sample_rate_hz
        place = {channel.dof.point: row for row, channel in enumerate(hit.channels)}
        read: dict[str, Complex] = {}
        for found, c in zip(out, candidates, strict=True):
            responses = np.full((len(c.outputs), c.lines.stop - c.lines.start), np.nan, dtype=np.complex128)
            for k, point in enumerate(c.outputs):
                if point not in place:
                    continue
                if point not in read:
                    row = place[point]
                    samples = np.asarray(hit.responses[row : row + 1])[0]
                    read[point] = hit.channels[row].dof.sign * np.asarray(rfft(samples))
                responses[k] = read[point][c.lines]
            middle = (c.lines.start + c.lines.stop) // 2
            found.append(
                _HitLines(
                    responses, complex(force[middle]), hit.hit.impact.point, delay, hit.window_decay_rad_s
                )
            )
    return out


def _is_hum(mode: Mode, candidate: _Candidate, shown: list[_HitLines], frfs: FrfSet, rest_s: float) -> bool:
    found = _evidence(mode, candidate, shown, frfs)
    if found.tone >= NEEDED or found.mode >= NEEDED:
        return found.tone >= NEEDED and found.mode < max(NEEDED, MINOR * found.tone)
    if np.isfinite(found.coherence):
        return found.coherence < COHERENT
    return _at_mains(mode, rest_s) and bool(np.exp(mode.pole.real * rest_s) >= GOES_ON)


def _evidence(mode: Mode, candidate: _Candidate, shown: list[_HitLines], frfs: FrfSet) -> _Evidence:
    """Compare a tone of free size and phase in every hit with a decay of free size and phase."""
    omega = 2 * np.pi * frfs.frequency_hz[candidate.lines]
    size = np.sqrt(np.nanmean([np.abs(hit.responses) ** 2 for hit in shown], axis=(0, 2)))
    left: dict[str, list[Real]] = {"tone": [], "mode": [], "both": []}
    sizes = []
    free = 0
    for hit in shown:
        background, decay, tones = _columns(mode, candidate, hit, omega, frfs.record_s)
        values = (hit.responses / size[:, None]).T
        known = np.isfinite(values).all(axis=0)
        values = np.where(known, values, 0.0)
        with_tone = [(_left(np.column_stack([background, tone]), values), tone) for tone in tones]
        rest, tone = min(with_tone, key=lambda pair: float(pair[0].sum()))
        left["tone"].append(np.where(known, rest, np.nan))
        with_mode = np.column_stack([background, decay])
        left["mode"].append(np.where(known, _left(with_mode, values), np.nan))
        both = np.column_stack([with_mode, tone])
        left["both"].append(np.where(known, _left(both, values), np.nan))
        free = len(omega) - both.shape[1]
        amplitude = np.linalg.lstsq(with_mode, values, rcond=None)[0][-1]
        sizes.append(np.where(known, amplitude / hit.force, np.nan))
    noise = np.nanmean(left["both"], axis=0) / max(free, 1)
    noise = np.maximum(noise, 1e-20)
    beside_mode = np.nanmean(np.array(left["mode"]) - np.array(left["both"]), axis=0) / noise
    beside_tone = np.nanmean(np.array(left["tone"]) - np.array(left["both"]), axis=0) / noise
    # one sensor in which the tone, or the mode, stands out shows it; the others need not
    best = int(np.nanargmax(np.maximum(beside_mode, beside_tone)))
    return _Evidence(
        float(beside_mode[best]),
        float(beside_tone[best]),
        _coherence(np.array(sizes), [hit.point for hit in shown]),
    )


def _columns(
    mode: Mode, candidate: _Candidate, hit: _HitLines, omega: Real, record_s: float
) -> tuple[Complex, Complex, list[Complex]]:
    """Background (n_lines, n_columns), a decay from the blow on, and tones that last for the whole record."""
    poles = np.array([*candidate.neighbours, mode.pole], dtype=np.complex128) - hit.window_rad_s
    blow = np.exp(-1j * omega * hit.delay_s)
    decays = blow * pole_values(omega, poles, record_s - hit.delay_s)
    tones = tone_poles(candidate.tone_hz, drifts(candidate.tone_hz, record_s), record_s, hit.window_rad_s)
    background = np.column_stack([slow(omega, hit.delay_s), *decays[:-1]])
    return background, decays[-1], list(pole_values(omega, tones, record_s))


def slow(omega: Real, delay_s: float) -> Complex:
    """What all that lies far away adds to a few lines, from the blow on, (n_lines, 3)."""
    x = (omega - omega.mean()) / (omega[-1] - omega[0])
    return np.asarray(np.exp(-1j * omega * delay_s)[:, None] * x[:, None] ** np.arange(3))


def drifts(tone_hz: float, record_s: float) -> Real:
    """Relative differences of the mains' frequency from its nominal one that are tried."""
    wanted = np.ceil(2 * MAINS_DRIFT * tone_hz * record_s / TONE_STEP)
    return MAINS_DRIFT * np.linspace(-1, 1, int(np.clip(wanted, FEWEST_TONES, MOST_TONES)))


def tone_poles(tone_hz: float, drift: Real, record_s: float, window_rad_s: float) -> Complex:
    """Poles of tones, rad/s, with a trace of decay, since the transform of a tone right on a line is a limit."""
    return np.asarray(2j * np.pi * tone_hz * (1 + drift) - window_rad_s - TRACE / record_s)


def _left(columns: Complex, values: Complex) -> Real:
    """Power that least squares leaves of each column of values."""
    basis, _ = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))
    rest = values - basis @ (basis.conj().T @ values)
    return np.asarray(np.sum(np.abs(rest) ** 2, axis=0))


def _coherence(sizes: Complex, points: list[str]) -> float:
    """Share of a mode's power that hits on a point have in common, without bias; NaN where no point was hit twice.

    Parameters
    ----------
    sizes : complex ndarray, (n_hits, n_outputs)
        Response over force in every hit; NaN where not measured.
    points : list of str
        Where each hit struck.
    """
    shared, power = 0.0, 0.0
    for point in set(points):
        here = sizes[[p == point for p in points]]
        n = np.isfinite(here).sum(axis=0)
        squares = np.nansum(np.abs(here) ** 2, axis=0)
        both = np.abs(np.nansum(here, axis=0)) ** 2 - squares
        twice = n > 1
        shared += float(np.sum(both[twice] / (n[twice] - 1)))
        power += float(np.sum(squares[twice]))
    return shared / power if power > 0 else np.nan
