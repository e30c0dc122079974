"""Modes that damping couples: frequencies, damping ratios and shapes beyond the diagonal of the modal damping matrix.

A strong damper at one place shifts frequencies by the square of what it couples: a model that leaves this out explains
it by a spring that is not there.

References
----------
T. K. Caughey, M. E. J. O'Kelly, Classical normal modes in damped linear dynamic systems, J. Appl. Mech. 32 (1965)
583-588. S. Adhikari, Rates of change of eigenvalues and eigenvectors in damped dynamic system, AIAA Journal 37 (1999)
1452-1458. R. B. Nelson, Simplified calculation of eigenvector derivatives, AIAA Journal 14 (1976) 1201-1205.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.mechanics.terms import DAMPING_MATRIX, MASS, STIFFNESS, STRUCTURAL, Matrices

_NEGLIGIBLE = 1e-6
"""Relative shift of a frequency below which coupling by damping is left out."""
_WEAK = 0.15
"""Share of another mode in a shape up to which eliminating the others one by one is exact enough."""
_ROUNDING = 1e-9
"""Coupling, over ω², that is no more than rounding: modes of one frequency are not mixed by it."""
_TURNS = 0.001
"""Share of another mode in a shape from which derivatives follow the damped shape."""
_CLOSE = 1e-4
"""Dynamic stiffness of another mode, over ω², below which the rotation of two shapes is no longer linear."""
_OVERLAP = 6.0
"""Half-widths within which modes are close."""
_ITERATIONS = 4
_OSCILLATES = 0.1
"""Share of a pole that is imaginary, below which a mode counts as one that does not oscillate."""
_LARGEST_RATIO = 0.99


@dataclass(frozen=True)
class DampedModes:
    """Modes of a coupled damping matrix.

    Attributes
    ----------
    poles : ndarray of complex, (n,)
        rad/s, with positive imaginary part, in the order of the undamped modes that they come from.
    shapes : ndarray of complex, (n, n)
        Columns; the share of the undamped mode of the same index is its own.
    shares : ndarray of complex, (n, n)
        Of the undamped modes in every shape; 1 on the diagonal.
    """

    poles: NDArray[np.complex128]
    shapes: NDArray[np.complex128]
    shares: NDArray[np.complex128]

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Natural frequencies \\|λ\\|/2π, (n,)."""
        return np.asarray(np.abs(self.poles) / (2 * np.pi))

    @property
    def damping_ratio(self) -> NDArray[np.float64]:
        """-Re λ/\\|λ\\|, (n,)."""
        return np.asarray(-np.real(self.poles) / np.abs(self.poles))

    @classmethod
    def of(
        cls,
        values: NDArray[np.float64],
        shapes: NDArray[np.float64],
        damping: NDArray[np.float64],
        structural: NDArray[np.float64],
    ) -> DampedModes | None:
        """Modes; None where coupling changes nothing.

        Parameters
        ----------
        values : ndarray, (n,)
            ω² of the undamped modes.
        shapes : ndarray, (n, n)
            Mass-normalised.
        damping, structural : ndarray, (n, n)
            In modal coordinates, the damping ratio that all modes share and gyroscopic coupling included.
        """
        omega = np.sqrt(values)
        coupled = np.hypot(omega[None, :] * damping, structural)
        np.fill_diagonal(coupled, 0.0)
        own = omega * np.diag(damping) + np.diag(structural)
        apart = np.hypot(values[:, None] - values[None, :], own[:, None] - own[None, :])
        np.fill_diagonal(apart, 1.0)
        apart = np.maximum(apart, 1e-12 * values[None, :])
        if np.max(coupled**2 / apart / values[None, :]) < _NEGLIGIBLE:
            return None
        if np.max(coupled / apart) < _WEAK:
            poles, weights = _eliminated(values, damping, structural)
        else:
            poles, weights = _exact(values, damping, structural) or _eliminated(values, damping, structural)
        if not np.all(np.isfinite(poles)):
            return None
        # What does not oscillate, a damped rigid body say, keeps the frequency and the shape that it has undamped.
        still = np.flatnonzero(np.imag(poles) < _OSCILLATES * np.abs(poles))
        ratio = np.clip(own[still] / (2 * values[still]), -_LARGEST_RATIO, _LARGEST_RATIO)
        poles[still] = omega[still] * (-ratio + 1j * np.sqrt(1 - ratio**2))
        weights[:, still] = np.eye(len(values))[:, still]
        return cls(poles, shapes @ weights, weights)

    @classmethod
    def uncoupled(
        cls,
        frequency_hz: NDArray[np.float64],
        damping_ratio: NDArray[np.float64],
        shapes: NDArray[np.float64],
    ) -> DampedModes:
        """Modes that damping leaves as they are."""
        ratio = np.clip(damping_ratio, -_LARGEST_RATIO, _LARGEST_RATIO)
        poles = 2 * np.pi * frequency_hz * (-ratio + 1j * np.sqrt(1 - ratio**2))
        return cls(poles, shapes.astype(complex), np.eye(len(poles), dtype=complex))

    @cached_property
    def turned(self) -> NDArray[np.bool_]:
        """True for modes whose shapes damping turns so far that derivatives have to follow them, (n,)."""
        return np.asarray(np.count_nonzero(np.abs(self.shares) > _TURNS, axis=0) > 1)

    def lag(
        self,
        skew: NDArray[np.float64],
        damping: NDArray[np.float64],
        structural: NDArray[np.float64],
        values: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Shares of the undamped modes, of these ω², that a little coupling of them adds to every shape, (n, n).

        By gyroscopic coupling, by damping and by structural damping between them, (n, n) each, or (k, n, n) of k
        unknowns. Damping turns close modes into each other, which is no linear function of it: it is left out.
        """
        omega, pole = np.sqrt(values), self.poles[None, :]
        decay = self.damping_ratio * omega
        apart = pole**2 + values[:, None] + 2 * decay[:, None] * pole
        least = (_CLOSE * np.abs(pole) ** 2) ** 2
        far = np.abs(np.subtract.outer(omega, omega)) > _OVERLAP * np.maximum.outer(decay, decay)
        across = skew * pole + np.where(far, damping * pole + 1j * structural, 0.0)
        return np.asarray(-across * np.conj(apart) / (np.abs(apart) ** 2 + least))

    def derivatives(
        self,
        matrices: Matrices,
        modes: NDArray[np.int64],
        log_frequency: NDArray[np.float64],
        turning: NDArray[np.float64],
        omega: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives of ln f and of the damping ratio by all unknowns but those of ratios, two of (n_unknowns, m).

        Of modes whose shapes are nearly the undamped ones, with symmetric matrices.

        Parameters
        ----------
        matrices : Matrices
        modes : ndarray of int, (m,)
        log_frequency : ndarray, (n_unknowns, m)
            Derivatives of the undamped modes, with which the common damping goes.
        turning : ndarray, (n_unknowns, n, m)
            Shares of all undamped shapes in the derivatives of these.
        omega : ndarray, (n,)
            Of the undamped modes, rad/s.
        """
        terms, pole, shape = matrices.terms, self.poles[modes], self.shapes[:, modes]
        every = 2 * matrices.damping_ratio * omega
        common = every[modes]  # what modes have besides the matrices goes with ω and the modal mass
        power = {
            MASS: pole**2 + pole * common,
            DAMPING_MATRIX: pole,
            STIFFNESS: np.ones_like(pole),
            STRUCTURAL: 1j + 0 * pole,
        }
        change = np.zeros((terms.log.shape[1] + len(matrices.by_shape), len(modes)), complex)
        for kind, (on, rows) in terms.by_kind.items():
            square = matrices.coefficient[on, None] * (rows @ shape) ** 2
            change[: terms.log.shape[1]] += power[kind] * (terms.log[on].T @ square)
        for k, kind in np.argwhere(matrices.shaped):
            pushed = matrices.by_shape[k, kind] @ shape
            change[terms.log.shape[1] + k] += power[kind] * np.sum(shape * pushed, axis=0)
        change += pole * common * log_frequency
        apart = every[:, None] - common[None, :]
        change -= 2 * pole * np.einsum("jsr,sr->jr", turning, self.shares[:, modes] * apart)
        mass, damping = matrices.dense[MASS], matrices.dense[DAMPING_MATRIX]
        slope = np.sum(shape * ((2 * mass) @ shape), axis=0) * pole
        slope += np.sum(shape * (damping @ shape), axis=0) + common
        return _of_pole(pole, -change / slope)

    def derivatives_of(
        self,
        modes: NDArray[np.int64],
        matrices: Matrices,
        shapes: NDArray[np.float64],
        omega: NDArray[np.float64],
        log_frequency: NDArray[np.float64],
        turning: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.complex128]]:
        """Derivatives of modes' ln f, damping ratios and shapes by all unknowns, those of damping ratios last.

        With P(λ)q = 0 in coordinates of the undamped modes, P·dq + P'q·dλ = -dP·q is solved for dλ and dq; the own
        share in q stays 1. Holds for any damping and for gyroscopic coupling.

        Parameters
        ----------
        modes : ndarray of int, (m,)
        matrices : Matrices
        shapes : ndarray, (n, n)
            Mass-normalised, undamped.
        omega : ndarray, (n,)
            rad/s.
        log_frequency : ndarray, (n_unknowns, n)
            Derivatives of ln ω.
        turning : ndarray, (n_unknowns, n, n)
            Shares of all undamped shapes in the derivatives of each.

        Returns
        -------
        log_frequency, damping_ratio : ndarray, (m, n_unknowns + u)
        shapes : complex ndarray, (m, n, n_unknowns + u)
        """
        pole, share, shape, terms = (
            self.poles[modes],
            self.shares[:, modes],
            self.shapes[:, modes],
            matrices.terms,
        )
        power = {
            MASS: pole**2,
            DAMPING_MATRIX: pole,
            STIFFNESS: np.ones_like(pole),
            STRUCTURAL: 1j + 0 * pole,
        }
        logs, n, count = terms.log.shape[1], len(share), len(turning)
        common = 2 * matrices.damping_ratio * omega
        force = np.zeros((count + len(matrices.damping_log), n, len(modes)), complex)
        for kind, (on, rows) in terms.by_kind.items():
            pushed = power[kind] * matrices.coefficient[on, None] * (rows @ shape)
            along = (terms.log[on][:, :, None] * (rows @ shapes)[:, None, :]).reshape(len(on), logs * n)
            force[:logs] += _product(along.T, pushed).reshape(logs, n, len(modes))
        for j, kind in np.argwhere(matrices.shaped):
            force[logs + j] += shapes.T @ (power[kind] * (matrices.by_shape[j, kind] @ shape))
        for j in np.flatnonzero(np.any(matrices.skew_by_shape, axis=(1, 2))):
            force[logs + j] += shapes.T @ (pole * (matrices.skew_by_shape[j] @ shape))
        # The damping of undamped modes goes with their frequencies and turns with their shapes.
        shared = common[:, None] * share
        turns = _product(turning.transpose(0, 2, 1), shared) + common[:, None] * _product(turning, share)
        force[:count] += pole * (log_frequency[:, :, None] * shared - turns)
        force[count:] = matrices.damping_log[:, :, None] * (pole * shared)
        for along, by_log in matrices.along_modal:
            by_mode = by_log[:, :, None]
            force[count:] += 0.5 * pole * (by_mode * (along @ share) + along @ (by_mode * share))
        _, damping, stiffness, structural = (shapes.T @ dense @ shapes for dense in matrices.dense)
        damping = damping + shapes.T @ matrices.skew @ shapes + np.diag(common)
        whole = pole[:, None, None] * damping + (stiffness + 1j * structural)
        at, every = np.arange(len(modes)), np.arange(n)
        own = whole[:, every, every] + (pole**2)[:, None] + 1e-30
        whole[:, every, every] = own + (_CLOSE * np.abs(pole[:, None]) ** 2) ** 2 / np.conj(own)
        whole[at, :, modes] = (2 * pole * share + damping @ share).T
        try:
            found = np.linalg.solve(whole, -force.transpose(2, 1, 0))
        except np.linalg.LinAlgError:  # a damper beside which nothing else is left in double precision
            found = -np.linalg.pinv(whole) @ force.transpose(2, 1, 0)
        frequency, ratio = _of_pole(pole[:, None], found[at, modes])
        found[at, modes] = 0.0
        return frequency, ratio, np.asarray(shapes @ found, complex)


