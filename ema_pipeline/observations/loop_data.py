"""One measured loop, prepared for comparison: its force in orthonormal functions of the phase, by harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.fourier import fourier
from ema_pipeline.observations.typical import Typical

SAME_AMPLITUDE = 0.05
"""Loops whose amplitudes agree to this share are taken as tests at one amplitude."""
SAME_FREQUENCY = 0.02
"""Loops whose frequencies agree to this share are taken as tests at one frequency."""
_FEWEST_GROUPS = 3
"""Amplitudes or frequencies from which one can be left out and still be enclosed or extrapolated by two."""
_ROUGH = 10
"""Harmonic up to which what a model lacks may be as large as at the first: play, stick and slip reach that far."""
_CLEARLY = 0.1
"""Share of the energy by which loops of one frequency and amplitude differ where they are of different settings."""


@dataclass(frozen=True)
class LoopData:
    """A loop's force as coefficients of orthonormal functions of its phases, the mean left out.

    Orthonormal functions keep the root mean square of the noise: `own_std` is that of one point of the force.

    Attributes
    ----------
    loop : Loop
    basis : ndarray, (n_points, n_rows)
        Cosine and sine of every harmonic, made orthonormal at the loop's phases.
    measured : ndarray, (n_rows,)
        N.
    own_std : ndarray, (n_rows,)
        1 σ of the force's noise and of what the noise of the displacement makes of it, N.
    unit : ndarray, (n_rows,)
        Discrepancy of model and device for a scatter of 1: the loop's force at the first harmonic, and less at the
        higher ones, N.
    """

    loop: Loop
    basis: NDArray[np.float64]
    measured: NDArray[np.float64]
    own_std: NDArray[np.float64]
    unit: NDArray[np.float64]

    @classmethod
    def of(cls, loop: Loop) -> LoopData:
        """A loop with as many harmonics as its points resolve."""
        count = len(loop.phase)
        whole, _ = np.linalg.qr(fourier_by_order(loop.phase, (count - 1) // 2))
        basis = whole[:, 1:]
        order = 1 + np.arange(basis.shape[1]) // 2
        measured = basis.T @ loop.force
        per_point = np.sqrt(count / 2)
        force = float(np.hypot(measured[0], measured[1]))
        stiffness = force / (per_point * loop.amplitude_m)
        by_displacement = np.where(
            order <= len(loop.series) // 2, stiffness * loop.displacement_std_m * per_point, 0.0
        )
        return cls(
            loop,
            basis,
            measured,
            np.hypot(loop.force_std_n, by_displacement),
            force / np.hypot(1.0, order / _ROUGH),
        )

    @property
    def stiffness(self) -> float:
        """Force over displacement at the first harmonic, N/m."""
        x = self.basis[:, :2].T @ self.loop.displacement
        return float(np.hypot(*self.measured[:2]) / max(np.hypot(*x), 1e-300))


def typical_of(loops: Sequence[LoopData]) -> Typical:
    """The largest motion of these loops, and the force of their median stiffness at it."""
    x = max(d.loop.amplitude_m for d in loops)
    omega = 2 * np.pi * float(np.mean([d.loop.frequency_hz for d in loops]))
    return Typical(x, omega, x * float(np.median([d.stiffness for d in loops])))


def fourier_by_order(phase: NDArray[np.float64], harmonics: int) -> NDArray[np.float64]:
    """1, then cosine and sine of each harmonic in turn, (n_points, 2·harmonics + 1)."""
    columns = fourier(phase, harmonics)
    order = [0, *(k for h in range(1, harmonics + 1) for k in (h, h + harmonics))]
    return columns[:, order]


def left_out(
    loops: Sequence[Loop], *, settings_differ: bool = False, parts: int = 3
) -> list[tuple[int, ...]]:
    """Indices of the loops to leave out, fold by fold.

    Parameters
    ----------
    loops : sequence of Loop
    settings_differ : bool
        Whether loops of one frequency and amplitude are tests at different settings; each is then left out too.
    parts : int
        Parts into which loops are dealt where they have neither three amplitudes nor three frequencies.

    Returns
    -------
    list of tuple of int
        Each amplitude in turn, each frequency, each setting; empty for a single loop.
    """
    amplitudes = groups([loop.amplitude_m for loop in loops], SAME_AMPLITUDE)
    frequencies = groups([loop.frequency_hz for loop in loops], SAME_FREQUENCY)
    found: list[tuple[int, ...]] = []
    for labels in (amplitudes, frequencies):
        if len(np.unique(labels)) >= _FEWEST_GROUPS:
            found += [tuple(np.flatnonzero(labels == g).tolist()) for g in np.unique(labels)]
    if settings_differ:
        cells = list(zip(amplitudes.tolist(), frequencies.tolist(), strict=True))
        found += [(i,) for i, cell in enumerate(cells) if cells.count(cell) > 1]
    if not found and len(loops) > 1:
        parts = min(parts, len(loops))
        found = [tuple(range(part, len(loops), parts)) for part in range(parts)]
    return [f for f in dict.fromkeys(found) if len(f) < len(loops)]


def groups(values: Sequence[float], tolerance: float) -> NDArray[np.int64]:
    """A number for each value; values that agree to the share `tolerance` have the same, (n,)."""
    order = np.argsort(values)
    labels = np.zeros(len(values), dtype=np.int64)
    start = values[order[0]]
    for before, at in pairwise(order):
        new = values[at] > start * (1 + tolerance)
        labels[at] = labels[before] + int(new)
        start = values[at] if new else start
    return labels


def have_own_scales(loops: Sequence[Loop], settings: LoopSettings, several_settings: bool) -> bool:
    """Whether each loop has a force scale of its own.

    Parameters
    ----------
    loops : sequence of Loop
    settings : LoopSettings
    several_settings : bool
        True where the test states that its loops are of several settings of one device.
    """
    if len(loops) < 2 or settings.own_scales != "auto":
        return len(loops) > 1 and settings.own_scales == "yes"
    return several_settings or settings_differ(loops, settings.significance)


def settings_differ(loops: Sequence[Loop], significance: float = 2.0) -> bool:
    """True where loops of one frequency and amplitude lose clearly different energy."""
    for i, one in enumerate(loops):
        for other in loops[:i]:
            alike = (
                abs(one.amplitude_m / other.amplitude_m - 1) < SAME_AMPLITUDE
                and abs(one.frequency_hz / other.frequency_hz - 1) < SAME_FREQUENCY
            )
            apart = abs(one.energy_j - other.energy_j)
            std = float(np.hypot(one.energy_std_j, other.energy_std_j))
            if alike and apart > max(_CLEARLY * abs(one.energy_j), 2 * significance * std):
                return True
    return False
