"""Sensors whose gain differs between points of impact: a loose mount, another range, a sensor that warms up, or
one that was mounted the other way.

The residues of one mode over points of impact and sensors are the product of two shapes, a matrix of rank one. A sensor
whose gain is another one while one point is struck changes one entry of it, by the same factor in every mode. A fit of
all FRFs mends that with a second mode at the same pole; for mode after mode. Here residues of the plain peaks, each
alone, are held against matrices of low rank, and factors that all peaks share are found and taken out of the FRFs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as variance_ratio

from ema_pipeline.dof import Dof
from ema_pipeline.frf.channels import moved_sensors
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.low_rank import first_right, low_rank, tangent
from ema_pipeline.modal.plain_residues import FALSE_ALARM, FEWEST_PEAKS, PlainResidues
from ema_pipeline.modal.reversals import signs_of, upright

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

MOST_CELLS = 1000
"""FRFs above which nothing is looked for: the strongest sensors of so many would not stand for the rest."""

PRIOR = 0.3
"""Standard deviation of the logarithm of a factor, while all of them are estimated together."""

LARGEST = np.log(20.0)
"""Largest logarithm of a factor: beyond it, the sensor was off."""

LARGEST_STEP = 0.7

MOST_NAMED = 3
"""Changes named one by one."""

WEIGHING_STEPS = 18
"""Steps in which all factors and the weights of the peaks are estimated together."""

RANK_STEPS = (10, 14)
"""Steps after which a peak may turn out to be of two modes."""

FACTOR_STEPS = 6
"""Steps after every factor that is found."""

ALTERNATIONS = 8
"""Alternating least-squares steps from one fit of a peak to the next."""

SECOND_MODE = 3.0
"""Misfit of one mode over that of two above which a peak is of two modes."""

FIRST_SCATTER = 0.1
"""Scatter of all peaks at the start: all peaks count alike until they have shown how well they fit."""

SCATTER_STEP = (0.5, 10.0)
"""Smallest and largest change of the scatter in one step."""

LEAST_SCATTER = 1e-5

KNOWN = 1e-6
"""Information on a factor over the largest below which nothing is known of it."""


@dataclass(frozen=True)
class GainChanges:
    """Gain of every sensor in hits on every point, over its gain in others.

    Attributes
    ----------
    outputs, inputs : tuple of Dof
    factors : ndarray, (n_outputs, n_inputs)
        1 where nothing differs, negative where the sensor was reversed. Which of two gains is the right one cannot be
        known: few factors stand against the majority; where most differ, each sensor and each point of impact has a
        geometric mean of 1.
    std : float
        Largest standard deviation of the logarithm of a factor, from the scatter of what the peaks tell.
    """

    outputs: tuple[Dof, ...]
    inputs: tuple[Dof, ...]
    factors: Real
    std: float

    def taken_out(self, frfs: FrfSet) -> FrfSet:
        """The FRFs as sensors of constant gain would have shown them."""
        factors = self.factors[..., None]
        return replace(frfs, frf=frfs.frf / factors, variance=frfs.variance / factors**2)

    @property
    def note(self) -> str:
        """What was found, and the remedy."""
        size = np.where(self.factors < 0, np.inf, np.abs(np.log(np.abs(self.factors))))
        differ = np.argwhere(size > 0)
        largest = sorted(differ.tolist(), key=lambda cell: -float(size[tuple(cell)]))
        named = "; ".join(self._words(*cell) for cell in largest[:MOST_NAMED])
        more = f"; and {len(differ) - MOST_NAMED} more" if len(differ) > MOST_NAMED else ""
        known = f" (± {100 * self.std:.1g} %)" if self.std else ""
        return (
            f"gains of sensors changed between hits, alike in all modes: {named}{more}{known}. "
            "FRFs were corrected; check how these sensors are mounted, and whether their range was changed"
        )

    def _words(self, output: int, point: int) -> str:
        factor = self.factors[output, point]
        size = abs(factor)
        told = ["is reversed"] if factor < 0 else []
        if size != 1:
            told.append(f"reads {100 * abs(size - 1):.2g} % {'more' if size > 1 else 'less'}")
        return f"{self.outputs[output]} {' and '.join(told)} in hits on {self.inputs[point]}"


@dataclass(frozen=True)
class _Peak:
    """One peak: residues, their variances (0 residue where unknown), and how it is described.

    Attributes
    ----------
    residues : complex ndarray, (n_inputs, n_outputs)
    variance : ndarray, (n_inputs, n_outputs)
    right : complex ndarray, (rank, n_outputs)
        Last estimate of the shapes at the sensors.
    scatter : float
        Standard deviation of residues beyond noise, over their root mean square: what bends under a peak moves all of
        them alike, weak ones by more than they are.
    """

    residues: Complex
    variance: Real
    right: Complex
    scatter: float = FIRST_SCATTER


@dataclass(frozen=True)
class _PeakFit:
    """A peak against given factors: what it tells of their logarithms, as normal equations over the cells."""

    information: Real
    slope: Real
    misfit: float
    degrees: int
    right: Complex

    @property
    def mean_square(self) -> float:
        """Of the misfit over its variance."""
        return self.misfit / max(self.degrees, 1)


def gain_changes(frfs: FrfSet, found: Sequence[PlainResidues]) -> GainChanges | None:
    """Sensors whose gain differs between points of impact; None unless three peaks or more can show it, and do.

    Where sensors rove, only reversed ones are looked for: what they read also differs with the mean direction of the
    hits in their turn, by another factor in every mode, and at points that two of them take by their gains.

    Forward selection: a factor enters where an F-test on all peaks leaves less than `FALSE_ALARM` to chance, over all
    FRFs; the first one without the peak that speaks for it most. Weights of peaks come from a fit of all factors at
    once, so that a peak that no low rank describes has no say.

    Parameters
    ----------
    frfs : FrfSet
        With common poles: aligned where frequencies differ from hit to hit.
    found : sequence of PlainResidues
        Of these FRFs.
    """
    if min(frfs.hits.shape) < 2 or frfs.hits.size > MOST_CELLS or len(found) < FEWEST_PEAKS:
        return None
    signs = signs_of(found)
    if moved_sensors(frfs):
        reversed_ones = GainChanges(frfs.outputs, frfs.inputs, signs.T.astype(float), 0.0)
        return reversed_ones if np.any(signs < 0) else None
    peaks = [_Peak(p.residues, p.variance, first_right(p.residues, 1)) for p in upright(found, signs)]
    cells, logarithms, covariance = _selected(*_weighed(peaks))
    if not cells and np.all(signs > 0):
        return None
    n_outputs, n_inputs = frfs.hits.shape
    full = np.zeros((n_inputs * n_outputs, len(cells)))
    full[cells, np.arange(len(cells))] = 1.0
    if 2 * len(cells) > (n_inputs - 1) * (n_outputs - 1):
        centred = [np.eye(n) - 1 / n for n in (n_inputs, n_outputs)]
        full = np.kron(*centred) @ full
    std = np.sqrt(np.max(np.sum((full @ covariance) * full, axis=1)))
    factors = signs * np.exp(full @ logarithms).reshape(n_inputs, n_outputs)
    return GainChanges(frfs.outputs, frfs.inputs, factors.T, float(std))


def _weighed(peaks: list[_Peak]) -> tuple[list[_Peak], Real]:
    """Peaks with the ranks and the scatters by which they fit factors that they share, and these factors."""
    shape = peaks[0].residues.shape
    logarithms = np.zeros(peaks[0].residues.size)
    for step in range(WEIGHING_STEPS):
        factors = np.exp(logarithms).reshape(shape)
        if step in RANK_STEPS:
            peaks = [_of_two_modes(p, factors) for p in peaks]
        fits = [_fitted(p, factors) for p in peaks]
        information, slope = _sums(fits)
        information += np.eye(len(logarithms)) / PRIOR**2
        logarithms = _moved(logarithms, np.linalg.inv(information) @ (slope - logarithms / PRIOR**2))
        peaks = [_scattered(p, f) for p, f in zip(peaks, fits, strict=True)]
    return peaks, np.exp(logarithms).reshape(shape)


def _of_two_modes(peak: _Peak, factors: Real) -> _Peak:
    """The peak with rank two where that explains what rank one leaves."""
    if len(peak.right) > 1 or min(factors.shape) < 3:
        return peak
    one = replace(peak, scatter=0.0)
    two = replace(one, right=first_right(peak.residues / factors, 2))
    alone, both = _fitted(one, factors), _fitted(two, factors)
    needed = alone.mean_square > SECOND_MODE and alone.mean_square > SECOND_MODE * both.mean_square
    return two if needed and both.degrees > 0 else peak


def _scattered(peak: _Peak, fit: _PeakFit) -> _Peak:
    """The peak with a scatter nearer to what its misfit asks for."""
    scatter = peak.scatter * float(np.clip(np.sqrt(fit.mean_square), *SCATTER_STEP))
    return replace(peak, right=fit.right, scatter=max(scatter, LEAST_SCATTER))


def _fitted(peak: _Peak, factors: Real) -> _PeakFit:
    """The best matrix of the peak's rank under given factors, and the normal equations around it."""
    values = peak.residues / factors
    known = np.isfinite(peak.variance)
    beyond = peak.scatter**2 * np.sum(np.abs(peak.residues) ** 2) / np.count_nonzero(known)
    weight = factors**2 / (peak.variance + beyond)
    left, right = low_rank(values, weight, peak.right, ALTERNATIONS)
    model = left @ right
    root = np.sqrt(weight)
    basis = tangent(left, right, root)
    off = (root * (values - model)).ravel()
    off = off - basis @ (basis.conj().T @ off)
    along = (root * model).ravel()
    inside = basis.conj().T * along
    information = np.diag(np.abs(along) ** 2) - (inside.conj().T @ inside).real
    misfit = 2 * float(np.sum(np.abs(off) ** 2))
    degrees = 2 * (int(np.count_nonzero(known)) - basis.shape[1])
    return _PeakFit(2 * information, 2 * (along.conj() * off).real, misfit, degrees, right)


