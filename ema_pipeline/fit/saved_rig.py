"""A rig file with fitted values: what a later test starts from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import tomlkit
from tomlkit.items import InlineTable, Table

from ema_pipeline.fit.types import FitResult, ParameterEstimate
from ema_pipeline.rigs.entries import LARGEST_TOLERANCE

FIGURES = 8
"""Significant figures of saved values: more than any test determines."""


def saved_rig(source: str, fit: FitResult, heads: Iterable[str] = ()) -> str:
    """The text of a rig file whose parameters have their fitted values, with their intervals as tolerances.

    Parameters
    ----------
    source : str
        Name of a shipped rig, or the text of the user's rig file; what is not fitted stays as it is written there.
    fit : FitResult
    heads : iterable of str
        Remarks for the first lines.
    """
    document = tomlkit.parse(source) if "\n" in source else tomlkit.document()
    if "\n" not in source:
        document["base"] = source
    parameters = document.setdefault("parameters", tomlkit.table())
    remarks = list(heads)
    for name, p in fit.parameters.items():
        if "@" in name:
            size = f"{p.value:.{FIGURES}g} {p.unit} ± {p.std:.2g}"
            remarks.append(
                f"{name} = {size} is an added effect, which a rig file cannot hold; add it to the run"
            )
        elif p.free and not p.identified:
            remarks.append(f"{name} is not identified and stays as it was")
        elif p.value and p.std > 0:
            if name == "modal_damping_ratio" and name not in parameters and "masses" in document:
                document[name] = _number(p.value)
            else:
                parameters[name] = _entry(parameters.get(name), p)
    return "".join(f"# {line}\n" for line in remarks) + tomlkit.dumps(document)


def _entry(stated: Any, p: ParameterEstimate) -> InlineTable | Table:
    """The parameter's entry with value and tolerance; bounds stay, but for those of a parameter in another unit."""
    entry = tomlkit.inline_table()
    entry["value"] = _number(p.value)
    if p.unit not in ("", "1"):
        entry["unit"] = p.unit
    entry["tolerance"] = _number(min(p.std / abs(p.value), LARGEST_TOLERANCE), 3)
    kept = stated if isinstance(stated, dict) else {}
    for key, value in kept.items():
        same = str(kept.get("unit", p.unit)) == p.unit or key not in ("min", "max")
        if key not in ("value", "unit", "tolerance", "free") and same:
            entry[key] = value
    return entry


def _number(value: float, figures: int = FIGURES) -> float:
    return float(f"{value:.{figures}g}")
