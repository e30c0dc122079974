"""Rows of the tables on force levels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ema_pipeline.levels.sentences import move_text
from ema_pipeline.levels.types import LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import format_percent, format_value, plain
from ema_pipeline.report.tables import Row, Table


def has_to_say(study: LevelStudy | None) -> bool:
    """True where several levels were struck, or one level shows a dependence in its decays."""
    return study is not None and (len(study.levels) > 1 or study.level_dependent)


def frequency_table(study: LevelStudy, modal: ModalModel) -> Table:
    """Natural frequency of every mode at every level, with the test's p value and what moves."""
    rows = tuple(
        Row(
            (
                str(m.mode + 1),
                *(_frequency(m, k) for k in range(len(study.levels))),
                _p(m.frequency_p),
                move_text(study, m) or _remark(modal, m),
            ),
            m.depends,
        )
        for m in study.modes
    )
    heads = tuple(f"f at {level.label}, Hz" for level in study.levels)
    return Table(("mode", *heads, "p", "moves"), rows, frozenset(range(len(heads) + 2)))


def damping_table(study: LevelStudy) -> Table:
    """Damping ratio of every mode at every level, with the test's p value."""
    rows = tuple(
        Row(
            (str(m.mode + 1), *(_damping(m, k) for k in range(len(study.levels))), _p(m.damping_p)),
            m.depends and "damping" in m.trend,
        )
        for m in study.modes
    )
    heads = tuple(f"ζ at {level.label}, %" for level in study.levels)
    return Table(("mode", *heads, "p"), rows, frozenset(range(len(heads) + 2)))


def size_table(study: LevelStudy) -> Table | None:
    """Size of every mode in the FRFs of each level over that in all hits, with p value; None where unknown."""
    known = [m for m in study.modes if m.size is not None]
    if not known:
        return None
    rows = tuple(
        Row(
            (str(m.mode + 1), *(_size(m, k) for k in range(len(study.levels))), _p(m.size_p)),
            m.depends and "size" in m.trend,
        )
        for m in known
    )
    heads = tuple(f"size at {level.label}" for level in study.levels)
    return Table(("mode", *heads, "p"), rows, frozenset(range(len(heads) + 2)))


def evidence_table(study: LevelStudy) -> Table:
    """Other signs that were seen: FRFs that differ between levels, coherence dips, distorted circles."""
    rows = tuple(
        Row((v.check, v.channel, plain(v.value, 3), plain(v.limit, 3), v.message), True)
        for v in study.verdicts
        if not v.passes
    )
    return Table(("sign", "where", "value", "limit", "in words"), rows, frozenset({2, 3}))


def summary_of(study: LevelStudy) -> dict[str, Any]:
    """The study for ``summary.json``."""
    return {
        "forces_n": [level.force_n for level in study.levels],
        "hits": [len(level.hits) for level in study.levels],
        "level_dependent": study.level_dependent,
        "p_value": study.p_value,
        "summary": study.summary,
        "modes": [
            {
                "mode": m.mode + 1,
                "frequency_hz": m.frequency_hz.tolist(),
                "frequency_std_hz": m.frequency_std_hz.tolist(),
                "damping_ratio": m.damping_ratio.tolist(),
                "damping_std": m.damping_std.tolist(),
                "frequency_p": m.frequency_p,
                "damping_p": m.damping_p,
                "size": None if m.size is None else m.size.tolist(),
                "size_std": None if m.size_std is None else m.size_std.tolist(),
                "size_p": m.size_p,
                "depends": m.depends,
                "trend": m.trend,
            }
            for m in study.modes
        ],
    }


def _frequency(mode: ModeLevels, k: int) -> str:
    if not math.isfinite(mode.frequency_hz[k]):
        return "–"
    return format_value(float(mode.frequency_hz[k]), float(mode.frequency_std_hz[k]))


def _damping(mode: ModeLevels, k: int) -> str:
    if not math.isfinite(mode.damping_ratio[k]):
        return "–"
    return format_percent(float(mode.damping_ratio[k]), float(mode.damping_std[k])).removesuffix(" %")


def _size(mode: ModeLevels, k: int) -> str:
    assert mode.size is not None
    assert mode.size_std is not None
    if not math.isfinite(mode.size[k]):
        return "–"
    return format_value(float(mode.size[k]), float(mode.size_std[k]))


def _p(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return "1" if value > 0.995 else f"{value:.2g}" if value >= 0.001 else f"{value:.0e}"


def _remark(modal: ModalModel, mode: ModeLevels) -> str:
    if np.isfinite(mode.frequency_p) or np.isfinite(mode.damping_p):
        return ""
    known = [f for f in modal.modes[mode.mode].flags if f.startswith("not found")]
    return known[0] if known else "not tested"
