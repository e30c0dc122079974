"""Backlash of the torsional gearbox: resonances that fall with the force, and what a describing function says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.harmonic import describing_function, harmonic_response
from ema_pipeline.mechanics.laws import PartingSpring
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.report.style import LINES, SERIES, margins, new_figure, styled
from ema_pipeline.reproduce.types import Entry, Table
from ema_pipeline.rigs import Rig

PRELOAD_M, GAP_M = 2e-6, 1e-4


@dataclass(frozen=True)
class Sweep:
    """A mode that is swept down through at several force levels."""

    title: str
    mode: int
    frequency_hz: tuple[float, float, float]
    forces_n: tuple[float, ...]


SWEEPS = (
    Sweep("second rotational mode", 4, (1848.0, 1528.0, -4.0), (2.0, 10.0, 15.0, 20.0, 30.0)),
    Sweep("first rotational mode", 1, (940.0, 740.0, -2.5), (2.0, 5.0, 8.0, 12.0, 20.0)),
)


@dataclass(frozen=True)
class Level:
    """Steady state over frequency at one force level, of a set whose sun meshes part.

    Attributes
    ----------
    force_n : float
    frequency_hz : ndarray, (n_lines,)
    accelerance : ndarray, (n_lines,)
        Of the sun, (m/s²)/N; NaN where no solution was found.
    deflection, offset : ndarray, (n_lines,)
        Amplitude and mean of the deflection of a sun mesh, m.
    """

    force_n: float
    frequency_hz: NDArray[np.float64]
    accelerance: NDArray[np.float64]
    deflection: NDArray[np.float64]
    offset: NDArray[np.float64]

    @property
    def resonance(self) -> int:
        """Line at which the meshes move most."""
        return int(np.nanargmax(np.where(np.isfinite(self.accelerance), self.deflection, np.nan)))


def loose(rig: Rig) -> Assembly:
    """The gearbox with sun meshes that part past their preload."""
    values = {"preload": PRELOAD_M, "gap": GAP_M}
    return rig_with_effects(rig, [(f"mesh_backlash@sun-planet{n}", values) for n in (1, 2, 3)]).assembly(
        "default"
    )


def backlash_levels(rig: Rig, sweep: Sweep) -> list[Level]:
    """Steady states at several force levels on the sun, swept down."""
    assembly = loose(rig)
    system = assembly.system()
    sun = sensor_rows(system, (Dof("sun", "u"),))
    mesh = assembly.named("sun-planet1 mesh")
    assert isinstance(mesh, PartingSpring)
    row = np.array([[mesh.row.get(d, 0.0) for d in system.dofs]])
    f = np.arange(*sweep.frequency_hz)
    found = []
    for force in sweep.forces_n:
        response = harmonic_response(
            assembly, f, force, np.vstack([sun, row]), sun[0], harmonics=5, samples=64
        )
        gain = np.abs(response.displacement[0, 1]) * (2 * np.pi * f) ** 2 / force
        motion = response.displacement[1]
        gain = np.where(response.converged, gain, np.nan)
        found.append(Level(force, f, gain, np.abs(motion[1]), motion[0].real))
    return found


def contact_share(preload: float, offset: float, amplitude: float) -> float:
    """Describing function over stiffness of a contact that parts: (φ + c·sin φ)/π, cos φ = -c.

    c = (preload + offset)/amplitude; φ is half the part of the cycle that the contact lasts.
    """
    c = float(np.clip((preload + offset) / amplitude, -1.0, 1.0))
    half = np.arccos(-c)
    return float((half + c * np.sin(half)) / np.pi)


def described_resonance(rig: Rig, mode: int, level: Level) -> float:
    """Frequency of a mode at `level`'s resonance with meshes as soft as their describing function says."""
    k = level.resonance
    share = contact_share(PRELOAD_M, float(level.offset[k]), float(level.deflection[k]))
    name = "sun_planet_mesh_stiffness"
    softer = rig.system("default", {name: share * rig.parameters[name].value})
    frequency_hz, _ = normal_modes(softer)
    return float(frequency_hz[mode])


def backlash_table(rig: Rig, swept: list[list[Level]]) -> Table:
    """Resonances of the swept levels beside those that a describing function gives, and the stiffness of the teeth."""
    entries = []
    for sweep, levels in zip(SWEEPS, swept, strict=True):
        for level in levels:
            k = level.resonance
            item = f"{sweep.title} at {level.force_n:g} N"
            described = described_resonance(rig, sweep.mode, level)
            found = float(level.frequency_hz[k])
            entries.append(
                Entry(item, described, found, "Hz", f"deflection {1e6 * level.deflection[k]:.2g} µm")
            )
    mesh = PartingSpring("mesh", {}, 1.25e7, preload=-GAP_M / 2, gap=GAP_M)
    for ratio in (1.5, 2.0, 4.0):
        k_eq = describing_function(mesh, ratio * GAP_M / 2, 100.0).real
        exact = 1 - 2 / np.pi * (np.arcsin(1 / ratio) + np.sqrt(1 - ratio**-2) / ratio)
        entries.append(Entry(f"k_eq/k at amplitude = {ratio:g}·b", exact, k_eq / mesh.stiffness, "1"))
    remarks = (
        "Resonances under a sine force on the sun by harmonic balance with five harmonics, swept down, where "
        "the sun's meshes move most. Beside them the frequency of the linear set whose sun meshes have the "
        "stiffness of their describing function at that deflection: k·(φ + c·sin φ)/π with cos φ = -c and "
        "c = (preload + mean)/amplitude.",
        "The first mode falls less than its describing function says: twice its frequency, 1826 Hz, meets the "
        "second rotational mode at 1823 Hz, so that the second harmonic of the mesh deflection grows to half of "
        "the first. One harmonic, which is all that a describing function knows, does not carry that.",
        "k_eq of one mesh in the middle of its gap 2b against 1 - 2/π·(asin(b/A) + b/A·√(1 - (b/A)²)).",
    )
    title = "Backlash: apparent frequency and stiffness over the level"
    return Table(title, "", tuple(entries), remarks, "describing function")


@styled
def backlash_figure(rig: Rig, swept: list[list[Level]]) -> Figure:
    """Resonances at several force levels, with what the describing function says."""
    figure = new_figure(3.2)
    grid = figure.add_gridspec(1, 2, wspace=0.2, **margins(figure))
    for k, (sweep, levels) in enumerate(zip(SWEEPS, swept, strict=True)):
        ax = figure.add_subplot(grid[0, k])
        for i, level in enumerate(levels):
            f, gain = level.frequency_hz, level.accelerance
            ax.plot(f, gain, color=SERIES[i], ls=LINES[i], label=f"{level.force_n:g} N")
        at = [described_resonance(rig, sweep.mode, level) for level in levels]
        peaks = [level.accelerance[level.resonance] for level in levels]
        ax.plot(at, peaks, "kx", ms=5, mew=1.2, label="describing function")
        ax.set_xlim(sweep.frequency_hz[1], sweep.frequency_hz[0])
        ax.set_xlabel("frequency, Hz")
        ax.set_title(sweep.title)
        ax.set_ylim(0, 1.45 * max(peaks))
        ax.legend(loc="upper left", fontsize=6, ncols=3, columnspacing=1.0)
        if k == 0:
            ax.set_ylabel("accelerance of the sun, (m/s²)/N")
    return figure
