"""Modes followed over the force levels, from the softest up, by shape and frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.levels.types import ModeLevels
from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.mode_acceptance import ECHO_MAC, ECHO_REACH, SAME_RESPONSE
from ema_pipeline.modal.types import ModalModel, Mode

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

SHIFT = 0.1
"""Relative difference of frequency that counts as much as a MAC of 0."""

DOUBT = 0.3
"""A mode that no model order voted for counts this much less: it is likely an echo of another."""

FEWEST_SENSORS = 3

APART = 20.0
"""Distance of a mode that stands alone, in half-power half-widths: errors of a neighbour make curves bend."""

FARTHEST = 1.0
"""Distance beyond which two modes are not the same."""

TRUSTED_VOTES = 0.3
"""Share of model orders that must show a mode which the softest hits do not show."""


def distances(a: ModalModel, b: ModalModel) -> Real:
    """How unlike the modes of two models are, (n_modes_a, n_modes_b): 0 for the same, above 1 for others."""
    dofs = tuple(d for d in a.dofs if d in b.dofs)
    if not dofs or not a.modes or not b.modes:
        return np.full((len(a.modes), len(b.modes)), np.inf)
    alike = np.nan_to_num(mac(_shapes(a, dofs), _shapes(b, dofs)))
    fa = np.array([m.frequency_hz for m in a.modes])
    fb = np.array([m.frequency_hz for m in b.modes])
    shift = np.abs(np.log(fa[:, None] / fb[None])) / SHIFT
    doubt = np.array([m.stability for m in b.modes])
    return np.asarray(1.0 - alike + shift + DOUBT * (1.0 - doubt))


def pairs(distance: Real) -> list[tuple[int, int]]:
    """One-to-one pairs with the least total distance, none beyond `FARTHEST`."""
    from scipy.optimize import linear_sum_assignment  # 14 MB that hits of one level do not need

    rows, columns = linear_sum_assignment(np.minimum(distance, FARTHEST))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if distance[r, c] < FARTHEST]


def follow(models: Sequence[ModalModel]) -> Integers:
    """Follow modes from level to level.

    Parameters
    ----------
    models : sequence of ModalModel
        Of each level, from the softest up.

    Returns
    -------
    ndarray of int, (n_tracks, n_levels)
        Index of the track's mode in each level's model, -1 where it has none. Every mode belongs to one track.
    """
    tracks: list[list[int]] = []
    for level, model in enumerate(models):
        taken: set[int] = set()
        # the nearest softer level first, so that a mode lost at one level is picked up again at the next
        for back in range(level - 1, -1, -1):
            open_ = {t[back]: t for t in tracks if t[back] >= 0 and len(t) == level}
            free = [m for m in range(len(model.modes)) if m not in taken]
            if not open_ or not free:
                continue
            ends = sorted(open_)
            for row, column in pairs(distances(models[back], model)[np.ix_(ends, free)]):
                open_[ends[row]].append(free[column])
                taken.add(free[column])
        for track in tracks:
            if len(track) == level:
                track.append(-1)
        tracks += [[-1] * level + [m] for m in range(len(model.modes)) if m not in taken]
    return np.array(tracks, dtype=np.int64).reshape(len(tracks), len(models))


def assign(modal: ModalModel, models: Sequence[ModalModel], tracks: Integers) -> Integers:
    """Track of every mode of the overall model, (n_modes,); -1 where it shows at no level.

    Parameters
    ----------
    modal : ModalModel
        Identified from all hits.
    models : sequence of ModalModel
    tracks : ndarray of int, (n_tracks, n_levels)
    """
    nearest = np.full((len(modal.modes), len(tracks)), np.inf)
    for level, model in enumerate(models):
        seen = np.flatnonzero(tracks[:, level] >= 0)
        distance = distances(modal, model)[:, tracks[seen, level]]
        nearest[:, seen] = np.minimum(nearest[:, seen], distance)
    # of two tracks as near, the one that shows at more levels
    nearest += 0.2 * (tracks < 0).mean(axis=1)
    out = np.full(len(modal.modes), -1, dtype=np.int64)
    for mode, track in pairs(nearest):
        out[mode] = track
    return out


def mode_at(models: Sequence[ModalModel], track: Integers, level: int) -> Mode | None:
    """The mode of a track at a level, None where it has none."""
    return models[level].modes[track[level]] if track[level] >= 0 else None


def _shapes(model: ModalModel, dofs: tuple[Dof, ...]) -> NDArray[np.complex128]:
    columns = [model.dofs.index(d) for d in dofs]
    return np.array([m.shape[columns] for m in model.modes])


def doubles(modal: ModalModel) -> NDArray[np.bool_]:
    """Modes that look like, and lie beside, one that is known better, (n_modes,): most likely its echo.

    Only for three or more sensors; fewer do not tell two modes apart.
    """
    out = np.zeros(len(modal.modes), dtype=bool)
    if len(modal.outputs) < FEWEST_SENSORS:
        return out
    known = np.array([m.frequency_std_hz / abs(m.pole.real) for m in modal.modes])
    sure = np.zeros(len(modal.modes), dtype=bool)
    for k in np.argsort(known):
        out[k] = echoes(modal, sure, SAME_RESPONSE)[k]
        sure[k] = not out[k]
    return out


def separated(modal: ModalModel) -> NDArray[np.bool_]:
    """Modes whose neighbours are `APART` half-power half-widths away, doubles aside, (n_modes,)."""
    poles = np.array([m.pole for m in modal.modes])
    distance = np.abs(poles[:, None] - poles[None])
    distance[:, doubles(modal)] = np.inf
    np.fill_diagonal(distance, np.inf)
    half = np.abs(poles.real)
    return np.asarray((distance > APART * np.maximum(half[:, None], half[None])).all(axis=1))


def echoes(modal: ModalModel, sure: NDArray[np.bool_], least_mac: float = ECHO_MAC) -> NDArray[np.bool_]:
    """Modes that look like, and lie beside, a sure one, (n_modes,).

    A fit mends the misfit that a mode leaves whose frequency moves with the level by further poles beside it.
    """
    poles = np.array([m.pole for m in modal.modes])
    shapes = np.array([m.shape for m in modal.modes])
    alike = np.nan_to_num(mac(shapes, shapes)) > least_mac
    near = np.abs(poles[:, None] - poles[None]) < ECHO_REACH * np.abs(poles.real)[None]
    return np.asarray(~sure & (alike & near & sure[None]).any(axis=1))


def trusted(modal: ModalModel, modes: Sequence[ModeLevels]) -> Integers:
    """Modes that the softest hits show, and others that are plain and no echo of these."""
    votes = np.array([m.stability for m in modal.modes])
    soft = np.array([m.level_modes is not None and m.level_modes[0] >= 0 for m in modes], dtype=bool)
    if not len(votes):
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(soft | ((votes >= TRUSTED_VOTES) & ~echoes(modal, soft)))


def only(modal: ModalModel, chosen: Integers) -> ModalModel:
    """The model with the chosen modes alone."""
    return replace(modal, modes=tuple(modal.modes[k] for k in chosen))
