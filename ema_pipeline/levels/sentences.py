"""What a study of force levels says, in plain words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.levels.linear import linear_words
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel

Real = NDArray[np.float64]

CLEAR = 3.0
"""A change between two levels of this many standard deviations can be read off the levels' own FRFs."""


def trend_words(
    frequency_moves: bool,
    slope: float,
    damping_moves: bool,
    damping_slope: float,
    size_moves: bool = False,
    size_slope: float = 0.0,
) -> str:
    """``"hardening"``, ``"softening"``, ``"damping falls"``, ``"size rises"`` and so on, joined; empty for none."""
    words = []
    if frequency_moves:
        words.append("hardening" if slope > 0 else "softening")
    if damping_moves:
        words.append("damping rises" if damping_slope > 0 else "damping falls")
    if size_moves:
        words.append("size rises" if size_slope > 0 else "size falls")
    return ", ".join(words)


def one_level(study: LevelStudy, modal: ModalModel) -> str:
    """What can be said from hits of one force level."""
    advice = (
        "To know more, strike every point at two or three forces, each at least twice the last, and two or more "
        "times at each."
    )
    about = f"All hits are of one force level (about {study.levels[0].label})"
    moving = [m for m in study.modes if m.depends]
    tested = [m for m in study.modes if np.isfinite(m.frequency_p)]
    if moving:
        names = ", ".join(
            f"{modal.modes[m.mode].frequency_hz:.4g} Hz ({m.trend} with amplitude)" for m in moving[:3]
        )
        more = f" and {len(moving) - 3} more" if len(moving) > 3 else ""
        return f"{about}, but modes move while they decay: {names}{more}. The structure is likely not linear. {advice}"
    if tested:
        return (
            f"{about}: their FRFs cannot tell whether anything depends on the force. The decays of {len(tested)} of "
            f"{len(study.modes)} modes show nothing that moves with the amplitude. {advice}"
        )
    return (
        f"{about}, and no decay is long and clean enough: whether frequencies and damping depend on the force cannot "
        f"be known. {advice}"
    )


def several_levels(study: LevelStudy, modal: ModalModel, settings: LevelSettings) -> str:
    """One or two plain sentences on the answer."""
    forces = forces_text(study)
    moving = [m for m in study.modes if m.depends]
    tested = [m for m in study.modes if np.isfinite(m.frequency_p) or np.isfinite(m.damping_p)]
    if not tested:
        return (
            f"Hits at {forces}, but too few to distinguish a change with the force from scatter: strike every point at "
            "least twice at each force."
        )
    if not study.level_dependent:
        return (
            f"Nothing moves with the force of the hits at {forces}: {len(tested)} modes tested, p = "
            f"{study.p_value:.2g}, false alarms {100 * settings.false_alarm:.2g} %."
        )
    words = "; ".join(f"mode {m.mode + 1}: {move_text(study, m)}" for m in moving[:3])
    more = f"; and {len(moving) - 3} more" if len(moving) > 3 else ""
    told = (
        f"{len(moving)} of {len(tested)} modes move with the force. {words}{more}."
        if moving
        else f"none of {len(tested)} modes is seen to move with the force, but the FRFs change with it."
    )
    linear = linear_words(study)
    return f"The structure is not linear: {told}" + (f" {linear}" if linear else "")


def forces_text(study: LevelStudy) -> str:
    """``"30, 100 and 300 N"``."""
    forces, unit = [f"{level.force_n:.3g}" for level in study.levels], study.levels[0].unit
    return f"{', '.join(forces[:-1])} and {forces[-1]} {unit}" if len(forces) > 1 else f"{forces[0]} {unit}"


