"""Tables for the terminal: they read well at 80 columns, without colour, and where only ASCII can be shown.

Every function returns something for ``rich.console.Console.print``. Colour is never the only cue: rows that
deserve a look start with ``!``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from ema_pipeline.correlate.types import Comparison
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.ingest.records import Hit
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report import diagnosis, diagnosis_tables, levels, summary, tables
from ema_pipeline.report.numbers import format_value, plain, words
from ema_pipeline.report.results import RunResults

Clean = Callable[[str], str]
_SHORT = 15
_VALUE = 32
_ERROR_WORDS = (
    "error: root mean square of (measurement - model)/σ, about 1 where the model explains the data; "
    "held out: the same on data that the fit has not seen"
)
_ASCII = str.maketrans(
    {
        "±": "+/-",
        "−": "-",
        "–": "-",
        "…": "..",
        "×": "x",
        "·": "*",
        "²": "^2",
        "³": "^3",
        "ζ": "zeta",
        "σ": "sigma",
        "ε": "epsilon",
        "χ": "chi",
        "µ": "u",
        "←": "<-",
        "↔": "<->",
        "≥": ">=",
        "≤": "<=",
        "Δ": "D",
        "θ": "theta",
        "η": "eta",
        "“": '"',
        "”": '"',
        "’": "'",
        "°": " deg",
        "ω": "omega",
        "→": "->",
        "◆": "*",
        "½": "1/2",
        "√": "sqrt ",
        "ψ": "psi",
        "λ": "lambda",
        "\u00a0": " ",
        "Σ": "sum ",
    }
)


def modes_table(modal: ModalModel, title: str = "Modes") -> RenderableType:
    """Frequency, damping, collinearity, votes and remarks of all modes."""
    source = _pick(tables.modes_table(modal), (0, 1, 2, 5, 6, 7))
    source = _renamed(source, ("mode", "frequency, Hz", "damping, %", "MPC", "stable", "method"))
    remarks = [
        _line(f"mode {i}: {'; '.join(m.flags)}") for i, m in enumerate(modal.modes, start=1) if m.flags
    ]
    return Group(_rich(source, title), *remarks)


def levels_tables(study: LevelStudy, modal: ModalModel, title: str = "") -> RenderableType:
    """What moves with the force of the hits: the answer, then frequency and damping of every mode by level."""
    parts: list[RenderableType] = [_heading(title)] if title else []
    parts.append(_line(study.summary))
    if study.modes:
        table = levels.frequency_table(study, modal)
        last = len(table.head) - 1
        parts += [_line(""), _rich(_pick(table, range(last)), "Natural frequency by force level")]
        remarks: dict[str, list[str]] = {}
        for row in table.rows:
            remarks.setdefault(row.cells[last], []).append(row.cells[0])
        for remark, alike in remarks.items():
            if remark:
                parts.append(_line(f"{'mode' if len(alike) == 1 else 'modes'} {', '.join(alike)}: {remark}"))
        parts += [_line(""), _rich(levels.damping_table(study), "Damping ratio by force level")]
        sizes = levels.size_table(study)
        if sizes is not None:
            parts += [
                _line(""),
                _rich(sizes, "Size in the FRFs by force level, 1 where it is alike in all hits"),
            ]
        parts.append(_line("p: probability of a trend as clear as this where nothing depends on the force;"))
        parts.append(_line("–: not tested, or a size that changes by less than a tenth."))
    failed = [v for v in study.verdicts if not v.passes]
    if failed:
        parts += [_line(""), _line("Other signs:"), *(_line(f"! {v.message}") for v in failed)]
    return Group(*parts)


def hits_table(hits: Sequence[Hit], title: str = "Hits") -> RenderableType:
    """How many hits were used, and every rejected hit or channel with its reason."""
    used = sum(h.accepted for h in hits)
    head = _line(f"{title}: {used} of {len(hits)} used")
    source = tables.rejected_hits_table(hits)
    if not source.rows:
        return head
    return Group(head, _rich(source, ""))


def verdict_table(hits: Sequence[Hit], title: str = "Verdicts") -> RenderableType:
    """The checks with limit and clause, then every hit's values, worst over its channels."""
    source = tables.verdicts_table(hits)
    checks = list(range(4, len(source.head)))
    short = _renamed(source, tuple(h.partition(" (limit")[0] for h in source.head))
    blocks = [_pick(short, (0, 1, *checks[k : k + 4])) for k in range(0, len(checks), 4)]
    return Group(
        _rich(tables.checks_table(hits), f"{title}: checks"),
        *(_rich(b, f"{title}: hits") for b in blocks),
    )


