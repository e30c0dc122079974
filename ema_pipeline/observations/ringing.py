"""How the modes ring on after every blow, and what the fit of single hits reads of a change meanwhile."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.observations.hit_reading import LAST, drive_gains, momentary_weights

if TYPE_CHECKING:
    from ema_pipeline.observations.hit_data import HitData

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FIRST = 0.03
"""First instant, in units of 1/2σ of the fastest mode."""
_PER_EFOLD = 1.1
_FASTER = 1.5
"""Most by which a mode's motion decays faster or slower in one hit than in most. The weight of each instant is that of
the median decay; a hit read with nine times that would leave, next to a mode that moves in step, no motion to refer to.
"""


class Ringing:
    """Of all hits and modes, found where it is asked for.

    Parameters
    ----------
    data : HitData
    """

    def __init__(self, data: HitData) -> None:
        self._data = data

    @cached_property
    def in_step(self) -> Real:
        """1 where a mode belongs to a group of those that move in step, (m, n_groups)."""
        found = np.zeros((len(self._data.modes), len(self._data.groups)))
        for k, group in enumerate(self._data.groups):
            found[group, k] = 1.0
        return found

    @cached_property
    def omega(self) -> Real:
        """Mean of every group, rad/s, (n_groups,)."""
        return np.asarray(self._data.omega @ self.in_step / self.in_step.sum(axis=0))

    @cached_property
    def motion(self) -> Complex:
        """Envelope of every mode about its group's frequency at the instants of `weights`, over that just after the
        blow, (h, t, m).
        """
        poles, usual = self._data.poles, self._data.decay
        decay = np.clip(-poles.real, usual / _FASTER, usual * _FASTER)
        turning = 1j * (poles.imag - self.in_step @ self.omega) - decay
        return np.asarray(np.exp(turning[:, None] * self.weights[0][:, None]))

    @cached_property
    def weights(self) -> tuple[Real, Complex]:
        """Instants after the blow, (t,), and the weight of each in what is read of every mode, (2, t, m).

        See `hit_reading.momentary_weights`.
        """
        decay = self._data.decay + self._data.window_decay
        first, last = np.log(0.5 * _FIRST / decay.max()), np.log(0.5 * LAST / decay.min())
        instants = np.exp(np.linspace(first, last, int(_PER_EFOLD * (last - first)) + 2))
        columns = [
            momentary_weights(instants, complex(-s, w), np.arange(low, high, self._data.line_hz))
            for s, w, (low, high) in zip(decay, self._data.omega, self._data.band_hz.tolist(), strict=True)
        ]
        return instants, np.stack(columns, axis=2)

    @cached_property
    def product_gains(self) -> Complex:
        """What is read of every mode where the product of two motions drives it, (pairs, 2m).

        Of `motion_pairs`, in both orders; poles, then sizes of all modes. See `hit_reading.drive_gains`.
        """
        together = self.exponents[:, None] + self.exponents - self._data.window_decay
        poles = self.exponents[: len(self._data.modes)] - self._data.window_decay
        gains = np.stack(
            [
                drive_gains(together, pole, np.arange(low, high, self._data.line_hz))
                for pole, (low, high) in zip(poles, self._data.band_hz.tolist(), strict=True)
            ],
            axis=1,
        )
        a, b = self.motion_pairs
        in_both_orders = gains[..., a, b] + np.where(a == b, 0.0, gains[..., b, a])
        return np.ascontiguousarray(in_both_orders.reshape(-1, len(a)).T)

    @cached_property
    def motion_pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of two among `exponents`, every pair once, two of (pairs,)."""
        first, second = np.triu_indices(len(self.exponents))
        return first, second

    @cached_property
    def exponents(self) -> Complex:
        """Poles of all modes, then their conjugates, 1/s, (2m,)."""
        pole = 1j * self._data.omega - self._data.decay
        return np.concatenate([pole, pole.conj()])
