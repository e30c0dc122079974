"""Rows of the report's and the terminal's tables: text cells, rounded to their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ema_pipeline.check_result import CheckResult
from ema_pipeline.correlate.types import Comparison, Pairing, percent_off
from ema_pipeline.fit.types import FitResult
from ema_pipeline.ingest.records import Hit
from ema_pipeline.modal.circle.compare import average_told
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.number_text import below, format_percent, format_value, plain, prefixed_as, signed
from ema_pipeline.report.diagnosis import parameter_words
from ema_pipeline.report.name_text import words
from ema_pipeline.report.thresholds import FAR_SIGMA, LOW_MAC


@dataclass(frozen=True)
class Row:
    """Text cells of a row; `alert` marks one that deserves a look (it also says why in words)."""

    cells: tuple[str, ...]
    alert: bool = False


@dataclass(frozen=True)
class Table:
    """A table of text. `numeric` are the columns to be set flush right."""

    head: tuple[str, ...]
    rows: tuple[Row, ...]
    numeric: frozenset[int] = frozenset()

    def picked(self, columns: Sequence[int]) -> Table:
        """Some of the columns."""
        return Table(
            tuple(self.head[c] for c in columns),
            tuple(Row(tuple(r.cells[c] for c in columns), r.alert) for r in self.rows),
            frozenset(k for k, c in enumerate(columns) if c in self.numeric),
        )


def modes_table(modal: ModalModel) -> Table:
    """One row per mode: frequency and damping of the pole and of all circles together, MPC, votes, remarks."""
    rows = tuple(_mode_row(i, m) for i, m in enumerate(modal.modes))
    head = (
        "mode",
        "frequency, Hz",
        "damping ratio, %",
        "circle: f, Hz",
        "circle: ζ, %",
        "MPC",
        "stable orders",
        "method",
        "remarks",
    )
    return Table(head, rows, frozenset({0, 1, 2, 3, 4, 5, 6}))


def pairs_table(pairing: Pairing, modal: ModalModel) -> Table:
    """One row per pair, with the deviation in % and in standard uncertainties of the measurement."""
    rows = []
    for p in pairing.pairs:
        std = modal.modes[p.measured].frequency_std_hz
        percent = percent_off(p.measured_frequency_hz, p.model_frequency_hz)
        remark = f"group {p.group + 1}" if p.group >= 0 else ""
        weak = p.mac < LOW_MAC
        remark = "; ".join(t for t in (remark, "low MAC" if weak else "") if t)
        rows.append(
            Row(
                (
                    str(p.measured + 1),
                    _bare(p.measured_frequency_hz, std),
                    str(p.model + 1),
                    plain(p.model_frequency_hz, 5),
                    signed(percent, 2),
                    below(p.mac, LOW_MAC) if weak else f"{p.mac:.2f}",
                    p.family,
                    remark,
                ),
                weak,
            )
        )
    head = ("mode", "measured, Hz", "model mode", "model, Hz", "difference, %", "MAC", "family", "remarks")
    return Table(head, tuple(rows), frozenset({0, 1, 2, 3, 4, 5}))


def unpaired_table(pairing: Pairing) -> Table:
    """Modes of either side that have no partner, and why."""
    sides = (("measured", pairing.unpaired_measured), ("model", pairing.unpaired_model))
    rows = tuple(
        Row((side, str(u.index + 1), plain(u.frequency_hz, 5), u.reason), side == "measured")
        for side, us in sides
        for u in us
    )
    return Table(("side", "mode", "frequency, Hz", "reason"), rows, frozenset({1, 2}))


def parameters_table(fit: FitResult, provisional: bool) -> Table:
    """One row per parameter: estimate, 68 % interval, nominal value, shift, and what the data say of it.

    See `RunResults.provisional`.
    """
    rows = []
    for p in fit.parameters.values():
        scale, unit = prefixed_as(p.value, p.std, p.unit)
        low, high = (plain(v * scale, 4) if math.isfinite(v) else "open" for v in (p.low, p.high))
        tail = f" {unit}" if unit not in ("", "1") else ""
        far = math.isfinite(p.shift_z) and abs(p.shift_z) > FAR_SIGMA
        held = "provisional" if provisional else "identified"
        status = held if p.identified else ("NOT identified" if p.free else "not narrowed")
        rows.append(
            Row(
                (
                    parameter_words(p.name),
                    format_value(p.value, p.std, p.unit),
                    f"{low} … {high}{tail}",
                    "free" if p.free else format_value(p.nominal, p.prior_std, p.unit),
                    signed(p.shift_z),
                    status,
                    p.note,
                ),
                far or (p.free and not p.identified),
            )
        )
    head = (
        "parameter",
        "fitted (±1σ)",
        "68 % interval",
        "nominal (±1σ)",
        "shift, tolerances",
        "data say",
        "remarks",
    )
    return Table(head, tuple(rows), frozenset({4}))


def sweeps_table(fit: FitResult) -> Table:
    """One row per sweep of the error function."""
    rows = tuple(
        Row(
            (
                words(s.parameter),
                s.configuration,
                str(s.mode_count),
                format_value(s.minimum, math.nan, "N/m") if s.identified else "not identified",
                plain(min(s.error), 3),
                s.note,
            ),
            not s.identified,
        )
        for s in fit.sweeps
    )
    return Table(
        ("parameter", "configuration", "modes", "minimum at", "least ε", "remarks"), rows, frozenset({2, 4})
    )


def differences_table(compared: Comparison) -> Table:
    """One row per pair: differences of frequency, damping and shape in units of their uncertainty."""
    rows = []
    for m in compared.modes:
        worst = max(
            (abs(z) for z in (m.frequency_z, m.damping_z, m.shape_z) if math.isfinite(z)), default=0.0
        )
        rows.append(
            Row(
                (
                    m.configuration,
                    str(m.measured + 1),
                    _bare(m.measured_frequency_hz, m.frequency_std_hz),
                    plain(m.model_frequency_hz, 5),
                    signed(percent_off(m.measured_frequency_hz, m.model_frequency_hz), 2),
                    signed(m.frequency_z),
                    _bare(100 * m.measured_damping_ratio, 100 * m.damping_std),
                    plain(100 * m.model_damping_ratio, 3),
                    signed(m.damping_z),
                    f"{m.mac:.2f}",
                    signed(m.shape_z),
                ),
                worst > FAR_SIGMA,
            )
        )
    head = (
        "configuration",
        "mode",
        "measured, Hz",
        "model, Hz",
        "difference, %",
        "f: z, σ",
        "measured ζ, %",
        "model ζ, %",
        "ζ: z, σ",
        "MAC",
        "shape: z, σ",
    )
    return Table(head, tuple(rows), frozenset(range(1, 11)))


def alone_table(compared: Comparison) -> Table:
    """Measured modes that the fitted model does not have, with the model's mode of the same shape."""
    rows = []
    for m in compared.alone:
        cells = (
            m.configuration,
            str(m.measured + 1),
            plain(m.measured_frequency_hz, 5),
            plain(m.model_frequency_hz, 5),
            signed(percent_off(m.measured_frequency_hz, m.model_frequency_hz)),
            f"{m.mac:.2f}" if math.isfinite(m.mac) else "–",
        )
        rows.append(Row(cells, True))
    head = ("configuration", "mode", "measured, Hz", "model mode of its shape, Hz", "difference, %", "MAC")
    return Table(head, tuple(rows), frozenset(range(1, 6)))


