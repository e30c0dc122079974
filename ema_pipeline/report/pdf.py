"""The report on paper: a few A4 pages with the verdict, the test sheet, the modes and the figures that matter."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from PIL import Image

from ema_pipeline.files import replacing
from ema_pipeline.plain_text import printable
from ema_pipeline.report import diagnosis, diagnosis_tables, summary, tables, terminal
from ema_pipeline.report.page_top import page_top
from ema_pipeline.report.plots import FigureSpec, figure_specs
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.test_sheet import set_up_table, transducers_table

if TYPE_CHECKING:
    from rich.console import RenderableType

TEXT_PAGES, FIGURE_PAGES = 4, 4
"""Most pages of either kind: together the eight that a reader of a test sheet will turn."""

_PAGE_IN = (8.27, 11.69)
_MARGIN_IN = 0.55
_FONT_PT, _LINE_PT = 7.0, 8.7
_COLUMNS = 118
_LINES = int((_PAGE_IN[1] - 2 * _MARGIN_IN) * 72 / _LINE_PT) - 2
_GAP_IN = 0.15
_DPI = 200

_WANTED = ("diagnosis_where", "diagnosis_candidates", "diagnosis_ladder", "frf_1", "mac_model", "stabilisation",
           "modes", "levels", "fit_parameters")  # fmt: skip
"""Figures by the ends of their names, the most telling first."""


def write_pdf(
    results: RunResults, path: Path, progress: Callable[[int, int, str], None] = lambda k, n, name: None
) -> None:
    """Write the report as PDF, eight pages at most.

    Parameters
    ----------
    results : RunResults
    path : Path
    progress : callable
        Told of each figure drawn.
    """
    buffer = io.BytesIO()
    facts: dict[str, Any] = {"Title": results.title, "CreationDate": None, "Creator": "ema"}
    with matplotlib.rc_context({"pdf.fonttype": 42}), PdfPages(buffer, metadata=facts) as pdf:
        for page in _text_pages(_text(results)):
            pdf.savefig(page)
        for page in _figure_pages(_chosen(results), progress):
            pdf.savefig(page)
    with replacing(path) as scratch:
        scratch.write_bytes(buffer.getvalue())


def _text(results: RunResults) -> Iterator[str]:
    """All lines, none longer than a page is wide."""
    band = page_top(results)
    yield from _wrapped(f"{results.title}: modal test report")
    yield ""
    yield from _wrapped(band.heading.upper())
    yield from _wrapped(band.summary)
    for tile in band.tiles:
        yield from _wrapped(
            f"{tile.name}: {tile.before}{f' → {tile.after}' if tile.after else ''} ({tile.words})"
        )
    for line in (*band.against, *([f"Measure next: {band.next}"] if band.next else []), *band.commands):
        yield from _wrapped(f"- {line}", "  ")
    for c in results.configurations:
        yield from _table(set_up_table(results, c), f"Test sheet, {c.name}")
        transducers = transducers_table(c)
        if transducers is not None:
            yield from _table(transducers, f"Transducers, {c.name}")
        if c.hits:
            yield from _table(tables.checks_table(c.hits), f"Quality checks of every hit, {c.name}")
            rejected = tables.rejected_hits_table(c.hits)
            if rejected.rows:
                yield from _table(rejected, f"Rejected hits, and channels left out of a hit, {c.name}")
    for c in results.configurations:
        if c.modal is not None:
            yield from _shown(terminal.modes_table(c.modal, f"Modes, {c.name}"))
    if results.diagnosis is not None:
        yield from _table(diagnosis_tables.candidates_table(results.diagnosis), "What may be missing")
        yield from _wrapped(diagnosis.sigma_words(results.diagnosis))
    if results.shown_ladder is not None:
        yield from _table(diagnosis_tables.ladder_table(results.shown_ladder), "Ladder of models")
        yield from _wrapped(diagnosis.noise_words(results.shown_ladder))
    cautions = summary.cautions(results)
    if cautions:
        yield ""
        yield "What to be careful about"
        for line in cautions:
            yield from _wrapped(f"- {line}", "  ")


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(printable(text), _COLUMNS, subsequent_indent=indent)


def _table(source: tables.Table, title: str) -> list[str]:
    return _shown(terminal.text_table(source, title))


def _shown(what: RenderableType) -> list[str]:
    """What a terminal would show, as lines of text, after an empty one."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=_COLUMNS, no_color=True, force_terminal=False)
    with console.capture() as shown:
        console.print(what)
    return ["", *(line.rstrip() for line in printable(shown.get()).splitlines())]


def _text_pages(lines: Iterator[str]) -> Iterator[Figure]:
    pages = _paged(list(lines))
    if len(pages) > TEXT_PAGES:
        left = sum(map(len, pages[TEXT_PAGES:]))
        pages = pages[:TEXT_PAGES]
        pages[-1] = [*pages[-1][: _LINES - 1], f"… {left} more lines: see report.html"]
    for lines_of_page in pages:
        page = Figure(figsize=_PAGE_IN)
        page.text(
            _MARGIN_IN / _PAGE_IN[0], 1 - _MARGIN_IN / _PAGE_IN[1], "\n".join(lines_of_page),
            family="DejaVu Sans Mono", fontsize=_FONT_PT, linespacing=_LINE_PT / _FONT_PT, va="top",
            parse_math=False,
        )  # fmt: skip
        yield page


def _paged(lines: list[str]) -> list[list[str]]:
    """Pages of lines; what stands between two empty lines stays on one page where it can."""
    pages: list[list[str]] = [[]]
    for empty, block in groupby(lines, key=lambda line: not line):
        mine = list(block)
        if len(pages[-1]) + len(mine) > _LINES and not empty and len(mine) <= _LINES:
            pages.append([])
        for line in mine:
            if len(pages[-1]) == _LINES:
                pages.append([])
            if line or pages[-1]:
                pages[-1].append(line)
    return pages


def _chosen(results: RunResults) -> list[FigureSpec]:
    specs = figure_specs(results)
    return [s for end in _WANTED for s in specs if s.name.endswith(end)]


def _figure_pages(specs: list[FigureSpec], progress: Callable[[int, int, str], None]) -> Iterator[Figure]:
    """Figures one below the other, as many as the pages hold."""
    width, height = (side - 2 * _MARGIN_IN for side in _PAGE_IN)
    page, used, pages = Figure(figsize=_PAGE_IN), 0.0, 1
    for number, spec in enumerate(specs, start=1):
        drawn = spec.draw()
        size = drawn.get_size_inches()
        scale = min(1.0, width / size[0], height / size[1])
        tall = scale * float(size[1])
        if used and used + tall > height:
            yield page
            if pages == FIGURE_PAGES:
                return
            page, used, pages = Figure(figsize=_PAGE_IN), 0.0, pages + 1
        top = _PAGE_IN[1] - _MARGIN_IN - used
        place = (
            _MARGIN_IN / _PAGE_IN[0],
            (top - tall) / _PAGE_IN[1],
            scale * size[0] / _PAGE_IN[0],
            tall / _PAGE_IN[1],
        )
        ax = page.add_axes(place)
        ax.imshow(_pixels(drawn), aspect="auto", interpolation="none")
        ax.set_axis_off()
        used += tall + _GAP_IN
        progress(number, len(specs), spec.name)
    if used:
        yield page


def _pixels(figure: Figure) -> np.ndarray:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return np.asarray(Image.open(buffer).convert("RGB"))
