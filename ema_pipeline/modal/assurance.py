"""How alike shapes are, and how real: MAC, also with a subspace, MPC, optimal phase.

Shapes are rows. An entry that is NaN was not measured; it is left out of every comparison that it would
take part in. What is left undefined by that (no common DOF, or a shape that is zero at all of them) is NaN.

References
----------
Allemang, R. J. & Brown, D. L., "A correlation coefficient for modal vector analysis", IMAC 1982.
Pappa, R. S., Elliott, K. B. & Schenk, A., "Consistent-mode indicator for the eigensystem realization
algorithm", J. Guidance, Control, and Dynamics 16(5), 1993.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def mac(shapes_a: ArrayLike, shapes_b: ArrayLike) -> NDArray[np.float64]:
    """Modal assurance criterion of every shape of one set with every shape of another.

    Parameters
    ----------
    shapes_a : array_like, (n_a, n_dofs) or (n_dofs,)
    shapes_b : array_like, (n_b, n_dofs) or (n_dofs,)
        Real or complex, at the same DOFs in the same order.

    Returns
    -------
    ndarray, (n_a, n_b)
        |aᴴb|² / (aᴴa · bᴴb), 0…1, over the DOFs that both shapes have. With one common DOF it is
        always 1 and says nothing.
    """
    a, has_a = _rows(shapes_a)
    b, has_b = _rows(shapes_b)
    cross = np.abs(a.conj() @ b.T) ** 2
    # the norms run over the common DOFs, which differ from pair to pair
    norms = (_power(a) @ has_b.T) * (has_a @ _power(b).T)
    return np.minimum(_ratio(cross, norms), 1.0)


def auto_mac(shapes: ArrayLike) -> NDArray[np.float64]:
    """MAC of a set of shapes, (n, n_dofs), with itself: large off-diagonal terms mean too few sensors."""
    return mac(shapes, shapes)


def mpc(shape: ArrayLike) -> float:
    """Modal phase collinearity |φᵀφ|² / (φᴴφ)²: 1 for a real shape at any phase, 0 for a travelling wave.

    Parameters
    ----------
    shape : array_like, (n_dofs,)

    Notes
    -----
    This is the form about the origin, ((S_xx - S_yy)² + 4 S_xy²) / (S_xx + S_yy)²: a real shape lies on a
    line through the origin of the complex plane, so no mean is taken off.
    """
    phi = _finite(shape)
    return float(np.minimum(_ratio(np.abs(np.sum(phi * phi)) ** 2, np.sum(_power(phi)) ** 2), 1.0))


def real_shape(shape: ArrayLike) -> tuple[NDArray[np.complex128], float]:
    """Turn a shape so that it is as real as possible.

    Parameters
    ----------
    shape : array_like, (n_dofs,)

    Returns
    -------
    shape : complex ndarray, (n_dofs,)
        shape · exp(-jα), with the least sum of squared imaginary parts; its largest entry has a positive
        real part.
    phase : float
        α, rad, in (-π, π].
    """
    phi = np.asarray(shape, dtype=np.complex128)
    phase = _optimal_phase(_finite(phi))
    turned = phi * np.exp(-1j * phase)
    modulus = np.where(np.isfinite(turned), np.abs(turned), -1.0)
    if modulus.size and turned[np.argmax(modulus)].real < 0:
        turned = -turned
        phase += np.pi if phase <= 0 else -np.pi
    return turned, float(phase)


def subspace_mac(shape: ArrayLike, basis: ArrayLike) -> float:
    """Share of a shape that lies in the span of other shapes, 0…1.

    For one basis shape this is the MAC; for the two modes of a degenerate pair, whose own shapes are
    arbitrary within their plane, it is the comparison that has a meaning.

    Parameters
    ----------
    shape : array_like, (n_dofs,)
    basis : array_like, (k, n_dofs)
        Need not be orthogonal, nor independent. With as many independent basis shapes as common DOFs the
        answer is always 1.
    """
    phi = np.asarray(shape, dtype=np.complex128)
    span = np.atleast_2d(np.asarray(basis, dtype=np.complex128))
    common = np.isfinite(phi) & np.all(np.isfinite(span), axis=0)
    inside = _orthonormal(span[:, common]).conj().T @ phi[common]
    return float(np.minimum(_ratio(np.sum(_power(inside)), np.sum(_power(phi[common]))), 1.0))


def _rows(shapes: ArrayLike) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Shapes scaled to a largest entry of 1 (against under- and overflow) with zeros for NaN; the mask."""
    rows = np.atleast_2d(np.asarray(shapes, dtype=np.complex128))
    has = np.isfinite(rows)
    rows = np.where(has, rows, 0.0)
    largest = np.max(np.abs(rows), axis=1, keepdims=True, initial=0.0)
    return rows / np.where(largest > 0, largest, 1.0), has.astype(np.float64)


def _finite(shape: ArrayLike) -> NDArray[np.complex128]:
    """The measured entries, scaled to a largest entry of 1."""
    phi = np.asarray(shape, dtype=np.complex128)
    phi = phi[np.isfinite(phi)]
    largest = np.max(np.abs(phi), initial=0.0)
    return phi / largest if largest > 0 else phi


def _optimal_phase(phi: NDArray[np.complex128]) -> float:
    return float(0.5 * np.angle(np.sum(phi * phi)))


def _orthonormal(basis: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Orthonormal columns spanning the rows of `basis`, (n_dofs, rank)."""
    norms = np.linalg.norm(basis, axis=1, keepdims=True)
    unit = basis / np.where(norms > 0, norms, 1.0)
    if 0 in unit.shape:
        return np.empty((basis.shape[1], 0), dtype=np.complex128)
    u, s, _ = np.linalg.svd(unit.T, full_matrices=False)
    return np.asarray(u[:, s > s[0] * max(unit.shape) * np.finfo(float).eps])


def _power(x: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.asarray(x.real**2 + x.imag**2)


def _ratio(top: ArrayLike, bottom: ArrayLike) -> NDArray[np.float64]:
    top, bottom = np.broadcast_arrays(np.asarray(top, dtype=float), np.asarray(bottom, dtype=float))
    return np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0)
