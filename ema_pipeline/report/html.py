"""The self-contained HTML report: one file, no network; its figures are those of the live page."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from ema_pipeline.choices import NO_CHOICES, HitChoice, ModeChoice, options_between
from ema_pipeline.correlate.types import ModeDifference
from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.files import replace_file
from ema_pipeline.number_text import format_percent, format_value, plain, signed
from ema_pipeline.report import diagnosis, diagnosis_tables, levels, summary, tables
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.loops import loops_context
from ema_pipeline.report.moved_modes import Seen, error_words, moved_table, still_words
from ema_pipeline.report.moving_shapes import moving_shapes
from ema_pipeline.report.name_text import slug, words
from ema_pipeline.report.page_top import page_top
from ema_pipeline.report.pages import page_templates
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.simulation import simulation_context
from ema_pipeline.report.summary_files import finite
from ema_pipeline.report.test_sheet import set_up_table, transducers_table

HITS_LISTED = 300


def write_report(results: RunResults, path: str | Path) -> None:
    """Write the report.

    Parameters
    ----------
    results : RunResults
    path : str or Path
        HTML file to write; its folder is made if need be.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    replace_file(target, report_html(results))


def report_html(results: RunResults) -> str:
    """The report's text."""
    from ema_pipeline.report.interactive.data import measured_data, model_data

    context = page_context(results)
    data = {
        "measured": measured_data(results),
        "model": model_data(results),
        "items": figures_of(context, results),
    }
    return (
        _templates()
        .get_template("report.html.j2")
        .render(context | {"data": script_json(data), "bokeh": bokeh_script()})
    )


def script_json(data: Any) -> str:
    """JSON that no browser takes for markup, whatever names it holds."""
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def page_parts(context: dict[str, Any], names: Sequence[str]) -> dict[str, str]:
    """Parts of the live page by the names of their templates."""
    return {name: _templates().get_template(f"{name}.html.j2").render(context) for name in names}


def live_page(context: dict[str, Any]) -> str:
    """The live page's text, from `page_context`; its data are fetched apart."""
    return str(_templates().get_template("live.html.j2").render(context))


def live_data(results: RunResults) -> str:
    """What the live page needs once, as JSON: the figures without data, and what was measured."""
    from ema_pipeline.report.interactive.data import measured_data

    items = figures_of(page_context(results, live=True), results)
    return script_json({"items": items, "measured": measured_data(results, None)})


def figures_of(context: dict[str, Any], results: RunResults) -> dict[str, Any]:
    """Documents of the figures for which there is something to show."""
    from ema_pipeline.report.interactive.figures import figure_items

    return figure_items(list(context["figures"]), _log_frequency(results))


def bokeh_script() -> str:
    """The drawing library's own script, from its package."""
    from bokeh.resources import Resources

    return str("\n".join(Resources(mode="inline", components=["bokeh"], log_level="warn").js_raw))


@cache
def _templates() -> Any:
    environment = page_templates()
    environment.filters["slug"] = slug
    environment.filters["words"] = words
    return environment


def _log_frequency(results: RunResults) -> bool:
    """True where the modes lie over about a decade or more."""
    all_hz = [m.frequency_hz for c in results.configurations if c.modal for m in c.modal.modes]
    return bool(all_hz) and max(all_hz) > 8 * min(all_hz) > 0


def page_context(
    results: RunResults, live: bool = False, moved: tuple[Seen, Seen] | None = None
) -> dict[str, Any]:
    """Everything that the templates show, as text and tables; what is not there is None or empty.

    `moved` are modes and errors before and after the last change of hits or modes.
    """
    fit, compared, found = results.fit, results.comparison, results.diagnosis
    configurations = [_configuration(results, c) for c in results.configurations]
    ladder = _ladder(results)
    shown = {
        "frf": any(c["frfs"] for c in configurations),
        "errors": bool(compared and compared.modes),
        "moved": bool(results.deviations[0]) and bool(found),
        "ladder": bool(ladder and (ladder["several"] or live)),
        "nyquist": any(m.circles for c in results.configurations if c.modal for m in c.modal.modes),
        "stab": any(c.modal and c.modal.chart.order.size for c in results.configurations),
        "shape": any(c.modal and c.modal.dofs and c.modal.modes for c in results.configurations),
        "mac": any(
            (c.modal and c.modal.modes and c.modal.dofs) or (c.pairing and c.pairing.mac.size)
            for c in results.configurations
        ),
        "levels": any(
            c.levels and has_to_say(c.levels) and len(c.levels.levels) > 1 for c in results.configurations
        ),
        "sweeps": bool(fit and fit.sweeps),
        "loops": bool(results.loops and results.loops.models),
        "loss": bool(results.loops and any(one.loss for one in results.loops.isolators.values())),
    }
    figures = tuple(name for name, there in shown.items() if there)
    return {
        "results": results,
        "live": live,
        "addable": _addable(results) if live else (),
        "band": page_top(results),
        "sections": _sections(results, figures),
        "figures": figures,
        "diagnosis": None if found is None else _diagnosis(results),
        "ladder": ladder,
        "findings": summary.findings(results),
        "cautions": summary.cautions(results),
        "stiffnesses": [
            {
                "name": words(p.name),
                "value": format_value(p.value, p.std, p.unit),
                "words": summary.identified_words(p, results.provisional),
                "identified": p.identified and not results.provisional,
            }
            for p in summary.stiffnesses(fit)
        ]
        if fit
        else [],
        "configurations": configurations,
        "parameters": tables.parameters_table(fit, results.provisional) if fit else None,
        "sweeps": tables.sweeps_table(fit) if fit and fit.sweeps else None,
        "stepwise": _stepwise(results),
        "differences": tables.differences_table(compared) if compared else None,
        "alone": tables.alone_table(compared) if compared and compared.alone else None,
        "worst_dofs": tables.worst_dofs_table(compared) if compared and compared.dofs else None,
        "worst_bands": tables.worst_bands_table(compared) if compared and compared.bands else None,
        "loops": None if results.loops is None else loops_context(results, results.loops),
        "simulation": simulation_context(results),
        "choices": _choices(results),
        "moved": None if moved is None else _moved(*moved),
    }


