"""summary.json, tables, plots and screens of tests of force-displacement loops."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ema_pipeline.files import replace_file
from ema_pipeline.loops.summary import summary, terminal_lines
from ema_pipeline.loops.types import Estimate, IsolatorResult, Loop, LoopModel
from ema_pipeline.number_text import format_value, plain
from ema_pipeline.report import diagnosis, summary_files
from ema_pipeline.report.commands import command
from ema_pipeline.report.name_text import words
from ema_pipeline.report.results import LoopResults, RunResults
from ema_pipeline.report.tables import Row, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_loops_summary(results: RunResults, found: LoopResults, path: Path) -> None:
    """Write ``summary.json``; its configurations are those of the isolators."""
    content = summary_files.summary(results)
    content["configurations"] = {name: summary(one) for name, one in found.isolators.items()}
    text = json.dumps(summary_files.finite(content), indent=2, ensure_ascii=False)
    replace_file(path, text + "\n")


def run_screen(isolators: Mapping[str, IsolatorResult], results: RunResults, out: str) -> str:
    """What a run found, for a terminal."""
    lines = []
    for name, one in isolators.items():
        lines += [name, *terminal_lines(one)]
    if results.diagnosis is not None:
        added = results.ladder.rungs[-1].effects if results.ladder is not None else ()
        lines += ["", diagnosis.compact(results.diagnosis), results.diagnosis.summary]
        files = results.effect_files
        commands = diagnosis.next_commands(results.diagnosis, out, added, files)
        commands = commands or (command("compare", out, effect_files=files),)
        lines += ["", "Next:", *(f"  {c}" for c in commands)]
    return "\n".join(lines)


def comparison_rows(
    loops: Sequence[Loop], models: Sequence[LoopModel]
) -> list[dict[str, float | str | None]]:
    """What `comparison_screen` shows, as numbers: shares of the force's range, energies of a cycle in J."""
    first, last = models[0], models[-1]
    return [
        {
            "loop": loop.name,
            "misfit_linear": a.misfit,
            "misfit": b.misfit,
            "energy_measured_j": loop.energy_j,
            "energy_model_j": b.energy_j,
        }
        for loop, a, b in zip(loops, first.fits, last.fits, strict=True)
    ]


def comparison_screen(loops: Sequence[Loop], models: Sequence[LoopModel]) -> str:
    """Where model and loops part, for a terminal."""
    first, last = models[0], models[-1]
    name = " + ".join(diagnosis.label_words(e) for e in last.effects) or "linear spring"
    lines = [
        f"Model: linear spring{f' + {name}' if last.effects else ''}",
        f"{'loop':32s} {'misfit, % of force':>20s} {'energy model/measured':>24s}",
    ]
    for loop, a, b in zip(loops, first.fits, last.fits, strict=True):
        misfit = f"{100 * a.misfit:.3g} -> {100 * b.misfit:.3g}" if last.effects else f"{100 * a.misfit:.3g}"
        share = b.energy_j / loop.energy_j if loop.energy_j else float("nan")
        lines.append(f"{loop.name[:32]:32s} {misfit:>20s} {share:>24.3f}")
    if last.effects:
        lines.append("misfit: root mean square over half the range of force, linear spring -> model")
    return "\n".join(lines)


def loops_context(results: RunResults, found: LoopResults) -> dict[str, Any]:
    """What the page shows of the loops beside its figures: the last model, tables, and what cannot be."""
    return {
        "sizes": _cards(results),
        "table": _loops_table(found.loops, found.models),
        "flags": [flag for one in found.isolators.values() for flag in one.flags],
        "tests": [
            {
                "name": name,
                "parameters": _estimates_table(one.parameters),
                "fits": _fits_table(one),
                "relaxation": _estimates_table(one.relaxation) if one.relaxation else None,
                "energy": _energy_table(one) if one.energy else None,
                "loss": _loss_table(one),
                "notes": one.notes,
            }
            for name, one in found.isolators.items()
        ],
    }


def _cards(results: RunResults) -> list[dict[str, str]]:
    """Parameters of the last model, as they stand at the top of the page."""
    ladder = results.shown_ladder
    if ladder is None or not ladder.rungs:
        return []
    cards = []
    for name, size in ladder.rungs[-1].parameters.items():
        label, _, own = name.partition(".")
        effect = label.partition("@")[0] if own else "spring"
        title = (
            words(effect) if words(own or name) in words(effect) else f"{words(effect)}: {words(own or name)}"
        )
        cards.append({"name": title, "value": format_value(size.value, size.std, _unit(size.unit))})
    return cards


