"""Which of the levels stands for the linear structure, where the answer depends on the level.

FRFs averaged over hits of several forces are then those of no structure. A spring that stiffens or softens is
nearest to a straight line in the softest hits, dry friction is least beside the forces of the hardest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.types import ForceLevel, LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel

Real = NDArray[np.float64]

_LITTLE = 0.1
"""Share of its damping that a mode loses from the softest to the hardest hits, below which the softest are as linear;
and they show fewest of the poles that a nonlinearity makes."""


def linear_level(levels: Sequence[ForceLevel], modes: Sequence[ModeLevels], frfs: FrfSet) -> int | None:
    """Index of the level that is nearest to the linear structure; None where no level saw all points.

    Parameters
    ----------
    levels : sequence of ForceLevel
        From the softest up.
    modes : sequence of ModeLevels
        With their shifts and trends.
    frfs : FrfSet
        Of all hits.
    """
    order = list(range(len(levels)))
    if _rubs(modes):
        order.reverse()
    for k in (order[0], order[-1], *order[1:-1]):
        own = levels[k].own_frfs
        if (
            own is not None
            and own.inputs == frfs.inputs
            and own.outputs == frfs.outputs
            and _has_modes(levels[k])
        ):
            return k
    return None


def structure(modal: ModalModel, study: LevelStudy | None) -> ModalModel:
    """The modes of the linear structure: those of all hits, or of the level that is nearest to it.

    Parameters
    ----------
    modal : ModalModel
        Of all hits together.
    study : LevelStudy or None
    """
    if study is None or study.linear_level is None:
        return modal
    own = study.levels[study.linear_level].modal
    return modal if own is None else own


def structure_frfs(frfs: FrfSet, study: LevelStudy | None) -> FrfSet:
    """The FRFs that `structure` was identified from."""
    if study is None or study.linear_level is None:
        return frfs
    return study.levels[study.linear_level].frfs


def linear_words(study: LevelStudy) -> str:
    """Whose modes those of the configuration are, in plain words; empty where they are of all hits."""
    if study.linear_level is None:
        return ""
    force = study.levels[study.linear_level].force_n
    which = (
        "softest"
        if study.linear_level == 0
        else "hardest"
        if force == study.levels[-1].force_n
        else "nearest"
    )
    text = (
        f"The modes given, fitted and compared are those of the {which} hits alone ({force:.3g} N), nearest to a "
        "linear structure: FRFs averaged over all forces belong to none."
    )
    if study.products:
        text += f" Not modes, but caused by the nonlinearity of modes that move: {', '.join(study.products)}."
    return text


def _rubs(modes: Sequence[ModeLevels]) -> bool:
    """True where damping falls with the force by more than frequencies move, and by more than a little: friction, not a
    spring.

    Where neither is seen to move, sizes that fall: what friction makes by locking fades, what springs make grows.
    """
    loss, most, move, fade = 0.0, 0.0, 0.0, 0.0
    for m in modes:
        if "size" in m.trend and m.size is not None and m.sized_levels is not None:
            softest, hardest = m.sized_levels
            fade += float(m.size[softest] - m.size[hardest])
        if m.level_modes is None or m.level_modes[0] < 0:
            continue  # what the softest hits do not show may be no mode
        if "damping falls" in m.trend:
            lost = -_change(m.damping_ratio, m.damping_shift)
            loss, most = loss + lost, max(most, lost / float(np.nanmax(m.damping_ratio)))
        if "hardening" in m.trend or "softening" in m.trend:
            move += abs(_change(m.frequency_hz, m.frequency_shift_hz)) / float(np.nanmax(m.frequency_hz))
    if max(loss, move) > 0:
        return loss > move and most > _LITTLE
    return fade > 0


def _change(values: Real, shift: Real | None) -> float:
    """Change from the softest to the hardest hits, as the levels' own FRFs show it, else as single hits do.

    Single hits tell changes of less than a half-width only.
    """
    own = float(values[-1] - values[0])
    if np.isfinite(own) or shift is None:
        return float(np.nan_to_num(own))
    return float(np.nan_to_num(shift[-1]))


def _has_modes(level: ForceLevel) -> bool:
    return level.modal is not None and len(level.modal.modes) > 0
