"""Finds a hammer and a response whose channels were exchanged.

A hammer pulse is short and pushes one way; a response rings both ways for a while. Only where the force
channel clearly rings *and* exactly one response is clearly a train of pulses are the two called swapped: a
dead, noisy or doubly struck hammer is left to the quality checks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

_PULSE_SIDE = 0.9  # share of the energy on one side of zero: pulses on real hammers have 0.89 to 1.00
_PULSE_SPREAD = 0.004  # share of samples with 90 % of the energy: 0.0002 to 0.0008 on real hammers
_RINGING_SIDE = 0.7
_RINGING_SPREAD = (0.008, 0.3)  # below: a pulse; above: noise (0.44 for Gaussian noise, 0.71 for hum)
_RINGING_CREST = 30.0  # peak over rms: real hammers in noise keep 32 and more
_CONTRAST = 10.0  # the pulse must be this much shorter than the ringing


@dataclass(frozen=True)
class Swap:
    """Evidence that the force channel and a response are exchanged.

    Attributes
    ----------
    channel : str
        The response that looks like a hammer.
    response_share, force_share : float
        Share of the samples that holds 90 % of the energy, of that response and of the force channel.
    """

    channel: str
    response_share: float
    force_share: float


@dataclass(frozen=True)
class _Shape:
    spread: float
    side: float
    crest: float

    @property
    def is_pulse(self) -> bool:
        return self.side >= _PULSE_SIDE and self.spread <= _PULSE_SPREAD

    @property
    def rings(self) -> bool:
        low, high = _RINGING_SPREAD
        return self.side <= _RINGING_SIDE and low <= self.spread <= high and self.crest < _RINGING_CREST


def find_swap(force: ArrayLike, responses: Mapping[str, ArrayLike]) -> Swap | None:
    """Return the response that was exchanged with the force channel, or None.

    Parameters
    ----------
    force : array_like, (n_samples,)
    responses : mapping of str to array_like, (n_samples,)
        Looked at one after the other, and only where the force channel rings.
    """
    shape = _shape(force)
    if not shape.rings:
        return None
    pulses = [(name, s) for name, s in ((n, _shape(r)) for n, r in responses.items()) if s.is_pulse]
    if len(pulses) != 1 or pulses[0][1].spread * _CONTRAST > shape.spread:
        return None
    return Swap(pulses[0][0], pulses[0][1].spread, shape.spread)


def is_pulse(samples: ArrayLike) -> bool:
    """True where samples (n,) look like a hammer: short pulses that push one way."""
    return _shape(samples).is_pulse


def _shape(samples: ArrayLike) -> _Shape:
    x = np.array(samples, dtype=np.float64)
    x -= np.median(x)
    energy = x**2
    total = float(energy.sum())
    if total == 0.0:
        return _Shape(spread=1.0, side=0.5, crest=1.0)
    running = np.cumsum(np.sort(energy)[::-1])
    spread = (int(np.searchsorted(running, 0.9 * total)) + 1) / x.size
    side = max(float(energy[x > 0].sum()), float(energy[x < 0].sum())) / total
    return _Shape(spread, side, float(np.max(np.abs(x)) / np.sqrt(total / x.size)))
