"""The report of two tests: one self-contained page."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from ema_pipeline.changes.figures import overlays
from ema_pipeline.changes.tables import change_lines, modes_table, notes, verdict_text
from ema_pipeline.changes.two_tests import Changes
from ema_pipeline.diagnose.sentences import label_text, probability_text, size_text
from ema_pipeline.files import replace_file
from ema_pipeline.report.diagnosis_tables import detection_table
from ema_pipeline.report.pages import page_templates
from ema_pipeline.report.style import png
from ema_pipeline.report.tables import Row, Table
from ema_pipeline.run.measured import measured_frfs, measured_modes
from ema_pipeline.run.types import Run

REPORT = "report.html"
_ABOVE = 1.15
"""End of the frequency axis over the highest mode."""


def write_page(found: Changes, a: Run, b: Run, out: Path) -> Path:
    """Write the page into a folder."""
    path = out / REPORT
    replace_file(path, page_templates().get_template("changes.html.j2").render(_content(found, a, b)))
    return path


def _content(found: Changes, a: Run, b: Run) -> dict[str, Any]:
    diagnosis = None if found.physics is None else found.physics.diagnosis
    return {
        "title": f"What changed: {a.info.title} → {b.info.title}",
        "a": found.a,
        "b": found.b,
        "rig": None if found.physics is None or b.rig is None else b.rig.name,
        "heading": found.verdict.capitalize(),
        "verdict": verdict_text(found),
        "lines": change_lines(found),
        "modes": modes_table(found),
        "notes": notes(found),
        "figures": _figures(a, b),
        "candidates": None if found.physics is None else _candidates(found),
        "limits": detection_table(diagnosis)
        if diagnosis is not None and diagnosis.detection_limits
        else None,
    }


def _figures(a: Run, b: Run) -> list[dict[str, str]]:
    modes_a, modes_b = measured_modes(a), measured_modes(b)
    high = {
        c: _ABOVE * max(float(m.frequency_hz.max(initial=1.0)) for m in (modes_a[c], modes_b[c]))
        for c in modes_a
        if c in modes_b
    }
    drawn = overlays(measured_frfs(a), measured_frfs(b), high)
    caption = "FRFs of both tests, response / impact, driving points first. Solid: A; dashed: B"
    return [
        {"data": base64.b64encode(png(figure)).decode(), "caption": f"{name}: {caption}"}
        for name, figure in drawn.items()
    ]


def _candidates(found: Changes) -> Table:
    assert found.physics is not None
    rows = tuple(
        Row(
            (
                label_text(c.label) + (" (in A)" if found.physics.reverse else ""),
                size_text(c.parameters),
                probability_text(c.probability),
                f"{c.error_before:.2f} → {c.error_after:.2f}",
                "claimed" if c.claimed else c.why,
            ),
            alert=c.claimed,
        )
        for c in found.physics.diagnosis.candidates
    )
    return Table(("effect", "size (±1σ)", "probability", "error, σ", "data say"), rows, frozenset({2, 3}))
