"""Tables for the terminal: they read well at 80 columns, without colour, and where only ASCII can be shown.

Every function returns something for ``rich.console.Console.print``. Colour is never the only cue: rows that
deserve a look start with ``!``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from ema_pipeline.correlate.types import Comparison, percent_off
from ema_pipeline.diagnose.types import Diagnosis, Ladder, Rung
from ema_pipeline.fit.types import FitResult
from ema_pipeline.ingest.records import Hit
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import plain, signed
from ema_pipeline.report import diagnosis, diagnosis_tables, levels, tables
from ema_pipeline.report.commands import typed

Clean = Callable[[str], str]
_SHORT = 15
_VALUE = 32
_ERROR_WORDS = "error: root mean square of (measurement - model)/σ, about 1 where the model explains the data"
_HELD_OUT_WORDS = "held out: the same on data that the fit has not seen"
_EPSILON_WORDS = (
    "ε: the error function of the source papers, the sum over the paired modes of "
    "((measured − model)/model frequency)²"
)
_COMPARISON_WORDS = (
    "σ: the test's own scatter and what was learned of the model's. Root mean square: the error of the fit, in which "
    "parts deviate as far as the data ask and a shape that is wrong as a whole counts little; in the ladder parts "
    "deviate no further than similar ones scatter, so its error may be larger."
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
    source = tables.modes_table(modal).picked((0, 1, 2, 5, 6, 7))
    source = _renamed(source, ("mode", "frequency, Hz", "damping, %", "MPC", "stable", "method"))
    remarks = [
        sentence(f"mode {i}: {'; '.join(m.flags)}") for i, m in enumerate(modal.modes, start=1) if m.flags
    ]
    return Group(text_table(source, title), *remarks)


def levels_tables(study: LevelStudy, modal: ModalModel, title: str = "") -> RenderableType:
    """What moves with the force of the hits: the answer, then frequency and damping of every mode by level."""
    parts: list[RenderableType] = [_heading(title)] if title else []
    parts.append(sentence(study.summary))
    if study.modes:
        table = levels.frequency_table(study, modal)
        last = len(table.head) - 1
        parts += [sentence(""), text_table(table.picked(range(last)), "Natural frequency by force level")]
        remarks: dict[str, list[str]] = {}
        for row in table.rows:
            remarks.setdefault(row.cells[last], []).append(row.cells[0])
        for remark, alike in remarks.items():
            if remark:
                parts.append(
                    sentence(f"{'mode' if len(alike) == 1 else 'modes'} {', '.join(alike)}: {remark}")
                )
        parts += [sentence(""), text_table(levels.damping_table(study), "Damping ratio by force level")]
        sizes = levels.size_table(study)
        if sizes is not None:
            parts += [
                sentence(""),
                text_table(sizes, "Size in the FRFs by force level, 1 where it is the same in all hits"),
            ]
        parts.append(
            sentence("p: probability of a trend as clear as this where nothing depends on the force;")
        )
        parts.append(
            sentence("–: not tested, or damping that changes by less than 1 %, or a size by less than 10 %.")
        )
    failed = [v for v in study.verdicts if not v.passes]
    if failed:
        parts += [sentence(""), sentence("Other signs:"), *(sentence(f"! {v.message}") for v in failed)]
    return Group(*parts)


def hits_table(hits: Sequence[Hit], title: str = "Hits") -> RenderableType:
    """How many hits were used, and every rejected hit or channel with its reason."""
    used = sum(h.accepted for h in hits)
    head = sentence(f"{title}: {used} of {len(hits)} used")
    source = tables.rejected_hits_table(hits)
    if not source.rows:
        return head
    return Group(head, text_table(source, ""))


def verdict_table(hits: Sequence[Hit], title: str = "Hits") -> RenderableType:
    """Every hit with what was measured of it and PASS or FAIL, then every check with limit, worst value and clause."""
    legend = (
        "bounce: second blow over the first; up to: where the force's spectrum has fallen; "
        "left: response at the end over its largest"
    )
    return Group(
        text_table(tables.hits_table(hits), f"{title}: hits"),
        sentence(legend),
        text_table(tables.checks_table(hits), f"{title}: checks"),
    )


def comparison_tables(compared: Comparison) -> RenderableType:
    """Differences per mode in units of σ, and the worst DOFs and FRF bands."""
    heads = ("mode", "measured, Hz", "model, Hz", "diff. %", "freq.", "damping", "MAC", "shape")
    every = tables.differences_table(compared)
    names = list(dict.fromkeys(m.configuration for m in compared.modes))
    parts: list[RenderableType] = [
        sentence(
            f"Model against measurement: {plain(compared.error, 3)} σ root mean square, "
            f"ε {plain(compared.frequency_error, 3)}"
        ),
        sentence(_COMPARISON_WORDS),
        sentence(_EPSILON_WORDS),
    ]
    for name in names:
        title = f"{name}: " if len(names) > 1 else ""
        own = tables.Table(every.head, tuple(r for r in every.rows if r.cells[0] == name), every.numeric)
        table = _renamed(own.picked((1, 2, 3, 4, 5, 8, 9, 10)), heads)
        parts += [sentence("")] if title else []
        parts.append(text_table(table, f"{title}per mode, (measured − model)/σ"))
    if compared.alone:
        parts += [sentence(""), *(sentence(f"! {text}") for text in _alone(compared))]
    if compared.dofs:
        parts += [sentence(""), text_table(tables.worst_dofs_table(compared), "DOFs that differ most")]
    if compared.bands:
        parts += [sentence(""), text_table(tables.worst_bands_table(compared), "FRF bands that differ most")]
    return Group(*parts)


def _alone(compared: Comparison) -> list[str]:
    """Measured modes that the fitted model does not have: they differ most, and stand in no table of differences."""
    found = []
    for m in compared.alone:
        hz = plain(m.measured_frequency_hz, 5)
        text = f"{m.configuration}: mode {m.measured + 1}, {hz} Hz, is none of the model's"
        if math.isfinite(m.model_frequency_hz):
            off = signed(percent_off(m.measured_frequency_hz, m.model_frequency_hz), 1)
            text += (
                f": that of its shape is at {plain(m.model_frequency_hz, 5)} Hz ({off} %, MAC {m.mac:.2f})"
            )
        found.append(text)
    return found


def fit_table(fit: FitResult, provisional: bool) -> RenderableType:
    """Fitted parameters with their uncertainty, nominal values, and what the data say of each.

    See `RunResults.provisional`.
    """
    source = tables.parameters_table(fit, provisional).picked((0, 1, 3, 4, 5))
    source = _renamed(source, ("parameter", "fitted (±1σ)", "nominal (±1σ)", "shift", "data say"))
    return Group(
        text_table(source, "Parameters; shift: in tolerances"),
        sentence(
            f"error {plain(fit.error, 3)} over {fit.data_count} data, ε {plain(fit.frequency_error, 3)}"
        ),
        sentence(_EPSILON_WORDS),
    )


def rung_table(rung: Rung) -> RenderableType:
    """Fitted parameters of one model of a ladder."""
    return Group(
        _heading(f"Parameters of {diagnosis.model_words(rung.effects)}"),
        text_table(diagnosis_tables.rung_table(rung), ""),
        sentence(f"error {plain(rung.error, 3)}"),
    )


def diagnosis_screen(
    found: Diagnosis,
    out: str = "OUT",
    program: str = "ema",
    suspicions: Sequence[str] = (),
    effect_files: Sequence[str] = (),
    added: Sequence[str] = (),
) -> RenderableType:
    """Verdict, candidates, what cannot be told apart, what to measure and what to type next.

    Parameters
    ----------
    found : Diagnosis
    out : str
        Results folder as the user would type it.
    program : str
        The command ``ema`` as the user would type it.
    suspicions : sequence of str
        Hits and sensors that cannot be right; they come first.
    effect_files : sequence of str
        Files with the user's own effects, as the user would type them.
    added : sequence of str
        Labels that are in the model.
    """
    parts: list[RenderableType] = [sentence(f"! {text}") for text in suspicions]
    parts += [_heading(diagnosis.heading(found)), sentence(found.summary)]
    if found.candidates:
        parts += [
            sentence(""),
            text_table(diagnosis_tables.candidates_table(found), "What may be missing"),
        ]
        parts.append(sentence(f"{_ERROR_WORDS}; {_HELD_OUT_WORDS}"))
        parts += [sentence(text) for text in (diagnosis.sigma_words(found),) if text]
    for text in diagnosis.reasons(found):
        parts += [sentence(""), sentence(text)]
    if unexplained := diagnosis.unexplained_words(found.ladder):
        parts += [sentence(""), sentence(unexplained)]
    if found.indistinguishable:
        parts += [sentence(""), *(sentence(f"! {text}") for text in diagnosis.group_words(found))]
    if found.localisation:
        parts += [
            sentence(""),
            text_table(diagnosis_tables.localisation_table(found), "Where the misfit sits"),
        ]
    if found.next_measurement:
        parts += [sentence(""), sentence(f"Measure next: {found.next_measurement}")]
    if shown := diagnosis.detection_words(found):
        parts += [sentence(""), sentence(shown)]
    if found.ladder.scatters:
        parts += [sentence(""), text_table(diagnosis_tables.scatter_table(found.ladder), "Scatter, 1 σ")]
    if found.notes:
        parts += [sentence(""), sentence("Remarks on the data:"), *(sentence(f"! {n}") for n in found.notes)]
    if not suspicions:
        commands = diagnosis.next_commands(found, out, added, effect_files)
        parts += _commands([typed(c, program) for c in commands])
    return Group(*parts)


def ladder_screen(ladder: Ladder) -> RenderableType:
    """Every model with its error on the data fitted and on data held out."""
    heads = ("model", "size (±1σ)", "error", "held out", "left", "evidence")
    told = ["evidence: logarithm, against the base model"]
    if diagnosis.of_modes(ladder):
        told.insert(0, "left: measured modes that the model does not explain")
    parts: list[RenderableType] = [
        text_table(_renamed(diagnosis_tables.ladder_table(ladder), heads), "Ladder of models"),
        sentence("; ".join([_ERROR_WORDS, _HELD_OUT_WORDS, *told])),
        sentence(diagnosis.noise_words(ladder)),
    ]
    if ladder.note:
        parts.append(sentence(f"No further effect is added: {ladder.note}."))
    return Group(*parts)


class Safe:
    """A line or table that suits the console: +/- where it has no ±, and made for its width."""

    def __init__(self, build: Callable[[Clean, int], RenderableType]) -> None:
        self._build = build

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield self._build(console_text(console), options.max_width)


def console_text(console: Console) -> Clean:
    """The function that makes text fit for a console: it replaces what an ASCII one cannot show."""
    return str if (console.encoding or "").lower().replace("-", "").startswith("utf") else _to_ascii


def _to_ascii(text: str) -> str:
    text = re.sub(r"(?<=\w)σ", " σ", text)  # 3σ reads 3 sigma
    return text.translate(_ASCII).encode("ascii", "replace").decode("ascii")


def _heading(text: str) -> Safe:
    return Safe(lambda clean, width: Text(clean(text), style="bold"))


def _commands(lines: Sequence[str]) -> list[RenderableType]:
    """Commands to copy, each on one line however long it is."""
    return [sentence(""), sentence("Next:"), *(_whole(f"  {line}") for line in lines)] if lines else []


def _whole(text: str) -> Safe:
    """A line that is never broken; the terminal lets it run on below."""
    return Safe(lambda clean, width: Text(clean(text), no_wrap=True, overflow="ignore"))


def sentence(text: str) -> Safe:
    """A sentence, broken at the console's width."""
    return Safe(lambda clean, width: Text(clean(text)))


