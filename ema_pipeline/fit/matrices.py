"""System matrices as polynomials of the parameters, so that thousands of systems are one matrix product.

Masses, springs and dampers enter the matrices linearly, a stiffness loss as a product of two parameters.
Where
that is so (it is checked, not assumed) the matrices are a + Σ b_i v_i + Σ c_ij v_i v_j; where it is not, the
rig
builds every system itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import Matrices
from ema_pipeline.fit.space import Space
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.types import Rig

_EXACT = 1e-9


class MatrixFamily:
    """The matrices of one configuration over the parameter space.

    Parameters
    ----------
    rig, configuration
    space : Space
    """

    def __init__(self, rig: Rig, configuration: str, space: Space) -> None:
        self.configuration = configuration
        self.space = space
        self._build = lambda v: _flat(rig.system(configuration, dict(zip(space.names, v, strict=True))))
        self.system = rig.system(configuration, space.named(space.point()))
        self.size = len(self.system.dofs)
        self.origin = space.values(space.point())
        steps = np.array(
            [
                _probe(c.kind, c.scale, c.low, c.high, v)
                for c, v in zip(space.coordinates, self.origin, strict=True)
            ]
        )
        self._fit_polynomial(steps)
        self.relevant = self._relevant(steps)
        point = self.origin + 0.3 * steps
        n2 = self.size**2
        self.damped = bool(np.any(self._build(point)[2 * n2 : 4 * n2]))

    def _fit_polynomial(self, steps: NDArray[np.float64]) -> None:
        count = len(steps)
        base = self._build(self.origin)
        slopes = np.array(
            [(self._build(_moved(self.origin, i, steps)) - base) / steps[i] for i in range(count)]
        )
        slopes = slopes.reshape(count, base.size)
        other = self.origin + 0.37 * steps
        other_base = self._build(other)
        scale = np.maximum(np.abs(base), np.abs(other_base)).max(initial=1.0)
        interacting = []
        for i in range(count):
            slope = (self._build(_moved(other, i, steps)) - other_base) / steps[i]
            if np.max(np.abs(slope - slopes[i]) * abs(steps[i]), initial=0.0) > _EXACT * scale:
                interacting.append(i)
        pairs, products = [], []
        for a, i in enumerate(interacting):
            for j in interacting[a + 1 :]:
                both = self._build(_moved(_moved(self.origin, i, steps), j, steps))
                term = (both - base - slopes[i] * steps[i] - slopes[j] * steps[j]) / (steps[i] * steps[j])
                if np.max(np.abs(term)) * abs(steps[i] * steps[j]) > _EXACT * scale:
                    pairs.append((i, j))
                    products.append(term)
        self.pairs = np.array(pairs, dtype=int).reshape(-1, 2)
        self.coefficients = np.vstack([base[None], slopes, np.reshape(products, (-1, base.size))])
        checks = [self.origin + 0.61 * steps * np.cos(np.arange(count) + s) ** 2 for s in (0.0, 1.0)]
        self.polynomial = all(
            np.max(np.abs(self._polynomial(v[None])[0] - self._build(v))) <= 1e3 * _EXACT * scale
            for v in checks
        )

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

    def derivatives(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """d mass/d x and d stiffness/d x at one point, each (n_parameters, n, n)."""
        values, slopes = self.space.values(x), self.space.slopes(x)
        n = self.size
        if self.polynomial:
            by_value = self.coefficients[1 : 1 + len(x)].copy()
            d = values - self.origin
            for (i, j), product in zip(self.pairs, self.coefficients[1 + len(x) :], strict=True):
                by_value[i] += d[j] * product
                by_value[j] += d[i] * product
        else:
            h = 1e-4 * np.where(self.space.high - self.space.low < 1, 0.1, 1.0)
            h = np.where(x + h > self.space.high, -h, h)
            base = self._build(values)
            moved = [self._build(self.space.values(x + h[i] * np.eye(len(x))[i])) for i in range(len(x))]
            by_value = np.array([(m - base) / (h[i] * slopes[i]) for i, m in enumerate(moved)])
        by_x = (by_value * slopes[:, None])[:, : 2 * n * n].reshape(len(x), 2, n, n)
        return by_x[:, 0], by_x[:, 1]


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
