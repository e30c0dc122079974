"""The source's own steps: backbone, energy over frequency, and Bouc-Wen slopes in closed form.

References
----------
F. Mezghani et al., "Experimental characterization of metal-mesh isolators damping capacity", Eqs. 3-14.
F. Ikhouane, J. Rodellar, *Systems with Hysteresis* (2007), chapter 4: the Bouc-Wen steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.loops.model import CUBIC, DAMPING, FORCE, QUADRATIC, RHO, SIGMA, STIFFNESS
from ema_pipeline.loops.types import EnergyLine, Estimate, Loop

SAME_AMPLITUDE = 0.05
"""Loops whose amplitudes agree to this share are taken as tests at one amplitude."""
_DEGREE = 6


def backbone(loop: Loop) -> tuple[float, float, float]:
    """K1, K2, K3 of the pseudo-major axis: the mean of the loop's upper and lower branch (Eq. 3)."""
    x, up, down = _branches(loop)
    axis = 0.5 * (up + down)
    scale = loop.amplitude_m
    z = x / scale
    fit = np.linalg.lstsq(np.stack([np.ones_like(z), z, z**2, z**3], axis=1), axis, rcond=None)[0]
    return float(fit[1] / scale), float(fit[2] / scale**2), float(fit[3] / scale**3)


def damping_from_energies(
    frequency_hz: Sequence[float] | NDArray[np.float64],
    energy_j: Sequence[float] | NDArray[np.float64],
    amplitude_m: float,
    energy_std_j: Sequence[float] | NDArray[np.float64] | None = None,
    significance: float = 2.0,
) -> EnergyLine:
    """Straight line through the energy per cycle over ω, and the damper c = a/(πX²) (Eqs. 6-8).

    Parameters
    ----------
    frequency_hz, energy_j : sequence of float, (n,)
        At one amplitude; two frequencies or more.
    amplitude_m : float
        X.
    energy_std_j : sequence of float, optional
        Standard deviations; from the scatter about the line where left out (NaN for two points).
    significance : float
        Standard deviations from which c counts as negative.

    Raises
    ------
    EmaError
        For fewer than two different frequencies.
    """
    f, energy = np.asarray(frequency_hz, dtype=float), np.asarray(energy_j, dtype=float)
    if len(np.unique(f)) < 2:
        raise EmaError("energy over frequency needs tests at two frequencies or more at one amplitude")
    omega = 2 * np.pi * f
    known = energy_std_j is not None
    std = np.asarray(energy_std_j, dtype=float) if known else np.ones_like(energy)
    basis = np.stack([omega, np.ones_like(omega)], axis=1) / std[:, None]
    (slope, intercept), *_ = np.linalg.lstsq(basis, energy / std, rcond=None)
    covariance = np.linalg.inv(basis.T @ basis)
    spread = float(np.sum(((energy - slope * omega - intercept) / std) ** 2)) / max(len(f) - 2, 1)
    if not known:
        covariance = covariance * (spread if len(f) > 2 else np.nan)
        std = np.full_like(energy, np.sqrt(spread) if len(f) > 2 else np.nan)
    elif len(f) > 2:
        covariance = covariance * max(1.0, spread)
    factor = np.pi * amplitude_m**2
    c, c_std = float(slope / factor), float(np.sqrt(covariance[0, 0]) / factor)
    negative = c < 0 and not abs(c) < significance * c_std
    reason = ""
    if negative:
        reason = (
            f"the energy per cycle falls with frequency, so c = {c:.3g} N·s/m: a negative damper cannot be. "
            "Loss that falls with frequency is a relaxation (Maxwell branch), or friction falling with rate"
        )
    estimate = Estimate(c, c_std, "N·s/m", bool(abs(c) > significance * c_std), reason)
    return EnergyLine(
        amplitude_m, f, energy, std, float(slope), float(intercept), estimate, not negative, reason
    )


