"""Sensors that were reversed while some points were struck: mounted again the other way, or with another polarity.

The residues of one mode over points of impact and sensors are a matrix of rank one, in which the product of two entries
on one diagonal of any rectangle is that on the other. One entry of the wrong sign turns the sign of all rectangles that
it is a corner of, in every mode. Shapes of the modes have to be known for none of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.plain_residues import FALSE_ALARM, FEWEST_PEAKS, PlainResidues

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

TRIED = 3
"""Entries that are tried the other way, of those whose rectangles agree least; again after each one that is turned."""

SEEN = 3.0
"""Standard deviations of its residue from which on a peak tells of an entry."""

_ALTERNATIONS = 8


def signs_of(found: Sequence[PlainResidues]) -> Real:
    """Sign of every sensor in hits on every point, (n_inputs, n_outputs): -1 where it is against the majority.

    Parameters
    ----------
    found : sequence of PlainResidues
        Of one set of FRFs.
    """
    signs = np.ones(found[0].residues.shape)
    needed = np.log(signs.size / FALSE_ALARM)
    likelihood = _log_likelihood(upright(found, signs))
    for _ in range(signs.size // 2):
        worst = np.argsort(_agreement(upright(found, signs)), axis=None)[:TRIED]
        trials = [_turned(signs, int(place)) for place in worst]
        after = [_log_likelihood(upright(found, trial)) for trial in trials]
        best = int(np.argmax(after))
        if after[best] - likelihood < needed:
            break
        signs, likelihood = trials[best], after[best]
    return signs


def upright(found: Sequence[PlainResidues], signs: Real) -> list[PlainResidues]:
    """Residues as sensors of these signs would have shown them all upright."""
    return [replace(peak, residues=peak.residues * signs) for peak in found]


def _turned(signs: Real, place: int) -> Real:
    turned = signs.copy()
    turned.flat[place] *= -1
    return turned


def _agreement(found: Sequence[PlainResidues]) -> Real:
    """Mean over the peaks that see an entry of how its rectangles agree, -1 to 1; 1 where too few do."""
    total, seen = np.zeros(found[0].residues.shape), np.zeros(found[0].residues.shape)
    for peak in found:
        clear = np.abs(peak.residues) ** 2 > SEEN**2 * peak.variance
        values = np.where(clear, peak.residues, 0.0)
        around, most = _rectangles(values), _rectangles(np.abs(values).astype(complex))
        total += np.divide(around, most, out=np.zeros_like(total), where=most > 0)
        seen += most > 0
    return np.where(seen >= FEWEST_PEAKS, total / np.maximum(seen, 1), 1.0)


def _rectangles(values: Complex) -> Real:
    """Sum over all rectangles with a corner at each entry: Re r_ij r_kl r*_il r*_kj over k other than i, l than j."""
    other = values.conj()
    size = np.abs(values) ** 2
    everywhere = values * (other @ values.T @ other)
    degenerate = size * (size.sum(axis=1, keepdims=True) + size.sum(axis=0) - size)
    return np.asarray((everywhere - degenerate).real)


def _log_likelihood(found: Sequence[PlainResidues]) -> float:
    """At the scatter that matrices of rank one leave, at least that of noise."""
    total = 0.0
    for peak in found:
        _, _, misfit = peak.rank_one(_ALTERNATIONS)
        noise = float(np.sum(1 / peak.variance > 0))
        total -= max(peak.free, 0) * float(np.log(max(misfit, noise)))
    return total
