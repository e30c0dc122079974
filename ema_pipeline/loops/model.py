"""The published model of a metal-mesh isolator: names of its parameters, its elements, and its force step by step.

Force = K1 x + K2 x² + K3 x³ + c ẋ + k_w w(ρ, σ, n; x) + relaxation(τ; x).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import Damper, Element, Spring
from ema_pipeline.mechanics.fourier import fourier, fourier_slope
from ema_pipeline.mechanics.laws import BoucWen, Maxwell, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import force_along, steady_deviation

STIFFNESS, QUADRATIC, CUBIC = "stiffness", "quadratic_stiffness", "cubic_stiffness"
DAMPING, FORCE, RELAXATION = "viscous_damping", "hysteresis_force", "relaxation_stiffness"
RHO, SIGMA, TIME = "hysteresis_rho", "hysteresis_sigma", "relaxation_time"
EXPONENT, GAP = "hysteresis_exponent", "backlash_gap"
UNITS = {
    STIFFNESS: "N/m",
    QUADRATIC: "N/m²",
    CUBIC: "N/m³",
    DAMPING: "N·s/m",
    FORCE: "N",
    RELAXATION: "N/m",
    RHO: "1/m",
    SIGMA: "1",
    EXPONENT: "1",
    TIME: "s",
    GAP: "m",
}

EFFECTS: Mapping[str, Mapping[str, str]] = {
    "quadratic_stiffness": {"stiffness": QUADRATIC},
    "cubic_stiffness": {"stiffness": CUBIC},
    "viscous_damping": {"coefficient": DAMPING},
    "hysteresis": {"force": FORCE, "rho": RHO, "sigma": SIGMA, "exponent": EXPONENT},
    "relaxation": {"stiffness": RELAXATION, "time": TIME},
    "backlash": {"gap": GAP},
}
"""Effects of the library that the parameters belong to, and their names there."""

_ROW = {"isolator.x": 1.0}
_POINTS = 512
"""Points per cycle at which the elements are run through."""


def elements(values: Mapping[str, float]) -> tuple[Element, ...]:
    """The isolator as elements of the mechanics, without free play."""
    found: list[Element] = [
        Spring("stiffness", _ROW, values.get(STIFFNESS, 0.0)),
        PolynomialSpring("curvature", _ROW, values.get(QUADRATIC, 0.0), values.get(CUBIC, 0.0)),
        Damper("viscous", _ROW, values.get(DAMPING, 0.0)),
    ]
    if values.get(FORCE):
        exponent = values.get(EXPONENT, 1.0)
        found.append(BoucWen("hysteresis", _ROW, values[FORCE], values[RHO], values[SIGMA], exponent))
    if values.get(RELAXATION):
        found.append(Maxwell("relaxation", _ROW, values[RELAXATION], values[TIME]))
    return tuple(found)


def loop_force(
    values: Mapping[str, float],
    series: NDArray[np.float64],
    frequency_hz: float,
    phase: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Steady force of an isolator without play at phases of the cycle, N, (n_points,).

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
    grid = np.arange(_POINTS) / _POINTS
    x = fourier(grid, harmonics) @ series
    v = fourier_slope(grid, harmonics) @ series * frequency_hz
    step = 1 / (frequency_hz * _POINTS)
    force = force_along(elements(values), x, v, step, deviation=steady_deviation)
    return np.interp(phase, grid, force, period=1.0)