def _moved(logarithms: Real, step: Real) -> Real:
    return np.clip(logarithms + np.clip(step, -LARGEST_STEP, LARGEST_STEP), -LARGEST, LARGEST)


def _selected(peaks: list[_Peak], all_factors: Real) -> tuple[list[int], Real, Real]:
    """Cells with a factor of their own, the logarithms of these factors, and the covariance of these.

    Parameters
    ----------
    peaks : list of _Peak
    all_factors : ndarray, (n_inputs, n_outputs)
        As they are where every cell has one: what these leave is noise.
    """
    noise = [_fitted(p, all_factors) for p in peaks]
    shape = all_factors.shape
    most = (shape[0] - 1) * (shape[1] - 1)
    cells: list[int] = []
    logarithms = np.zeros(all_factors.size)
    while True:
        for _ in range(FACTOR_STEPS):
            fits = [_fitted(p, np.exp(logarithms).reshape(shape)) for p in peaks]
            peaks = [replace(p, right=f.right) for p, f in zip(peaks, fits, strict=True)]
            information, slope = _sums(fits)
            if not cells:
                break
            step = np.linalg.pinv(information[np.ix_(cells, cells)]) @ slope[cells]
            logarithms[cells] = _moved(logarithms[cells], step)
        cell = _next(fits, noise, cells) if len(cells) < most else None
        if cell is None:
            return cells, logarithms[cells], np.asarray(np.linalg.pinv(information[np.ix_(cells, cells)]))
        cells.append(cell)


