"""Modes of given matrices, and their exact derivatives by the unknowns that the matrices depend on.

References
----------
R. L. Fox, M. P. Kapoor, Rates of change of eigenvalues and eigenvectors, AIAA Journal 6 (1968) 2426-2429: the
derivative of a shape is expanded over all shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.mechanics.damped_modes import DampedModes
from ema_pipeline.mechanics.terms import DAMPING_MATRIX, MASS, STIFFNESS, STRUCTURAL, Matrices

T = TypeVar("T", np.float64, np.complex128)

_CLOSE = 1e-4
"""Relative distance of eigenvalues below which the rotation of their shapes into each other is no longer linear."""
_LEAST_DAMPING_RATIO = 1e-6
_ROUNDING = 1e-12
"""Share of the largest eigenvalue below which a negative one is a rigid body's zero."""


@dataclass(frozen=True)
class EigenSolution:
    """Undamped modes, with the frequencies and ratios of the damped ones.

    Damping ratios come from the diagonal of the modal damping matrix where its coupling changes nothing.

    Attributes
    ----------
    eigenvalues : ndarray, (n,)
        ω², (rad/s)², ascending; never negative.
    shapes : ndarray, (n, n)
        Mass-normalised columns.
    frequency_hz, damping_ratio : ndarray, (n,)
    damped : DampedModes, optional
        Where damping or gyroscopic coupling couples the modes; frequencies and damping ratios are then theirs.
    """

    eigenvalues: NDArray[np.float64]
    shapes: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damped: DampedModes | None = None

    @classmethod
    def of(
        cls,
        dense: NDArray[np.float64],
        skew: NDArray[np.float64],
        damping_ratio: NDArray[np.float64] | float,
        undamped: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    ) -> EigenSolution | None:
        """Modes of M, C, K and structural matrix, (4, n, n); None where a mass or a stiffness is not admissible.

        `damping_ratio` is that of every undamped mode, (n,), or of all. `undamped` modes may be given where they are
        known already, see `solved`.
        """
        undamped = undamped or solved(dense)
        if undamped is None:
            return None
        values, shapes = undamped
        _, damping, _, structural = dense
        omega = np.sqrt(values)
        ratio = np.full(len(values), damping_ratio, float)
        damping = damping + skew
        coupling, lag = np.any(damping), np.any(structural)
        modal = shapes.T @ damping @ shapes if coupling else np.zeros_like(shapes)
        modal_lag = shapes.T @ structural @ shapes if lag else np.zeros_like(shapes)
        if coupling or lag:
            modal[np.diag_indices_from(modal)] += 2 * ratio * omega
            found = DampedModes.of(values, shapes, modal, modal_lag)
            if found is not None:
                least = np.maximum(found.damping_ratio, _LEAST_DAMPING_RATIO)
                return cls(values, shapes, found.frequency_hz, least, found)
            ratio = np.diag(modal) / (2 * omega) + np.diag(modal_lag) / (2 * values)
        return cls(values, shapes, omega / (2 * np.pi), np.maximum(ratio, _LEAST_DAMPING_RATIO))


