"""The isolator's force along a loop: a sum of elements, most of whose parameters enter linearly.

Force = K1 x + K2 x² + K3 x³ + c ẋ + k_w w(ρ, σ; x) + relaxation(τ; x) + an offset per loop. Only ρ, σ and τ
do not enter linearly; for given ones the best of the rest follow from a linear fit (variable projection, G.
H. Golub, V. Pereyra, *SIAM J. Numer. Anal.* 10 (1973) 413-432).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.hysteresis.fourier import fourier, fourier_slope
from ema_pipeline.hysteresis.types import Loop
from ema_pipeline.mechanics.assembly import Damper, Element, Spring
from ema_pipeline.mechanics.laws import BoucWen, Maxwell, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import force_along, steady_deviation

STIFFNESS, QUADRATIC, CUBIC = "stiffness", "quadratic_stiffness", "cubic_stiffness"
DAMPING, FORCE, RELAXATION = "viscous_damping", "hysteresis_force", "relaxation_stiffness"
RHO, SIGMA, TIME = "hysteresis_rho", "hysteresis_sigma", "relaxation_time"
UNITS = {
    STIFFNESS: "N/m",
    QUADRATIC: "N/m²",
    CUBIC: "N/m³",
    DAMPING: "N·s/m",
    FORCE: "N",
    RELAXATION: "N/m",
    RHO: "1/m",
    SIGMA: "1",
    TIME: "s",
}

Terms = tuple[str, ...]
"""Names of the linear parameters that a model has."""

ALL_TERMS: Terms = (STIFFNESS, QUADRATIC, CUBIC, DAMPING, FORCE)
_ROW = {"isolator.x": 1.0}
POINTS = 512
"""Points per cycle at which the elements are run through."""


def elements(values: Mapping[str, float]) -> tuple[Element, ...]:
    """The isolator as elements of the mechanics."""
    found: list[Element] = [
        Spring("stiffness", _ROW, values.get(STIFFNESS, 0.0)),
        PolynomialSpring("curvature", _ROW, values.get(QUADRATIC, 0.0), values.get(CUBIC, 0.0)),
        Damper("viscous", _ROW, values.get(DAMPING, 0.0)),
    ]
    if values.get(FORCE):
        found.append(BoucWen("hysteresis", _ROW, values[FORCE], values[RHO], values[SIGMA]))
    if values.get(RELAXATION):
        found.append(Maxwell("relaxation", _ROW, values[RELAXATION], values[TIME]))
    return tuple(found)


def loop_force(
    values: Mapping[str, float],
    series: NDArray[np.float64],
    frequency_hz: float,
    phase: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Steady force of the isolator at phases of the cycle, N, (n_points,).

    Parameters
    ----------
    values : dict of str to float
        Parameters named as in `IsolatorResult.parameters`.
    series : ndarray, (2·n_harmonics + 1,)
        Fourier coefficients of the displacement, m.
    frequency_hz : float
    phase : ndarray, (n_points,)
        In cycles.
    """
    harmonics = len(series) // 2
    grid = np.arange(POINTS) / POINTS
    x = fourier(grid, harmonics) @ series
    v = fourier_slope(grid, harmonics) @ series * frequency_hz
    step = 1 / (frequency_hz * POINTS)
    force = force_along(elements(values), x, v, step, deviation=steady_deviation)
    return np.interp(phase, grid, force, period=1.0)


@dataclass(frozen=True)
class Problem:
    """The loops as one linear fit for given ρ, σ, τ, weighted by the standard deviations of the force."""

    loops: Sequence[Loop]
    terms: Terms

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Parameters that do not enter linearly."""
        return ((RHO, SIGMA) if FORCE in self.terms else ()) + ((TIME,) if RELAXATION in self.terms else ())

    def columns(self, shape: Mapping[str, float]) -> NDArray[np.float64]:
        """Weighted columns of all terms and of one offset per loop, (n_points, n_terms + n_loops)."""
        blocks = []
        for i, loop in enumerate(self.loops):
            block = np.zeros((len(loop.force), len(self.terms) + len(self.loops)))
            for j, term in enumerate(self.terms):
                block[:, j] = _unit_force(term, loop, shape)
            block[:, len(self.terms) + i] = 1.0
            blocks.append(block / loop.force_std_n)
        return np.vstack(blocks)

    def data(self) -> NDArray[np.float64]:
        """Weighted forces, (n_points,)."""
        return np.concatenate([loop.force / loop.force_std_n for loop in self.loops])

    def solve(self, shape: Mapping[str, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Best linear parameters and offsets, and the weighted residuals (model - measured)."""
        columns, data = self.columns(shape), self.data()
        size = np.linalg.norm(columns, axis=0)
        size[size == 0] = 1.0
        solution = np.linalg.lstsq(columns / size, data, rcond=1e-12)[0] / size
        return solution, columns @ solution - data

    def residual(self, linear: NDArray[np.float64], shape: Mapping[str, float]) -> NDArray[np.float64]:
        """Weighted residuals of loops left out of a fit: the terms are held, only the offsets fitted."""
        columns, data = self.columns(shape), self.data()
        count = len(self.terms)
        left = data - columns[:, :count] @ linear[:count]
        offsets = columns[:, count:]
        return np.asarray(offsets @ np.linalg.lstsq(offsets, left, rcond=None)[0] - left)


def _unit_force(term: str, loop: Loop, shape: Mapping[str, float]) -> NDArray[np.float64]:
    x = loop.displacement
    if term == RELAXATION:
        # Linear, so each harmonic of the displacement has its closed-form factor jωτ/(1 + jωτ).
        count = len(loop.series) // 2
        jwt = 2j * np.pi * loop.frequency_hz * shape[TIME] * np.arange(1, count + 1)
        harmonics = (loop.series[1 : count + 1] - 1j * loop.series[count + 1 :]) * jwt / (1 + jwt)
        series = np.concatenate([[0.0], harmonics.real, -harmonics.imag])
        return fourier(loop.phase, count) @ series
    if term == STIFFNESS:
        return x
    if term == QUADRATIC:
        return x**2
    if term == CUBIC:
        return x**3
    if term == DAMPING:
        return loop.velocity
    return loop_force({term: 1.0, **shape}, loop.series, loop.frequency_hz, loop.phase)