def _renamed(source: tables.Table, head: tuple[str, ...]) -> tables.Table:
    """The same table with heads short enough for 80 columns."""
    return tables.Table(head, source.rows, source.numeric)


def text_table(source: tables.Table, title: str) -> Safe:
    """A table for the terminal, or for any other place with letters of one width.

    Where numbers would have to be broken, some columns stand below the others.
    """

    def made(clean: Clean, width: int) -> RenderableType:
        kept = _kept(source)
        if len(kept) > 1 and _widths(source, kept, clean, width) is None:
            return Group(*_blocks(source.picked(kept), title, clean, width))
        return build_table(source, title, clean, width)

    return Safe(made)


def matrix_table(source: tables.Table, title: str) -> Safe:
    """A table with as many columns as there are modes: below one another as many at a time as the width holds.

    The first column stands in every block.
    """
    return Safe(lambda clean, width: Group(*_blocks(source, title, clean, width)))


def _blocks(source: tables.Table, title: str, clean: Clean, width: int) -> Iterator[RenderableType]:
    needed = [
        2 + max(cell_len(clean(text)) for text in (source.head[k], *(r.cells[k] for r in source.rows)))
        for k in range(len(source.head))
    ]
    last, room, block = len(source.head) - 1, width - 1 - needed[0], list[int]()
    for k in range(1, last + 1):
        block.append(k)
        if k < last and sum(needed[n] for n in (*block, k + 1)) <= room:
            continue
        columns = f"columns {block[0]} to {k}" if len(block) > 1 else f"column {k}"
        part = f", {columns} of {last}" if len(block) < last else ""
        yield Text(clean((title + part).removeprefix(", ")), style="bold")
        yield build_table(source.picked((0, *block)), "", clean, width)
        yield Text("")
        block = []


