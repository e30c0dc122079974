"""Simulated records as words, tables and figures for the report and the terminal."""

from __future__ import annotations

import base64
from typing import Any

from ema_pipeline.diagnose.hysteresis_loop import HysteresisLoop
from ema_pipeline.number_text import format_value, plain
from ema_pipeline.observations.free_run import RecordError
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.tables import Row, Table

_USE = {"fit": "fitted", "held_out": "held out"}
_LEAST = 0.2
"""Share of a parameter in a combination below which it is not named."""


def simulation_context(results: RunResults) -> dict[str, Any] | None:
    """What the page shows of simulated records; None where none were simulated."""
    if not results.simulation:
        return None
    from ema_pipeline.report import style
    from ema_pipeline.report.figures.records import hysteresis_figure, records_figure

    images = [(style.png(records_figure(results.simulation)), _RECORDS)]
    if results.hysteresis:
        images.append((style.png(hysteresis_figure(results.hysteresis)), _LOOPS))
    return {
        "table": errors_table(results.simulation),
        "loops": [loop_words(loop) for loop in results.hysteresis],
        "images": [
            {"uri": f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}", "caption": caption}
            for png, caption in images
        ],
    }


_RECORDS = "Left: measured response about its largest value, and both models; right: amplitude by frequency"
_LOOPS = "Loop of the hysteresis at the amplitude of the records; grey: two standard deviations"


def errors_table(errors: tuple[RecordError, ...]) -> Table:
    """One row per record and sensor."""
    rows = [
        Row(
            (
                e.record,
                _USE[e.use],
                str(e.sensor),
                str(e.samples),
                f"{plain(e.before, 3)} {e.unit}",
                f"{plain(e.rmse, 3)} {e.unit}",
                f"{100 * e.relative:.2g} %",
            ),
            False,
        )
        for e in errors
    ]
    head = (
        "record",
        "use",
        "sensor",
        "samples",
        "error without effects",
        "error of the model",
        "of the response",
    )
    return Table(head, tuple(rows), frozenset(range(3, 7)))


def error_lines(errors: tuple[RecordError, ...]) -> list[str]:
    """The same for a terminal, a line each."""
    several = len({e.sensor for e in errors}) > 1
    return [
        f"{e.record}{f', {e.sensor}' if several else ''} ({_USE[e.use]}): free-run error {plain(e.rmse, 3)} {e.unit}, "
        f"{100 * e.relative:.2g} % of the response; without effects {plain(e.before, 3)} {e.unit}"
        for e in errors
    ]


def loop_words(loop: HysteresisLoop) -> str:
    """What is identified of a Bouc-Wen element."""
    energy = format_value(loop.energy_j, loop.energy_std_j, "J")
    stiffness = format_value(loop.stiffness_n_m, loop.stiffness_std_n_m, "N/m")
    return (
        f"{loop.label.replace('@', ' at ')}: at an amplitude of {plain(loop.amplitude_m, 3)} m it takes {energy} per "
        f"cycle and has a stiffness of {stiffness} from tip to tip. Of its parameters the records determine "
        f"{_combination(loop.best[0])} to {100 * loop.best[1]:.2g} %, and {_combination(loop.worst[0])} to "
        f"{100 * loop.worst[1]:.2g} % only."
    )


def _combination(parts: dict[str, float]) -> str:
    """``stiffness^0.7·force^-0.7`` of relative changes."""
    largest = max(abs(v) for v in parts.values())
    named = [(n, v) for n, v in parts.items() if abs(v) >= _LEAST * largest]
    if len(named) == 1:
        return named[0][0]
    sign = -1.0 if named[0][1] < 0 else 1.0
    return "·".join(f"{n}^{sign * v:.2g}" for n, v in named)