def _choices(results: RunResults) -> list[dict[str, str]]:
    """What the user excluded and included: in words, and the verb that takes it back."""
    return [
        {"what": f"{'included' if verb == 'exclude' else 'excluded'}: {option.removeprefix('--')} {name}",
         "verb": f"{verb}_{option.removeprefix('--')}", "label": name}
        for verb, option, name in options_between(results.choices, NO_CHOICES)
    ]  # fmt: skip


def _moved(before: Seen, after: Seen) -> dict[str, Any]:
    table = moved_table(before, after)
    return {
        "table": table if table.rows else None,
        "still": still_words(before, after),
        "words": error_words(before, after),
    }


def _addable(results: RunResults) -> tuple[str, ...]:
    """Effects that the diagnosis weighed, the more probable first."""
    found = results.diagnosis
    if found is None:
        return ()
    single = [label for label in found.probabilities if "@" in label and " + " not in label]
    return tuple(sorted((x for x in single if x not in results.added), key=lambda x: -found.probabilities[x]))


def _sections(results: RunResults, figures: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    there = {
        "summary": True,
        "frf": "frf" in figures,
        "model": results.diagnosis is not None or results.shown_ladder is not None or "errors" in figures,
        "loops": results.loops is not None,
        "parameters": results.loops is not None,
        "loss": results.loops is not None,
        "modes": any(c.modal and c.modal.modes for c in results.configurations),
        "pairing": "mac" in figures or any(c.pairing for c in results.configurations),
        "simulation": bool(results.simulation),
        "levels": any(c.levels and has_to_say(c.levels) for c in results.configurations),
        "fit": results.fit is not None,
        "hits": any(c.hits for c in results.configurations),
        "provenance": bool(results.provenance or results.settings),
    }
    titles = {
        "summary": "Summary",
        "frf": "FRFs",
        "model": "Model and missing physics",
        "loops": "Loops",
        "parameters": "Parameters",
        "loss": "Energy and loss factor",
        "modes": "Modes",
        "pairing": "Pairing and MAC",
        "simulation": "Simulated records",
        "levels": "Does it depend on how hard you hit?",
        "fit": "Fitted parameters",
        "hits": "Hits",
        "provenance": "Settings and provenance",
    }
    return tuple((name, title) for name, title in titles.items() if there[name])


def _diagnosis(results: RunResults) -> dict[str, Any]:
    found = results.diagnosis
    assert found is not None
    return {
        "candidates": [_candidate(results, c) for c in found.candidates],
        "null": {
            "probability": probability_text(found.null_probability),
            "share": found.null_probability,
            "error": plain(found.error, 3),
            "held": plain(found.heldout_error, 3),
        },
        "sigma": diagnosis.sigma_words(found),
        "localisation": diagnosis_tables.localisation_table(found) if found.localisation else None,
        "scatter": diagnosis_tables.scatter_table(found.ladder) if found.ladder.scatters else None,
        "detection": diagnosis_tables.detection_table(found) if found.detection_limits else None,
    }


def _candidate(results: RunResults, c: Any) -> dict[str, Any]:
    """A candidate as a row, with what the page needs to add it."""
    found = results.diagnosis
    assert found is not None
    return {
        "label": c.label,
        "name": diagnosis.label_words(c.label),
        "size": diagnosis.size_words(c.parameters),
        "probability": probability_text(c.probability),
        "share": c.probability,
        "standing": diagnosis.standing(found, c),
        "before": plain(c.error_before, 3),
        "error": plain(c.error_after, 3),
        "held": f"{plain(c.heldout_error_before, 3)} → {plain(c.heldout_error_after, 3)}"
        if math.isfinite(c.heldout_error_after)
        else "–",
        "claimed": c.claimed,
        "why": c.why,
        "in_model": c.label in results.added,
    }


def _ladder(results: RunResults) -> dict[str, Any] | None:
    ladder = results.shown_ladder
    if ladder is None or not ladder.rungs:
        return None
    return {
        "table": diagnosis_tables.ladder_table(ladder),
        "noise": diagnosis.noise_words(ladder),
        "note": ladder.note,
        "users": results.ladder is not None,
        "several": len(ladder.rungs) > 1,
    }


def _configuration(results: RunResults, c: ConfigurationResults) -> dict[str, Any]:
    hits = c.hits
    listed = hits
    if len(hits) > HITS_LISTED:
        listed = tuple(h for h in hits if any(not v.passes for v in h.verdicts))[:HITS_LISTED]
    return {
        "name": c.name,
        "modal": c.modal,
        "frfs": c.frfs if c.frfs is not None and (c.frfs.hits > 0).any() else None,
        "averages": _averages(c),
        "pairing": c.pairing,
        "levels": _levels(c),
        "rows": _mode_rows(results, c),
        "modes": tables.modes_table(c.modal) if c.modal else None,
        "pairs": tables.pairs_table(c.pairing, c.modal) if c.pairing and c.modal else None,
        "unpaired": tables.unpaired_table(c.pairing) if c.pairing else None,
        "moving_shapes": moving_shapes(c),
        "hit_count": len(hits),
        "used": sum(h.accepted for h in hits),
        "hit_rows": _hit_rows(results, c),
        "rejected": tables.rejected_hits_table(hits),
        "verdicts": tables.verdicts_table(listed),
        "listed": len(listed),
        "set_up": set_up_table(results, c),
        "transducers": transducers_table(c),
        "check_limits": tables.checks_table(hits) if hits else None,
        "checks": tables.failed_checks_table(c.frfs.verdicts) if c.frfs else None,
    }


def _hit_rows(results: RunResults, c: ConfigurationResults) -> list[dict[str, Any]]:
    """One row per hit, with what the live page needs to exclude it."""
    table, excluded = tables.hits_table(c.hits), results.choices.of(c.name).excluded_hits
    rows = []
    for hit, row in zip(c.hits[:HITS_LISTED], table.rows, strict=False):
        choice = HitChoice(c.name, hit.file, hit.number)
        rows.append(
            {
                "cells": row.cells,
                "label": str(choice),
                "accepted": hit.accepted,
                "excluded": choice in excluded,
            }
        )
    return rows


def _mode_rows(results: RunResults, c: ConfigurationResults) -> list[dict[str, Any]]:
    """One row per mode: frequency and damping with σ, MAC, and the model's difference in % and σ."""
    if c.modal is None:
        return []
    by_mode: dict[int, ModeDifference] = {}
    if results.comparison is not None:
        by_mode = {m.measured: m for m in results.comparison.modes if m.configuration == c.name}
    rows = []
    for k, mode in enumerate(c.modal.modes):
        m = by_mode.get(k)
        percent = (
            100 * (m.measured_frequency_hz / m.model_frequency_hz - 1)
            if m and m.model_frequency_hz > 0
            else None
        )
        rows.append(
            {
                "number": k + 1,
                "label": str(ModeChoice(c.name, mode.frequency_hz, mode.damping_ratio)),
                "frequency": format_value(mode.frequency_hz, mode.frequency_std_hz),
                "damping": format_percent(mode.damping_ratio, mode.damping_std).removesuffix(" %"),
                "mac": "–" if m is None else f"{m.mac:.2f}",
                "percent": "–" if percent is None else signed(percent, 2),
                "z": "–" if m is None else signed(m.frequency_z),
                "damping_z": "–" if m is None else signed(m.damping_z),
                "shape_z": "–" if m is None else signed(m.shape_z),
                "remarks": "; ".join(mode.flags),
            }
        )
    return rows


def _levels(c: ConfigurationResults) -> dict[str, Any] | None:
    if c.levels is None or c.modal is None or not has_to_say(c.levels):
        return None
    return {
        "summary": c.levels.summary,
        "frequency": levels.frequency_table(c.levels, c.modal) if c.levels.modes else None,
        "damping": levels.damping_table(c.levels) if c.levels.modes else None,
        "size": levels.size_table(c.levels),
        "evidence": levels.evidence_table(c.levels) if any(not v.passes for v in c.levels.verdicts) else None,
    }


def _averages(c: ConfigurationResults) -> str:
    if c.frfs is None or not (c.frfs.hits > 0).any():
        return "no hits"
    counts = c.frfs.hits[c.frfs.hits > 0]
    low, high = int(counts.min()), int(counts.max())
    if low == high:
        return "one hit" if low == 1 else f"{low} hits"
    return f"{low} to {high} hits"


def _stepwise(results: RunResults) -> str:
    """The stiffnesses found one configuration after the other, in words; empty without such a route."""
    found = None if results.fit is None else results.fit.stepwise
    if found is None:
        return ""
    values = [f"{words(name)} {format_value(value, math.nan, 'N/m')}" for name, value in found.values.items()]
    average = f"average {format_value(found.average, math.nan, 'N/m')}"
    return f"One configuration after the other: {', '.join([*values, average])}. {found.note}".rstrip()
