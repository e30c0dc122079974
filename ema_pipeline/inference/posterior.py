"""The Gaussian posterior about a maximum, and what is read from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.factor import lower_factor
from ema_pipeline.inference.problem import Residuals
from ema_pipeline.inference.unknowns import Unknowns


@dataclass(frozen=True)
class Posterior:
    """Laplace's approximation of the posterior about `x`.

    Attributes
    ----------
    unknowns : Unknowns
    x : ndarray, (n,)
        Maximum a posteriori.
    scatters : dict of str to float
        Hyper-parameters at which it was found.
    residuals : Residuals
        At `x`, with derivatives.
    scatter_cost : float
        -log prior density of learned scatters relative to that of the defaults.

    References
    ----------
    D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415-447.
    """

    unknowns: Unknowns
    x: NDArray[np.float64]
    scatters: Mapping[str, float]
    residuals: Residuals
    scatter_cost: float = 0.0

    @cached_property
    def prior_std(self) -> NDArray[np.float64]:
        """Prior 1 σ, (n,)."""
        return self.unknowns.prior_std(self.scatters)

    @cached_property
    def cost(self) -> float:
        """-log posterior up to a constant."""
        return self.residuals.cost + 0.5 * float(np.sum((self.x / self.prior_std) ** 2))

    def _information(self) -> NDArray[np.float64]:
        """Posterior precision in units of the prior's, (n, n); not kept: a diagnosis holds hundreds of posteriors."""
        whitened = self.residuals.weighted[1] * self.prior_std
        return np.asarray(np.eye(len(self.x)) + whitened.T @ whitened)

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """Posterior covariance, (n, n)."""
        inverse = np.linalg.inv(self._information())
        return np.asarray(self.prior_std[:, None] * inverse * self.prior_std)

    @cached_property
    def std(self) -> NDArray[np.float64]:
        """Posterior 1 σ, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @cached_property
    def log_evidence(self) -> float:
        """Natural logarithm of the evidence, up to a constant that is the same for all models of the same data."""
        if not np.isfinite(self.cost):
            return -np.inf
        half_log_det = float(np.sum(np.log(np.diag(lower_factor(self._information())))))
        return -self.cost - half_log_det - self.scatter_cost

    @property
    def error(self) -> float:
        """Root mean square of the marginally whitened residual: about 1 where the model explains the data.

        The sum of squares at the maximum, priors included, is that of the residual whitened by the covariance of
        everything uncertain: what parts, channels and damping may scatter is in it.
        """
        squares = self.residuals.squares
        squares += 2 * self.residuals.penalty + float(np.sum((self.x / self.prior_std) ** 2))
        count = len(self.residuals.values) - self.residuals.projected
        return float(np.sqrt(squares / max(count, 1)))

    def expected_squares(self, weighted: bool = True) -> NDArray[np.float64]:
        """Expected squares of the residuals while the unknowns are as uncertain as they are, (m,).

        Parameters
        ----------
        weighted : bool
            True for residuals as least squares take them.
        """
        r = self.residuals
        values, jacobian = r.weighted if weighted else (r.values, r.jacobian)
        return np.asarray(values**2 + np.einsum("ij,ij->i", jacobian @ self.covariance, jacobian))

    def of_sums(
        self, terms: Sequence[Mapping[str, float]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Posterior and prior covariance of weighted sums of unknowns, (k, k) each; weights by the unknowns' names."""
        weights = np.zeros((len(terms), len(self.x)))
        for row, term in zip(weights, terms, strict=True):
            for name, weight in term.items():
                row[self.unknowns.index[name]] = weight
        return weights @ self.covariance @ weights.T, (weights * self.prior_std**2) @ weights.T

    def value(self, name: str) -> float:
        """Maximum a posteriori of one unknown."""
        return float(self.x[self.unknowns.index[name]])