def build_table(
    source: tables.Table, title: str, clean: Clean, width: int | None = None, *, ruled: bool = True
) -> RichTable:
    """A table for rich; `ruled` draws a line under the head.

    Within `width` numbers and values are never broken over lines; where that does not fit, they are broken at their
    blanks rather than lose a digit. Without it every cell stays on its lines.
    """
    kept = _kept(source)
    widths = None if width is None else _widths(source, kept, clean, width)
    table = RichTable(
        title=Text(clean(title), style="bold") if title else None,
        title_justify="left",
        box=box.SIMPLE_HEAD if ruled else None,
        safe_box=True,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("", width=1, no_wrap=True)
    for n, k in enumerate(kept):
        table.add_column(
            Text(clean(source.head[k])),
            justify="right" if k in source.numeric else "left",
            width=None if widths is None else widths[n],
            no_wrap=width is None,
            overflow="fold",
        )
    for row in source.rows:
        cells = [Text(clean(row.cells[k])) for k in kept]
        table.add_row(Text("!" if row.alert else " "), *cells, style="bold yellow" if row.alert else None)
    return table


def _kept(source: tables.Table) -> list[int]:
    """Columns without those of remarks that nobody made, which are only noise."""
    return [k for k in range(len(source.head)) if not source.rows or any(r.cells[k] for r in source.rows)]


def _widths(source: tables.Table, kept: Sequence[int], clean: Clean, width: int) -> list[int] | None:
    """Widths of columns that fill no more than a width; None where words would have to be broken."""
    room = width - 1 - 2 * len(kept)
    most, least, loose = [], [], []
    for k in kept:
        cells = [line for r in source.rows for line in clean(r.cells[k]).splitlines()]
        head = clean(source.head[k])
        longest = max(map(cell_len, cells), default=0)
        words = max(map(cell_len, " ".join([head, *cells]).split()), default=1)
        value = any(
            "±" in r.cells[k] and (r.cells[k][:1].isdigit() or longest <= _VALUE) for r in source.rows
        )
        whole = k in source.numeric or value or longest <= _SHORT
        most.append(max(longest, cell_len(head)))
        least.append(max(longest, words) if whole else words)
        loose.append(words)
    for narrowest in (least, loose):
        if sum(narrowest) <= room:
            return _narrowed(most, narrowest, room)
    return None


def _narrowed(widths: list[int], least: Sequence[int], room: int) -> list[int]:
    """The widest columns give way first."""
    widths = list(widths)
    while sum(widths) > room:
        give = [k for k in range(len(widths)) if widths[k] > least[k]]
        widths[max(give, key=widths.__getitem__)] -= 1
    return widths
