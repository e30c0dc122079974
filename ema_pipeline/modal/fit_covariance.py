"""Covariance of poles, participations and shapes from the fit, and how significant each mode is.

Where the interval of a mode begins. Later steps, in their order:

1. `fitted_modes`: where many points are struck, variances are raised to the scatter between points; the step that the
   fit would still take is added.
2. `identify`: a pole that is held at its peak gets the scatter over hits there, and half the way that the fit would
   have gone; variances of poles become those of frequency and damping ratio.
3. `hit_to_hit`: of one hit, the scatter that it cannot show; of many, how far frequencies move from hit to hit, and a
   trend with the force.
4. `combine_estimates`: where circles or single hits disagree with the pole, the interval covers them.
5. `levels.study`: for modes that move with the force, one size at each force level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import mode_columns, real_columns
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import (
    Estimate,
    LinearSolution,
    Step,
    mixing,
    newton_step,
    parameter_columns,
    solve_scaled,
)
from ema_pipeline.modal.noise import Noise
from ema_pipeline.modal.serial import variance_of_sum
from ema_pipeline.modal.windowed import power_of
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


def parameter_covariance(
    data: FitData, weight: Real, estimate: Estimate, solution: LinearSolution, noise: Noise
) -> Real:
    """Covariance of poles and participations by linear propagation of the noise through the weighted fit.

    Noise that all outputs of an input have in common does not average out over channels; its share is
    propagated coherently (a sandwich covariance).

    Parameters
    ----------
    data : FitData
    weight : ndarray, (n_rows, n_references, n_lines)
        Weights that the fit used.
    estimate, solution
        Result of the fit with these weights.
    noise : Noise

    Returns
    -------
    ndarray, (n_parameters, n_parameters)
        In the order of `fit.parameter_columns`.
    """
    meat = scatter_of_scores(data, weight, estimate, solution, noise)
    return sandwich(meat, newton_step(estimate, solution).information)


def sandwich(scatter: Real, information: Real) -> Real:
    """Covariance of parameters from that of their gradient and from the information of the fit."""
    inverse = _inverse(information)
    parameters = inverse @ scatter @ inverse
    return np.asarray(0.5 * (parameters + parameters.T))


def scatter_of_scores(
    data: FitData, weight: Real, estimate: Estimate, solution: LinearSolution, noise: Noise
) -> Real:
    """Covariance of the gradient by noise, (n_parameters, n_parameters); arguments as of `parameter_covariance`.

    With a roving hammer it adds up over rows.
    """
    m = len(estimate.poles)
    mix = mixing(estimate.participation)
    z = parameter_columns(estimate, solution.shapes)
    eliminated = _eliminated(estimate, solution)
    columns = np.concatenate(
        [*real_columns(data.omega, estimate.poles, data.rest_s), data.residual_columns()]
    )
    n_rows, n_ref, _ = data.frf.shape
    # what all outputs share adds up over the outputs of one input before it is squared
    together = [[(o, i) for i in range(n_ref)] for o in range(n_rows)]
    if not data.transposed:
        together = [list(group) for group in zip(*together, strict=True)]
    together = [[(o, i) for o, i in group if np.any(weight[o, i])] for group in together]

    def of_columns(pair: tuple[int, int]) -> Real:
        """How much of every column the scores of one FRF have, (n_parameters, 4M + n_residual)."""
        o, i = pair
        own = z[o, i].copy()
        own[: 2 * m] -= mix[i] @ eliminated[o]
        return np.asarray(own.T @ _free_of_residuals(columns, 4 * m, weight[o, i]))

    pairs = [pair for group in together for pair in group]
    parts = dict(zip(pairs, in_order(of_columns, pairs), strict=True))

    def meat_of(lines: slice) -> Real:
        some, at = replace(data, omega=data.omega[lines]), _parts(columns[:, lines])
        meat = np.zeros((z.shape[-1], z.shape[-1]))
        for group in together:
            coherent = np.zeros((z.shape[-1], at.shape[1] // 2), dtype=np.complex128)
            for o, i in group:
                a = (parts[o, i] @ at).view(np.complex128)
                np.conj(a, out=a)
                a *= weight[o, i, lines]
                meat += 0.5 * power_of(a * np.sqrt(noise.own[o, i, lines]), some)
                frf = data.frf[o, i, lines]
                size = np.abs(frf)
                phase = np.where(size > 0, frf / np.maximum(size, 1e-300), 0.0)
                a *= np.sqrt(noise.common[o, i, lines]) * phase
                coherent += a
            meat += 0.5 * power_of(coherent, some)
        return meat

    # under a window all lines hang together
    blocks = [slice(0, len(data.omega))] if data.window_rad_s > 0 else _blocks(len(data.omega))
    return np.asarray(sum(in_order(meat_of, blocks)))


LINES_AT_ONCE = 2048
"""Lines whose scores are made at a time: what is made of them then fits into the cache."""


def _blocks(n_lines: int) -> list[slice]:
    return [slice(k, min(k + LINES_AT_ONCE, n_lines)) for k in range(0, n_lines, LINES_AT_ONCE)]


FEWEST_GROUPS = 5
"""Struck points without which their scatter does not tell an interval."""

LARGEST_SHARE = 0.9
"""Share of one point in what is known of a parameter, past which the others do not tell what it does to the pole."""


@dataclass(frozen=True)
class PointScores:
    """What the hits on each point ask of the parameters.

    Attributes
    ----------
    scores : ndarray, (n_points, n_parameters)
        Gradient of each point's FRFs, shapes eliminated; points in the order in which they were struck.
    own : ndarray, (n_points, n_parameters)
        Diagonal of each point's information.
    information : ndarray, (n_parameters, n_parameters)
        Of all points.
    """

    scores: Real
    own: Real
    information: Real

    @property
    def step(self) -> Step:
        """That all points would still take."""
        return Step(self.information, self.scores.sum(axis=0))


def scores_of_points(transposed: bool, estimate: Estimate, solution: LinearSolution) -> PointScores:
    """What the hits on each point ask of the parameters, and the information of all of them.

    Parameters
    ----------
    transposed : bool
        True where rows are struck points, False where references are.
    estimate, solution
        Result of a fit.
    """
    m = len(estimate.poles)
    mix = mixing(estimate.participation)
    z = parameter_columns(estimate, solution.shapes)
    z[:, :, : 2 * m] -= np.einsum("iab,obp->oiap", mix, _eliminated(estimate, solution), optimize=True)
    psi = np.stack([solution.shapes.real, solution.shapes.imag], axis=-1).reshape(len(solution.shapes), -1)
    coefficients = np.einsum("iab,ob->oia", mix, psi)
    misfit = solution.moment - np.einsum("oiab,oib->oia", solution.gram[..., : 2 * m], coefficients)
    over = "op" if transposed else "ip"
    scores = np.einsum(f"oiap,oia->{over}", z, misfit, optimize=True)
    own = np.einsum(f"oiap,oiap->{over}", z, np.matmul(solution.gram, z))
    return PointScores(scores, own, newton_step(estimate, solution).information)


def of_all_blocks(parts: list[PointScores], transposed: bool) -> PointScores:
    """What blocks of rows add up to: rows are points with `transposed`, and all hit the same points without."""
    of = np.concatenate if transposed else partial(np.sum, axis=0)
    return PointScores(
        of([p.scores for p in parts]),
        of([p.own for p in parts]),
        np.asarray(sum(p.information for p in parts)),
    )


def scatter_over_points(found: PointScores) -> Real:
    """Variance of every parameter from the scatter of what single struck points ask for, (n_parameters,).

    This is the jackknife over points, to first order: it holds whatever differs from hit to hit, be it noise, drift or
    a structure that is not quite linear. Drift moves a peak as a whole, which noise from line to line does not know.

    A point that has a large share in what is known of a parameter pulls it along, and then asks for less than it would
    of a fit without it: its part is that of the fit without it. Points struck one after the other may ask for the same,
    as where the rig drifts slowly or a part of the structure answers differently: they count as fewer
    (`serial.variance_of_sum`). Few points give 0.

    References
    ----------
    Efron, B., "The Jackknife, the Bootstrap and Other Resampling Plans", SIAM 1982 (infinitesimal jackknife).
    MacKinnon, J. G. & White, H., "Some heteroskedasticity-consistent covariance matrix estimators with improved
    finite sample properties", Journal of Econometrics 29, 1985 (HC3).
    """
    n = len(found.scores)
    if n < FEWEST_GROUPS:
        return np.zeros(len(found.information))
    total = np.diag(found.information)
    share = np.clip(found.own / np.where(total > 0, total, np.inf), 0.0, LARGEST_SHARE)
    asked = found.scores @ _inverse(found.information) / (1 - share)
    return np.asarray(variance_of_sum(asked - asked.mean(axis=0)) * (n - 1) / n)


def left_to_go(step: Step) -> Real:
    """Step that each parameter would still take to the best fit, (n_parameters,).

    About nothing after a polish that has converged; for poles that are not polished, or not placed by it, the
    size of their bias.
    """
    return np.asarray(_inverse(step.information) @ step.gradient)


def shape_covariance(
    data: FitData, estimate: Estimate, solution: LinearSolution, noise: Noise, parameters: Real
) -> Real:
    """Covariance of (Re, Im) of all modes' shape entries of each row, the poles' errors included.

    Parameters
    ----------
    data, estimate, noise
        As for `parameter_covariance`; rows are independent of each other.
    solution : LinearSolution
        Of a fit weighted by one over the variance of `noise`.
    parameters : ndarray, (n_parameters, n_parameters)
        From `parameter_covariance`.

    Returns
    -------
    ndarray, (n_rows, 2M, 2M)
    """
    if data.window_rad_s > 0:
        meat = _meat_of_shapes(data, estimate, noise)
    else:  # with independent lines and these weights it is the normal matrix
        meat = 0.5 * solution.normal
    inverse = np.array([_inverse(normal) for normal in solution.normal])
    eliminated = _eliminated(estimate, solution)
    out = inverse @ meat @ inverse
    out += np.einsum("oap,pq,obq->oab", eliminated, parameters, eliminated, optimize=True)
    return np.asarray(out)


def own_share(data: FitData, estimate: Estimate, noise: Noise) -> Real:
    """Share of the variance of every row's shape entries that the row does not have in common with others.

    What all outputs of one hit share changes the scale of a shape, and not its form. Rows that are struck points share
    nothing: each has hits of its own; nor do those of sensors that are moved, whose turns are of different hits.

    Parameters
    ----------
    data, estimate, noise
        As for `shape_covariance`.

    Returns
    -------
    ndarray, (n_rows, M)
    """
    m = len(estimate.poles)
    if data.transposed or data.in_turn:
        return np.ones((len(data.frf), m))
    power = np.abs(1 / (1j * data.omega - estimate.poles[:, None])) ** 2
    weight = noise.weight(data.measured)
    taking_part = np.abs(estimate.participation.T) ** 2  # (n_references, M)
    total = np.einsum("oil,ml,im->om", weight, power, taking_part, optimize=True)
    own = np.einsum("oil,ml,im->om", weight**2 * noise.own, power, taking_part, optimize=True)
    return np.asarray(np.where(total > 0, own / np.where(total > 0, total, 1.0), 1.0))


def _meat_of_shapes(data: FitData, estimate: Estimate, noise: Noise) -> Real:
    """Covariance of the right-hand sides that give the shapes of each row, (n_rows, 2M, 2M)."""
    mix = mixing(estimate.participation)
    columns = mode_columns(data.omega, estimate.poles, data.rest_s)
    residual = data.residual_columns()
    variance, weight = noise.variance, noise.weight(data.measured)
    out = np.zeros((len(data.frf), len(columns), len(columns)))
    for o, i in np.ndindex(*data.measured.shape):
        if np.any(weight[o, i]):
            x = mix[i].T @ _projected(columns, residual, weight[o, i]) * weight[o, i]
            out[o] += 0.5 * power_of(x.conj() * np.sqrt(variance[o, i]), data)
    return out


def _eliminated(estimate: Estimate, solution: LinearSolution) -> Real:
    """Minus the derivative of each row's shape entries by the parameters, (n_rows, 2M, n_parameters)."""
    m = len(estimate.poles)
    gz = np.matmul(solution.gram, parameter_columns(estimate, solution.shapes))
    cross = np.einsum("iba,oibp->oap", mixing(estimate.participation), gz[:, :, : 2 * m], optimize=True)
    return solve_scaled(solution.normal, cross)


