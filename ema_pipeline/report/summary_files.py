"""summary.json and modes.csv: the numbers, for other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ema_pipeline.choices import Choices
from ema_pipeline.correlate.types import Comparison, percent_off
from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder
from ema_pipeline.exchange.tables import csv_text, modes_table
from ema_pipeline.files import replace_file
from ema_pipeline.fit.types import FitResult
from ema_pipeline.report import levels
from ema_pipeline.report.cautions import cautions
from ema_pipeline.report.results import ConfigurationResults, RunResults

SCHEMA = 1


def write_summary(results: RunResults, path: Path) -> None:
    """Write ``summary.json``; numbers that are not finite become null."""
    replace_file(path, json.dumps(finite(summary(results)), indent=2, ensure_ascii=False) + "\n")


def write_modes_csv(results: RunResults, path: Path) -> None:
    """Write ``modes.csv``: one row per measured mode."""
    rows = [
        row
        for c in results.configurations
        if c.modal is not None
        for row in modes_table(c.modal, c.name, c.pairing)
    ]
    replace_file(path, csv_text(rows))


def summary(results: RunResults) -> dict[str, Any]:
    """Contents of ``summary.json`` (schema 1)."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "title": results.title,
        "rig": results.rig,
        "effects": list(results.added),
        "configurations": {c.name: _configuration(c) for c in results.configurations},
    }
    if results.choices:
        content["choices"] = choices_summary(results.choices)
    if results.fit is not None:
        content["fit"] = _fit(results.fit)
    if results.comparison is not None:
        content["comparison"] = _comparison(results.comparison)
    if results.diagnosis is not None:
        content["diagnosis"] = _diagnosis(results.diagnosis) | {"on_top_of": list(results.diagnosed_on)}
        if results.choices or results.diagnosed_choices:
            content["diagnosis"]["choices"] = choices_summary(results.diagnosed_choices)
    if results.shown_ladder is not None:
        content["ladder"] = _ladder(results.shown_ladder)
        content["ladder_note"] = results.shown_ladder.note
    if results.simulation:
        content["simulation"] = _simulation(results)
    content["warnings"] = list(cautions(results))
    return content


def choices_summary(choices: Choices) -> dict[str, list[str]]:
    """What the user excluded and included, as `ema exclude` and `ema include` name it."""
    return {kind: [str(x) for x in listed] for kind, listed in vars(choices).items()}


def _comparison(compared: Comparison) -> dict[str, Any]:
    """Differences by mode and by DOF; modes count from 1, `_z` are in standard uncertainties.

    `alone` are measured modes that the model does not have, with its mode of the same shape.
    """
    modes = [
        {
            "configuration": m.configuration,
            "mode": m.measured + 1,
            "frequency_hz": m.measured_frequency_hz,
            "model_frequency_hz": m.model_frequency_hz,
            "frequency_difference_percent": percent_off(m.measured_frequency_hz, m.model_frequency_hz),
            "frequency_z": m.frequency_z,
            "damping_ratio": m.measured_damping_ratio,
            "model_damping_ratio": m.model_damping_ratio,
            "damping_z": m.damping_z,
            "mac": m.mac,
            "shape_z": m.shape_z,
        }
        for m in compared.modes
    ]
    return {
        "error": compared.error,
        "frequency_error": compared.frequency_error,
        "modes": modes,
        "dofs": [asdict(d) for d in compared.dofs],
        "alone": [
            {
                "configuration": m.configuration,
                "mode": m.measured + 1,
                "frequency_hz": m.measured_frequency_hz,
                "model_frequency_hz": m.model_frequency_hz,
                "frequency_difference_percent": percent_off(m.measured_frequency_hz, m.model_frequency_hz),
                "mac": m.mac,
            }
            for m in compared.alone
        ],
    }


def _fit(fit: FitResult) -> dict[str, Any]:
    """The fit; a free parameter that the data do not determine has no value."""
    return {
        "parameters": {
            name: {
                "value": p.value if p.identified or not p.free else None,
                "std": p.std if p.identified or not p.free else None,
                "unit": p.unit,
                "identified": p.identified,
                "free": p.free,
                "note": p.note,
            }
            for name, p in fit.parameters.items()
        },
        "frequency_error": fit.frequency_error,
        "chi2_per_dof": fit.chi2_per_dof,
        "error": fit.error,
        "data_count": fit.data_count,
        "stop_reason": fit.stop_reason,
        "sweeps": [{k: v for k, v in vars(s).items() if k not in ("values", "error")} for s in fit.sweeps],
        "stepwise": None if fit.stepwise is None else asdict(fit.stepwise),
        "notes": list(fit.notes),
    }


