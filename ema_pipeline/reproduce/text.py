"""Reproductions as plain text and as Markdown."""

from __future__ import annotations

import math
import textwrap

from ema_pipeline.reproduce.types import Entry, Reproduction, Table


def number(value: float | None, unit: str = "") -> str:
    """Four digits, frequencies to 0.1 Hz."""
    if value is None:
        return "–"
    if math.isnan(value):
        return "none"
    return f"{value:.1f}" if unit == "Hz" else f"{value:.4g}"


def difference(entry: Entry) -> str:
    """Relative difference in per cent."""
    share = entry.difference
    if share is None or math.isnan(share):
        return ""
    return f"{100 * share:+.1f} %" if abs(share) < 1 else f"×{entry.value / (entry.printed or 1.0):.3g}"


def terminal_text(reproduction: Reproduction, width: int = 110) -> str:
    """All tables as text for a terminal."""
    lines = [reproduction.title, reproduction.source, ""]
    for table in reproduction.tables:
        lines += [*_plain(table, width), ""]
    return "\n".join(lines).rstrip() + "\n"


def _plain(table: Table, width: int) -> list[str]:
    rows = [("", table.reference, "here", "unit", "difference", ""), *_cells(table)]
    sizes = [max(len(row[c]) for row in rows) for c in range(5)]
    title = f"{table.title} ({table.source})" if table.source else table.title
    lines = [title, "-" * min(len(title), width)]
    left = sum(sizes) + 2 * 5
    for row in rows:
        cells = [row[0].ljust(sizes[0])]
        cells += [row[c].rjust(sizes[c]) for c in (1, 2)]
        cells += [row[3].ljust(sizes[3]), row[4].rjust(sizes[4])]
        remark = textwrap.wrap(row[5], max(width - left, 30)) or [""]
        lines.append(("  ".join(cells) + "  " + remark[0]).rstrip())
        lines += [" " * left + part for part in remark[1:]]
    for remark_line in table.remarks:
        lines += textwrap.wrap(remark_line, width, initial_indent="* ", subsequent_indent="  ")
    return lines


def _cells(table: Table) -> list[tuple[str, ...]]:
    return [
        (
            e.item,
            number(e.printed, e.unit),
            number(e.value, e.unit),
            e.unit if e.unit != "1" else "",
            difference(e),
            e.remark,
        )
        for e in table.entries
    ]


def markdown(reproduction: Reproduction, figure_folder: str = "figures") -> str:
    """All tables and figures as Markdown."""
    lines = [f"## {reproduction.title}", "", reproduction.source, ""]
    for table in reproduction.tables:
        lines += [f"### {table.title}", ""]
        if table.source:
            lines += [f"Source: {table.source}.", ""]
        lines += [f"| | {table.reference} | here | unit | difference | why |", "|---|---:|---:|---|---:|---|"]
        lines += ["| " + " | ".join(row) + " |" for row in _cells(table)]
        lines.append("")
        for remark in table.remarks:
            lines += [f"- {remark}"]
        if table.remarks:
            lines.append("")
    for name, caption in reproduction.captions.items():
        lines += [f"![{caption}]({figure_folder}/{name}.png)", "", f"*{caption}*", ""]
    return "\n".join(lines)