def _loops_table(loops: Sequence[Loop], models: Sequence[LoopModel]) -> Table | None:
    if not models:
        return None
    first, last = models[0], models[-1]
    rows = []
    for k, loop in enumerate(loops):
        a, b = first.fits[k], last.fits[k]
        scale = f"{last.scales[loop.name]:.3g}" if loop.name in last.scales else ""
        rows.append(
            Row(
                (
                    loop.name,
                    f"{loop.frequency_hz:.4g}",
                    f"{1e3 * loop.amplitude_m:.4g}",
                    str(loop.cycles),
                    format_value(loop.energy_j, loop.energy_std_j, "J"),
                    plain(b.energy_j, 4),
                    f"{100 * b.energy_error:+.3g}",
                    f"{100 * a.misfit:.3g} → {100 * b.misfit:.3g}",
                    scale,
                ),
                abs(b.energy_error) > _ENERGY,
            )
        )
    head = (
        "loop", "frequency, Hz", "amplitude, mm", "cycles", "energy per cycle", "model, J", "difference, %",
        "misfit, % of force", "force scale",
    )  # fmt: skip
    return _filled(Table(head, tuple(rows), frozenset(range(1, 9))))


def _filled(source: Table) -> Table:
    """A table without its empty columns."""
    kept = [c for c in range(len(source.head)) if any(r.cells[c] for r in source.rows)]
    return Table(
        tuple(source.head[c] for c in kept),
        tuple(Row(tuple(r.cells[c] for c in kept), r.alert) for r in source.rows),
        frozenset(k for k, c in enumerate(kept) if c in source.numeric),
    )


_ENERGY = 0.03


def _estimates_table(estimates: Mapping[str, Estimate]) -> Table:
    rows = [
        Row(
            (words(name), "–" if np.isnan(e.value) else format_value(e.value, e.std, _unit(e.unit)), e.note),
            not e.identified,
        )
        for name, e in estimates.items()
    ]
    return Table(("parameter", "value (±1σ)", "remarks"), tuple(rows), frozenset({1}))


def _fits_table(one: IsolatorResult) -> Table:
    rows = [
        Row(
            (
                loop.name,
                format_value(loop.energy_j, loop.energy_std_j, "J"),
                f"{100 * fit.energy_error:+.3g}",
                f"{100 * fit.misfit:.3g}",
                f"{100 * own.energy_error:+.3g}",
                f"{100 * own.misfit:.3g}",
            ),
            abs(fit.energy_error) > _ENERGY,
        )
        for loop, fit, own in zip(one.loops, one.fits, one.alone, strict=True)
    ]
    head = (
        "loop", "energy per cycle", "energy, one set, %", "misfit, % of force", "energy, by itself, %",
        "misfit, % of force",
    )  # fmt: skip
    return Table(head, tuple(rows), frozenset(range(1, 6)))


def _energy_table(one: IsolatorResult) -> Table:
    rows = [
        Row(
            (
                f"{1e3 * line.amplitude_m:.3g}",
                ", ".join(f"{f:.3g}" for f in line.frequency_hz),
                format_value(line.damping.value, line.damping.std, "N·s/m"),
                line.reason or "possible",
            ),
            not line.possible,
        )
        for line in one.energy
    ]
    return Table(("amplitude, mm", "frequencies, Hz", "damper", "remarks"), tuple(rows), frozenset({0, 2}))


def _loss_table(one: IsolatorResult) -> Table:
    rows = [
        Row((p.name, f"{p.frequency_hz:.4g}", f"{1e3 * p.amplitude_m:.4g}", format_value(p.value, p.std, "")))
        for p in one.loss
    ]
    return Table(
        ("loop", "frequency, Hz", "amplitude, mm", "loss factor η"), tuple(rows), frozenset({1, 2, 3})
    )


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def write_loops_plots(results: RunResults, found: LoopResults, folder: Path) -> None:
    """Write every figure as PNG and SVG into `folder`."""
    from ema_pipeline.report import style  # loads the drawing library, which the page does without

    folder.mkdir(exist_ok=True)
    for name, figure in _figures(results, found).items():
        replace_file(folder / f"{name}.png", style.png(figure))
        replace_file(folder / f"{name}.svg", style.svg(figure))


def _figures(results: RunResults, found: LoopResults) -> dict[str, Figure]:
    """Figures by name."""
    from ema_pipeline.report.figures.diagnosis import candidate_probabilities, ladder_errors
    from ema_pipeline.report.figures.loops import isolator_figures, misfit_figure, models_figure

    figures: dict[str, Figure] = {}
    ladder = results.shown_ladder
    if found.models:
        figures["models"] = models_figure(found.loops, found.models)
        figures["misfit"] = misfit_figure(found.loops, found.models)
    if results.diagnosis is not None:
        figures["candidates"] = candidate_probabilities(results.diagnosis)
    if ladder is not None and ladder.rungs:
        figures["ladder"] = ladder_errors(ladder)
    for name, one in found.isolators.items():
        figures |= {f"{name}_{kind}": figure for kind, figure in isolator_figures(one).items()}
    return figures