def _next(fits: list[_PeakFit], noise: list[_PeakFit], cells: list[int]) -> int | None:
    """The cell whose factor the peaks support best; None where chance may do it.

    The first must hold without the peak that speaks for it most: one peak alone may be of two modes.
    """
    left_out = [()] if cells else [(k,) for k in range(len(fits))]
    chance = np.max([_chance(fits, noise, cells, left) for left in left_out], axis=0)
    chance[cells] = np.inf
    best = int(np.argmin(chance))
    return best if chance[best] < FALSE_ALARM else None


def _chance(fits: list[_PeakFit], noise: list[_PeakFit], cells: list[int], left_out: tuple[int, ...]) -> Real:
    """Probability that noise supports a factor anywhere as well as the peaks that are not left out, (n_cells,)."""
    kept = [k for k in range(len(fits)) if k not in left_out]
    rest = [noise[k] for k in kept]
    information = _sums(rest)[0]
    free = sum(f.degrees for f in rest) - int(np.linalg.matrix_rank(information, hermitian=True))
    if free < 1:
        return np.ones(len(information))
    level = max(sum(f.misfit for f in rest) / free, 1.0)
    gain = _gain([fits[k] for k in kept], cells)
    return np.asarray(len(gain) * variance_ratio.sf(gain / level, 1, free))


def _gain(fits: list[_PeakFit], cells: list[int]) -> Real:
    """Fall of the misfit with one more factor, for every cell, those found re-estimated beside it, (n_cells,)."""
    information, slope = _sums(fits)
    own = np.diag(information).copy()
    least = KNOWN * own.max()
    if cells:
        beside = np.linalg.lstsq(information[np.ix_(cells, cells)], information[cells])[0]
        own -= np.sum(information[cells] * beside, axis=0)
        slope = slope - beside.T @ slope[cells]
    # what the shapes of the modes can follow, or the factors found, is no news
    return np.where(own > least, slope**2 / np.maximum(own, 1e-300), 0.0)


def _sums(fits: list[_PeakFit]) -> tuple[Real, Real]:
    """Normal equations of all peaks: information, (n_cells, n_cells), and slope, (n_cells,)."""
    return np.sum([f.information for f in fits], axis=0), np.sum([f.slope for f in fits], axis=0)