def worst_dofs_table(compared: Comparison, count: int = 8) -> Table:
    """The DOFs with the largest shape difference."""
    dofs = sorted((d for d in compared.dofs if math.isfinite(d.z)), key=lambda d: -d.z)[:count]
    rows = tuple(Row((d.configuration, d.dof, f"{d.z:.1f}"), d.z > FAR_SIGMA) for d in dofs)
    return Table(("configuration", "DOF", "shape difference, σ"), rows, frozenset({2}))


def worst_bands_table(compared: Comparison, count: int = 8) -> Table:
    """The FRF bands with the largest difference."""
    bands = sorted((b for b in compared.bands if math.isfinite(b.z)), key=lambda b: -b.z)[:count]
    rows = tuple(
        Row(
            (
                b.configuration,
                f"{b.output} ← {b.input}",
                f"{plain(b.low_hz)} … {plain(b.high_hz)}",
                f"{b.z:.1f}",
            ),
            b.z > FAR_SIGMA,
        )
        for b in bands
    )
    return Table(("configuration", "FRF", "band, Hz", "difference, σ"), rows, frozenset({3}))


def rejected_hits_table(hits: Sequence[Hit]) -> Table:
    """Rejected hits with their reasons, and accepted hits that lost a channel."""
    rows = []
    for h in hits:
        if not h.accepted:
            rows.append(Row((h.file, str(h.number), str(h.impact), "hit rejected", h.reason), True))
        elif h.rejected_channels:
            why = "; ".join(
                v.message or f"{v.channel}: {v.check}"
                for v in h.verdicts
                if v.consequence == "reject_channel" and not v.passes
            )
            rows.append(
                Row(
                    (
                        h.file,
                        str(h.number),
                        str(h.impact),
                        f"left out: {', '.join(sorted(h.rejected_channels))}",
                        why,
                    )
                )
            )
    return Table(("file", "hit", "impact", "consequence", "reason"), tuple(rows), frozenset({1}))


