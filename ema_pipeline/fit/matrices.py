"""System matrices as polynomials of the parameters, so that thousands of systems are one matrix product.

Masses, springs and dampers enter the matrices linearly, a stiffness loss as a product of two parameters. Where
that is so (it is checked, not assumed) the matrices are a + Σ b_i v_i + Σ c_ij v_i v_j; where it is not, the rig
builds every system itself.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import Matrices
from ema_pipeline.fit.space import Space
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.types import Rig

_EXACT = 1e-9
_STEP = 1e-4


@dataclass(frozen=True)
class Derivatives:
    """By the coordinates at one point: the matrices (P, n, n) and the modal damping ratio (P,)."""

    mass: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    structural: NDArray[np.float64]
    modal_damping_ratio: NDArray[np.float64]


class MatrixFamily:
    """The matrices of one configuration over the parameter space.

    Parameters
    ----------
    rig, configuration
    space : Space
    poorer : MatrixFamily, optional
        Of a rig that has fewer parameters at the same nominal values: what it knows is not found out again.

    Attributes
    ----------
    coefficients : ndarray, (1 + P + pairs, 4n² + 1)
        Matrices at `origin`, their slopes by the values of the parameters, and products of the `pairs`.
    interacting : ndarray of bool, (P,)
        Parameters whose slope is not the same everywhere.
    polynomial : bool
        Whether the coefficients say it all.
    relevant : ndarray of bool, (P,)
        Parameters that this configuration depends on.
    damped : bool
        Whether there are dampers or loss factors.
    """

    coefficients: NDArray[np.float64]
    pairs: NDArray[np.int64]
    interacting: NDArray[np.bool_]
    polynomial: bool

    def __init__(
        self, rig: Rig, configuration: str, space: Space, poorer: MatrixFamily | None = None
    ) -> None:
        self.configuration = configuration
        self.space = space
        self._rig = rig
        self.system = rig.system(configuration, space.named(space.point()))
        self.size = len(self.system.dofs)
        self.origin = space.values(space.point())
        steps = np.array(
            [
                _probe(c.kind, c.scale, c.low, c.high, v)
                for c, v in zip(space.coordinates, self.origin, strict=True)
            ]
        )
        if poorer is None or not poorer.polynomial or poorer.system.dofs != self.system.dofs:
            self._probe(steps)
        else:
            self._extend(poorer, steps)
        self.relevant = self._relevant(steps)
        n2 = self.size**2
        self.damped = bool(np.any(self._build(self.origin + 0.3 * steps)[2 * n2 : 4 * n2]))

    def over(self, space: Space) -> MatrixFamily:
        """The same matrices over other coordinates of the same parameters, or of some of them.

        Parameters that `space` leaves out stay at their nominal values.
        """
        kept = np.array([self.space.names.index(n) for n in space.names], dtype=int)
        place = {int(k): i for i, k in enumerate(kept)}
        inside = [i for i, (a, b) in enumerate(self.pairs) if int(a) in place and int(b) in place]
        products = 1 + len(self.space.names) + np.array(inside, dtype=int)
        other = copy(self)
        other.space = space
        other.origin = self.origin[kept]
        other.relevant = self.relevant[kept]
        other.interacting = self.interacting[kept]
        other.coefficients = self.coefficients[np.concatenate([[0], 1 + kept, products])]
        other.pairs = np.array([[place[int(v)] for v in self.pairs[i]] for i in inside], dtype=int).reshape(
            -1, 2
        )
        return other

    def _build(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        named = dict(zip(self.space.names, values.tolist(), strict=True))
        return _flat(self._rig.system(self.configuration, named))

    def _probe(self, steps: NDArray[np.float64]) -> None:
        """Find slopes, and products by slopes that change from one point to another."""
        slopes = self._slopes(self.origin, steps)
        elsewhere = self._slopes(self.origin + 0.37 * steps, steps)
        self.interacting = self._differ(slopes, elsewhere, steps)
        self._add_products(slopes, steps)

    def _extend(self, poorer: MatrixFamily, steps: NDArray[np.float64]) -> None:
        """Take over what a poorer model knows; look closer only where the new parameters change it."""
        names, count = list(self.space.names), len(steps)
        old = np.array([names.index(n) for n in poorer.space.names], dtype=int)
        new = np.setdiff1d(np.arange(count), old)
        slopes = np.zeros((count, poorer.coefficients.shape[1]))
        slopes[old] = poorer.coefficients[1 : 1 + old.size]
        slopes[new] = self._slopes(self.origin, steps, new)
        self.interacting = np.zeros(count, dtype=bool)
        self.interacting[old] = poorer.interacting
        self.pairs = old[poorer.pairs]
        base = self._build(self.origin)
        self.coefficients = np.vstack([base[None], slopes, poorer.coefficients[1 + old.size :]])
        self.polynomial = self._holds(steps)
        if not self.polynomial:
            probed = self._slopes(self.origin, steps)
            self.interacting |= self._differ(probed, slopes, steps)
            self.interacting[new] = True
            self._add_products(probed, steps)

    def _slopes(
        self, origin: NDArray[np.float64], steps: NDArray[np.float64], which: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        base = self._build(origin)
        chosen = range(len(steps)) if which is None else which
        found = [(self._build(_moved(origin, i, steps)) - base) / steps[i] for i in chosen]
        return np.array(found).reshape(len(found), base.size)

    def _differ(
        self, a: NDArray[np.float64], b: NDArray[np.float64], steps: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        change = np.abs(a - b) * np.abs(steps)[:, None]
        return np.any(change > _EXACT * self._size(a, steps), axis=1)

    def _size(self, slopes: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Largest entry of the matrix that each entry belongs to: below a share of it all is rounding."""
        largest = np.max(np.abs(slopes) * np.abs(steps)[:, None], axis=0, initial=0.0)
        largest = np.maximum(largest, np.abs(self._build(self.origin)))
        blocks = largest[:-1].reshape(4, -1).max(axis=1)
        return np.append(np.repeat(blocks, self.size**2), largest[-1])

    def _add_products(self, slopes: NDArray[np.float64], steps: NDArray[np.float64]) -> None:
        base, least = self._build(self.origin), _EXACT * self._size(slopes, steps)
        pairs, products = [], []
        for i, j in combinations(np.flatnonzero(self.interacting).tolist(), 2):
            both = self._build(_moved(_moved(self.origin, i, steps), j, steps))
            change = both - base - slopes[i] * steps[i] - slopes[j] * steps[j]
            change[np.abs(change) <= least] = 0.0
            if np.any(change):
                pairs.append((i, j))
                products.append(change / (steps[i] * steps[j]))
        self.pairs = np.array(pairs, dtype=int).reshape(-1, 2)
        self.coefficients = np.vstack([base[None], slopes, np.reshape(products, (-1, base.size))])
        self.polynomial = self._holds(steps)

    def _holds(self, steps: NDArray[np.float64]) -> bool:
        """Is the polynomial what the rig builds, at points that it was not made from?"""
        count = np.arange(len(steps))
        checks = [self.origin + 0.61 * steps * np.cos(count + s) ** 2 for s in (0.0, 1.0)]
        most = 1e3 * _EXACT * self._size(self.coefficients[1 : 1 + len(steps)], steps)
        return all(np.all(np.abs(self._polynomial(v[None])[0] - self._build(v)) <= most) for v in checks)

    def _relevant(self, steps: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Parameters that this configuration depends on."""
        relevant = np.any(self.coefficients[1 : 1 + len(steps)] != 0, axis=1)
        for i, j in self.pairs:
            relevant[[i, j]] = True
        return np.asarray(relevant)

    def _polynomial(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        d = values - self.origin
        ones = np.ones((len(values), 1))
        features = np.hstack([ones, d, d[:, self.pairs[:, 0]] * d[:, self.pairs[:, 1]]])
        return np.asarray(features @ self.coefficients)

    def at(self, x: NDArray[np.float64]) -> Matrices:
        """Matrices at points x, (B, n_parameters)."""
        values = self.space.values(x)
        flat = self._polynomial(values) if self.polynomial else np.array([self._build(v) for v in values])
        n = self.size
        blocks = flat[:, : 4 * n * n].reshape(len(x), 4, n, n)
        return Matrices(blocks[:, 0], blocks[:, 1], blocks[:, 2], blocks[:, 3], flat[:, -1], self.damped)

    def derivatives(self, x: NDArray[np.float64]) -> Derivatives:
        """Derivatives by the coordinates at one point, (P,)."""
        values, slopes = self.space.values(x), self.space.slopes(x)
        by_value = self.coefficients[1 : 1 + len(x)].copy()
        if self.polynomial:
            d = values - self.origin
            for (i, j), product in zip(self.pairs, self.coefficients[1 + len(x) :], strict=True):
                by_value[i] += d[j] * product
                by_value[j] += d[i] * product
        else:
            # The slopes by parameters that do not interact are the same everywhere.
            h = np.where(x + _STEP > self.space.high, -_STEP, _STEP)
            base = self._build(values)
            for i in np.flatnonzero(self.interacting):
                there = self._build(self.space.values(x + np.where(np.arange(len(x)) == i, h, 0.0)))
                by_value[i] = (there - base) / (h[i] * slopes[i])
        n = self.size
        by_x = by_value * slopes[:, None]
        blocks = by_x[:, : 4 * n * n].reshape(len(x), 4, n, n)
        return Derivatives(blocks[:, 0], blocks[:, 1], blocks[:, 2], blocks[:, 3], by_x[:, -1])


def _flat(system: LinearSystem) -> NDArray[np.float64]:
    """All matrices of a system in one row: mass, stiffness, damping, structural, damping ratio."""
    parts = [system.mass, system.stiffness, system.damping, system.structural]
    return np.concatenate([*(p.ravel() for p in parts), [system.modal_damping_ratio]])


def _probe(kind: str, scale: float, low: float, high: float, value: float) -> float:
    """Step, in units of the value, that stays inside the bounds."""
    if kind == "log":
        return 0.3 * value if np.log(1.3 * value) < high else -0.2 * value
    step = scale if kind == "prior" else 0.1 * scale
    origin = 0.0 if kind == "prior" else value / scale
    return step if origin + step / scale <= high else -step


def _moved(values: NDArray[np.float64], index: int, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    out = values.copy()
    out[index] += steps[index]
    return out