def _product(matrix: NDArray[np.float64], columns: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Product of a real matrix, or several, with complex columns; no complex copy of the matrix is made."""
    both = matrix @ np.concatenate([columns.real, columns.imag], axis=1)
    m = columns.shape[1]
    return np.asarray(both[..., :m] + 1j * both[..., m:])


def _of_pole(
    pole: NDArray[np.complex128], moved: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of ln f and of the damping ratio from those of a pole."""
    ratio, turned = -np.real(pole) / np.abs(pole), moved / pole
    # λ = |λ|(-ζ + i√(1 - ζ²)): the real part of d ln λ is d ln|λ|, the imaginary one turns the pole by dζ
    return np.real(turned), np.imag(turned) * np.sqrt(np.maximum(1 - ratio**2, 0.0))


def _eliminated(
    values: NDArray[np.float64], damping: NDArray[np.float64], structural: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles and shares of the undamped modes, each mode with all others eliminated."""
    own, lag = np.diag(damping), np.diag(structural)
    mixed = np.hypot(np.sqrt(values)[None, :] * damping, structural) > _ROUNDING * values[None, :]
    np.fill_diagonal(mixed, False)
    stiff = values + 1j * lag
    pole = -0.5 * own + 1j * np.sqrt(np.maximum(stiff - 0.25 * own**2, 1e-12) + 0j)
    aside, behind = damping - np.diag(own), structural - np.diag(lag)
    share = np.zeros_like(aside, complex)
    for _ in range(_ITERATIONS):
        across = damping * pole[None, :] + 1j * structural
        across = (
            across + (aside @ share) * pole[None, :] + 1j * (behind @ share)
        )  # what the others do to each other
        back = damping.T * pole[None, :] + 1j * structural  # gyroscopic coupling has the other sign
        others = pole[None, :] ** 2 + pole[None, :] * own[:, None] + stiff[:, None]
        share = np.where(mixed, -across / np.where(mixed, others, 1.0), 0.0)
        pull = np.sum(back * share, axis=0)  # nothing from the mode itself, whose share is 0 here
        pole = -0.5 * own + 1j * np.sqrt(stiff + pull - 0.25 * own**2 + 0j)
    np.fill_diagonal(share, 1.0)
    return pole, share


def _exact(
    values: NDArray[np.float64], damping: NDArray[np.float64], structural: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]] | None:
    """The same from the eigenvalues of the first-order system; None where they cannot be told apart by shape."""
    n = len(values)
    scale = float(np.sqrt(np.max(values)))
    stiff = np.diag(values)
    if np.any(structural):  # a real matrix takes half the time
        stiff = stiff + 1j * structural
    first = np.zeros((2 * n, 2 * n), stiff.dtype)
    first[:n, n:] = np.eye(n)
    first[n:, :n] = -stiff / scale**2
    first[n:, n:] = -damping / scale
    try:
        found, vectors = scipy.linalg.eig(first, check_finite=False)
    except (np.linalg.LinAlgError, ValueError):
        return None
    up = np.flatnonzero(np.imag(found) > 1e-9)
    if len(up) > n:
        return None
    weights = vectors[:n, up]
    weights = weights / np.max(np.abs(weights), axis=0)
    mode, column = scipy.optimize.linear_sum_assignment(-(np.abs(weights) ** 2))
    weights = weights[:, column]
    own = weights[mode, np.arange(len(mode))]
    if np.any(np.abs(own) < 1e-3):
        return None
    poles, shares = (
        np.full(n, -scale, complex),
        np.eye(n, dtype=complex),
    )  # where nothing is found: no oscillation
    poles[mode], shares[:, mode] = found[up][column] * scale, weights / own
    return poles, shares
