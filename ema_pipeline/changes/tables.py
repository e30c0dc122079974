"""What changed as sentences and tables, for the screen and for the page."""

from __future__ import annotations

import math

from ema_pipeline.changes.matrices import MacMatrix
from ema_pipeline.changes.modes import LEVEL, ModeChange, ModeChanges
from ema_pipeline.changes.two_tests import Changes
from ema_pipeline.diagnose.sentences import label_text, probability_text, size_text
from ema_pipeline.diagnose.types import Diagnosis
from ema_pipeline.number_text import format_percent, format_value, plain, signed
from ema_pipeline.report.diagnosis_tables import detection_table
from ema_pipeline.report.tables import Row, Table

_LEAST_SHOWN = 0.005
"""Change of a frequency in per cent that two decimals show."""

_SHIFTED = 3.0
"""Standard deviations from which a shift of all frequencies is one."""


def verdict_text(found: Changes) -> str:
    """The answer in one or two sentences."""
    if found.physics is None:
        return _of_modes(found)
    diagnosis = found.physics.diagnosis
    error = diagnosis.ladder.rungs[0].error
    if found.physics.claimed:
        changed = f"Changed: {'; '.join(change_lines(found))}."
        if diagnosis.verdict != "unknown_effect":
            return changed
        after = diagnosis.ladder.rungs[-1].error
        return (
            f"The rig's model does not explain both tests (error {error:.2f} → {after:.2f}); what it finds is "
            f"provisional. {changed}"
        )
    if diagnosis.verdict == "unknown_effect":
        return (
            f"The rig's model does not explain both tests with one rig (error {error:.2f}), and no effect of the "
            f"library explains what differs. {_of_modes(found)}"
        )
    if diagnosis.verdict == "not_enough_data":
        return f"The tests have too few modes in common to show a physical change. {_of_modes(found)}"
    odds = probability_text(diagnosis.null_probability)
    same = f"The same within what these tests can show (probability that nothing changed: {odds})."
    if any(m.changed for m in found.modes.modes):
        return f"{same} {_of_modes(found)} Temperature, mounting or another scatter explains that; no effect does."
    return same


def _of_modes(found: Changes) -> str:
    changed = [m for m in found.modes.modes if m.changed]
    count, level = len(found.modes.modes), f"(p < {LEVEL:g} over all that was compared)"
    if not changed:
        return f"None of {count} modes in common changed beyond its interval {level}."
    return f"{len(changed)} of {count} modes in common changed beyond their intervals {level}."


def change_lines(found: Changes) -> list[str]:
    """Each claimed effect with its size and probability."""
    if found.physics is None:
        return []
    where = " in A, not in B" if found.physics.reverse else ""
    lines = []
    for c in found.physics.claimed:
        sizes = size_text(c.parameters)
        same = f", the same as {', '.join(map(label_text, c.equivalents))}" if c.equivalents else ""
        lines.append(
            f"{label_text(c.label)}{where}, {sizes} (probability {probability_text(c.probability)}{same})"
        )
    return lines


def limits_text(diagnosis: Diagnosis) -> str:
    """The least sizes of effects that two tests would show."""
    told = []
    for effect, size, best, _ in (row.cells for row in detection_table(diagnosis).rows):
        named = effect if effect.endswith(size) else f"{effect} {size}"  # a mass is not of a "mass mass"
        told.append(f"{named} {'from ' if best[0].isdigit() else ''}{best}")  # or "up to …", "no size"
    return f"These tests would show, nine times in ten: {'; '.join(told)}"


def notes(found: Changes) -> list[str]:
    """What a reader should know beside the verdict."""
    lines = []
    for c in found.modes.common_shift:
        lines.append(f"{c}: {_shift_text(found.modes, c)}.")
    for name, lone in (("A", found.modes.only_a), ("B", found.modes.only_b)):
        if lone:
            told = ", ".join(f"{c} mode {k} at {f:.2f} Hz" for c, k, f in lone[:6])
            lines.append(f"Modes of {name} alone: {told}{' …' if len(lone) > 6 else ''}.")
    lines.append(
        "Intervals (± 1 σ) include each test's own scatter; effects of a new set-up (temperature, mounting, "
        "suspension) are not included and appear as changes."
    )
    return lines


