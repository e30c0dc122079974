"""Where the isolator's model fails, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.types import Loop, LoopFit

PLAY = 0.04
"""Share of the amplitude by which the idle travel must exceed the model's to be called play."""
IDLE_FORCE = 0.10
"""Share of half the force range within which the force counts as idle."""
ENERGY = 0.03
"""Error of the energy per cycle that is worth a word."""
CHATTER = 0.05
"""Amplitude of a fast force oscillation, as a share of half the force range, that is worth a word."""
SIDES = 0.08
"""Offset of the loop's middle, as a share of half the force range, that is worth a word."""
_MIDDLE = 0.3
SLOWEST_CHATTER = 8
"""Harmonics of the drive from which an oscillation counts as fast."""


def failures(
    loops: Sequence[Loop],
    fits: Sequence[LoopFit],
    alone: Sequence[LoopFit],
    scale: float,
    *,
    has_play: bool = False,
    own_scales: bool = False,
) -> tuple[str, ...]:
    """Sentences on what the model does not show, worst first.

    Parameters
    ----------
    loops, fits, alone : sequences of equal length
        Measured loops, their fits by one set of parameters, and by parameters of their own.
    scale : float
        Root-mean-square misfit in standard deviations.
    has_play, own_scales : bool
        Whether the model has play, and whether each loop has a force scale of its own.
    """
    words = []
    energy = [abs(fit.energy_error) for fit in fits]
    worst = int(np.argmax(energy))
    if energy[worst] > ENERGY:
        scaled = ", each loop with a force scale of its own," if own_scales else ""
        device = "" if own_scales else "the loops do not come from the same device, or "
        words.append(
            f"one set of parameters{scaled} misses the energy per cycle by up to {100 * energy[worst]:.2g} % "
            f"({loops[worst].name}): {device}the loss depends on amplitude, frequency or setting in a way "
            "that the model does not describe"
        )
    words += _play(loops, alone, has_play)
    words += _sides(loops, alone) if has_play else []
    words += _chatter(loops, alone)
    if scale > 2 and not words:
        at = int(np.argmax([fit.misfit for fit in fits]))
        words.append(
            f"the loops differ from the model by {scale:.2g} times their noise, most at {loops[at].name} "
            f"({100 * fits[at].misfit:.2g} % of its force)"
        )
    return tuple(words)


def _play(loops: Sequence[Loop], alone: Sequence[LoopFit], has_play: bool) -> list[str]:
    """Travel at hardly any force after a reversal, which no Bouc-Wen loop has."""
    found = []
    for loop, fit in zip(loops, alone, strict=True):
        travel = idle_travel(loop.displacement, loop.force) - idle_travel(loop.displacement, fit.force)
        if travel > PLAY * loop.amplitude_m:
            found.append((travel, loop))
    if not found:
        return []
    low, high = (1e3 * f(t for t, _ in found) for f in (min, max))
    span = f"{low:.2g}" if f"{low:.2g}" == f"{high:.2g}" else f"{low:.2g} to {high:.2g}"
    if has_play:
        return [
            f"the play differs between loops: after a reversal {len(found)} of {len(loops)} loops move "
            f"{span} mm further almost without force than the model does"
        ]
    return [
        f"after a reversal the device moves {span} mm further almost without force than the fitted loop does "
        f"({len(found)} of {len(loops)} loops): it has play (backlash), which a Bouc-Wen loop does not have; "
        "the fit rounds it off into a softer unloading branch"
    ]


def _sides(loops: Sequence[Loop], fits: Sequence[LoopFit]) -> list[str]:
    """Force that is larger one way than the other, about the level of the play."""
    found = []
    for loop, fit in zip(loops, fits, strict=True):
        near = np.abs(loop.displacement) < _MIDDLE * loop.amplitude_m
        up, down = loop.force[near & (loop.velocity > 0)], loop.force[near & (loop.velocity < 0)]
        if len(up) and len(down):
            middle = 0.5 * (float(np.median(up)) + float(np.median(down)))
            found.append((abs(middle) / (0.5 * float(np.ptp(fit.force))), loop.name))
    share, name = max(found, default=(0.0, ""))
    if share < SIDES:
        return []
    return [
        f"the force is larger one way than the other, by up to {100 * 2 * share:.2g} % of its size ({name}): a brake "
        "that tightens itself one way, or an offset of the force channel; the model is the same both ways"
    ]


def idle_travel(x: NDArray[np.float64], force: NDArray[np.float64]) -> float:
    """Mean travel per half cycle within `IDLE_FORCE` of half the force range about zero, m.

    Forces count from the middle between the branches, so that an offset of the force channel does no harm.
    """
    middle = 0.5 * (np.quantile(force, 0.02) + np.quantile(force, 0.98))
    half = 0.5 * (np.quantile(force, 0.98) - np.quantile(force, 0.02))
    centre = middle if abs(middle) > IDLE_FORCE * half and np.min(np.abs(force)) > 0.5 * abs(middle) else 0.0
    idle = np.abs(force - centre) < IDLE_FORCE * half
    step = np.abs(np.diff(np.append(x, x[0])))
    return float(0.5 * np.sum(step[idle]))


def _chatter(loops: Sequence[Loop], alone: Sequence[LoopFit]) -> list[str]:
    worst, frequency = 0.0, 0.0
    for loop, fit in zip(loops, alone, strict=True):
        spectrum = np.abs(np.fft.rfft(loop.force - fit.force)) * 2 / len(loop.force)
        spectrum[:SLOWEST_CHATTER] = 0.0
        share = float(np.sqrt(np.sum(spectrum**2))) / (0.5 * float(np.ptp(loop.force)))
        if share > worst:
            worst, frequency = share, int(np.argmax(spectrum)) * loop.frequency_hz
    if worst < CHATTER:
        return []
    return [
        f"the force oscillates about the fitted loop, most at {frequency:.2g} Hz and by up to "
        f"{100 * worst:.2g} % of its size: stick-slip, or a resonance of the test "
        "machine; the fit goes through its middle"
    ]