def verdicts_table(hits: Sequence[Hit]) -> Table:
    """One row per hit, one column per check: the worst value over its channels, marked where it fails."""
    checks: dict[str, CheckResult] = {}
    for h in hits:
        for v in h.verdicts:
            checks.setdefault(v.check, v)
    head = ["file", "hit", "impact", "peak"]
    for v in checks.values():
        head.append(f"{words(v.check)} (limit {with_unit(v.limit, v.unit)})")
    rows = []
    for h in hits:
        cells = [h.file, str(h.number), str(h.impact), with_unit(h.peak_force, h.force_unit)]
        for check in checks:
            mine = [v for v in h.verdicts if v.check == check]
            cells.append(_verdict_cell(mine))
        rows.append(Row(tuple(cells), not h.accepted))
    return Table(tuple(head), tuple(rows), frozenset({1, 3}))


SHOWN_CHECKS = {"double hit": "bounce", "force spectrum": "up to", "response decay": "left"}
"""Checks whose value is shown for every hit, and the heads of their columns."""


def hits_table(hits: Sequence[Hit]) -> Table:
    """One row per hit: peak force, what the checks of `SHOWN_CHECKS` measured, and PASS or FAIL."""
    rows = []
    for h in hits:
        values = []
        for check in SHOWN_CHECKS:
            mine = [v for v in h.verdicts if v.check == check]
            worst = _worst(mine) if mine else None
            values.append("–" if worst is None else with_unit(worst.value, worst.unit))
        warned = any(not v.passes for v in h.verdicts)
        result = "FAIL" if not h.accepted else "PASS" if not warned else "warn"
        peak = with_unit(h.peak_force, h.force_unit)
        name = h.file + (f" ({h.number})" if h.number > 1 else "")
        rows.append(Row((name, str(h.impact), peak, *values, result), not h.accepted))
    head = ("file", "impact", "peak", *SHOWN_CHECKS.values(), "result")
    return Table(head, tuple(rows), frozenset({2, 3, 4, 5}))


