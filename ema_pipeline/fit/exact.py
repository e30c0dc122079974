"""Gauss-Newton terms of the residuals of paired modes; see `ema_pipeline.correlate.residuals`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import mode_residuals, observable_modes
from ema_pipeline.fit.evidence import Dataset

_STEP = 1e-4


class ExactObjective:
    """Cost of every measured mode of all configurations with fixed pairs.

    Parameters
    ----------
    evidence : sequence of Dataset
    pairs : sequence of ndarray, (R,)
        Per configuration the model mode of each measured mode, -1 where it has none.
    mixing : float
        See `ema_pipeline.correlate.residuals`.
    """

    def __init__(
        self, evidence: Sequence[Dataset], pairs: Sequence[NDArray[np.int64]], mixing: float
    ) -> None:
        self.evidence = evidence
        self.pairs = pairs
        self.mixing = mixing
        self.paired = np.concatenate([p >= 0 for p in pairs])

    def residuals(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Residuals in units of the standard uncertainty, per configuration (B, R, m), at points (B, P).

        Columns: frequency, damping ratio, shape (real and imaginary parts), mixing; 0 for modes without
        partner.
        """
        return [
            mode_residuals(e, p, observable_modes(e.family.at(x)), self.mixing)
            for e, p in zip(self.evidence, self.pairs, strict=True)
        ]

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,); infinite where the mode has no partner."""
        squares = np.concatenate([np.sum(r[0] ** 2, axis=1) for r in self.residuals(x[None])])
        return np.where(self.paired, squares, np.inf)

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """JᵀJ, (P, P), and Jᵀr, (P,), with `weight` (R,) on each mode; Jacobian by forward differences.

        A step of 1e-4 tolerances leaves an error of about 1e-6 of the Jacobian, at half the price of central ones.
        """
        count = x.size
        points = np.vstack([x[None], x + _STEP * np.eye(count)])
        normal, gradient = np.zeros((count, count)), np.zeros(count)
        start = 0
        for r in self.residuals(points):
            w = np.sqrt(weight[start : start + r.shape[1]])[None, :, None]
            start += r.shape[1]
            weighted = (r * w).reshape(len(points), -1)
            jacobian = (weighted[1:] - weighted[0]) / _STEP
            normal += jacobian @ jacobian.T
            gradient += jacobian @ weighted[0]
        return normal, gradient


class PairedOnly:
    """The same residuals where modes without partner cost nothing: for a plain least-squares step."""

    def __init__(self, inner: ExactObjective) -> None:
        self.inner = inner

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,)."""
        return np.where(self.inner.paired, self.inner.costs(x), 0.0)

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `ExactObjective.normal_equations`."""
        return self.inner.normal_equations(x, weight)
