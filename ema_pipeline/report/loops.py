"""summary.json, plots and report.html of hysteresis tests."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path

from ema_pipeline.hysteresis.figures import isolator_figures
from ema_pipeline.hysteresis.summary import summary, terminal_lines
from ema_pipeline.hysteresis.types import IsolatorResult
from ema_pipeline.report import style
from ema_pipeline.report.summary_files import SCHEMA, replace_file


def write_loops_report(
    results: Mapping[str, IsolatorResult], title: str, provenance: Mapping[str, str], folder: Path
) -> None:
    """Write ``summary.json``, ``plots/`` and ``report.html`` into `folder`.

    Parameters
    ----------
    results : mapping of configuration to IsolatorResult
    title : str
    provenance : mapping of str to str
    folder : Path
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    content = {
        "schema": SCHEMA,
        "title": title,
        "rig": "isolator",
        "configurations": {name: summary(result) for name, result in results.items()},
    }
    replace_file(folder / "summary.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    plots = folder / "plots"
    plots.mkdir(exist_ok=True)
    tests = []
    for name, result in results.items():
        images = []
        for figure_name, figure in isolator_figures(result).items():
            picture = style.png(figure)
            (plots / f"{name}_{figure_name}.png").write_bytes(picture)
            (plots / f"{name}_{figure_name}.svg").write_bytes(style.svg(figure))
            uri = f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"
            images.append({"name": figure_name, "uri": uri})
        tests.append({"name": name, "text": "\n".join(terminal_lines(result)), "images": images})
    environment = Environment(
        loader=PackageLoader("ema_pipeline.report", "templates"), autoescape=True, undefined=StrictUndefined
    )
    page = environment.get_template("loops.html.j2").render(title=title, tests=tests, provenance=provenance)
    replace_file(folder / "report.html", page)