def move_text(study: LevelStudy, mode: ModeLevels) -> str:
    """``"frequency rises with force: 101.20 ± 0.02 → 104.70 ± 0.03 Hz from 30 to 300 N"``; empty for none."""
    parts = []
    if "hardening" in mode.trend or "softening" in mode.trend:
        word = "rises" if "hardening" in mode.trend else "falls"
        ends = _ends(
            mode.frequency_hz, mode.frequency_std_hz, mode.frequency_shift_hz, mode.frequency_shift_std_hz,
            1.0 if word == "rises" else -1.0,
        )  # fmt: skip
        parts.append(f"frequency {word} with {_cause(study)}{_arrow(ends, 1)}" + (" Hz" if ends else ""))
    if "damping" in mode.trend:
        word = "rises" if "damping rises" in mode.trend else "falls"
        ends = _ends(
            mode.damping_ratio, mode.damping_std, mode.damping_shift, mode.damping_shift_std,
            1.0 if word == "rises" else -1.0,
        )  # fmt: skip
        parts.append(f"damping {word} with {_cause(study)}{_arrow(ends, 100)}" + (" %" if ends else ""))
    if "size" in mode.trend:
        word = "rises" if "size rises" in mode.trend else "falls"
        ends = _size_ends(mode)
        parts.append(f"size in the FRFs {word} with {_cause(study)}{_arrow(ends, 1)}")
    if not parts:
        return ""
    span = f" from {study.levels[0].force_n:.3g} to {study.levels[-1].label}"
    return ", ".join(parts) + (span if len(study.levels) > 1 else "")


def _cause(study: LevelStudy) -> str:
    return "force" if len(study.levels) > 1 else "amplitude"


Ends = tuple[float, float, float, float]


def _ends(values: Real, stds: Real, shift: Real | None, shift_std: Real | None, sign: float) -> Ends | None:
    """Value and standard deviation at the softest and the hardest level.

    From the FRFs of the levels where these show the change; where they do not (impact points that move a mode by
    different amounts smear it), from the differences between single hits. None where these show no such change, or one
    to a value that there is not: a mode that moves by more than its width.
    """
    if len(values) < 2 or not np.isfinite(values[0]):
        return None
    change, noise = float(values[-1] - values[0]), float(np.hypot(stds[0], stds[-1]))
    if np.isfinite(change) and sign * change > CLEAR * noise:
        return float(values[0]), float(stds[0]), float(values[-1]), float(stds[-1])
    if shift is None or shift_std is None or not sign * shift[-1] > 0 or values[0] + shift[-1] <= 0:
        return None
    hard = float(values[0] + shift[-1])
    return float(values[0]), float(stds[0]), hard, float(np.hypot(stds[0], shift_std[-1]))


def _size_ends(mode: ModeLevels) -> Ends | None:
    """Size at the softest and the hardest level that tell, over that in all hits."""
    if mode.sized_levels is None or mode.size is None or mode.size_std is None:
        return None
    a, b = mode.sized_levels
    return float(mode.size[a]), float(mode.size_std[a]), float(mode.size[b]), float(mode.size_std[b])


def _arrow(ends: Ends | None, factor: float) -> str:
    if ends is None:
        return ""
    soft, soft_std, hard, hard_std = (factor * e for e in ends)
    return f": {with_uncertainty(soft, soft_std)} → {with_uncertainty(hard, hard_std)}"


def with_uncertainty(value: float, std: float) -> str:
    """``"104.76 ± 0.02"``: as many decimals as the first digit of the standard deviation has."""
    if not (np.isfinite(std) and std > 0):
        return f"{value:.4g}"
    decimals = max(int(-np.floor(np.log10(std))), 0)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def flagged(modal: ModalModel, study: LevelStudy) -> ModalModel:
    """The modes with a remark where they move with the force, or are seen in hard hits of a nonlinear test only."""
    modes = list(modal.modes)
    for level in study.modes:
        remark = move_text(study, level) or _only_hard(study, level)
        if remark and level.mode < len(modes):
            old = modes[level.mode]
            modes[level.mode] = replace(old, flags=(*old.flags, remark))
    return replace(modal, modes=tuple(modes))


def _only_hard(study: LevelStudy, mode: ModeLevels) -> str:
    if not study.level_dependent or len(study.levels) < 2 or mode.level_modes is None:
        return ""
    seen = np.flatnonzero(mode.level_modes >= 0)
    if len(seen) and seen[0] == 0:
        return ""
    if not len(seen):
        return "not found at any force level alone: probably caused by mixing levels"
    return f"not found in hits softer than {study.levels[seen[0]].label}: weak, or caused by the nonlinearity"