def energy_lines(loops: Sequence[Loop], significance: float) -> tuple[EnergyLine, ...]:
    """One line per amplitude that was tested at two frequencies or more."""
    groups: list[list[Loop]] = []
    for loop in sorted(loops, key=lambda one: one.amplitude_m):
        if groups and loop.amplitude_m < groups[-1][0].amplitude_m * (1 + SAME_AMPLITUDE):
            groups[-1].append(loop)
        else:
            groups.append([loop])
    lines = []
    for group in groups:
        f = np.array([one.frequency_hz for one in group])
        if np.ptp(f) > 0.02 * f.max():
            # Small differences of amplitude: loss goes about with its square.
            amplitude = float(np.mean([one.amplitude_m for one in group]))
            scale = np.array([(amplitude / one.amplitude_m) ** 2 for one in group])
            energy = scale * [one.energy_j for one in group]
            std = scale * [one.energy_std_j for one in group]
            lines.append(damping_from_energies(f, energy, amplitude, std, significance))
    return tuple(lines)


def bouc_wen_steps(loop: Loop, hysteresis: NDArray[np.float64]) -> dict[str, float]:
    """k_w, ρ and σ from the slopes of the hysteresis force on the loading branch (Eqs. 10-14).

    Parameters
    ----------
    loop : Loop
    hysteresis : ndarray, (n_points,)
        Force of the loop less stiffness and viscous damping, N.

    Returns
    -------
    dict
        Values; NaN where the branch does not give them.

    Notes
    -----
    For F_H ≥ 0 the slope is a - b·F_H: a at the zero crossing, ρ = b and k_w = a/b. For F_H < 0 it is
    k_w ρ (1 - (2σ - 1) w). The source takes one design point each; here all points of the branch are taken.
    """
    x, up, down = _branches(loop, hysteresis)
    # A polynomial takes the noise out of the branch before its slope is taken.
    branch = np.polynomial.Polynomial.fit(x, up - 0.5 * float(np.mean(up + down)), _DEGREE)
    inner = x[len(x) // 12 : -len(x) // 12]
    force, slope = branch(inner), branch.deriv()(inner)
    above, below = force > 0, force < 0
    values = {FORCE: float("nan"), RHO: float("nan"), SIGMA: float("nan")}
    if above.sum() < 4 or below.sum() < 4:
        return values
    b, a = np.polyfit(force[above], slope[above], 1)
    if not (b < 0 < a):
        return values
    values[RHO], values[FORCE] = float(-b), float(a / -b)
    w = force[below] / values[FORCE]
    excess = slope[below] / a - 1.0
    values[SIGMA] = float(0.5 * (np.sum(-w * excess) / np.sum(w**2) + 1.0))
    return values


def closed_form(loops: Sequence[Loop], lines: Sequence[EnergyLine]) -> dict[str, float]:
    """All three steps of the source; the largest loop gives stiffness and hysteresis."""
    largest = max(loops, key=lambda loop: loop.amplitude_m)
    k1, k2, k3 = backbone(largest)
    c = float(np.mean([line.damping.value for line in lines])) if lines else 0.0
    values = {STIFFNESS: k1, QUADRATIC: k2, CUBIC: k3, DAMPING: c}
    return {**values, **bouc_wen_steps(largest, hysteresis_force(largest, values))}


def hysteresis_force(loop: Loop, values: Mapping[str, float]) -> NDArray[np.float64]:
    """What stiffness and viscous damping leave of a loop's force, N, (n_points,)."""
    x = loop.displacement
    elastic = (values[STIFFNESS] + (values[QUADRATIC] + values[CUBIC] * x) * x) * x
    return loop.force - elastic - values[DAMPING] * loop.velocity


def _branches(
    loop: Loop, force: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Force on the way up and on the way down at common places, each (n,)."""
    f = loop.force if force is None else force
    x = loop.displacement
    start = int(np.argmin(x))
    x, f = np.roll(x, -start), np.roll(f, -start)
    top = int(np.argmax(x))
    grid = np.linspace(-0.98, 0.98, 101) * loop.amplitude_m
    up = np.interp(grid, np.maximum.accumulate(x[: top + 1]), f[: top + 1])
    back = np.append(x[top:], x[0])[::-1]
    down = np.interp(grid, np.maximum.accumulate(back), np.append(f[top:], f[0])[::-1])
    return grid, up, down
