"""Sensors that are late or early against the others: modules that are not synchronised, filters that differ.

Shapes of lightly damped structures are real, up to a factor of each mode. A channel that is late by τ turns its entry
of a shape by −ωτ: in mode after mode in proportion to the frequency, which no damper does. A fit follows it without a
misfit, and shapes are complex that should be real; what is then fitted to them is wrong by several standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as variance_ratio

from ema_pipeline.dof import Dof
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.plain_residues import FALSE_ALARM, FEWEST_PEAKS, PlainResidues

Real = NDArray[np.float64]

TRIALS = 20
"""Delays that are tried on each sensor count as so many independent ones."""

COMPLEX = 0.01
"""Standard deviation of the phases of shapes, rad, that dampers leave in any case."""

STEPS = 800
"""Delays tried in each sensor, up to one period of the highest peak either way."""

ALTERNATIONS = 30
SWEEPS = 20


@dataclass(frozen=True)
class ChannelDelays:
    """Delays of sensors against the majority of the others.

    Attributes
    ----------
    outputs : tuple of Dof
    delay_s, std_s : ndarray, (n_outputs,)
        0 where there is none.
    """

    outputs: tuple[Dof, ...]
    delay_s: Real
    std_s: Real

    def taken_out(self, frfs: FrfSet) -> FrfSet:
        """The FRFs as sensors that are not late would have shown them."""
        turn = np.exp(2j * np.pi * frfs.frequency_hz * self.delay_s[:, None])
        return replace(frfs, frf=frfs.frf * turn[:, None, :])

    @property
    def note(self) -> str:
        """What was found, and the remedy."""
        named = "; ".join(
            f"{self.outputs[o]} is {1e3 * abs(self.delay_s[o]):.3g} ± {1e3 * self.std_s[o]:.1g} ms "
            f"{'late' if self.delay_s[o] > 0 else 'early'}"
            for o in np.flatnonzero(self.delay_s)
        )
        return (
            f"sensors do not measure at the same time, alike in all modes: {named}. FRFs were corrected; check the "
            "synchronisation of the modules and the filters of these channels"
        )


@dataclass(frozen=True)
class _Phases:
    """Phases of the shapes of all peaks at the sensors.

    Attributes
    ----------
    omega : ndarray, (n_peaks,)
    doubled : complex ndarray, (n_peaks, n_outputs)
        e²ʲᵖ, in which the sign of an entry does not count.
    weight : ndarray, (n_peaks, n_outputs)
        Inverse variances of the phases p.
    """

    omega: Real
    doubled: NDArray[np.complex128]
    weight: Real

    def turned(self, delay: Real) -> NDArray[np.complex128]:
        """Doubled phases without delays, (n_peaks, n_outputs)."""
        return np.asarray(self.doubled * np.exp(2j * self.omega[:, None] * delay))

    def misfit(self, delay: Real) -> Real:
        """Squares of sines of what every peak leaves, over their variances, (n_peaks,)."""
        turned = self.turned(delay)
        common = _unit(np.sum(self.weight * turned, axis=1))
        return np.asarray(np.sum(self.weight * (1 - (turned * common.conj()[:, None]).real), axis=1) / 2)

    def best(self, output: int, delay: Real) -> float:
        """Delay of one sensor that fits the others best, s."""
        others = self.weight.copy()
        others[:, output] = 0.0
        common = _unit(np.sum(others * self.turned(delay), axis=1))
        best, reach = 0.0, 2 * np.pi / float(self.omega.max())
        for _ in range(2):
            tried = best + np.linspace(-reach, reach, STEPS + 1)
            turn = np.exp(2j * self.omega * tried[:, None])
            likeness = (self.doubled[:, output] * common.conj() * turn).real @ self.weight[:, output]
            best, reach = float(tried[np.argmax(likeness)]), 2 * reach / STEPS
        return best

    def swept(self, delay: Real, some: Sequence[int]) -> Real:
        """Delays of some sensors, each against all others in turn."""
        now = delay.copy()
        for _ in range(SWEEPS):
            before = now.copy()
            for output in some:
                now[output] = self.best(output, now)
            if np.array_equal(before, now):
                break
        return now


def channel_delays(frfs: FrfSet, found: Sequence[PlainResidues]) -> ChannelDelays | None:
    """Sensors that are late or early; None unless three peaks or more show it.

    Forward selection: a delay is believed where an F-test on all peaks leaves less than `FALSE_ALARM` to chance, over
    all sensors; the first one without the peak that speaks for it most.

    Parameters
    ----------
    frfs : FrfSet
    found : sequence of PlainResidues
        Of these FRFs.
    """
    n_outputs = len(frfs.outputs)
    if n_outputs < 2 or len(found) < FEWEST_PEAKS:
        return None
    phases = _phases(found)
    delay = np.zeros(n_outputs)
    noise = phases.misfit(phases.swept(delay, range(n_outputs)))
    late: list[int] = []
    while len(late) < n_outputs - 1:
        chances = [np.inf if o in late else _chance(phases, delay, noise, o, late) for o in range(n_outputs)]
        best = int(np.argmin(chances))
        if chances[best] > FALSE_ALARM:
            break
        late.append(best)
        delay = phases.swept(delay, late)
    if not late:
        return None
    free = max(int(np.count_nonzero(phases.weight)) - len(found) - len(late), 1)
    level = max(float(np.sum(phases.misfit(delay))) / free, 1.0)
    std = np.sqrt(level / np.maximum(np.sum(phases.weight * phases.omega[:, None] ** 2, axis=0), 1e-300))
    return ChannelDelays(frfs.outputs, delay, np.where(delay != 0, std, 0.0))


def _phases(found: Sequence[PlainResidues]) -> _Phases:
    doubled, weight = [], []
    for peak in found:
        left, right, misfit = peak.rank_one(ALTERNATIONS)
        level = max(misfit / max(peak.free, 1), 1.0)
        information = np.abs(left[:, 0]) ** 2 @ (1 / peak.variance) * np.abs(right[0]) ** 2
        doubled.append(_unit(right[0] ** 2))
        weight.append(
            np.where(information > 0, 1 / (0.5 * level / np.maximum(information, 1e-300) + COMPLEX**2), 0.0)
        )
    return _Phases(np.array([p.omega for p in found]), np.array(doubled), np.array(weight))


def _chance(phases: _Phases, delay: Real, noise: Real, output: int, late: list[int]) -> float:
    """Probability by chance of what a delay of one sensor explains, F-test.

    Against what it leaves, or where other sensors are late too against `noise`, what delays of all sensors leave.
    """
    tried = delay.copy()
    tried[output] = phases.best(output, delay)
    after = phases.misfit(tried)
    gain = phases.misfit(delay) - after
    # the first must hold without the peak that speaks for it most: one peak alone may be of two modes
    kept = (np.arange(len(gain)) != np.argmax(gain)) | bool(late)
    data = int(np.count_nonzero(phases.weight[kept])) - int(np.count_nonzero(kept))
    chance = np.inf
    for left, free in ((after, data - len(late) - 1), (noise, data - len(delay) + 1)):
        if free > 0:
            ratio = float(np.sum(gain[kept])) / max(float(np.sum(left[kept])) / free, 1.0)
            chance = min(chance, float(variance_ratio.sf(ratio, 1, free)))
    return len(delay) * TRIALS * chance


def _unit(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(values / np.maximum(np.abs(values), 1e-300))