def comparison_tables(compared: Comparison) -> RenderableType:
    """Differences per mode in units of σ, and the worst DOFs and FRF bands."""
    several = len({m.configuration for m in compared.modes}) > 1
    columns = ((0,) if several else ()) + (1, 2, 3, 4, 7, 8, 9)
    heads = (("config",) if several else ()) + (
        "mode",
        "measured, Hz",
        "model, Hz",
        "freq.",
        "damping",
        "MAC",
        "shape",
    )
    parts: list[RenderableType] = [
        _line(
            f"Model against measurement: {plain(compared.error, 3)} σ root mean square, "
            f"ε {plain(compared.frequency_error, 3)}"
        ),
        _rich(
            _renamed(_pick(tables.differences_table(compared), columns), heads),
            "Per mode, (measured − model)/σ",
        ),
    ]
    if compared.dofs:
        parts += [_line(""), _rich(tables.worst_dofs_table(compared), "DOFs that differ most")]
    if compared.bands:
        parts += [_line(""), _rich(tables.worst_bands_table(compared), "FRF bands that differ most")]
    return Group(*parts)


def diagnosis_screen(found: Diagnosis, out: str = "OUT") -> RenderableType:
    """Verdict, candidates, what cannot be told apart, what to measure and what to type next.

    Parameters
    ----------
    found : Diagnosis
    out : str
        Results folder as the user would type it.
    """
    parts: list[RenderableType] = [_heading(diagnosis.heading(found)), _line(found.summary)]
    if found.candidates:
        parts += [_line(""), _rich(diagnosis_tables.short_candidates_table(found), "What may be missing")]
        parts.append(_line(_ERROR_WORDS))
    for text in diagnosis.reasons(found):
        parts += [_line(""), _line(text)]
    if unexplained := diagnosis.unexplained_words(found.ladder):
        parts += [_line(""), _line(unexplained)]
    if found.indistinguishable:
        parts += [_line(""), *(_line(f"! {text}") for text in diagnosis.group_words(found))]
    if found.localisation:
        parts += [_line(""), _rich(diagnosis_tables.localisation_table(found), "Where the misfit sits")]
    if found.next_measurement:
        parts += [_line(""), _line(f"Measure next: {found.next_measurement}")]
    if shown := diagnosis.detection_words(found):
        parts += [_line(""), _line(shown)]
    if found.ladder.scatters:
        parts += [_line(""), _rich(diagnosis_tables.scatter_table(found.ladder), "Scatter, 1 σ")]
    if found.notes:
        parts += [_line(""), _line("Remarks on the data:"), *(_line(f"! {n}") for n in found.notes)]
    parts += _commands(diagnosis.next_commands(found, out))
    return Group(*parts)


def ladder_screen(ladder: Ladder) -> RenderableType:
    """Every model with its error on the data fitted and on data held out."""
    heads = ("model", "size (±1σ)", "error", "held out", "left", "evidence")
    told = ["evidence: logarithm, against the base model"]
    if diagnosis.of_modes(ladder):
        told.insert(0, "left: measured modes that the model does not explain")
    parts: list[RenderableType] = [
        _rich(_renamed(diagnosis_tables.ladder_table(ladder), heads), "Ladder of models"),
        _line("; ".join([_ERROR_WORDS, *told])),
        _line(diagnosis.noise_words(ladder)),
    ]
    if ladder.note:
        parts.append(_line(f"No further effect is added: {ladder.note}."))
    return Group(*parts)


