"""Noise and nonlinear distortion of a periodic test, separated.

Noise differs from period to period. Distortion repeats with the period and differs from one realisation of the phases
to the next. Where a multisine leaves lines without force, what the response has there is distortion: of even order at
even lines, of odd order at odd ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.ingest.driven import DrivenRecord

_EXCITED = 1e-4
"""Share of the largest power of the force above which a line is excited: a shaker that a nonlinear structure loads
leaves less at lines that should have none."""
_OVER_NOISE = 20.0
"""Power of the force over its noise from which a line is excited; of ten thousand lines of noise none reaches it."""
_FEWEST = 8
"""Excited lines, and lines without force among them, from which orders are told apart."""


@dataclass(frozen=True)
class Distortion:
    """Variances of a FRF, (n_outputs, 1, n_lines); NaN where they are unknown.

    Attributes
    ----------
    noise : ndarray
        Of the mean over all periods and realisations, from the scatter over periods.
    distortion : ndarray
        Of one realisation, by distortion.
    total : ndarray
        Of the mean over all realisations: noise and distortion.
    detected : ndarray, (n_outputs, 2, n_lines)
        Response at lines without force, over the root mean square of the force at lines that have some, SI: odd
        lines, even lines; NaN elsewhere.
    excited : ndarray of bool, (n_lines,)
        Lines at which there is force.

    References
    ----------
    R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed. (2012), sections 3 and 4.
    """

    noise: NDArray[np.float64]
    distortion: NDArray[np.float64]
    total: NDArray[np.float64]
    detected: NDArray[np.float64]
    excited: NDArray[np.bool_]


def distortion(records: Sequence[DrivenRecord], period: int) -> Distortion:
    """Variances of the FRF of one force from records of whole periods, one realisation each.

    Parameters
    ----------
    records : sequence of DrivenRecord
    period : int
        Samples.
    """
    spectra = [_periods(record, period) for record in records]
    powers = np.array([np.abs(f.mean(axis=0)) ** 2 for f, _ in spectra])
    every = np.array([_excited(power, f) for power, (f, _) in zip(powers, spectra, strict=True)])
    excited = np.asarray(every.all(axis=0))
    means, noises, responses = [], [], []
    for f, y in spectra:
        mean_f, mean_y, count = f.mean(axis=0), y.mean(axis=1), f.shape[0]
        safe = np.where(excited & (mean_f != 0), mean_f, 1.0)
        h = np.where(excited, mean_y / safe, np.nan)
        means.append(h)
        responses.append(mean_y)
        if count > 1:
            apart = (y - mean_y[:, None]) - h[:, None] * (f - mean_f)
            power = np.sum(np.abs(apart) ** 2, axis=1) / (count - 1) / count
            noises.append(np.where(excited, power / np.abs(safe) ** 2, np.nan))
    unknown = np.full_like(means[0].real, np.nan)
    m = len(means)
    noise = np.mean(noises, axis=0) if noises else unknown
    total = np.var(means, axis=0, ddof=1) if m > 1 else unknown
    distortion = np.maximum(total - np.nan_to_num(noise), 0.0) if m > 1 else unknown
    mean = total / m if m > 1 else noise
    return Distortion(
        noise=noise[:, None] / m,
        distortion=distortion[:, None],
        total=np.asarray(mean)[:, None],
        detected=_detected(np.sqrt(np.mean(np.abs(responses) ** 2, axis=0)), powers.mean(axis=0), every),
        excited=excited,
    )


def _periods(record: DrivenRecord, period: int) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Spectra of the settled periods: force (n_periods, n_lines), responses (n_outputs, n_periods, n_lines)."""
    skipped = min(-(-record.transient // period), record.n_samples // period - 1)
    f = np.asarray(rfft(record.force.reshape(1, -1, period)[0, skipped:], axis=-1))
    y = np.asarray(rfft(record.responses.reshape(len(record.responses), -1, period)[:, skipped:], axis=-1))
    return f, y


def _excited(power: NDArray[np.float64], periods: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """Lines at which the mean force stands out of its noise, which is what differs from period to period."""
    count = len(periods)
    noise = float(np.median(np.var(periods, axis=0, ddof=1)[1:])) / count if count > 1 else 0.0
    found = power > max(_EXCITED * float(np.max(power[1:])), _OVER_NOISE * noise)
    found[0] = False
    return np.asarray(found)


def _detected(
    size: NDArray[np.float64], force_power: NDArray[np.float64], every: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Response at lines without force between excited ones, over that force, by parity, (n_outputs, 2, n_lines)."""
    found = np.full((len(size), 2, size.shape[1]), np.nan)
    on = np.flatnonzero(every.all(axis=0))
    if len(on) < _FEWEST:
        return found
    lines = np.arange(size.shape[1])
    silent = ~every.any(axis=0) & (lines > on[0]) & (lines < on[-1])
    if np.count_nonzero(silent) < _FEWEST:
        return found
    typical = float(np.sqrt(np.mean(force_power[on])))
    for k, parity in enumerate((1, 0)):
        at = silent & (lines % 2 == parity)
        found[:, k, at] = size[:, at] / typical
    return found
