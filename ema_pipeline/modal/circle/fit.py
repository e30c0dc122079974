"""Circle fit of one mode in one FRF.

Near a viscously damped mode the mobility is, exactly,

    Y(ω) = B + D / (1 + j x),    x = (ω/ω_n - ω_n/ω) / (2ζ),

where B is what the other modes add, taken as constant over the lines used. In the complex plane this is a
circle of diameter |D|; seen from its centre, the point at ω lies at θ(ω) = arg D - 2 arctan x. The sweep
rate dθ/dω is largest at resonance, and any two points a above and b below it give
tan(θ_b/2) + tan(θ_a/2) = x_a - x_b (angles from the resonance point), hence the damping.

References
----------
Kennedy, C. C. & Pancu, C. D. P., "Use of vectors in vibration measurement and analysis", J. Aeronautical
Sciences 14, 1947.
Ewins, D. J., "Modal Testing: Theory, Practice and Application", 2nd ed., Research Studies Press, 2000,
sections 4.3 (circle fit) and 4.3.4 (refinement of SDOF methods).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.modal.circle.fit_kernel import fit_sweep
from ema_pipeline.modal.circle.geometry import geometric_circle

MINIMUM_POINTS = 5  # six real unknowns against two real numbers per line, and some to judge the fit by


@dataclass(frozen=True)
class SdofCircle:
    """A fitted circle, as measured (the share of an exponential window still in it).

    Attributes
    ----------
    frequency_hz : ndarray, (n_points,)
    points : complex ndarray, (n_points,)
        Mobility, (m/s)/N.
    centre : complex
    radius : float
    natural_frequency_hz, natural_frequency_std_hz : float
    damping_ratio, damping_std : float
    pair_damping : ndarray, (n_pairs,)
        From each pair of points on either side of resonance.
    diameter : complex
        D: from the point opposite to resonance to the resonance point.
    residual : float
        Root-mean-square distance from the circle over the radius.
    misfit : complex ndarray, (n_points,)
        Points minus B + D/(1 + j x), over the radius.
    """

    frequency_hz: NDArray[np.float64]
    points: NDArray[np.complex128]
    centre: complex
    radius: float
    natural_frequency_hz: float
    natural_frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    pair_damping: NDArray[np.float64]
    diameter: complex
    residual: float
    misfit: NDArray[np.complex128]

    def contribution(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Mobility of this mode alone, D/(1 + j x), at any lines, (n,)."""
        x = sweep(frequency_hz, self.natural_frequency_hz, self.damping_ratio)
        return np.asarray(self.diameter / (1 + 1j * x), dtype=np.complex128)


def sweep(
    frequency_hz: NDArray[np.float64], natural_frequency_hz: float, damping_ratio: float
) -> NDArray[np.float64]:
    """x = (f/f_n - f_n/f) / (2ζ), the tangent of half the angle swept from resonance; ±1 at half power."""
    ratio = frequency_hz / natural_frequency_hz
    return np.asarray((ratio - 1 / ratio) / (2 * damping_ratio))


def fit_circle(
    frequency_hz: NDArray[np.float64],
    mobility: NDArray[np.complex128],
    variance: NDArray[np.float64] | None = None,
    start: tuple[float, float] | None = None,
) -> SdofCircle:
    """Fit a circle to the lines around one resonance.

    Parameters
    ----------
    frequency_hz : ndarray, (n_points,)
        Ascending, above 0.
    mobility : complex ndarray, (n_points,)
        Velocity over force.
    variance : ndarray, (n_points,), optional
        Variance of each point; equal where left out. Estimates from few hits are themselves uncertain, so
        half of their mean is added to each.
    start : tuple of float, optional
        Natural frequency (Hz) and damping ratio from which to search, e.g. of an earlier fit; the best of a
        grid over the lines where left out.

    Returns
    -------
    SdofCircle
        Damping is the mean over pairs of points, each weighted by how well its angles determine it. Standard
        deviations are those of the least-squares fit of all six unknowns, with the scatter of the points
        about the fit as noise.

    Raises
    ------
    EmaError
        For fewer than five points, points that are not finite, or a constant FRF.
    """
    f = np.asarray(frequency_hz, dtype=float)
    points = np.asarray(mobility, dtype=complex)
    if f.size < MINIMUM_POINTS:
        raise EmaError(
            f"circle fit: {f.size} lines around the mode, at least {MINIMUM_POINTS} are needed; "
            "use a longer record"
        )
    if not np.all(np.isfinite(points)) or np.ptp(np.abs(points - points[0])) == 0.0 or f[0] <= 0:
        raise EmaError(
            f"circle fit: the FRF from {f[0]:.4g} to {f[-1]:.4g} Hz is constant or not finite; leave it out"
        )
    weights = _weights(f.size, variance)
    centre, radius = geometric_circle(points, weights)
    if not np.isfinite(radius) or radius > 1e6 * np.max(np.abs(points - points.mean())):
        raise EmaError(f"circle fit: the FRF from {f[0]:.4g} to {f[-1]:.4g} Hz is a straight line, no circle")
    unit = points - centre
    unit = unit / np.maximum(np.abs(unit), 1e-300)
    f_n, zeta, phase = _fit_sweep(f, unit, weights, start or _search(f, unit, weights))
    pairs, pair_weights = _pair_damping(f, unit * np.exp(-1j * phase), f_n)
    if pairs.size:
        zeta = float(np.sum(pair_weights * pairs) / np.sum(pair_weights))
    diameter = 2 * radius * complex(np.exp(1j * phase))
    x = sweep(f, f_n, zeta)
    on_circle = centre + diameter * (1 / (1 + 1j * x) - 0.5)
    misfit = np.asarray(points - on_circle, dtype=np.complex128)
    f_std, zeta_std = _standard_deviations(f, f_n, zeta, diameter, misfit, weights)
    return SdofCircle(
        frequency_hz=f,
        points=points,
        centre=complex(centre),
        radius=radius,
        natural_frequency_hz=f_n,
        natural_frequency_std_hz=f_std,
        damping_ratio=zeta,
        damping_std=zeta_std,
        pair_damping=pairs,
        diameter=diameter,
        residual=float(np.sqrt(np.sum(weights * (np.abs(points - centre) - radius) ** 2)) / radius),
        misfit=misfit / radius,
    )


