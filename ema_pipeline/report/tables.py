"""Rows of the report's and the terminal's tables: text cells, rounded to their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.fit.types import FitResult
from ema_pipeline.ingest.records import Hit
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.report.limits import FAR_SIGMA, LOW_MAC, POOR_ERROR
from ema_pipeline.report.numbers import (
    below,
    format_percent,
    format_value,
    plain,
    prefixed,
    signed,
    words,
)
from ema_pipeline.verdict import Verdict


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


def modes_table(modal: ModalModel) -> Table:
    """One row per mode: frequency and damping of the pole and the best circle, MPC, votes, remarks."""
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
        percent = (
            100 * (p.measured_frequency_hz / p.model_frequency_hz - 1)
            if p.model_frequency_hz > 0
            else math.nan
        )
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


def parameters_table(fit: FitResult) -> Table:
    """One row per parameter: estimate, 68 % interval, nominal value, shift, and what the data say of it."""
    rows = []
    for p in fit.parameters.values():
        scale, unit = prefixed(max(abs(p.value), p.std if math.isfinite(p.std) else 0.0), p.unit)
        low, high = (plain(v * scale, 4) if math.isfinite(v) else "open" for v in (p.low, p.high))
        tail = f" {unit}" if unit not in ("", "1") else ""
        far = math.isfinite(p.shift_z) and abs(p.shift_z) > FAR_SIGMA
        held = "identified" if fit.error <= POOR_ERROR else "provisional"
        status = held if p.identified else ("NOT identified" if p.free else "not narrowed")
        rows.append(
            Row(
                (
                    words(p.name),
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
        "f: z, σ",
        "measured ζ, %",
        "model ζ, %",
        "ζ: z, σ",
        "MAC",
        "shape: z, σ",
    )
    return Table(head, tuple(rows), frozenset(range(1, 10)))


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
            rows.append(Row((h.file, str(h.number + 1), str(h.impact), "hit rejected", h.reason), True))
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
                        str(h.number + 1),
                        str(h.impact),
                        f"left out: {', '.join(sorted(h.rejected_channels))}",
                        why,
                    )
                )
            )
    return Table(("file", "hit", "impact", "consequence", "reason"), tuple(rows), frozenset({1}))


def verdicts_table(hits: Sequence[Hit]) -> Table:
    """One row per hit, one column per check: the worst value over its channels, marked where it fails."""
    checks: dict[str, Verdict] = {}
    for h in hits:
        for v in h.verdicts:
            checks.setdefault(v.check, v)
    head = ["file", "hit", "impact", "peak, N"]
    for v in checks.values():
        head.append(f"{words(v.check)} (limit {plain(v.limit, 3)}{_unit(v)})")
    rows = []
    for h in hits:
        cells = [h.file, str(h.number + 1), str(h.impact), plain(h.peak_force, 3)]
        for check in checks:
            mine = [v for v in h.verdicts if v.check == check]
            cells.append(_verdict_cell(mine))
        rows.append(Row(tuple(cells), not h.accepted))
    return Table(tuple(head), tuple(rows), frozenset({1, 3}))


_CONSEQUENCES = {
    "reject_hit": "hit left out",
    "reject_channel": "channel left out",
    "warn": "warning",
}


def checks_table(hits: Sequence[Hit]) -> Table:
    """One row per check: its limit, where the limit comes from, and how many hits fail it."""
    found: dict[str, list[Verdict]] = {}
    failing: dict[str, set[tuple[str, int]]] = {}
    for h in hits:
        for v in h.verdicts:
            found.setdefault(v.check, []).append(v)
            if not v.passes:
                failing.setdefault(v.check, set()).add((h.file, h.number))
    rows = tuple(
        Row(
            (
                words(check),
                f"{plain(verdicts[0].limit, 3)}{_unit(verdicts[0])}",
                _CONSEQUENCES[verdicts[0].consequence],
                verdicts[0].clause or "own limit",
                f"{len(failing.get(check, ()))} of {len(hits)}",
            ),
            check in failing,
        )
        for check, verdicts in found.items()
    )
    return Table(("check", "limit", "if it fails", "clause", "hits failing"), rows)


def failed_checks_table(verdicts: Sequence[Verdict]) -> Table:
    """Checks over several hits or points that failed."""
    rows = tuple(
        Row(
            (
                words(v.check),
                v.channel,
                f"{plain(v.value, 3)} (limit {plain(v.limit, 3)}{_unit(v)})",
                v.clause,
                v.message,
            ),
            True,
        )
        for v in verdicts
        if not v.passes
    )
    return Table(("check", "where", "value", "clause", "finding"), rows)


def _unit(v: Verdict) -> str:
    return "" if v.unit in ("", "1") else f" {v.unit}"


def _verdict_cell(verdicts: Sequence[Verdict]) -> str:
    if not verdicts:
        return "–"
    failed = [v for v in verdicts if not v.passes]
    pool = failed or list(verdicts)
    worst = max(pool, key=lambda v: abs(v.value) if math.isfinite(v.value) else 0.0)
    where = f" {worst.channel}" if failed and worst.channel else ""
    more = f" +{len(failed) - 1}" if len(failed) > 1 else ""
    return f"{'FAIL' if failed else 'ok'} {plain(worst.value, 3)}{where}{more}"


def _mode_row(index: int, mode: Mode) -> Row:
    best = mode.circles[0] if mode.circles else None
    cells = (
        str(index + 1),
        _bare(mode.frequency_hz, mode.frequency_std_hz),
        format_percent(mode.damping_ratio, mode.damping_std).removesuffix(" %"),
        _bare(best.natural_frequency_hz, best.natural_frequency_std_hz) if best else "–",
        _bare(100 * best.damping_ratio, 100 * best.damping_std) if best else "–",
        f"{mode.mpc:.2f}",
        f"{100 * mode.stability:.0f} %",
        mode.method,
        "; ".join(mode.flags),
    )
    return Row(cells, bool(mode.flags))


def _bare(value: float, std: float) -> str:
    return format_value(value, std)