def _projected(columns: Complex, residual: Complex, weight: Real) -> Complex:
    """Columns with what the residual terms can follow taken off, for one FRF's weights (n_lines,)."""
    both = np.concatenate([columns, residual])
    return np.asarray((_free_of_residuals(both, len(columns), weight) @ _parts(both)).view(np.complex128))


def _free_of_residuals(columns: Complex, n_modes: int, weight: Real) -> Real:
    """What gives the first `n_modes` columns without what the others can follow, (n_modes, n_columns)."""
    parts = _parts(columns)
    at = parts[n_modes:]
    products = (at * np.repeat(weight, 2)) @ parts.T
    taken = np.linalg.lstsq(products[:, n_modes:], products[:, :n_modes], rcond=None)[0]
    return np.concatenate([np.eye(n_modes), -taken.T], axis=1)


def _parts(values: Complex) -> Real:
    """Real and imaginary parts side by side: products with real matrices then cost half, (n, 2·n_lines)."""
    return np.ascontiguousarray(values).view(np.float64)


def _inverse(matrix: Real) -> Real:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(
        scale[:, None] * np.linalg.pinv(matrix * scale[:, None] * scale[None], rcond=1e-12) * scale[None]
    )


def evidence(solution: LinearSolution, n_modes: int) -> Real:
    """How much the weighted sum of squares would grow without each mode, the other poles kept.

    Returns
    -------
    ndarray, (n_modes,)
        Growth of χ², in units where each real datum adds 1.
    """
    identity = np.broadcast_to(np.eye(2 * n_modes), solution.normal.shape)
    inverse = solve_scaled(solution.normal, identity)
    gain = np.empty(n_modes)
    for r in range(n_modes):
        two = slice(2 * r, 2 * r + 2)
        psi = np.stack([solution.shapes[:, r].real, solution.shapes[:, r].imag], axis=-1)
        gain[r] = 2.0 * np.sum(psi * solve_scaled(inverse[:, two, two], psi[..., None])[..., 0])
    return gain