def _weights(n: int, variance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Inverse variances, adding up to 1; equal where the variance is not known."""
    if variance is None or not np.all(np.isfinite(variance)) or not np.mean(variance) > 0:
        return np.full(n, 1 / n)
    weights = 1 / (variance + 0.5 * np.mean(variance))
    return np.asarray(weights / np.sum(weights))


def _search(
    f: NDArray[np.float64], unit: NDArray[np.complex128], weights: NDArray[np.float64]
) -> tuple[float, float]:
    """Best of a grid over natural frequency and damping: no prior knowledge, no local minimum."""
    span = f[-1] - f[0]
    f_n = np.linspace(f[0] + 0.1 * span, f[-1] - 0.1 * span, 21)
    zeta = np.geomspace(0.02, 1.0, 13) * span / np.mean(f)
    ratio = f / f_n[:, None]
    x = (ratio - 1 / ratio)[:, None, :] / (2 * zeta[None, :, None])
    turned = np.sum(weights * unit * ((1 + 1j * x) / (1 - 1j * x)), axis=2)
    i, j = np.unravel_index(np.argmax(np.abs(turned)), turned.shape)
    return float(f_n[i]), float(zeta[j])


def _fit_sweep(
    f: NDArray[np.float64],
    unit: NDArray[np.complex128],
    weights: NDArray[np.float64],
    start: tuple[float, float],
) -> tuple[float, float, float]:
    """Natural frequency (Hz), damping ratio and phase at resonance by least squares of the angles."""
    x = sweep(f, *start)
    phase = float(np.angle(np.sum(weights * unit * (1 + 1j * x) / (1 - 1j * x))))
    found = np.array([np.log(start[0]), np.log(start[1]), phase])
    fit_sweep(np.ascontiguousarray(f), unit, weights, found)
    return float(np.exp(found[0])), float(np.exp(found[1])), float(found[2])


def _pair_damping(
    f: NDArray[np.float64], turned: NDArray[np.complex128], f_n: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Damping from every pair of points on either side of resonance, and the pairs' weights.

    `turned` are unit vectors from the centre, turned so that the resonance point is at 1.
    """
    swept = -np.angle(turned)  # grows with frequency
    tangent = np.tan(swept / 2)
    x_damped = f / f_n - f_n / f  # 2ζ x
    useful = np.abs(swept) < np.deg2rad(160)
    above = np.flatnonzero(useful & (f > f_n) & (swept > 0))
    below = np.flatnonzero(useful & (f < f_n) & (swept < 0))
    spread = np.subtract.outer(tangent[above], tangent[below])
    keep = spread > np.tan(np.deg2rad(15))
    spread = spread[keep]
    # equal noise on the angles: d tan(θ/2) = dθ (1 + tan²)/2
    noise = np.hypot.outer(1 + tangent[above] ** 2, 1 + tangent[below] ** 2)[keep] / 2
    return np.subtract.outer(x_damped[above], x_damped[below])[keep] / (2 * spread), (spread / noise) ** 2


def _standard_deviations(
    f: NDArray[np.float64],
    f_n: float,
    zeta: float,
    diameter: complex,
    misfit: NDArray[np.complex128],
    weights: NDArray[np.float64],
) -> tuple[float, float]:
    """Standard deviations of f_n and ζ with centre and diameter unknown as well."""
    x = sweep(f, f_n, zeta)
    term = 1 / (1 + 1j * x)
    by_x = -1j * diameter * term**2
    ratio = f / f_n
    columns = np.stack(
        [
            np.ones_like(term),
            1j * np.ones_like(term),
            term,
            1j * term,
            by_x * -(ratio + 1 / ratio) / (2 * zeta),  # by ln f_n
            by_x * -x,  # by ln ζ
        ],
        axis=1,
    )
    scale = np.sqrt(weights)
    jacobian = np.concatenate([(columns * scale[:, None]).real, (columns * scale[:, None]).imag])
    noise = np.sum(weights * np.abs(misfit) ** 2) / max(2 * f.size - 6, 1)
    norms = np.linalg.norm(jacobian, axis=0)
    if not np.all(norms > 0):
        return float(f_n), float(zeta)
    covariance = np.linalg.pinv((jacobian / norms).T @ (jacobian / norms)) / np.outer(norms, norms)
    relative = np.sqrt(np.maximum(np.diag(covariance)[4:], 0) * noise)
    return float(relative[0] * f_n), float(relative[1] * zeta)