def _diagnosis(found: Diagnosis) -> dict[str, Any]:
    """The diagnosis; `probabilities` are those of every hypothesis and add up to 1."""
    return {
        "verdict": found.verdict,
        "summary": found.summary,
        "candidates": [_candidate(c) for c in found.candidates],
        "indistinguishable": [list(group) for group in found.indistinguishable],
        "next_measurement": found.next_measurement,
        "nothing_missing_probability": found.null_probability,
        "nothing_visible_probability": found.adequate_probability,
        "probabilities": dict(found.probabilities),
        "error": found.error,
        "heldout_error": found.heldout_error,
        "localisation": [asdict(place) for place in found.localisation],
        "notes": list(found.notes),
        "detection_limits": [
            {
                "effect": x.label,
                "parameter": x.parameter,
                "size": x.size,
                "unit": x.unit,
                "largest": x.largest,
            }
            for x in found.detection_limits
        ],
        "scatter": {
            s.name: {"title": s.title, "stated": s.stated, "learned": s.learned}
            for s in found.ladder.scatters
        },
    }


def _candidate(c: Candidate) -> dict[str, Any]:
    return {
        "effect": c.effect,
        "at": c.at,
        "title": c.title,
        "probability": c.probability,
        "parameters": _sizes(c.parameters),
        "error_before": c.error_before,
        "error_after": c.error_after,
        "heldout_error_before": c.heldout_error_before,
        "heldout_error_after": c.heldout_error_after,
        "log_evidence": c.log_evidence,
        "claimed": c.claimed,
        "also_called": list(c.equivalents),
        "why": c.why,
    }


def _ladder(ladder: Ladder) -> list[dict[str, Any]]:
    return [
        {
            "effects": list(r.effects),
            "error": r.error,
            "heldout_error": r.heldout_error,
            "chi2": r.chi2,
            "log_evidence": r.log_evidence + 0.0,  # never -0.0
            "unexplained_modes": r.unexplained,
            "parameters": _sizes(r.parameters),
        }
        for r in ladder.rungs
    ]


def _simulation(results: RunResults) -> dict[str, Any]:
    """Free-run errors by record; of several responses by sensor, and the largest share on top."""
    records: dict[str, Any] = {}
    for e in results.simulation:
        one = {"rmse": e.rmse, "unit": e.unit, "relative": e.relative, "rmse_without_effects": e.before}
        entry = records.setdefault(e.record, {"use": e.use} | one | {"samples": e.samples, "sensors": {}})
        entry["sensors"][str(e.sensor)] = one
        if e.relative > entry["relative"]:
            entry |= one
    for entry in records.values():
        if len(entry["sensors"]) == 1:
            del entry["sensors"]
    loops = [
        {
            "effect": loop.label,
            "amplitude_m": loop.amplitude_m,
            "energy_per_cycle_j": loop.energy_j,
            "energy_per_cycle_std_j": loop.energy_std_j,
            "stiffness_n_m": loop.stiffness_n_m,
            "stiffness_std_n_m": loop.stiffness_std_n_m,
            "best_told": {"combination": loop.best[0], "std": loop.best[1]},
            "worst_told": {"combination": loop.worst[0], "std": loop.worst[1]},
        }
        for loop in results.hysteresis
    ]
    return {"records": records} | ({"hysteresis": loops} if loops else {})


def _sizes(sizes: Mapping[str, EffectSize]) -> dict[str, Any]:
    return {name: {"value": s.value, "std": s.std, "unit": s.unit} for name, s in sizes.items()}


def _configuration(c: ConfigurationResults) -> dict[str, Any]:
    content: dict[str, Any] = {"modes": _modes(c)}
    if c.pairing is not None:
        content["unpaired_model_modes"] = [asdict(u) for u in c.pairing.unpaired_model]
        content["unpaired_measured_modes"] = [asdict(u) for u in c.pairing.unpaired_measured]
    if c.levels is not None:
        content["levels"] = levels.summary_of(c.levels)
    content["records"] = {
        "used": len({h.file for h in c.hits if h.accepted}) + c.driven,
        "found": len({h.file for h in c.hits}) + c.driven,
        "hits_used": sum(h.accepted for h in c.hits),
        "rejected": [{"file": h.file, "hit": h.number, "reason": h.reason} for h in c.hits if not h.accepted],
    }
    return content


def _modes(c: ConfigurationResults) -> list[dict[str, Any]]:
    """Rows of the table of modes, with the flags one by one; `model_mode` is an index, as in `unpaired_model_modes`."""
    if c.modal is None:
        return []
    rows = modes_table(c.modal, c.name, c.pairing)
    return [
        {k: v for k, v in row.items() if k != "configuration"}
        | {
            "flags": list(mode.flags),
            "model_mode": None if row["model_mode"] is None else int(row["model_mode"]) - 1,
        }
        for row, mode in zip(rows, c.modal.modes, strict=True)
    ]


def finite(value: Any) -> Any:
    """The value with NaN and infinity replaced by None, which JSON can hold."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
