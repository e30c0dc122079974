"""The test sheet: set-up, transducers, processing and quality checks, the items that ISO 7626-5 asks a report for."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ema_pipeline.number_text import counted, plain
from ema_pipeline.report.name_text import words
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.tables import Row, Table

_WINDOWS = (("force_window", "force window"), ("exponential_window", "exponential window"))


def set_up_table(results: RunResults, c: ConfigurationResults) -> Table:
    """One row per item: structure, excitation, responses, resolution, windows, averaging, band."""
    rows = [("structure", f"{results.title}, {c.name}"), ("model", results.rig or "none")]
    if c.frfs is not None and c.frfs.excitation:
        rows.append(("excitation", c.frfs.excitation.replace("_", " ")))
    else:
        rows.append(("hits", f"{sum(h.accepted for h in c.hits)} of {len(c.hits)} used"))
    if c.hits:
        peaks = [abs(h.peak_force) for h in c.hits if h.accepted] or [math.nan]
        unit = "N" if c.frfs is None or c.frfs.force_calibrated else "V"
        rows.append(("peak force", f"{plain(min(peaks), 3)} to {plain(max(peaks), 3)} {unit}"))
    if c.frfs is not None:
        f = c.frfs
        counts = f.hits[f.hits > 0]
        step = float(f.frequency_hz[1] - f.frequency_hz[0]) if f.frequency_hz.size > 1 else math.nan
        rows += [
            ("driven points" if f.excitation else "impact points", ", ".join(d.point for d in f.inputs)),
            ("response points", ", ".join(d.point for d in f.outputs)),
            ("sample rate", f"{plain(2 * float(f.frequency_hz[-1]), 5)} Hz"),
            ("record", f"{plain(f.record_s, 4)} s, lines every {plain(step, 3)} Hz"),
            (
                "estimator",
                f"{f.estimator}, {_from_to(counts.min(), counts.max(), f.averaged)} per FRF"
                if counts.size
                else f.estimator,
            ),
            *_windows(results.settings.get("frf", {}), f.response_decay_rad_s),
            ("band", f"{plain(f.band_hz[0], 4)} to {plain(f.band_hz[1], 5)} Hz"),
            ("force", "calibrated" if f.force_calibrated else "in volts: FRFs have no absolute scale"),
        ]
    if c.modal is not None:
        scaled = "mass-normalised" if c.modal.scaled else f"not scaled: {c.modal.scaling_note}"
        rows.append(("modes", f"{len(c.modal.modes)}; shapes {scaled}"))
    chosen = results.choices.of(c.name)
    for what, listed in vars(chosen).items():
        if listed:
            rows.append((f"{words(what)} by hand", ", ".join(map(str, listed))))
    return Table(("item", c.name), tuple(Row(r) for r in rows))


def _from_to(low: int, high: int, what: str) -> str:
    """``"3 to 5 hits"``, ``"3 hits"`` or ``"1 hit"``."""
    return counted(low, what) if low == high else f"{low} to {counted(high, what)}"


def _windows(settings: Mapping[str, str], decay_rad_s: float) -> list[tuple[str, str]]:
    rows = [(name, settings[key].strip('"')) for key, name in _WINDOWS if key in settings]
    if decay_rad_s:
        rows.append(("decay taken off every pole", f"{plain(decay_rad_s, 4)} 1/s"))
    return rows


def transducers_table(c: ConfigurationResults) -> Table | None:
    """One row per sensor; None where the test's description is not known."""
    if not c.transducers:
        return None
    rows = tuple(
        Row(
            (
                t.name,
                words(t.quantity),
                t.dof or ("hammer" if t.quantity == "force" else "roving"),
                f"{plain(t.sensitivity_mv, 5)} mV/{t.unit if '/' not in t.unit else f'({t.unit})'}"
                if math.isfinite(t.sensitivity_mv)
                else f"files in {t.unit}",
                f"{plain(100 * t.calibration_std, 2)} %",
                f"{plain(100 * t.transverse, 2)} %",
                f"{plain(1e3 * t.mass_kg, 3)} g" if t.mass_kg else "–",
            )
        )
        for t in c.transducers
    )
    head = ("channel", "quantity", "where", "sensitivity", "its 1σ", "transverse", "mass")
    return Table(head, rows, frozenset({3, 4, 5, 6}))