def run_summary(results: RunResults, out: str = "OUT") -> RenderableType:
    """The run in a few sentences: findings, stiffnesses, what to be careful about, and what to type next.

    Parameters
    ----------
    results : RunResults
    out : str
        Results folder as the user would type it.
    """
    parts: list[RenderableType] = [_line(line) for line in summary.findings(results)]
    if results.fit is not None:
        parts += [
            _line(
                f"{words(p.name)} = {format_value(p.value, p.std, p.unit)}, "
                f"{summary.identified_words(p, results.fit)}"
            )
            for p in summary.stiffnesses(results.fit)
        ]
    cautions = summary.cautions(results)
    if cautions:
        parts += [_line(""), _line("Be careful about:"), *(_line(f"! {c}") for c in cautions)]
    if results.diagnosis is not None:
        added = (
            results.ladder.rungs[-1].effects if results.ladder is not None and results.ladder.rungs else ()
        )
        parts += _commands(diagnosis.next_commands(results.diagnosis, out, added))
    return Group(*parts)


class Safe:
    """A table or line that suits the console: +/- where it has no ±, loose where it is narrow.

    In a rigid table numbers are never broken over lines; where that does not fit the width, a loose one
    breaks them at their blanks rather than lose a digit.
    """

    def __init__(self, build: Callable[[Clean, bool], RenderableType]) -> None:
        self._build = build

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        unicode_console = (console.encoding or "").lower().replace("-", "").startswith("utf")
        clean = str if unicode_console else _to_ascii
        rigid = self._build(clean, True)
        needed = Measurement.get(console, options.update(max_width=10_000), rigid).minimum
        yield rigid if needed <= options.max_width else self._build(clean, False)


def _to_ascii(text: str) -> str:
    text = re.sub(r"(?<=\w)σ", " σ", text)  # 3σ reads 3 sigma
    return text.translate(_ASCII).encode("ascii", "replace").decode("ascii")


def _heading(text: str) -> Safe:
    return Safe(lambda clean, rigid: Text(clean(text), style="bold"))


def _commands(lines: Sequence[str]) -> list[RenderableType]:
    """Commands to copy, one a line."""
    return [_line(""), _line("Next:"), *(_line(f"  {line}") for line in lines)] if lines else []


def _line(text: str) -> Safe:
    return Safe(lambda clean, rigid: Text(clean(text)))


def _pick(source: tables.Table, columns: Sequence[int]) -> tables.Table:
    """Some columns of a table."""
    return tables.Table(
        tuple(source.head[c] for c in columns),
        tuple(tables.Row(tuple(r.cells[c] for c in columns), r.alert) for r in source.rows),
        frozenset(k for k, c in enumerate(columns) if c in source.numeric),
    )


def _renamed(source: tables.Table, head: tuple[str, ...]) -> tables.Table:
    """The same table with heads short enough for 80 columns."""
    return tables.Table(head, source.rows, source.numeric)


def _rich(source: tables.Table, title: str) -> Safe:
    return Safe(lambda clean, rigid: _build(source, title, clean, rigid))


def _build(source: tables.Table, title: str, clean: Clean, rigid: bool) -> RichTable:
    # a column of remarks that nobody made is only noise
    kept = [k for k in range(len(source.head)) if not source.rows or any(r.cells[k] for r in source.rows)]
    table = RichTable(
        title=Text(clean(title), style="bold") if title else None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        safe_box=True,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("", width=1, no_wrap=True)
    for k in kept:
        numeric = k in source.numeric
        longest = max((len(line) for r in source.rows for line in r.cells[k].splitlines()), default=0)
        short = longest <= _SHORT
        value = any(
            "±" in r.cells[k] and (r.cells[k][:1].isdigit() or longest <= _VALUE) for r in source.rows
        )
        table.add_column(
            Text(clean(source.head[k])),
            justify="right" if numeric else "left",
            no_wrap=rigid and (numeric or value or short),
            overflow="fold",
        )
    for row in source.rows:
        cells = [Text(clean(row.cells[k])) for k in kept]
        table.add_row(Text("!" if row.alert else " "), *cells, style="bold yellow" if row.alert else None)
    return table
