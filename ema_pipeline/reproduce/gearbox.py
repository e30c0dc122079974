"""Torsional planetary gearbox with a cracked tooth (I. Manarikkal et al.)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.fit.map_fit import fit_rig
from ema_pipeline.frf import estimate_frfs
from ema_pipeline.ingest.description import read_campaign
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.quality import hits_of_test
from ema_pipeline.ingest.records import cut_hit
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.harmonic import describing_function, harmonic_response
from ema_pipeline.mechanics.laws import PartingSpring
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.report.style import LINES, SERIES, log_y, margins, new_figure, styled
from ema_pipeline.reproduce.types import Entry, Reproduction, Table
from ema_pipeline.rigs import Rig, load_rig, model_modes
from ema_pipeline.simulate import simulate_campaign

SOURCE = (
    'I. Manarikkal, F. Elasha, D. S. Laila, D. Mba, "Dynamic Modelling of Planetary Gearboxes with Cracked '
    "Tooth "
    'Using Vibrational Analysis". It prints no parameter values; the rig `gearbox` takes the bodies and '
    "the mesh "
    "stiffness of the planetary gear above, so there is nothing printed to compare numbers with."
)
CRACK, LOSS = "mesh_stiffness_loss@sun-planet1", 0.3
PRELOAD_M, GAP_M = 2e-6, 1e-4
LEVELS_N = (2.0, 5.0, 8.0, 12.0, 20.0)


def reproduce_gearbox() -> Reproduction:
    """Healthy and cracked set, recovery of the crack from raw hits, and backlash."""
    healthy = load_rig("gearbox")
    cracked = rig_with_effects(healthy, [(CRACK, {"fraction": LOSS})])
    curves = backlash_curves(healthy)
    tables = (_modes_table(healthy, cracked), _recovery_table(healthy), _backlash_table(curves))
    figures = {
        "gearbox_frf": frf_figure(healthy, cracked),
        "gearbox_backlash": backlash_figure(curves),
    }
    captions = {
        "gearbox_frf": f"Healthy set and one with {100 * LOSS:.0f} % of the stiffness of one sun-planet "
        "mesh lost: "
        "the crack lowers three modes and parts the pair at 1659 Hz",
        "gearbox_backlash": "Backlash: the resonance falls as the force grows and the teeth of the sun part",
    }
    title = "Planetary gearbox in torsion: crack and backlash"
    return Reproduction("gearbox", title, SOURCE, tables, figures, captions)


def _modes_table(healthy: Rig, cracked: Rig) -> Table:
    entries = []
    for name, rig in (("healthy", healthy), ("cracked", cracked)):
        for mode in model_modes(rig, "default"):
            entries.append(
                Entry(f"{name}, mode {mode.index + 1}", None, mode.frequency_hz, "Hz", mode.family)
            )
    return Table(
        "Natural frequencies (Eq. 7)",
        "",
        tuple(entries),
        ("Planet modes come N - 1 times; a crack parts one from them and leaves the rest where they were.",),
    )


def measure(raw: Path) -> MeasuredModes:
    """Modes of a raw folder: hits, FRFs, identification."""
    (test,) = read_campaign(raw).tests
    records = list(load_records(test))
    by_file = {r.file: r for r in records}
    hits = [h for h in hits_of_test(records) if h.accepted]
    frfs = estimate_frfs(cut_hit(by_file[h.file], h) for h in hits)
    return from_modal_model(identify(frfs, ModalSettings()), "default")


def recover_crack(healthy: Rig, seed: int = 1) -> tuple[float, float, float]:
    """True and fitted stiffness of the cracked mesh, and its standard deviation, from simulated raw hits.

    The true rig deviates from the nominal one within its tolerances.
    """
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw"
        truth = simulate_campaign(
            raw, healthy, effects=[f"{CRACK}:fraction={LOSS}"], scatter=1.0, seed=seed, format="hdf5"
        )
        fit = fit_rig(rig_with_effects(healthy, [CRACK]), {"default": measure(raw)})
    name = "sun_planet_mesh_stiffness"
    fraction, mesh = fit.parameters[f"{CRACK}.fraction"], fit.parameters[name]
    true = truth.values[name] * (1 - LOSS)
    a, b = fit.names.index(name), fit.names.index(f"{CRACK}.fraction")
    # d ln k = d ln k_sp - d fraction/(1 - fraction)
    x, y = mesh.std / mesh.value, fraction.std / (1 - fraction.value)
    std = np.sqrt(max(x**2 + y**2 - 2 * fit.correlation[a, b] * x * y, 0.0))
    value = mesh.value * (1 - fraction.value)
    return true, value, float(std * value)


def _recovery_table(healthy: Rig) -> Table:
    true, value, std = recover_crack(healthy)
    entries = (Entry("cracked sun-planet1 mesh", true, value, "N/m", f"± {std:.2g}"),)
    return Table(
        "Stiffness of the cracked mesh from simulated hammer hits, through the whole chain",
        "",
        entries,
        ("Inertias of the simulated rig deviate by their tolerances; both mesh stiffnesses are unknown.",),
        "simulated",
    )


Curve = tuple[float, NDArray[np.float64], NDArray[np.float64]]
"""Force level N, frequencies Hz, and accelerance (m/s²)/N."""


def loose(rig: Rig) -> Assembly:
    """The gearbox with sun meshes that part past their preload."""
    values = {"preload": PRELOAD_M, "gap": GAP_M}
    return rig_with_effects(rig, [(f"mesh_backlash@sun-planet{n}", values) for n in (1, 2, 3)]).assembly(
        "default"
    )


def backlash_curves(rig: Rig) -> list[Curve]:
    """Accelerance of the sun at several force levels, swept down."""
    assembly = loose(rig)
    row = sensor_rows(assembly.system(), (Dof("sun", "u"),))
    f = np.arange(940.0, 740.0, -2.5)
    curves = []
    for level in LEVELS_N:
        response = harmonic_response(assembly, f, level, row, row[0], harmonics=5, samples=64)
        gain = np.abs(response.displacement[0, 1]) * (2 * np.pi * f) ** 2 / level
        curves.append((level, f, np.where(response.converged, gain, np.nan)))
    return curves


def _backlash_table(curves: list[Curve]) -> Table:
    entries = [
        Entry(f"resonance at {level:g} N", None, float(f[np.nanargmax(gain)]), "Hz")
        for level, f, gain in curves
    ]
    mesh = PartingSpring("mesh", {}, 1.25e7, preload=-GAP_M / 2, gap=GAP_M)
    for ratio in (1.5, 2.0, 4.0):
        k = describing_function(mesh, ratio * GAP_M / 2, 100.0).real
        exact = 1 - 2 / np.pi * (np.arcsin(1 / ratio) + np.sqrt(1 - ratio**-2) / ratio)
        entries.append(Entry(f"k_eq/k at amplitude = {ratio:g}·b", exact, k / mesh.stiffness, "1"))
    remark = (
        "Resonances of the gearbox by harmonic balance, swept down; k_eq of one mesh in the middle of its "
        "gap 2b "
        "against the closed form of the describing function, 1 - 2/π·(asin(b/A) + b/A·√(1 - (b/A)²))."
    )
    title = "Backlash: apparent frequency and stiffness over the level"
    return Table(title, "", tuple(entries), (remark,), "closed form")


@styled
def frf_figure(healthy: Rig, cracked: Rig) -> Figure:
    """Accelerances of the healthy and the cracked set side by side."""
    figure = new_figure(3.4)
    grid = figure.add_gridspec(1, 2, wspace=0.1, **margins(figure))
    f = np.arange(500.0, 2200.0, 1.0)
    first = None
    for k, (title, rig) in enumerate((("healthy", healthy), ("one mesh cracked", cracked))):
        system = rig.system("default")
        ax = figure.add_subplot(grid[0, k], sharey=first)
        first = first or ax
        struck = sensor_rows(system, (Dof("sun", "u"),))
        for i, dof in enumerate(("sun.u", "planet1.u", "planet2.u")):
            h = np.abs(accelerance(system, f, sensor_rows(system, (Dof.parse(dof),)), struck)[0, 0])
            ax.plot(f, h, color=SERIES[i], ls=LINES[i], label=f"{dof} / sun.u")
        log_y(ax)
        ax.set_title(title)
        ax.set_xlabel("frequency, Hz")
        if k == 0:
            ax.set_ylabel("accelerance, (m/s²)/N")
            ax.legend(loc="lower left")
        else:
            ax.tick_params(labelleft=False)
    return figure


@styled
def backlash_figure(curves: list[Curve]) -> Figure:
    """Resonance at several force levels."""
    figure = new_figure(3.0)
    ax = figure.add_subplot(figure.add_gridspec(1, 1, **margins(figure))[0, 0])
    for i, (level, f, gain) in enumerate(curves):
        ax.plot(f, gain, color=SERIES[i], ls=LINES[i], label=f"{level:g} N")
    ax.set_xlabel("frequency, Hz")
    ax.set_ylabel("accelerance of the sun, (m/s²)/N")
    ax.set_title(f"Meshes of the sun part past {1e6 * PRELOAD_M:g} µm")
    ax.legend(loc="upper left")
    return figure
