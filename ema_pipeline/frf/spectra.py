"""Sums of spectra over blocks, and the FRFs of several forces at once that they give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TINY = 1e-300


@dataclass
class Spectra:
    """Sums over blocks, lines first.

    Attributes
    ----------
    forces : complex ndarray, (n_lines, n_in, n_in)
        ΣFFᴴ.
    cross : complex ndarray, (n_lines, n_out, n_in)
        ΣYFᴴ.
    responses : ndarray, (n_lines, n_out)
        Σ|Y|².
    count : int
        Blocks.
    """

    forces: NDArray[np.complex128]
    cross: NDArray[np.complex128]
    responses: NDArray[np.float64]
    count: int = 0

    @classmethod
    def none(cls, n_in: int, n_out: int, n_lines: int) -> Spectra:
        """Nothing summed yet."""
        return cls(
            np.zeros((n_lines, n_in, n_in), complex),
            np.zeros((n_lines, n_out, n_in), complex),
            np.zeros((n_lines, n_out)),
        )

    def add(self, force: NDArray[np.complex128], response: NDArray[np.complex128]) -> None:
        """Add one block: (n_in, n_lines) and (n_out, n_lines)."""
        f, y = force.T, response.T
        self.forces += f[:, :, None] * f[:, None, :].conj()
        self.cross += y[:, :, None] * f[:, None, :].conj()
        self.responses += np.abs(y) ** 2
        self.count += 1

    @property
    def force_power(self) -> NDArray[np.float64]:
        """Power of every force, (n_in, n_lines)."""
        return np.einsum("lii->il", self.forces).real

    def excited(self, share: float) -> NDArray[np.bool_]:
        """Lines at which every force has at least this share of its largest power."""
        power = self.force_power
        on = power >= share * np.max(power[:, 1:], axis=1, keepdims=True)
        on[:, 0] = False
        return np.asarray(np.all(on, axis=0))

    def input_coherence(self) -> NDArray[np.float64]:
        """Ordinary coherence between forces, (n_in, n_in, n_lines)."""
        power = self.force_power.T
        size = np.maximum(power[:, :, None] * power[:, None, :], _TINY)
        return np.asarray(np.moveaxis(np.abs(self.forces) ** 2 / size, 0, -1))

    def explained_by_others(self) -> NDArray[np.float64]:
        """Share of every force that all others explain, (n_in, n_lines)."""
        scaled = _normalised(self.forces)
        n = scaled.shape[1]
        inverse = np.linalg.inv(scaled + 1e-12 * np.eye(n))
        return np.asarray(np.clip(1 - 1 / np.maximum(np.einsum("lii->il", inverse).real, 1.0), 0, 1))


@dataclass(frozen=True)
class Solved:
    """FRFs, partial coherence and variance, (n_out, n_in, n_lines); multiple coherence, (n_out, n_lines)."""

    frf: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    variance: NDArray[np.float64]
    multiple: NDArray[np.float64]


def solved(total: Spectra, averages: float, excited: NDArray[np.bool_], estimator: str) -> Solved:
    """FRFs at the excited lines, 0 at the others; see `driven.estimate_driven_frfs`.

    Parameters
    ----------
    total : Spectra
    averages : float
        Independent blocks.
    excited : ndarray of bool, (n_lines,)
    estimator : str
        ``"H1"``, ``"H2"`` (one force) or ``"Hv"``.
    """
    n_lines, n_out, n_in = total.cross.shape
    frf = np.zeros((n_lines, n_out, n_in), complex)
    coherence = np.zeros((n_lines, n_out, n_in))
    variance = np.full((n_lines, n_out, n_in), np.nan)
    multiple = np.zeros((n_lines, n_out))
    on = np.flatnonzero(excited)
    forces, cross, responses = total.forces[on], total.cross[on], total.responses[on]
    inverse = np.linalg.inv(forces)
    h1 = cross @ inverse
    explained = np.einsum("loi,loi->lo", h1, cross.conj()).real
    seen = np.clip(explained / np.maximum(responses, _TINY), 0.0, 1.0)
    rest = np.maximum(responses - explained, 0.0) / max(averages - n_in, 1.0)
    own = np.einsum("lii->li", inverse).real
    frf[on], multiple[on] = h1, seen
    if averages > n_in:
        variance[on] = rest[:, :, None] * own[:, None, :]
    coherence[on] = _partial(forces, cross, responses) if n_in > 1 else seen[:, :, None]
    if estimator == "H2":
        gain = np.divide(1.0, seen, out=np.zeros_like(seen), where=seen > 1e-12)[:, :, None]
        frf[on] *= gain
        variance[on] *= gain**2
    elif estimator == "Hv":
        frf[on] = _total_least_squares(forces, cross, responses)
    return Solved(
        np.ascontiguousarray(np.moveaxis(frf, 0, -1)),
        np.ascontiguousarray(np.moveaxis(coherence, 0, -1))
        if averages > n_in
        else np.full((n_out, n_in, n_lines), np.nan),
        np.ascontiguousarray(np.moveaxis(variance, 0, -1)),
        np.ascontiguousarray(multiple.T),
    )


def _normalised(forces: NDArray[np.complex128]) -> NDArray[np.complex128]:
    size = np.sqrt(np.maximum(np.einsum("lii->li", forces).real, _TINY))
    return np.asarray(forces / (size[:, :, None] * size[:, None, :]))


def _augmented(
    forces: NDArray[np.complex128], cross: NDArray[np.complex128], responses: NDArray[np.float64], output: int
) -> NDArray[np.complex128]:
    """Spectral matrix of all forces and one response, (n_lines, n_in + 1, n_in + 1)."""
    n = forces.shape[1]
    whole = np.empty((len(forces), n + 1, n + 1), complex)
    whole[:, :n, :n] = forces
    whole[:, n, :n] = cross[:, output]
    whole[:, :n, n] = cross[:, output].conj()
    whole[:, n, n] = responses[:, output]
    return whole


def _partial(
    forces: NDArray[np.complex128], cross: NDArray[np.complex128], responses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Partial coherence of every response and force, (n_lines, n_out, n_in), from the inverse spectral matrix."""
    n, found = forces.shape[1], np.empty(cross.shape)
    for o in range(cross.shape[1]):
        whole = _normalised(_augmented(forces, cross, responses, o))
        inverse = np.linalg.inv(whole + 1e-12 * np.eye(n + 1))
        own = np.einsum("lii->li", inverse).real
        found[:, o] = np.abs(inverse[:, n, :n]) ** 2 / (own[:, n, None] * own[:, :n])
    return np.clip(found, 0.0, 1.0)


def _total_least_squares(
    forces: NDArray[np.complex128], cross: NDArray[np.complex128], responses: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """FRFs whose misfit, forces and response scaled to equal power, is least along all of them, (n_lines, n_out, n_in).

    For one force it is the geometric mean of H1 and H2.
    """
    n, found = forces.shape[1], np.empty(cross.shape, complex)
    for o in range(cross.shape[1]):
        whole = _augmented(forces, cross, responses, o)
        size = np.sqrt(np.maximum(np.einsum("lii->li", whole).real, _TINY))
        _, vectors = np.linalg.eigh(whole / (size[:, :, None] * size[:, None, :]))
        least = vectors[:, :, 0].conj() / size  # h·F - Y = 0 along it
        found[:, o] = -least[:, :n] / np.where(least[:, n:] == 0, _TINY, least[:, n:])
    return found
