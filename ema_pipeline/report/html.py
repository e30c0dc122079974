"""The self-contained HTML report: one file, no network, prints on A4."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ema_pipeline.files import replace_file
from ema_pipeline.report import diagnosis, diagnosis_tables, levels, summary, tables
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.moving_gear import fill_of, moving_gears
from ema_pipeline.report.numbers import format_value, slug, words
from ema_pipeline.report.pages import page_templates
from ema_pipeline.report.plots import Plot, Progress, render
from ema_pipeline.report.results import ConfigurationResults, RunResults

HITS_LISTED = 300
SECTIONS = (
    ("summary", "Summary"),
    ("diagnosis", "Diagnosis"),
    ("frf", "FRFs and coherence"),
    ("nyquist", "Nyquist circles"),
    ("levels", "Does it depend on how hard you hit?"),
    ("stabilisation", "Stabilisation charts"),
    ("modes", "Modes"),
    ("pairing", "Pairing and MAC"),
    ("shapes", "Mode shapes"),
    ("error_function", "Error function"),
    ("fit", "Fitted parameters"),
    ("comparison", "Where model and measurement part"),
    ("hits", "Hits"),
    ("provenance", "Settings and provenance"),
)


def write_report(
    results: RunResults,
    path: str | Path,
    plots: Sequence[Plot] | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the report.

    Parameters
    ----------
    results : RunResults
    path : str or Path
        HTML file to write; its folder is made if need be.
    plots : sequence of Plot or None
        What `write_plots` returned; None draws the figures now.
    progress : callable or None
        Told of each figure drawn.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    drawn = render(results, None, progress) if plots is None else plots
    replace_file(target, report_html(results, drawn))


def report_html(results: RunResults, plots: Sequence[Plot]) -> str:
    """The report's text, with `plots` embedded."""
    environment = page_templates()
    environment.filters["slug"] = slug
    environment.filters["words"] = words
    return environment.get_template("report.html.j2").render(_context(results, plots))


def _context(results: RunResults, plots: Sequence[Plot]) -> dict[str, Any]:
    shown = [p for p in plots if p.spec.in_report]
    fit, compared = results.fit, results.comparison
    images = [
        {
            "section": p.spec.section,
            "configuration": p.spec.configuration,
            "caption": p.spec.caption,
            "uri": _data_uri(p),
            "share": min(100, round(100 * p.width_in / 7.2)),
        }
        for p in shown
    ]
    absent = set() if results.shown_ladder is not None else {"diagnosis"}
    if not any(has_to_say(c.levels) for c in results.configurations):
        absent.add("levels")
    sections = tuple((i, t) for i, t in SECTIONS if i not in absent)
    return {
        "results": results,
        "sections": sections,
        "number": {name: k for k, (name, _) in enumerate(sections, start=1)},
        "diagnosis": _diagnosis(results),
        "ladder": _ladder(results),
        "images": images,
        "findings": summary.findings(results),
        "cautions": summary.cautions(results),
        "stiffnesses": [
            {
                "name": words(p.name),
                "value": format_value(p.value, p.std, p.unit),
                "words": summary.identified_words(p, fit),
                "identified": p.identified and not summary.fails(fit),
            }
            for p in summary.stiffnesses(fit)
        ]
        if fit
        else [],
        "configurations": [_configuration(c) for c in results.configurations],
        "parameters": tables.parameters_table(fit) if fit else None,
        "sweeps": tables.sweeps_table(fit) if fit and fit.sweeps else None,
        "two_step": _two_step(results),
        "differences": tables.differences_table(compared) if compared else None,
        "worst_dofs": tables.worst_dofs_table(compared) if compared and compared.dofs else None,
        "worst_bands": tables.worst_bands_table(compared) if compared and compared.bands else None,
        "fill_of": fill_of,
    }


def _diagnosis(results: RunResults) -> dict[str, Any] | None:
    found = results.diagnosis
    if found is None:
        return None
    return {
        "heading": diagnosis.heading(found),
        "summary": found.summary,
        "candidates": diagnosis_tables.candidates_table(found),
        "reasons": diagnosis.reasons(found),
        "unexplained": diagnosis.unexplained_words(found.ladder),
        "alike": diagnosis.group_words(found),
        "next": found.next_measurement,
        "localisation": diagnosis_tables.localisation_table(found) if found.localisation else None,
        "scatter": diagnosis_tables.scatter_table(found.ladder) if found.ladder.scatters else None,
        "detection": diagnosis_tables.detection_table(found) if found.detection_limits else None,
        "notes": found.notes,
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
    }


def _configuration(c: ConfigurationResults) -> dict[str, Any]:
    hits = c.hits
    listed = hits
    if len(hits) > HITS_LISTED:
        listed = tuple(h for h in hits if any(not v.passes for v in h.verdicts))[:HITS_LISTED]
    return {
        "name": c.name,
        "modal": c.modal,
        "frfs": c.frfs,
        "averages": _averages(c),
        "pairing": c.pairing,
        "levels": _levels(c),
        "modes": tables.modes_table(c.modal) if c.modal else None,
        "pairs": tables.pairs_table(c.pairing, c.modal) if c.pairing and c.modal else None,
        "unpaired": tables.unpaired_table(c.pairing) if c.pairing else None,
        "gears": moving_gears(c),
        "hit_count": len(hits),
        "used": sum(h.accepted for h in hits),
        "rejected": tables.rejected_hits_table(hits),
        "verdicts": tables.verdicts_table(listed),
        "listed": len(listed),
        "checks": tables.failed_checks_table(c.frfs.verdicts) if c.frfs else None,
    }


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


def _two_step(results: RunResults) -> dict[str, str] | None:
    if results.fit is None or results.fit.two_step is None:
        return None
    two = results.fit.two_step
    nan = float("nan")
    return {
        "sun planet mesh stiffness": format_value(two.sun_planet_mesh_stiffness, nan, "N/m"),
        "ring planet mesh stiffness": format_value(two.ring_planet_mesh_stiffness, nan, "N/m"),
        "average": format_value(two.average, nan, "N/m"),
        "note": two.note,
    }


def _data_uri(plot: Plot) -> str:
    wanted = plot.spec.report_format
    kind = wanted if wanted in plot.files else next(iter(plot.files))
    mime = {"png": "image/png", "svg": "image/svg+xml"}[kind]
    return f"data:{mime};base64,{base64.b64encode(plot.files[kind]).decode('ascii')}"
