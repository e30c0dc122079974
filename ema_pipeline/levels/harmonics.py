"""Poles that a nonlinearity makes at multiples and sums of the frequencies of modes: no modes of the structure.

A spring that is not linear answers a mode of frequency f with forces at 2f and 3f, and two modes with forces at
their sums and differences. Each decays like the product of the motions that make it, so that an identification
takes it for a mode. It grows with the square or the cube of the force, and softer hits do not show it. Friction
answers with forces of many multiples and sums, as large as it is itself whatever the force of the hit, so that what
they move hardly moves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.levels.tracks import follow
from ema_pipeline.levels.types import ForceLevel, ModeLevels
from ema_pipeline.modal.types import ModalModel, Mode

REACH = 1.5
"""Distance from the exact multiple or sum in half-power half-widths of what is made there: the frequencies move
while they decay."""

SLOWEST = 0.33
"""Share of the decay rate of the product of the motions that make it, below which a pole is none: a product decays no
slower than what makes it."""

GROWTH = 1.5
"""Power of the force, above which a response grows like no mode: 1 for a mode, 2 and 3 for what it makes."""

FAINT = 2.0
"""Standard deviations that a size which the softest hits do not show may have there."""

SURE = 0.01
"""Largest p value of the size of what is taken for no mode: it is known that something is not linear."""

HARDLY_MOVES = 0.01
"""Largest share of the mass-normalised shapes' usual square that a pole has which friction makes: in eight simulated
tests 37 such had at most 0.003 of it, and modes at least 0.1."""

_PRODUCTS = ((2, 0), (3, 0), (1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (-1, 2))
"""Multiples of the frequencies of two modes that springs with squares and cubes make."""


def product_of(mode: Mode, parents: Sequence[Mode]) -> str:
    """Which multiple or sum of the parents' frequencies a pole lies at, ``"3 × 163.4 Hz"``; empty for none."""
    best, words = REACH, ""
    for (a, b), (first, second) in itertools.product(
        _PRODUCTS, itertools.combinations_with_replacement(parents, 2)
    ):
        if (b == 0) != (first is second):
            continue
        hz = a * first.frequency_hz + b * second.frequency_hz
        half = abs(a) * _half_width(first) + abs(b) * _half_width(second)
        distance = abs(mode.frequency_hz - hz) / half
        if hz > 0 and distance < best and _half_width(mode) > SLOWEST * half:
            best, words = distance, _text(a, first) + (_text(b, second, sign=True) if b else "") + " Hz"
    return words


def may_be_products(modes: Sequence[Mode]) -> NDArray[np.bool_]:
    """Mask of the modes that lie at a multiple or sum of others' frequencies, (m,)."""
    others = ([m for m in modes if m is not one] for one in modes)
    return np.array([bool(product_of(one, rest)) for one, rest in zip(modes, others, strict=True)], bool)


def without_products(
    levels: Sequence[ForceLevel], modes: Sequence[ModeLevels], modal: ModalModel
) -> tuple[tuple[ForceLevel, ...], tuple[str, ...]]:
    """The modes of every level less what the moving ones make.

    Parameters
    ----------
    levels : sequence of ForceLevel
        Two or more, from the softest up.
    modes : sequence of ModeLevels
        What moves, where the nonlinearity acts, and what grows like no mode.
    modal : ModalModel
        That `modes` counts.

    Returns
    -------
    levels : tuple of ForceLevel
        Without poles that grow with the force like no mode, and without those at multiples and sums of moving
        frequencies that the softest hits do not show.
    products : tuple of str
        What was left out, ``"489.9 Hz (3 × 163.4 Hz)"``.
    """
    force = np.array([level.force_n for level in levels])
    soft = {
        m.mode: int(m.level_modes[0]) for m in modes if m.level_modes is not None and m.level_modes[0] >= 0
    }
    power = {m.mode: growth(m, force) for m in modes if m.size_p < SURE}
    grown = {mode for mode, p in power.items() if p > GROWTH}
    real = [m for m in modes if m.mode in soft and m.mode not in grown]
    # where no frequency moves, what is made tells of modes that make it
    moving = [m for m in real if m.depends] or real
    parents = [modal.modes[m.mode] for m in moving]
    grown_tracks = {
        (k, int(r)): f"grows with the force to the power of {power[m.mode]:.1f}"
        for m in modes
        if m.mode in grown and m.level_modes is not None
        for k, r in enumerate(m.level_modes)
    }
    models = _models(levels)
    drop: list[set[int]] = [set() for _ in models]
    found: dict[str, Mode] = {}
    for track in follow(models):
        seen = np.flatnonzero(track >= 0).tolist()
        grows = next((grown_tracks[k, int(track[k])] for k in seen if (k, int(track[k])) in grown_tracks), "")
        if track[0] >= 0 and not grows:
            continue
        for k in seen:
            mode = models[k].modes[track[k]]
            words = product_of(mode, parents) or grows
            if words:
                drop[k].add(int(track[k]))
                found[words] = mode  # that of the hardest hits
    by_frequency = sorted(found.items(), key=lambda item: item[1].frequency_hz)
    return _without(levels, drop), tuple(
        f"{mode.frequency_hz:.4g} Hz ({words})" for words, mode in by_frequency
    )


