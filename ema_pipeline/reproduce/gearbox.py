"""Torsional planetary gearbox with a cracked tooth (I. Manarikkal et al.)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.fit.parameters import fit_modes, fit_result
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf import estimate_frfs
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import cut_hit
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.report.style import GREY, LINES, SERIES, log_y, margins, new_figure, styled
from ema_pipeline.reproduce.backlash import (
    PRELOAD_M,
    SWEEPS,
    backlash_figure,
    backlash_levels,
    backlash_table,
)
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


def reproduce_gearbox() -> Reproduction:
    """Healthy and cracked set, recovery of the crack from raw hits, and backlash."""
    healthy = load_rig("gearbox")
    cracked = rig_with_effects(healthy, [(CRACK, {"fraction": LOSS})])
    swept = [backlash_levels(healthy, sweep) for sweep in SWEEPS]
    tables = (_modes_table(healthy, cracked), _recovery_table(healthy), backlash_table(healthy, swept))
    figures = {
        "gearbox_frf": frf_figure(healthy, cracked),
        "gearbox_backlash": backlash_figure(healthy, swept),
    }
    captions = {
        "gearbox_frf": f"Healthy set and one with {100 * LOSS:.0f} % of the stiffness of one sun-planet "
        "mesh lost: "
        "the crack lowers three modes and splits the pair at 1659 Hz, so that the planets no longer move alike",
        "gearbox_backlash": f"Backlash: resonances fall as the force grows and the meshes of the sun separate beyond "
        f"{1e6 * PRELOAD_M:g} µm; crosses: the frequency that the describing function of the meshes gives at the "
        "largest deflection",
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
        ("Planet modes come N - 1 times; a crack splits one off and leaves the rest unchanged.",),
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
        measured = {"default": measure(raw)}
    cracked = rig_with_effects(healthy, [CRACK])
    crack = Model((parse_effect(CRACK, healthy),))
    fitted = fit_modes(ModeObservations(healthy, [prepare(m) for m in measured.values()]), crack)
    fit = fit_result(fitted, cracked, measured, FitSettings())
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


@styled
def frf_figure(healthy: Rig, cracked: Rig) -> Figure:
    """Accelerances of the healthy and the cracked set side by side, magnitude above phase."""
    figure = new_figure(4.4)
    grid = figure.add_gridspec(2, 2, wspace=0.1, hspace=0.12, height_ratios=(2, 1), **margins(figure))
    f = np.arange(500.0, 2200.0, 1.0)
    before, after = _accelerances(healthy, f), _accelerances(cracked, f)
    left: tuple[Axes, Axes] | None = None
    for k, (title, curves) in enumerate((("healthy", before), ("one mesh cracked", after))):
        magnitude = figure.add_subplot(grid[0, k], sharey=left[0] if left else None)
        phase = figure.add_subplot(grid[1, k], sharex=magnitude, sharey=left[1] if left else None)
        left = left or (magnitude, phase)
        for i, (name, h) in enumerate(curves.items()):
            magnitude.plot(f, np.abs(h), color=SERIES[i], ls=LINES[i], label=name)
            phase.plot(f, np.rad2deg(np.unwrap(np.angle(h))), color=SERIES[i], ls=LINES[i])
        if k == 1:
            magnitude.plot(
                f, np.abs(next(iter(before.values()))), color=GREY, lw=0.7, zorder=1, label="sun.u, healthy"
            )
        log_y(magnitude)
        magnitude.set_title(title)
        magnitude.legend(loc="lower right", fontsize=6)
        magnitude.tick_params(labelbottom=False, labelleft=k == 0)
        phase.tick_params(labelleft=k == 0)
        phase.set_yticks([-360, -180, 0, 180])
        phase.set_xlabel("frequency, Hz")
        if k == 0:
            magnitude.set_ylabel("accelerance, (m/s²)/N")
            phase.set_ylabel("phase, °")
    return figure


def _accelerances(rig: Rig, frequency_hz: NDArray[np.float64]) -> dict[str, NDArray[np.complex128]]:
    """Accelerance of the sun and two planets over a force on the sun, by name."""
    system = rig.system("default")
    struck = sensor_rows(system, (Dof("sun", "u"),))
    return {
        f"{dof} / sun.u": accelerance(system, frequency_hz, sensor_rows(system, (Dof.parse(dof),)), struck)[
            0, 0
        ]
        for dof in ("sun.u", "planet1.u", "planet2.u")
    }