def _shift_text(found: ModeChanges, configuration: str) -> str:
    """How the frequencies of a configuration moved: by one share, each by its own, or not at all."""
    shift = found.common_shift[configuration]
    size = format_percent(shift.relative, shift.std)
    if not shift.alike:
        each = [100 * m.frequency_change[0] for m in found.modes if m.configuration == configuration]
        if max(map(abs, each)) < _LEAST_SHOWN:
            return f"frequencies changed by less than {_LEAST_SHOWN:g} %, not all by the same share"
        return f"frequencies changed by {signed(min(each), 2)} to {signed(max(each), 2)} %, not all by the same share"
    if abs(shift.relative) < _SHIFTED * shift.std:
        return f"no shift common to all frequencies ({size})"
    return f"all frequencies moved by the same share, {size}, as with a change of temperature"


def modes_table(found: Changes) -> Table:
    """Every pair of modes with its changes."""
    head = (
        "configuration", "A", "B", "frequency in A, Hz", "change, %", "p", "damping in A, %", "change, %", "p", "MAC",
        "usual above", "p", "changed",
    )  # fmt: skip
    rows = tuple(Row(_mode_cells(m), alert=bool(m.changed)) for m in found.modes.modes)
    return Table(head, rows, frozenset(range(1, 12)))


def short_modes_table(found: Changes) -> Table:
    """The same for a screen of 80 columns."""
    several = len({m.configuration for m in found.modes.modes}) > 1
    rows = []
    for m in found.modes.modes:
        cells = _mode_cells(m)
        own, other = f"{m.mode_a}", f"{m.mode_b}"
        name = f"{m.configuration + ' ' if several else ''}{own if own == other else f'{own} → {other}'}"
        short = (name, plain(m.frequency_a, 6), cells[4], cells[7], cells[9], cells[12])
        rows.append(Row(short, alert=bool(m.changed)))
    head = ("mode", "frequency in A, Hz", "change, %", "change of damping, %", "MAC", "changed")
    return Table(head, tuple(rows), frozenset({1, 2, 3, 4}))


def _mode_cells(m: ModeChange) -> tuple[str, ...]:
    frequency, damping = m.frequency_change, m.damping_change
    return (
        m.configuration,
        str(m.mode_a),
        str(m.mode_b),
        format_value(m.frequency_a, m.frequency_a_std),
        _percent(frequency),
        _p(m.frequency_p),
        format_value(100 * m.damping_a, 100 * m.damping_a_std),
        _percent(damping),
        _p(m.damping_p),
        _mac(m.mac),
        _mac(m.mac_usual),
        _p(m.mac_p),
        ", ".join(m.changed) or "–",
    )


def _percent(change: tuple[float, float]) -> str:
    return format_value(100 * change[0], 100 * change[1]) if math.isfinite(change[0]) else "–"


def _p(value: float) -> str:
    return "–" if math.isnan(value) else "<1e-6" if value < 1e-6 else f"{value:.2g}"


def _mac(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}" if value < 0.999 else f"{value:.5f}"


def mac_table(matrix: MacMatrix) -> Table:
    """Frequencies of A down, those of the other across; a dash at a model mode that no sensor sees."""
    rows = (
        Row((plain(hz, 5), *("–" if math.isnan(v) else f"{v:.2f}" for v in row)))
        for hz, row in zip(matrix.rows_hz, matrix.values, strict=True)
    )
    head = ("Hz", *(plain(hz, 5) for hz in matrix.columns_hz))
    return Table(head, tuple(rows), frozenset(range(len(head))))
