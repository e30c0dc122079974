"""The Gaussian posterior about a maximum, and what is read from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ema_pipeline.inference.factor import lower_factor
from ema_pipeline.inference.problem import Residuals
from ema_pipeline.inference.unknowns import Unknowns

ERROR_LIMIT = 1.5
"""Error up to which a model explains few data."""
LEAST_LIMIT = 1.3
"""The same of many, whose σ are themselves known to some tenths only: of 400 models of simulated rigs that lacked
nothing one had an error above it, of 103 that lacked too little to be named ten."""
_ONCE_IN = 1e-3
LARGE = 2.0
"""Prior σ that sizes of effects count in an error at most: that an effect is large is no misfit. Of twelve data, a
damper that explained all had left an error of 1.4."""


def error_limit(count: int, most: float = ERROR_LIMIT) -> float:
    """Error up to which a model explains so many data: one that is right exceeds it in one of a thousand tests.

    >>> [round(error_limit(n), 2) for n in (10, 30, 100)]
    [1.5, 1.41, 1.3]

    Parameters
    ----------
    count : int
        Number of data.
    most : float
        Largest limit; all are in proportion to it.
    """
    by_chance = np.sqrt(scipy.special.chdtri(count, _ONCE_IN) / count) if count > 0 else ERROR_LIMIT
    return float(np.clip(by_chance, LEAST_LIMIT, ERROR_LIMIT)) * most / ERROR_LIMIT


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
    widths : ndarray, (n,), optional
        Factors on standard deviations that are known better than from the curvature at the maximum.

    References
    ----------
    D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415-447.
    """

    unknowns: Unknowns
    x: NDArray[np.float64]
    scatters: Mapping[str, float]
    residuals: Residuals
    scatter_cost: float = 0.0
    widths: NDArray[np.float64] | None = None

    @cached_property
    def prior_std(self) -> NDArray[np.float64]:
        """Prior 1 σ, (n,)."""
        return self.unknowns.prior_std(self.scatters)

    @cached_property
    def cost(self) -> float:
        """-log posterior up to a constant."""
        return self.residuals.cost + 0.5 * float(np.sum((self.x / self.prior_std) ** 2))

    @property
    def information(self) -> NDArray[np.float64]:
        """Posterior precision in units of the prior's, (n, n); not kept: a diagnosis holds hundreds of posteriors."""
        whitened = self.residuals.weighted[1] * self.prior_std
        return np.asarray(np.eye(len(self.x)) + whitened.T @ whitened)

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """Posterior covariance, (n, n)."""
        inverse = np.linalg.inv(self.information)
        std = self.prior_std if self.widths is None else self.prior_std * self.widths
        return np.asarray(std[:, None] * inverse * std)

    @cached_property
    def std(self) -> NDArray[np.float64]:
        """Posterior 1 σ, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def log_evidence(self) -> float:
        """Natural logarithm of the evidence, up to a constant that is the same for all models of the same data."""
        return self.evidence_at_scatters - self.scatter_cost

    @cached_property
    def evidence_at_scatters(self) -> float:
        """The same for these scatters, whatever they cost."""
        if not np.isfinite(self.cost):
            return -np.inf
        half_log_det = float(np.sum(np.log(np.diag(lower_factor(self.information)))))
        return -self.cost - half_log_det

    @property
    def error(self) -> float:
        """Root mean square of the marginally whitened residual: about 1 where the model explains the data.

        The sum of squares at the maximum, priors included, is that of the residual whitened by the covariance of
        everything uncertain: what parts, channels and damping may scatter is in it.
        """
        return self._error(self.residuals, len(self.x))

    def _error(self, residuals: Residuals, unknowns: int) -> float:
        """Of some residuals, with the priors of the first unknowns."""
        away = self.x / self.prior_std
        sizes = [self.unknowns.index[name] for name in self.unknowns.sizes if name in self.unknowns.index]
        away[sizes] = np.clip(away[sizes], -LARGE, LARGE)
        squares = residuals.squares + 2 * residuals.penalty + float(np.sum(away[:unknowns] ** 2))
        return float(np.sqrt(squares / max(residuals.count, 1)))

    @property
    def error_apart(self) -> float:
        """The same of the values that count on their own as well; 0 where there are none, or they are rough."""
        apart = self.residuals.apart
        if apart is None or apart.rough:
            return 0.0
        return self._error(self.residuals.only_apart(apart), apart.unknowns)

    @property
    def telling(self) -> tuple[float, int]:
        """Error and number of the data that tell whether the model lacks something: of those apart, or else of all."""
        apart, count = self.residuals.apart, self.residuals.count
        if apart is None or apart.rough:
            return self.error, count
        return self.error_apart, apart.values - apart.projected

    def error_limit(self, most: float = ERROR_LIMIT) -> float:
        """Error of all data up to which the model explains them; where those apart tell more, the largest."""
        apart = self.residuals.apart
        return error_limit(self.residuals.count, most) if apart is None or apart.rough else most

    def fails(self, most: float = ERROR_LIMIT) -> bool:
        """True where the model does not explain the data, or those that count on their own as well."""
        error, count = self.telling
        return error > error_limit(count, most) or self.error > self.error_limit(most)

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
