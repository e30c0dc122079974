"""An identified isolator as lines for a terminal and as plain numbers for summary.json."""

from __future__ import annotations

import math
from typing import Any

from ema_pipeline.loops.types import Estimate, IsolatorResult
from ema_pipeline.number_text import format_value, plain


def terminal_lines(result: IsolatorResult) -> list[str]:
    """Parameters, dampers, loss factors, what cannot be, and where the published model fails."""
    lines = [f"{len(result.loops)} loops; parameters of the published model fitted to all of them:"]
    lines += [f"  {_line(name, e)}" for name, e in result.parameters.items()]
    if result.relaxation:
        lines.append("with a relaxation (Maxwell branch) instead of a negative damper:")
        lines += [f"  {_line(name, e)}" for name, e in result.relaxation.items()]
    for line in result.energy:
        c = line.damping
        verdict = "" if line.possible else "  cannot be"
        lines.append(
            f"energy over frequency at {1e3 * line.amplitude_m:.3g} mm: "
            f"c = {format_value(c.value, c.std, 'N·s/m')}{verdict}"
        )
    lines.append(
        "loop, energy per cycle measured, by one set of parameters, by parameters of its own; loss factor:"
    )
    each = zip(result.loops, result.fits, result.alone, result.loss, strict=True)
    for loop, fit, alone, loss in each:
        lines.append(
            f"  {loop.name}: {format_value(loop.energy_j, loop.energy_std_j, 'J')}, {plain(fit.energy_j)} J, "
            f"{plain(alone.energy_j)} J; η = {format_value(loss.value, loss.std)}"
        )
    lines += [f"! {flag}" for flag in result.flags]
    lines += [f"- {note}" for note in result.notes]
    return lines


def summary(result: IsolatorResult) -> dict[str, Any]:
    """Numbers for summary.json; what is unknown is null."""

    def estimates(given: dict[str, Estimate]) -> dict[str, Any]:
        return {
            name: {
                "value": _known(e.value),
                "std": _known(e.std),
                "unit": e.unit,
                "identified": e.identified,
                "note": e.note,
            }
            for name, e in given.items()
        }

    return {
        "parameters": estimates(result.parameters),
        "relaxation": estimates(result.relaxation),
        "loops": [
            {
                "name": loop.name,
                "frequency_hz": loop.frequency_hz,
                "amplitude_m": loop.amplitude_m,
                "cycles": loop.cycles,
                "energy_j": loop.energy_j,
                "energy_std_j": loop.energy_std_j,
                "model_energy_j": fit.energy_j,
                "misfit": fit.misfit,
                "own_energy_j": alone.energy_j,
                "own_misfit": alone.misfit,
                "loss_factor": _known(loss.value),
                "loss_factor_std": _known(loss.std),
            }
            for loop, fit, alone, loss in zip(
                result.loops, result.fits, result.alone, result.loss, strict=True
            )
        ],
        "energy": [
            {
                "amplitude_m": line.amplitude_m,
                "viscous_damping": _known(line.damping.value),
                "std": _known(line.damping.std),
                "possible": line.possible,
                "reason": line.reason,
            }
            for line in result.energy
        ],
        "flags": list(result.flags),
        "notes": list(result.notes),
    }


def _line(name: str, e: Estimate) -> str:
    words = name.replace("_", " ")
    if math.isnan(e.value):
        return f"{words}: {e.note}"
    value = f"{words} = {format_value(e.value, e.std, e.unit)}"
    return f"{value} ({e.note})" if e.note else value


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
