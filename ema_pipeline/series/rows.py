"""What a series keeps of one test: one row, and the rows of its modes, parameters and effects."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.summary_files import summary

Cell = str | int | float | None
Row = dict[str, Cell]

State = Literal["ok", "failed", "lost"]
"""``lost``: the process or the machine that worked on it was lost; it is tried again by the next run."""


@dataclass(frozen=True)
class TestRow:
    """One test of a series.

    Attributes
    ----------
    test : dict
        Columns of the table ``tests``.
    modes, parameters, effects : tuple of dict
        Rows of the tables of these names.
    cost : dict
        Columns of ``cost``: what it took, which is no result.
    """

    __test__ = False  # not a test case, whatever pytest makes of the name

    test: Row
    modes: tuple[Row, ...] = ()
    parameters: tuple[Row, ...] = ()
    effects: tuple[Row, ...] = ()
    cost: Row = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The test's name."""
        return str(self.test["test"])


COLUMNS: Mapping[str, tuple[str, ...]] = {
    "tests": (
        "test", "raw", "results", "key", "state", "reason", "serial_number", "date", "title", "rig", "verdict",
        "summary", "effects", "error", "hits_used", "hits_rejected", "modes", "warnings",
    ),
    "modes": (
        "test", "configuration", "mode", "frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std",
        "model_mode", "mac", "mpc", "shape",
    ),
    "parameters": ("test", "name", "value", "std", "unit", "identified"),
    "effects": ("test", "effect", "at", "name", "value", "std", "unit", "probability"),
    "cost": ("test", "seconds", "processor_seconds", "peak_memory_mb"),
}  # fmt: skip
"""Columns of every table of ``series.db``."""


def failed_row(name: str, raw: str, key: str, reason: str, state: State = "failed") -> TestRow:
    """The row of a test that gave no results, with its reason in one line."""
    row: Row = dict.fromkeys(COLUMNS["tests"])
    row |= {"test": name, "raw": raw, "key": key, "state": state, "reason": reason}
    return TestRow(row)


def row_of(name: str, raw: str, results: RunResults, about: Mapping[str, str], key: str) -> TestRow:
    """The rows of a test that was run.

    Parameters
    ----------
    name, raw : str
        Of the test and of its raw folder.
    results : RunResults
    about : dict of str to str
        ``serial_number`` and ``date``.
    key : str
        Fingerprint of what the results were made of.
    """
    content = summary(results)
    diagnosis = content.get("diagnosis", {})
    claimed = [c for c in diagnosis.get("candidates", ()) if c["claimed"]]
    records = [c["records"] for c in content["configurations"].values() if "records" in c]
    test: Row = {
        "test": name,
        "raw": raw,
        "results": results.folder,
        "key": key,
        "state": "ok",
        "reason": "",
        "serial_number": about.get("serial_number", ""),
        "date": about.get("date", ""),
        "title": results.title,
        "rig": results.rig,
        "verdict": diagnosis.get("verdict"),
        "summary": diagnosis.get("summary"),
        "effects": "; ".join(f"{c['effect']}@{c['at']}" for c in claimed),
        "error": _number(diagnosis.get("error")),
        "hits_used": sum(r["hits_used"] for r in records),
        "hits_rejected": sum(len(r["rejected"]) for r in records),
        "modes": sum(len(c.modal.modes) for c in results.configurations if c.modal is not None),
        "warnings": "\n".join(content["warnings"]),
    }
    modes = tuple(
        _mode(name, c.name, row, shape)
        for c in results.configurations
        for row, shape in zip(content["configurations"][c.name].get("modes", ()), _shapes(c), strict=True)
    )
    parameters = tuple(
        {"test": name, "name": key_, **{k: _number(p[k]) for k in ("value", "std")}, "unit": p["unit"],
         "identified": int(p["identified"])}
        for key_, p in content.get("fit", {}).get("parameters", {}).items()
    )  # fmt: skip
    effects = tuple(
        {"test": name, "effect": c["effect"], "at": c["at"], "name": short, "value": _number(size["value"]),
         "std": _number(size["std"]), "unit": size["unit"], "probability": _number(c["probability"])}
        for c in claimed
        for short, size in c["parameters"].items()
    )  # fmt: skip
    return TestRow(test, modes, parameters, effects)


def _mode(test: str, configuration: str, row: Mapping[str, Any], shape: str) -> Row:
    model = row["model_mode"]
    numbers = {k: _number(row[k]) for k in COLUMNS["modes"][3:7]} | {
        k: _number(row[k]) for k in ("mac", "mpc")
    }
    return {
        "test": test,
        "configuration": configuration,
        "mode": row["mode"],
        "model_mode": None if model is None else model + 1,
        "shape": shape,
        **numbers,
    }


def _shapes(c: ConfigurationResults) -> list[str]:
    """Every mode's shape as JSON: DOFs, real and imaginary parts; what was not measured is left out."""
    if c.modal is None:
        return []
    out = []
    for mode in c.modal.modes:
        known = [(str(d), v) for d, v in zip(c.modal.dofs, mode.shape, strict=True) if math.isfinite(abs(v))]
        out.append(
            json.dumps(
                {
                    "dofs": [d for d, _ in known],
                    "re": [float(f"{v.real:.6g}") for _, v in known],
                    "im": [float(f"{v.imag:.6g}") for _, v in known],
                }
            )
        )
    return out


def _number(value: float | None) -> float | None:
    """A number that a database can hold; None for what is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)