def checks_table(hits: Sequence[Hit]) -> Table:
    """One row per check: limit, worst value, how many hits fail it (FAIL where that rejects something), and clause."""
    found: dict[str, list[CheckResult]] = {}
    failing: dict[str, set[tuple[str, int]]] = {}
    for h in hits:
        for v in h.verdicts:
            found.setdefault(v.check, []).append(v)
            if not v.passes:
                failing.setdefault(v.check, set()).add((h.file, h.number))
    rows = []
    for check, verdicts in found.items():
        failed = len(failing.get(check, ()))
        rejects = any(not v.passes and v.consequence != "warn" for v in verdicts)
        result = "PASS" if not failed else f"{'FAIL' if rejects else 'warn'} {failed} of {len(hits)}"
        result += " (channels)" if failed and verdicts[0].consequence == "reject_channel" else ""
        cells = (
            words(check),
            _direction(verdicts) + with_unit(verdicts[0].limit, verdicts[0].unit),
            with_unit(_worst(verdicts).value, verdicts[0].unit),
            result,
            verdicts[0].clause or "own limit",
        )
        rows.append(Row(cells, rejects))
    return Table(("check", "limit", "worst", "result", "clause"), tuple(rows))


def _direction(verdicts: Sequence[CheckResult]) -> str:
    """Whether a limit is the least or the most, as its verdicts tell; empty where it is neither, or both."""
    at_least = {v.passes == (v.value > v.limit) for v in verdicts if v.value != v.limit}
    return "≥ " if at_least == {True} else "≤ " if at_least == {False} else ""


def failed_checks_table(verdicts: Sequence[CheckResult]) -> Table:
    """Checks over several hits or points that failed."""
    rows = tuple(
        Row(
            (
                words(v.check),
                v.channel,
                f"{with_unit(v.value, v.unit)} (limit {with_unit(v.limit, v.unit)})",
                v.clause,
                v.message,
            ),
            True,
        )
        for v in verdicts
        if not v.passes
    )
    return Table(("check", "where", "value", "clause", "finding"), rows)


def with_unit(value: float, unit: str) -> str:
    """A checked value with its unit; ratios in per cent.

    >>> with_unit(0.0251, "1"), with_unit(2291.4, "Hz")
    ('2.51 %', '2290 Hz')
    """
    if unit in ("", "1"):
        return f"{_short(100 * value)} %" if math.isfinite(value) else "–"
    return f"{_short(value)} {unit}" if math.isfinite(value) else "–"


def _short(value: float) -> str:
    """Three significant figures, without noughts that say nothing."""
    text = plain(float(f"{value:.3g}"), 3)
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


def _worst(verdicts: Sequence[CheckResult]) -> CheckResult:
    """The verdict nearest to its limit, or furthest beyond it."""
    pool = [v for v in verdicts if not v.passes] or list(verdicts)

    def beyond(v: CheckResult) -> float:
        distance = abs(v.value - v.limit) if math.isfinite(v.value) else 0.0
        return distance if not v.passes else -distance

    return max(pool, key=beyond)


def _verdict_cell(verdicts: Sequence[CheckResult]) -> str:
    if not verdicts:
        return "–"
    failed = [v for v in verdicts if not v.passes]
    worst = _worst(verdicts)
    rejects = any(v.consequence != "warn" for v in failed)
    where = f" {worst.channel}" if failed and worst.channel else ""
    more = f" +{len(failed) - 1}" if len(failed) > 1 else ""
    return f"{'FAIL' if rejects else 'warn' if failed else 'ok'} {with_unit(worst.value, worst.unit)}{where}{more}"


def _mode_row(index: int, mode: Mode) -> Row:
    circle = average_told(mode.circles)  # what the remark about circles compares with
    cells = (
        str(index + 1),
        _bare(mode.frequency_hz, mode.frequency_std_hz),
        format_percent(mode.damping_ratio, mode.damping_std).removesuffix(" %"),
        _bare(circle.frequency_hz, circle.frequency_std_hz) if circle else "–",
        _bare(100 * circle.damping_ratio, 100 * circle.damping_std) if circle else "–",
        f"{mode.mpc:.2f}",
        f"{100 * mode.stability:.0f} %",
        mode.method,
        "; ".join(mode.flags),
    )
    return Row(cells, bool(mode.flags))


def _bare(value: float, std: float) -> str:
    return format_value(value, std)
