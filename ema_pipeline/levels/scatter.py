"""How much single hits of one point scatter about smooth curves over their force, and what all modes say of it.

Hits that nothing moves scatter by their noise; an unsteady hand or a loose cable adds to it. One mode of a short
test has few hits to tell how much. All modes of a test together tell what is usual there, and how alike the modes
are; a mode's own scatter is shrunk towards that (empirical Bayes, [1]_).

References
----------
.. [1] G. K. Smyth, "Linear models and empirical Bayes methods for assessing differential expression", Stat. Appl.
   Genet. Mol. Biol. 3(1), 2004.
.. [2] R. C. Paule and J. Mandel, "Consensus values and weighting factors", J. Res. Natl. Bur. Stand. 87, 1982.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, xlogy

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_SHARED = 8.0
"""Degrees of freedom that the scatter of the other modes counts for at most: modes of one structure are alike, not
the same."""

_DOF = np.array([0.5, 1.0, 2.0, 4.0, MOST_SHARED])
_SIZE = np.exp(np.linspace(0.0, np.log(1e4), 41))
"""Values tried for the usual scatter: its degrees of freedom, and its size over the noise (variance), never below 1."""

_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Usual:
    """Scatter that is usual among the modes of a test: its variance over that of the noise, and how many degrees of
    freedom that counts for.
    """

    size: float
    dof: float


NOTHING_USUAL = Usual(1.0, 0.0)


class Scatter:
    """Scatter of one mode's hits about what `terms` of their force describe.

    Parameters
    ----------
    values, variance : ndarray, (n_hits,)
        The quantity, and its variance from noise alone.
    sheet : ndarray of int, (n_hits,)
        Hits of one sheet have a mean of their own.
    terms : tuple of ndarray, (n_hits,)
        Functions of the force.
    shared : bool
        True where all sheets have the same coefficients: so few hits that no sheet can have its own.
    """

    def __init__(
        self, values: Real, variance: Real, sheet: Integers, terms: tuple[Real, ...], shared: bool
    ) -> None:
        self.shared, self._range, self._most = shared, float(np.ptp(values)), float(np.max(variance))
        ones = np.asarray(sheet[:, None] == np.unique(sheet), dtype=float)
        columns = np.column_stack([ones if shared else np.ones(len(values)), *terms])
        blocks = [np.arange(len(values))] if shared else [np.flatnonzero(of) for of in ones.T]
        # of every block; lines of nothing fill them to one length
        self._count, longest = len(values), max(map(len, blocks))
        self._values, self._variance = np.zeros((len(blocks), longest)), np.ones((len(blocks), longest))
        self._columns = np.zeros((len(blocks), longest, columns.shape[1]))
        for k, block in enumerate(blocks):
            self._values[k, : len(block)], self._variance[k, : len(block)] = values[block], variance[block]
            self._columns[k, : len(block)] = columns[block]
        self.noise_only, self.dof = self._chi_square(0.0)

    def extra(self, usual: Usual) -> float:
        """Variance to add to every hit: the one that brings chi-square to where the shrunk scatter puts it.

        Without anything usual this is Paule and Mandel's estimate [2]_; with usual noise of many degrees of freedom
        it is 0.
        """
        shrunk = (usual.dof * usual.size + self.noise_only) / (usual.dof + self.dof)
        if shrunk <= 1.0:
            return 0.0
        from scipy.optimize import brentq  # only where scatter exceeds the noise

        target = self.noise_only / shrunk
        top = self._range**2 + self._most
        while self._chi_square(top)[0] > target:
            top *= 10
        return float(brentq(lambda extra: self._chi_square(extra)[0] - target, 0.0, top, rtol=1e-4))

    def _chi_square(self, extra: float) -> tuple[float, int]:
        """Sum of squares of what the terms leave over, at unit noise, and its degrees of freedom."""
        root = 1.0 / np.sqrt(self._variance + extra)
        values, columns = root * self._values, root[..., None] * self._columns
        size = np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
        basis, strength, _ = np.linalg.svd(columns / size, full_matrices=False)
        kept = strength > _TOLERANCE
        share = np.where(kept, np.einsum("bnk,bn->bk", basis, values), 0.0)
        rest = values - np.einsum("bnk,bk->bn", basis, share)
        return float(np.sum(rest**2)), self._count - int(np.sum(kept))


def usual_scatter(scatters: Iterable[Scatter]) -> Usual:
    """What is usual among many modes: maximum likelihood of scaled F distributions.

    Parameters
    ----------
    scatters : iterable of Scatter
        Of all modes of a test, frequency and damping.

    Returns
    -------
    Usual
        Where some modes scatter much more than others, few degrees of freedom.
    """
    found = list(scatters)
    if not found:
        return NOTHING_USUAL
    size = np.array([max(s.noise_only / s.dof, _TOLERANCE) for s in found])
    dof = np.array([float(s.dof) for s in found])
    best, usual = -np.inf, NOTHING_USUAL
    most = max(float(dof.sum()), float(_DOF[0]))
    for shared in (d for d in _DOF.tolist() if d <= most):
        likelihood = _log_density(size / _SIZE[:, None], dof, shared) - np.log(_SIZE[:, None])
        total = np.sum(likelihood, axis=1)
        k = int(np.argmax(total))
        if total[k] > best:
            best, usual = float(total[k]), Usual(float(_SIZE[k]), shared)
    return usual


def _log_density(ratio: Real, dof: Real, of_divisor: float) -> Real:
    """Logarithm of the density of Fisher's F distribution with `dof` over `of_divisor` degrees of freedom."""
    n, m = dof, of_divisor
    constant = m / 2 * np.log(m) + n / 2 * np.log(n)
    return np.asarray(
        constant + xlogy(n / 2 - 1, ratio) - ((n + m) / 2 * np.log(m + n * ratio) + betaln(n / 2, m / 2))
    )
