"""Modes that zeros of the force's spectrum make: division by next to no force raises whatever is left of a response.

A pulse of one shape has zeros, of which the first lies at about 1.5 over its length. What a record cuts off, hum and
noise are smooth over frequency; divided by the force they look like a heavily damped mode there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.drift.windows import Hits
from ema_pipeline.modal.identify import ANCHORED, AT_PEAK
from ema_pipeline.modal.left_out import taken_out_and_named
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.types import ModalModel, Mode

Real = NDArray[np.float64]

WEAK = 0.01
"""Power of the force over its largest, above which a mode is excited."""

DIPS = 0.4
"""Power of the force at a mode, over that two to four half-power half-widths on either side, below which it has a zero
there: 0.02 to 0.38 where zeros made a pole. Modes lie at zeros, too."""

UNKNOWN = 0.04
"""Relative standard deviation of the damping above which such a mode is doubted: real ones had up to 0.01, those that
zeros made 0.05 to 0.14."""

REASON = "the force has next to no energy there, at a zero of its spectrum, and the damping is known poorly"


def without_zeros(modal: ModalModel, hits: Hits, frfs: FrfSet, wanted: KnownPeaks) -> ModalModel:
    """The modes without those that zeros of the force's spectrum make, which are named among what is left out.

    Parameters
    ----------
    modal : ModalModel
    hits : callable
        Gives the accepted hits.
    frfs : FrfSet
        Of these hits.
    wanted : KnownPeaks
        Modes that the user asked for, which stay.
    """
    doubtful = [k for k, mode in enumerate(modal.modes) if _doubtful(mode, wanted)]
    if not doubtful:
        return modal
    power: dict[str, Real] = {}
    for hit in hits():
        here = np.abs(np.asarray(rfft(hit.force))) ** 2
        point = hit.hit.impact.point
        power[point] = power[point] + here if point in power else here
    step = float(frfs.frequency_hz[1])
    gone = [k for k in doubtful if _at_zero(modal.modes[k], list(power.values()), step)]
    if not gone:
        return modal
    return taken_out_and_named(modal, gone, "a pole", REASON)


def _doubtful(mode: Mode, wanted: KnownPeaks) -> bool:
    held = ANCHORED in mode.flags or AT_PEAK in mode.flags
    poorly_known = mode.damping_std > UNKNOWN * abs(mode.damping_ratio)
    return poorly_known and not held and not wanted.hold(mode.pole)


def _at_zero(mode: Mode, power: list[Real], step_hz: float) -> bool:
    """True where no point was struck with much force at the frequency of a mode, and at one the force has a zero."""
    line = round(mode.frequency_hz / step_hz)
    width = max(mode.frequency_hz * mode.damping_ratio / step_hz, 1.0)
    near, far = max(int(2 * width), 3), max(int(4 * width), 5)
    if not near < line < len(power[0]) - far:
        return False
    here = np.array([p[max(line - 1, 1) : line + 2].mean() for p in power])
    most = np.array([p[1:].max() for p in power])
    sides = slice(max(line - far, 1), line - near + 1), slice(line + near, line + far + 1)
    beside = np.array([max(np.median(p[side]) for side in sides) for p in power])
    return bool(np.all(here < WEAK * most) and np.any(here < DIPS * beside))
