"""What the sensors of one configuration read of the model's shapes, with derivatives by all unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.eigen_derivatives import EigenSolution


@dataclass(frozen=True)
class Sensing:
    """Rows of the motion along and across each sensor, and the unknowns of what it reads of them.

    Attributes
    ----------
    along : ndarray, (s, n)
    across : ndarray, (k, s, n)
        In up to k - 1 directions; last along it once more, for how blows were aimed.
    gain : ndarray of int, (s,)
    transverse : ndarray of int, (k, s)
        Positions of their unknowns, -1 for none.
    drift : int
        Position of the unknown by which all frequencies are off together; -1 where no frequencies are compared.
    mixing : ndarray of int, (k,)
        Positions of the unknowns of `ModeData.mixes`.
    """

    along: NDArray[np.float64]
    across: NDArray[np.float64]
    gain: NDArray[np.int64]
    transverse: NDArray[np.int64]
    drift: int
    mixing: NDArray[np.int64]

    def moved(self, by: int) -> Sensing:
        """With all unknowns so many places further on."""

        def further(at: NDArray[np.int64]) -> NDArray[np.int64]:
            return np.where(at >= 0, at + by, at)

        gain, transverse, mixing = map(further, (self.gain, self.transverse, self.mixing))
        drift = self.drift + by if self.drift >= 0 else self.drift
        return replace(self, gain=gain, transverse=transverse, drift=drift, mixing=mixing)


class SensorReadings:
    """What the sensors read at one point.

    Parameters
    ----------
    sensing : Sensing
    x : ndarray, (n,)
        All unknowns.
    """

    def __init__(self, sensing: Sensing, x: NDArray[np.float64]) -> None:
        self._sensing, self._unknowns = sensing, len(x)
        self._gain = np.where(sensing.gain >= 0, np.exp(x[np.maximum(sensing.gain, 0)]), 1.0)
        cross = np.where(sensing.transverse >= 0, x[np.maximum(sensing.transverse, 0)], 0.0)
        self._rows = self._gain[:, None] * (sensing.along + np.sum(cross[..., None] * sensing.across, axis=0))

    def of(self, solution: EigenSolution) -> NDArray[Any]:
        """Of every mode, (s, n); complex where the modes are."""
        shapes = solution.shapes if solution.damped is None else solution.damped.shapes
        return np.asarray(self._rows @ shapes[: self._rows.shape[1]])

    def slopes(
        self,
        by_model: NDArray[np.float64] | NDArray[np.complex128],
        solution: EigenSolution,
        to: NDArray[np.int64],
    ) -> NDArray[Any]:
        """Derivatives of what is read of some modes by all unknowns, complex where they are, (k, s, n).

        Parameters
        ----------
        by_model : ndarray, (n_coordinates, k, m)
            Derivatives of their shapes by the model's unknowns, which come first.
        solution : EigenSolution
        to : ndarray of int, (k,)
            These modes.
        """
        width, s = self._rows.shape[1], self._sensing
        follows = solution.damped if np.iscomplexobj(by_model) else None
        shapes = (solution if follows is None else follows).shapes[:width, to]
        predicted = (self._rows @ shapes).T
        k, count = predicted.shape
        slope = np.zeros((k, count, self._unknowns), np.result_type(predicted, by_model))
        read = self._rows @ by_model[:width].reshape(width, k * by_model.shape[2])
        slope[:, :, : by_model.shape[2]] = read.reshape(count, k, by_model.shape[2]).transpose(1, 0, 2)
        has = np.flatnonzero(s.gain >= 0)
        slope[:, has, s.gain[has]] += predicted[:, has]
        for across, unknown in zip(s.across, s.transverse, strict=True):
            has = np.flatnonzero(unknown >= 0)
            slope[:, has, unknown[has]] += (self._gain[:, None] * (across @ shapes)).T[:, has]
        return slope

    def real_slopes(
        self,
        by_model: NDArray[np.float64] | NDArray[np.complex128],
        solution: EigenSolution,
        to: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """The same of shapes that are turned as measured ones are, and made real."""
        slope = self.slopes(by_model, solution, to)
        if solution.damped is not None and np.iscomplexobj(slope):
            return turned_slopes(self.of(solution)[:, to].T, slope)
        return np.real(slope)


def turned_slopes(read: NDArray[np.complex128], slope: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Derivatives of `mode_pairing.turned` shapes from those (k, s, n) of the complex ones (k, s), which turn the
    angle, too.
    """
    square = np.sum(read**2, axis=1)
    square = np.where(square == 0, 1.0, square)  # no sensor reads the mode: nothing turns
    back = np.exp(-0.5j * np.angle(square))[:, None]
    angle = np.imag(np.einsum("ks,ksn->kn", read, slope) / square[:, None])
    return np.asarray(np.real(back[..., None] * slope) + np.imag(back * read)[..., None] * angle[:, None, :])
