"""What a study of force levels says, in plain words."""

from __future__ import annotations

import numpy as np

from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel


def trend_words(frequency_moves: bool, slope: float, damping_moves: bool, damping_slope: float) -> str:
    """``"hardening"``, ``"softening"``, ``"damping falls"``, ``"damping rises"``, joined; empty for none."""
    words = []
    if frequency_moves:
        words.append("hardening" if slope > 0 else "softening")
    if damping_moves:
        words.append("damping rises" if damping_slope > 0 else "damping falls")
    return ", ".join(words)


def one_level(study: LevelStudy) -> str:
    """What can be said from hits that are all about as hard."""
    return (
        f"All hits are about as hard ({study.levels[0].force_n:.3g} N): whether frequencies and damping depend on "
        "the force cannot be known from their FRFs. Strike every point at two or three forces, each at least "
        "twice the last, and two or more times at each."
    )


def several_levels(study: LevelStudy, modal: ModalModel, settings: LevelSettings) -> str:
    """One or two plain sentences on the answer."""
    forces = forces_text(study)
    moving = [m for m in study.modes if m.depends]
    tested = [m for m in study.modes if np.isfinite(m.frequency_p) or np.isfinite(m.damping_p)]
    if not tested:
        return (
            f"Hits at {forces}, but too few to tell a change with the force from scatter: strike every point at "
            "least twice at each force."
        )
    if not moving:
        return (
            f"Nothing moves with the force of the hits from {forces}: {len(tested)} modes tested, p = "
            f"{study.p_value:.2g}, false alarms {100 * settings.false_alarm:.2g} %."
        )
    words = "; ".join(f"mode {m.mode + 1}: {move_text(study, m)}" for m in moving[:3])
    more = f"; and {len(moving) - 3} more" if len(moving) > 3 else ""
    return f"The structure is not linear: {len(moving)} of {len(tested)} modes move with the force. {words}{more}."


def forces_text(study: LevelStudy) -> str:
    """``"30, 100 and 300 N"``."""
    forces = [f"{level.force_n:.3g}" for level in study.levels]
    return f"{', '.join(forces[:-1])} and {forces[-1]} N" if len(forces) > 1 else f"{forces[0]} N"


def move_text(study: LevelStudy, mode: ModeLevels) -> str:
    """``"frequency rises with force: 101.2 → 104.7 Hz from 30 to 300 N"``; empty where nothing moves."""
    parts = []
    if "hardening" in mode.trend or "softening" in mode.trend:
        word = "rises" if "hardening" in mode.trend else "falls"
        parts.append(
            f"frequency {word} with force: {_ends(study, mode.frequency_hz, mode.frequency_std_hz, 1)} Hz"
        )
    if "damping" in mode.trend:
        word = "rises" if "damping rises" in mode.trend else "falls"
        parts.append(
            f"damping {word} with force: {_ends(study, mode.damping_ratio, mode.damping_std, 100)} %"
        )
    if not parts:
        return ""
    first, last = _known(mode.frequency_hz)
    return f"{', '.join(parts)} from {study.levels[first].force_n:.3g} to {study.levels[last].force_n:.3g} N"


def _ends(study: LevelStudy, values: np.ndarray, stds: np.ndarray, factor: float) -> str:
    first, last = _known(values)
    return " → ".join(
        with_uncertainty(factor * float(values[k]), factor * float(stds[k])) for k in (first, last)
    )


def _known(values: np.ndarray) -> tuple[int, int]:
    """Softest and hardest level at which a value is known."""
    known = np.flatnonzero(np.isfinite(values))
    return (int(known[0]), int(known[-1])) if len(known) else (0, len(values) - 1)


def with_uncertainty(value: float, std: float) -> str:
    """``"104.76 ± 0.02"``: as many decimals as the first digit of the standard deviation has."""
    if not (np.isfinite(std) and std > 0):
        return f"{value:.4g}"
    decimals = max(int(-np.floor(np.log10(std))), 0)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"
