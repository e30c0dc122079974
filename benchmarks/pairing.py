"""Times of two pieces of work, run in turns: what else the machine does then slows both alike."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO

import numpy as np


@dataclass(frozen=True)
class Paired:
    """Medians over the turns.

    Attributes
    ----------
    ours_s, peer_s : float
        Time of one run.
    ratio : float
        Of peer over ours, the median of the ratios of the turns.
    spread : tuple of float
        Smallest and largest of these ratios.
    """

    ours_s: float
    peer_s: float
    ratio: float
    spread: tuple[float, float]

    def __str__(self) -> str:
        low, high = self.spread
        return (
            f"ours {1e3 * self.ours_s:.1f} ms, peer {1e3 * self.peer_s:.1f} ms, "
            f"ratio {self.ratio:.1f} ({low:.1f} to {high:.1f})"
        )


def paired(ours: Callable[[], object], peer: Callable[[], object], turns: int) -> Paired:
    """Warm both up, then run them in turns, ours as often as fits into a fifth of the peer's time."""
    clock(ours), clock(peer)
    first, second = clock(ours), clock(peer)
    often = max(1, min(20, round(0.2 * second / first)))
    mine, theirs = [], []
    for _ in range(turns):
        mine.append(float(np.median([clock(ours) for _ in range(often)])))
        theirs.append(clock(peer))
    ratios = np.array(theirs) / np.array(mine)
    return Paired(
        float(np.median(mine)),
        float(np.median(theirs)),
        float(np.median(ratios)),
        (float(ratios.min()), float(ratios.max())),
    )


def clock(work: Callable[[], object]) -> float:
    """Time of one run, s; what it prints is dropped."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin
