"""A run on one screen: verdict, modes, the most serious cautions, and the next command."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Iterator, Sequence

from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.text import Text

from ema_pipeline.choices import Choices
from ema_pipeline.correlate.types import percent_off
from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.types import Candidate, Diagnosis
from ema_pipeline.modal.chosen import EXCLUDED
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import below, counted, format_percent, format_value, plain, signed
from ema_pipeline.report import diagnosis
from ema_pipeline.report.cautions import Weight, cautions, left_out, suspect, suspicions
from ema_pipeline.report.commands import naming, typed
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.simulation import error_lines
from ema_pipeline.report.summary import changed_words, commands_left
from ema_pipeline.report.tables import Row, Table
from ema_pipeline.report.terminal import Clean, build_table, console_text
from ema_pipeline.report.thresholds import LOW_MAC

SCREEN_LINES = 15
"""Lines of the summary: what a reader takes in at a glance, and what a terminal of 24 lines holds with its prompt."""

MOST_CAUTIONS = 3
LEAST_MODES = 3
"""Rows of modes that later cautions do not push out."""

_MOST_RECORDS = 4
"""Records whose errors a screen has room for."""

_MODEL_HZ = "model, Hz"
_GIVE_WAY = (_MODEL_HZ, "MPC", "MAC", "difference, %", "damping, %")
"""Columns that a narrow terminal does without, one after the other."""

_MOST_NAMED = 4
"""Candidates left out that a line has room for."""


class RunScreen:
    """The summary of a run in at most `SCREEN_LINES` lines of 80 characters; for ``rich.console.Console.print``.

    Parameters
    ----------
    results : RunResults
    out : str
        Results folder as the user would type it.
    below : int
        Lines that the caller prints below; they are counted.
    """

    def __init__(self, results: RunResults, out: str, below: int = 0) -> None:
        self._results, self._out, self._below = results, out, below

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        clean = console_text(console)
        width = options.max_width

        def wrapped(text: str, indent: str = "") -> list[str]:
            return textwrap.wrap(clean(text), width, subsequent_indent=indent, break_long_words=False) or [""]

        head = wrapped(verdict_line(self._results)) + wrapped(data_line(self._results))
        for line in error_lines(self._results.simulation)[:_MOST_RECORDS]:
            head += wrapped(f"{line}.", "  ")
        table = modes_table(self._results)
        total = len(table.rows)
        # the head of the table is a line of its own, and so is the count of modes that are not shown
        room = SCREEN_LINES - len(head) - self._below - (1 if total else 0)
        told = _fitting(
            [wrapped(f"! {c}", "  ") for c in cautions(self._results, Weight.SCALE)],
            room - min(total, LEAST_MODES + 1),
        )
        shown = room - sum(map(len, told))
        rows = table.rows if total <= shown else table.rows[: max(shown - 1, 0)]
        yield from (Text(line) for line in head)
        if rows:
            yield _fitted(Table(table.head, rows, table.numeric), clean, console, options)
        if len(rows) < total:
            yield Text(clean(f"  … {total - len(rows)} more modes in {self._out}/modes.csv"))
        yield from (Text(line) for lines in told for line in lines)


def _fitted(table: Table, clean: Clean, console: Console, options: ConsoleOptions) -> RenderableType:
    """The table of modes without the columns that it is too wide for: first the model's frequencies, which the
    differences tell.
    """
    for name in (None, *_GIVE_WAY):
        table = table.picked([k for k, head in enumerate(table.head) if head != name])
        built = build_table(table, "", clean, ruled=False)
        if Measurement.get(console, options.update(max_width=10_000), built).maximum <= options.max_width:
            break
    return built


def _fitting(blocks: Sequence[list[str]], room: int) -> list[list[str]]:
    """The first caution, and as many more as fit."""
    told: list[list[str]] = []
    for block in blocks[:MOST_CAUTIONS]:
        if told and sum(map(len, told)) + len(block) > room:
            break
        told.append(block)
    return told


def verdict_line(results: RunResults) -> str:
    """What is missing and how sure that is; without a model how many modes there are."""
    words = _verdict(results)
    doubted = suspect(results)
    if doubted and results.fit is not None:
        return f"{doubted} is suspected, see below. If it is right: {words[:1].lower()}{words[1:]}"
    return words


def _verdict(results: RunResults) -> str:
    found = results.diagnosis
    fit = results.fit
    if results.diagnosis_is_old:
        return changed_words(results)
    if found is not None:
        told = _diagnosed(found)
        named = " and ".join(diagnosis.label_words(x) for x in results.added)
        return f"With {named} in the model: {told[:1].lower()}{told[1:]}" if named else told
    if fit is not None:
        return f"The model was fitted: error {plain(fit.error, 3)} (about 1 where it explains the data)."
    modes = [m for c in results.configurations if c.modal is not None for m in c.modal.modes]
    if not modes:
        return "No modes were found." if results.configurations else "Nothing has been analysed yet."
    low, high = min(m.frequency_hz for m in modes), max(m.frequency_hz for m in modes)
    span = f"at {plain(low)}" if len(modes) == 1 else f"from {plain(low)} to {plain(high)}"
    return f"{counted(len(modes), 'mode')} {span} Hz; no model was named (--rig)."


def _diagnosed(found: Diagnosis) -> str:
    """The verdict in a sentence, with the errors that the ladder states."""
    error = found.error
    heading = diagnosis.heading(found)
    if found.verdict == "adequate":
        odds = probability_text(found.adequate_probability)
        perhaps = diagnosis.perhaps_words(found)
        return " ".join(filter(None, (f"{heading} (probability {odds}, error {plain(error, 3)}).", perhaps)))
    if found.verdict == "not_enough_data":
        return f"{heading}. {found.summary}"
    top = found.ladder.rungs[-1].parameters if found.ladder.rungs else {}

    def named(candidates: Sequence[Candidate]) -> str:
        told = []
        for c in candidates:
            sizes = {
                n: top.get(f"{c.label}.{n}", s) for n, s in c.parameters.items()
            }  # as the ladder has them
            shown = diagnosis.size_words(sizes, ", ")
            told.append(
                ", ".join(filter(None, (diagnosis.label_words(c.label), shown, diagnosis.or_words(c))))
            )
        return "; ".join(told)

    if found.verdict == "effect":
        mine = diagnosis.claimed(found)
        odds = probability_text(min((c.probability for c in mine), default=math.nan))
        rungs = found.ladder.rungs
        fall = f", error {plain(error, 3)} → {plain(rungs[-1].error, 3)}" if rungs else ""
        return f"Missing: {named(diagnosis.leading(found))} (probability {odds}{fall})."
    if found.verdict == "ambiguous":
        sure = named(diagnosis.undisputed(found))
        told = f"{diagnosis.heading_of_alike(found)}: {named(diagnosis.alike(found))}."
        return f"Missing: {sure}. Beside it, {told[:1].lower()}{told[1:]}" if sure else told
    closest = found.ladder.rungs[-1].error if found.ladder.rungs and diagnosis.claimed(found) else error
    errors = dict.fromkeys((plain(error, 3), plain(closest, 3)))  # without and with what is closest
    return f"{heading} (error {' → '.join(errors)})."


def data_line(results: RunResults) -> str:
    """Hits, modes and pairs of every configuration, and what was left out."""
    several = len(results.configurations) > 1
    return (
        "; ".join(_data_words(c, several, results.choices.of(c.name)) for c in results.configurations) + "."
    )


def _data_words(c: ConfigurationResults, several: bool, choices: Choices) -> str:
    parts = []
    if c.hits:
        dropped = " (channels left out of some)" if any(t.startswith("channel") for t in left_out(c)) else ""
        yours = f" ({len(choices.excluded_hits)} excluded by you)" if choices.excluded_hits else ""
        parts.append(f"{sum(h.accepted for h in c.hits)} of {len(c.hits)} hits used{yours}{dropped}")
    if c.modal is not None:
        parts.append(counted(len(c.modal.modes), "mode") + _chosen_words(choices))
        parts += _candidates_left_out(c.modal)
    if c.pairing is not None:
        weak = sum(p.mac < LOW_MAC for p in c.pairing.pairs)
        parts.append(f"{len(c.pairing.pairs)} paired" + (f", {weak} of these doubtfully" if weak else ""))
    if c.levels is not None and has_to_say(c.levels) and c.levels.level_dependent:
        parts.append("some move with the force")
    return (f"{c.name}: " if several else "") + (", ".join(parts) or "nothing analysed yet")


def _candidates_left_out(modal: ModalModel) -> list[str]:
    """Peaks, columns of stable poles and tones that are left out of the list; empty where none are."""
    found = [entry.frequency_hz for entry in modal.left_out if entry.reason != EXCLUDED]
    if not found:
        return []
    named = ", ".join(plain(f) for f in found[:_MOST_NAMED])
    more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    reasons = "reason" if len(found) == 1 else "reasons"
    return [f"{counted(len(found), 'candidate')} left out: {named} Hz{more} ({reasons} in the report)"]


def _chosen_words(choices: Choices) -> str:
    """What the user excluded from the modes and included in them; empty for nothing."""
    words = [
        f"{len(chosen)} {what}"
        for chosen, what in ((choices.excluded_modes, "excluded"), (choices.included_modes, "included"))
        if chosen
    ]
    return f" ({', '.join(words)} by you)" if words else ""


def next_lines(results: RunResults, out: str, program: str) -> tuple[str, ...]:
    """The command to type next, as it can be pasted; none where there is nothing left to do."""
    if suspicions(results):
        raw, rig = results.provenance.get("raw folder", "RAW"), results.provenance.get("rig", "none")
        model = "" if rig == "none" else f" --rig {shlex.quote(rig)}"
        named = shlex.join(["--out", out, *naming(results.effect_files)])
        again = f"run {shlex.quote(raw)}{model} {named}"
        return (f"correct test.toml, then {shlex.quote(program)} {again}",)
    return tuple(typed(c, program) for c in commands_left(results, out)[:1])


def modes_table(results: RunResults) -> Table:
    """Frequency and damping of every mode and, with a model, its frequency, the difference and the MAC."""
    several = len(results.configurations) > 1
    paired = any(c.pairing is not None for c in results.configurations)
    head = (("",) if several else ()) + ("mode", "frequency, Hz", "damping, %")
    head += (_MODEL_HZ, "difference, %", "MAC") if paired else ("MPC",)
    rows = tuple(
        Row(((c.name,) if several else ()) + cells, alert)
        for c in results.configurations
        for cells, alert in _mode_rows(c, paired)
    )
    first = 1 if several else 0
    return Table(head, rows, frozenset(range(first, len(head))))


def _mode_rows(c: ConfigurationResults, paired: bool) -> Iterator[tuple[tuple[str, ...], bool]]:
    pairs = {} if c.pairing is None else {p.measured: p for p in c.pairing.pairs}
    for k, mode in enumerate(() if c.modal is None else c.modal.modes):
        cells: tuple[str, ...] = (
            str(k + 1),
            format_value(mode.frequency_hz, mode.frequency_std_hz),
            format_percent(mode.damping_ratio, mode.damping_std).removesuffix(" %"),
        )
        if not paired:
            yield (*cells, f"{mode.mpc:.2f}"), bool(mode.flags)
            continue
        pair = pairs.get(k)
        if pair is None:
            yield (*cells, "none", "–", "–"), True
            continue
        weak = pair.mac < LOW_MAC
        mac = "–" if math.isnan(pair.mac) else below(pair.mac, LOW_MAC) if weak else f"{pair.mac:.2f}"
        off = percent_off(mode.frequency_hz, pair.model_frequency_hz)
        yield (*cells, plain(pair.model_frequency_hz, 5), signed(off, 2), mac), weak