def without_faint(
    levels: Sequence[ForceLevel], linear: int
) -> tuple[tuple[ForceLevel, ...], tuple[str, ...]]:
    """The modes of every level less what friction makes, where those of hard hits are nearest to a linear structure.

    The softest hits do not show which poles are modes, since friction may hold a body there. What friction makes moves
    as if it had hundreds of times the mass of a mode: it is no mode of the structure that was struck.

    Parameters
    ----------
    levels : sequence of ForceLevel
        Two or more, from the softest up.
    linear : int
        The level whose modes stand for the linear structure.

    Returns
    -------
    levels : tuple of ForceLevel
        Without poles of that level which the softest hits do not show and which hardly move, compared with those that
        both show. All modes where shapes are not mass-normalised.
    products : tuple of str
        What was left out, ``"50.36, 595.7 Hz (hardly moving)"``.
    """
    models = _models(levels)
    hard = models[linear]
    if not hard.scaled:
        return tuple(levels), ()
    squares = np.array([np.nanmax(np.abs(mode.shape) ** 2) for mode in hard.modes])
    tracks = [track for track in follow(models) if track[linear] >= 0]
    usual = [squares[track[linear]] for track in tracks if track[0] >= 0]
    least = HARDLY_MOVES * float(np.median(usual)) if usual else 0.0
    made = [track for track in tracks if track[0] < 0 and squares[track[linear]] < least]
    if not made:
        return tuple(levels), ()
    drop = [{int(track[k]) for track in made if track[k] >= 0} for k in range(len(models))]
    poles = ", ".join(f"{hz:.4g}" for hz in sorted(hard.modes[track[linear]].frequency_hz for track in made))
    return _without(levels, drop), (f"{poles} Hz (hardly moving)",)


def _models(levels: Sequence[ForceLevel]) -> list[ModalModel]:
    return [level.modal for level in levels if level.modal is not None]


def _without(levels: Sequence[ForceLevel], drop: Sequence[set[int]]) -> tuple[ForceLevel, ...]:
    return tuple(
        replace(level, modal=without(model, gone))
        for level, model, gone in zip(levels, _models(levels), drop, strict=True)
    )


def growth(mode: ModeLevels, force_n: NDArray[np.float64]) -> float:
    """Least power of the force with which a mode's motion grows, from the softest hits that tell to the hardest.

    Parameters
    ----------
    mode : ModeLevels
    force_n : ndarray, (n_levels,)

    Returns
    -------
    float
        1 for a mode, 2 and 3 for what springs with squares and cubes make; a size that the softest hits do not show
        counts as `FAINT` of its standard deviations. NaN where unknown.
    """
    if mode.sized_levels is None or mode.size is None or mode.size_std is None:
        return float("nan")
    a, b = mode.sized_levels
    soft = max(abs(float(mode.size[a])), FAINT * float(mode.size_std[a]))
    hard = float(mode.size[b])
    if not (hard > 0 and soft > 0):
        return float("nan")
    return 1.0 + float(np.log(hard / soft) / np.log(force_n[b] / force_n[a]))


def without(modal: ModalModel, gone: set[int]) -> ModalModel:
    """The model less some of its modes."""
    if not gone:
        return modal
    kept = [k for k in range(len(modal.modes)) if k not in gone]
    number = np.full(len(modal.modes) + 1, -1, dtype=np.int64)  # the last entry is for poles without a mode
    number[kept] = np.arange(len(kept))
    chart = replace(modal.chart, selected=number[modal.chart.selected])
    return replace(modal, modes=tuple(modal.modes[k] for k in kept), chart=chart)


def _half_width(mode: Mode) -> float:
    return abs(mode.pole.real) / (2 * np.pi)


def _text(factor: int, mode: Mode, sign: bool = False) -> str:
    size = f"{mode.frequency_hz:.4g}" if abs(factor) == 1 else f"{abs(factor)} × {mode.frequency_hz:.4g}"
    if sign:
        return f" {'+' if factor > 0 else '−'} {size}"
    return size if factor > 0 else f"−{size}"
