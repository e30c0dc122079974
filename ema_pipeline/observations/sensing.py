"""What the sensors of one configuration read of the model's shapes, with derivatives by all unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.eigen_derivatives import EigenSolution
from ema_pipeline.observations.comparison_kernel import turn_slopes
from ema_pipeline.observations.mode_pairing import turned


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
        Positions of the unknowns of `ModeData.holds`.
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
        self._last: tuple[EigenSolution, NDArray[Any], NDArray[np.float64]] | None = None

    def of(self, solution: EigenSolution) -> NDArray[Any]:
        """Of every mode, (s, n); complex where the modes are. What was read last is kept."""
        return self._read_of(solution)[1]

    def turned(self, solution: EigenSolution) -> NDArray[np.float64]:
        """The same, turned as measured shapes are, and made real."""
        return self._read_of(solution)[2]

    def _read_of(self, solution: EigenSolution) -> tuple[EigenSolution, NDArray[Any], NDArray[np.float64]]:
        if self._last is None or self._last[0] is not solution:
            shapes = solution.shapes if solution.damped is None else solution.damped.shapes
            read = np.asarray(self._rows @ shapes[: self._rows.shape[1]])
            self._last = solution, read, turned(read)
        return self._last

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
        # complex numbers as pairs of real ones: half of the products
        flat = np.ascontiguousarray(by_model[:width]).view(float).reshape(width, -1)
        read = (self._rows @ flat).view(by_model.dtype)
        slope[:, :, : by_model.shape[2]] = read.reshape(count, k, by_model.shape[2]).transpose(1, 0, 2)
        has = np.flatnonzero(s.gain >= 0)
        slope[:, has, s.gain[has]] += predicted[:, has]
        for across, unknown in zip(s.across, s.transverse, strict=True):
            has = np.flatnonzero(unknown >= 0)
            slope[:, has, unknown[has]] += (self._gain[:, None] * (across @ shapes)).T[:, has]
        return slope

    def real_slopes(
        self, slopes: NDArray[Any], solution: EigenSolution, to: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """The same of shapes that are turned as measured ones are, and made real, from `slopes`."""
        if solution.damped is not None and np.iscomplexobj(slopes):
            return turned_slopes(self.of(solution)[:, to].T, slopes)
        return np.ascontiguousarray(np.real(slopes))


def turned_slopes(read: NDArray[np.complex128], slope: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Derivatives of `mode_pairing.turned` shapes from those (k, s, n) of the complex ones (k, s), which turn the
    angle, too.
    """
    result = np.empty(slope.shape)
    turn_slopes(np.ascontiguousarray(read, complex), np.ascontiguousarray(slope, complex), result)
    return result