def solved(dense: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """ω² and mass-normalised shapes of undamped modes; None where a mass or a stiffness is not admissible."""
    if not np.all(np.isfinite(dense)):
        return None
    found = _solved(dense[STIFFNESS], dense[MASS])
    if found is None or found[0][0] < -_ROUNDING * float(np.max(np.abs(found[0]))):
        return None
    return np.maximum(found[0], 1.0), found[1]  # rigid bodies: far under any band


def _solved(
    stiffness: NDArray[np.float64], mass: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Eigenvalues and mass-normalised shapes; None where the mass is not positive."""
    diagonal = np.diag(mass)
    if np.any(diagonal <= 0):
        return None
    try:
        if np.count_nonzero(mass) == len(diagonal):
            root = np.sqrt(diagonal)
            values, vectors = np.linalg.eigh(stiffness / root / root[:, None])
            return values, vectors / root[:, None]
        found: tuple[NDArray[np.float64], NDArray[np.float64]] = scipy.linalg.eigh(
            stiffness, mass, check_finite=False
        )
        return found
    except (np.linalg.LinAlgError, ValueError):
        return None


@dataclass(frozen=True)
class ModeDerivatives:
    """Derivatives of some modes by the model's unknowns: logarithms, the damping ratio, then what is left.

    Attributes
    ----------
    log_frequency : ndarray, (m, n)
    damping_ratio : ndarray, (m, n)
    shapes : ndarray, (n_dofs, m, n)
        Complex where damping or an effect turns them; else those of the undamped ones.
    reduced : ndarray, (q, n)
        Of what the matrices are between modes of one group, where the diagonal holds their eigenvalues. The shapes of a
        group then stay in their place: between close modes a rotation is no linear function of anything, while this
        matrix is.
    between : ndarray of int, (m, m)
        Row of each pair of modes in `reduced`, -1 where they are of no group.
    """

    log_frequency: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    shapes: NDArray[np.float64] | NDArray[np.complex128]
    reduced: NDArray[np.float64]
    between: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        matrices: Matrices,
        solution: EigenSolution,
        modes: NDArray[np.int64],
        group: NDArray[np.int64] | None = None,
    ) -> ModeDerivatives:
        """Derivatives of the modes with these indices.

        Parameters
        ----------
        matrices : Matrices
        solution : EigenSolution
            Their modes.
        modes : ndarray of int, (m,)
        group : ndarray of int, (m,), optional
            Modes with the same number are of one group; those with -1 are of none, as all are where it is left out.
        """
        group = np.full(len(modes), -1) if group is None else group
        if solution.damped is not None:
            return cls._damped(matrices, solution, solution.damped, modes, group)
        between = _numbered_pairs(group)
        log_frequency, weight, reduced = _undamped(matrices, solution, modes, between)
        ratio = _damping(matrices, solution, modes, log_frequency, weight)
        shapes = _with_lag(solution.shapes @ weight, matrices, solution, modes)
        log_frequency, ratio, shapes, reduced = _with_ratios(
            matrices, solution, modes, log_frequency, ratio, shapes, reduced
        )
        return cls(
            log_frequency.T, ratio.T, shapes.transpose(1, 2, 0), np.ascontiguousarray(reduced.T), between
        )

    @classmethod
    def _damped(
        cls,
        matrices: Matrices,
        solution: EigenSolution,
        damped: DampedModes,
        modes: NDArray[np.int64],
        group: NDArray[np.int64],
    ) -> ModeDerivatives:
        omega, phi = np.sqrt(solution.eigenvalues), solution.shapes
        between = _numbered_pairs(group)
        bare, weight, reduced = _undamped(matrices, solution, modes, between)
        log_frequency, ratio = damped.derivatives(matrices, modes, bare, weight, omega)
        turned = np.flatnonzero(damped.turned[modes])
        shapes = _with_lag(phi @ weight, matrices, solution, modes)
        if len(turned):
            shapes = np.asarray(shapes, complex)
        log_frequency, ratio, shapes, reduced = _with_ratios(
            matrices, solution, modes, log_frequency, ratio, shapes, reduced
        )
        if len(turned):
            alone = _numbered_pairs(np.full(len(omega), -1))
            bare, weight, _ = _undamped(matrices, solution, np.arange(len(omega)), alone)
            count, at = len(weight), matrices.terms.log.shape[1]
            order = [*range(at), *range(count, count + len(matrices.damping_log)), *range(at, count)]
            own = damped.derivatives_of(modes[turned], matrices, phi, omega, bare, weight)
            log_frequency[:, turned], ratio[:, turned] = own[0][:, order].T, own[1][:, order].T
            shapes[:, :, turned] = own[2][:, :, order].transpose(2, 1, 0)
        shapes = shapes.transpose(1, 2, 0)
        return cls(log_frequency.T, ratio.T, shapes, np.ascontiguousarray(reduced.T), between)


def _with_lag(
    shapes: NDArray[np.float64],
    matrices: Matrices,
    solution: EigenSolution,
    modes: NDArray[np.int64],
) -> NDArray[Any]:
    """Derivatives of shapes, (n_unknowns, n, m), with what dampers, losses and gyroscopic effects let lag behind.

    Of no size yet they couple nothing, and shapes lag behind with them all the same.
    """
    losses = [DAMPING_MATRIX, STRUCTURAL]
    lag = np.flatnonzero(
        np.any(matrices.shaped[:, losses], axis=1) | np.any(matrices.skew_by_shape, axis=(1, 2))
    )
    if not len(lag):
        return shapes
    damped = solution.damped or DampedModes.uncoupled(
        solution.frequency_hz, solution.damping_ratio, solution.shapes
    )
    found, at, phi = shapes.astype(complex), matrices.terms.log.shape[1], solution.shapes
    by_loss = (matrices.skew_by_shape[lag], *(matrices.by_shape[lag, kind] for kind in losses))
    skew, damping, structural = (phi.T @ of @ phi for of in by_loss)
    found[at + lag] += phi @ damped.lag(skew, damping, structural, solution.eigenvalues)[:, :, modes]
    return found


def _numbered_pairs(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs of modes of one group, numbered through; -1 for all others, (m, m)."""
    of_one = (group[:, None] == group) & (group[:, None] >= 0)
    found = np.full(of_one.shape, -1)
    found[of_one] = np.arange(np.count_nonzero(of_one))
    return found


def _undamped(
    matrices: Matrices, solution: EigenSolution, modes: NDArray[np.int64], between: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of ln f of undamped modes, (n_unknowns, m), of shapes as shares of all, (n_unknowns, n, m), and of
    the matrix between the pairs of modes of a group, (n_unknowns, q).
    """
    stiffness, mass = (_forms(matrices, solution, modes, kind) for kind in (STIFFNESS, MASS))
    values = solution.eigenvalues[modes]
    apart = values[None, :] - solution.eigenvalues[:, None]
    nearness = apart / (apart**2 + (_CLOSE * values[None, :]) ** 2)
    weight = (stiffness - values * mass) * nearness
    here = np.arange(len(modes))
    own = stiffness[:, modes, here] - values * mass[:, modes, here]
    weight[:, modes, here] = -0.5 * mass[:, modes, here]
    a, b = np.nonzero(between >= 0)
    shared = mass[:, modes[a], b]
    reduced = stiffness[:, modes[a], b] - 0.5 * (values[a] + values[b]) * shared
    weight[:, modes[a], b] = -0.5 * shared
    return own / (2 * values), weight, reduced


def _with_ratios(
    matrices: Matrices,
    solution: EigenSolution,
    modes: NDArray[np.int64],
    log_frequency: NDArray[np.float64],
    ratio: NDArray[np.float64],
    shapes: NDArray[T],
    reduced: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[T], NDArray[np.float64]]:
    """Derivatives, unknowns first, with those by the damping ratios of undamped modes, which come after the logs."""
    at, logs = matrices.terms.log.shape[1], matrices.damping_log
    if not len(logs):
        return log_frequency, ratio, shapes, reduced

    def inserted(array: NDArray[Any], rows: NDArray[np.float64] | float) -> NDArray[Any]:
        new = np.zeros((len(logs), *array.shape[1:]), array.dtype)
        new[:] = rows
        return np.concatenate([array[:at], new, array[at:]])

    own = logs[:, modes] * matrices.damping_ratio[modes]
    for along, by_log in matrices.along_modal:
        own += by_log[:, modes] * (np.diag(along) / (2 * np.sqrt(solution.eigenvalues)))[modes]
    return inserted(log_frequency, 0.0), inserted(ratio, own), inserted(shapes, 0.0), inserted(reduced, 0.0)


def _forms(
    matrices: Matrices, solution: EigenSolution, modes: NDArray[np.int64], kind: int
) -> NDArray[np.float64]:
    """φ_sᵀ(∂A/∂x_j)φ_r of one kind of matrix, (n_unknowns, n, m)."""
    terms, phi = matrices.terms, solution.shapes
    logs, m, n = terms.log.shape[1], len(modes), phi.shape[1]
    forms = np.zeros((logs + len(matrices.by_shape), n, m))
    if kind in terms.by_kind:
        on, rows = terms.by_kind[kind]
        along = rows @ phi
        weighted = matrices.coefficient[on, None] * along[:, modes]
        products = (along[:, :, None] * weighted[:, None, :]).reshape(len(on), n * m)
        forms[:logs] = (terms.log[on].T @ products).reshape(logs, n, m)
    if len(matrices.by_shape):
        forms[logs:] = phi.T @ (matrices.by_shape[:, kind] @ phi[:, modes])
    return forms


def _damping(
    matrices: Matrices,
    solution: EigenSolution,
    modes: NDArray[np.int64],
    log_frequency: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Derivatives of the damping ratios but for the common one, (n_unknowns, m)."""
    values = solution.eigenvalues[modes]
    total = np.zeros_like(log_frequency)
    here = np.arange(len(modes))
    phi = solution.shapes
    for kind, size, power in ((DAMPING_MATRIX, np.sqrt(values), 1.0), (STRUCTURAL, values, 2.0)):
        dense = matrices.dense[kind]
        if not np.any(dense) and not np.any(matrices.by_shape[:, kind]):
            continue
        forms = phi.T @ dense @ phi[:, modes]
        share = 0.5 * forms[modes, here] / size
        moved = np.einsum("sr,jsr->jr", forms, weight) / size
        changed = 0.5 * _forms(matrices, solution, modes, kind)[:, modes, here] / size
        total += changed - power * share * log_frequency + moved
    return total
