"""Automatic selection of modes from the poles of all orders.

Physical poles come back from order to order; poles that fit noise wander. Poles of consecutive orders are
linked into tracks by frequency, damping and similarity of shape and participation. A track is a candidate
when it goes through enough orders. The limits are deliberately generous: whether a candidate is a mode is
decided later, by whether the measured FRFs need it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.poles import PoleSet

FREQUENCY_TOLERANCE = 0.002
"""Relative change of frequency between consecutive orders of a stable pole (plus BANDWIDTH_TOLERANCE)."""

BANDWIDTH_TOLERANCE = 0.2
"""Change of frequency between orders in units of the pole's decay rate: heavily damped poles scatter more."""

DAMPING_TOLERANCE = 0.3
"""Relative change of damping between consecutive orders of a stable pole."""

SIMILARITY = 0.8
"""Least MAC (shape × participation) between consecutive orders."""

GAP = 2
"""A track may miss this many orders."""

VOTES = 0.2
"""Share of the orders in the upper half of the chart that a candidate must go through."""


@dataclass(frozen=True)
class Tracks:
    """Poles linked over orders.

    Attributes
    ----------
    member : ndarray of int, (n_poles,)
        Candidate that each pole belongs to, or -1.
    stable : ndarray of bool, (n_poles,)
        Pole found again at the next lower order.
    representative : ndarray of int, (n_candidates,)
        Index of the pole that stands for each candidate.
    votes : ndarray, (n_candidates,)
        Share of orders, 0…1, counted over the upper half of the chart.
    """

    member: NDArray[np.int64]
    stable: NDArray[np.bool_]
    representative: NDArray[np.int64]
    votes: NDArray[np.float64]


def link(poles: PoleSet) -> Tracks:
    """Link the poles of all orders into tracks and keep those with enough votes.

    Parameters
    ----------
    poles : PoleSet

    Returns
    -------
    Tracks
        Candidates in order of frequency.
    """
    n = len(poles.pole)
    track = np.full(n, -1)
    stable = np.zeros(n, dtype=bool)
    shapes, parts = _unit(poles.shape), _unit(poles.participation)
    position = {order: k for k, order in enumerate(poles.orders)}
    level = np.array([position[int(o)] for o in poles.order], dtype=np.int64)
    tails = np.zeros(0, dtype=np.int64)  # last pole of every open track
    names = np.zeros(0, dtype=np.int64)
    n_tracks = 0
    for k in range(len(poles.orders)):
        here = np.flatnonzero(level == k)
        open_ = level[tails] >= k - 1 - GAP
        tails, names = tails[open_], names[open_]
        if len(here) and len(tails):
            distance = _distance(poles.pole, shapes, parts, tails, here)
            # the nearest first; every track and every pole is used once
            for flat in np.argsort(distance, axis=None):
                a, b = divmod(int(flat), len(here))
                if distance[a, b] > 1.0:
                    break
                if track[here[b]] < 0 and names[a] >= 0 and level[tails[a]] < k:
                    track[here[b]] = names[a]
                    stable[here[b]] = level[tails[a]] == k - 1
                    tails[a] = here[b]
        fresh = here[track[here] < 0]
        track[fresh] = np.arange(n_tracks, n_tracks + len(fresh))
        n_tracks += len(fresh)
        tails = np.concatenate([tails, fresh])
        names = np.concatenate([names, track[fresh]])
    return _candidates(poles, track, stable, level, n_tracks)


def votes(poles: PoleSet, modes: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Share of the orders in the upper half of the chart that show each mode, and what each pole voted for.

    Parameters
    ----------
    poles : PoleSet
    modes : complex ndarray, (n_modes,)
        Poles of the modes, rad/s.

    Returns
    -------
    share : ndarray, (n_modes,)
    choice : ndarray of int, (n_poles,)
        Nearest mode within the tolerances, or -1. Modes that coincide share their votes.
    """
    if not len(modes) or not len(poles.pole):
        return np.zeros(len(modes)), np.full(len(poles.pole), -1, dtype=np.int64)
    shift = np.abs(poles.pole.imag[:, None] - modes.imag[None])
    loss = np.abs(poles.pole.real[:, None] - modes.real[None])
    decay = -modes.real
    limit = FREQUENCY_TOLERANCE * np.abs(modes) + BANDWIDTH_TOLERANCE * decay
    score = np.maximum(shift / limit, loss / (2 * DAMPING_TOLERANCE * decay))
    nearest = np.argmin(score, axis=1)
    choice = np.where(score[np.arange(len(nearest)), nearest] < 1, nearest, -1)
    upper = poles.orders[len(poles.orders) // 2 :]
    share = np.zeros(len(modes))
    for r in range(len(modes)):
        twins = np.flatnonzero(np.abs(modes - modes[r]) < 0.1 * decay[r])
        mine = np.isin(choice, twins) & np.isin(poles.order, upper)
        share[r] = min(1.0, np.count_nonzero(mine) / (len(twins) * max(len(upper), 1)))
    return share, choice


def _unit(vectors: NDArray[np.complex128]) -> NDArray[np.complex128]:
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(norm > 0, norm, 1.0))


def _distance(
    pole: NDArray[np.complex128],
    shapes: NDArray[np.complex128],
    parts: NDArray[np.complex128],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Distance of poles in units of the tolerances; above 1 where any tolerance is exceeded."""
    sa, sb = pole[a][:, None], pole[b][None]
    decay = np.minimum(-sa.real, -sb.real)
    shift = np.abs(sa.imag - sb.imag) / (FREQUENCY_TOLERANCE * np.abs(sa) + BANDWIDTH_TOLERANCE * decay)
    loss = np.abs(sa.real - sb.real) / (DAMPING_TOLERANCE * decay + 1e-4 * np.abs(sa))
    mac = np.abs(shapes[a].conj() @ shapes[b].T) ** 2 * np.abs(parts[a].conj() @ parts[b].T) ** 2
    unlike = (1.0 - mac) / (1.0 - SIMILARITY)
    worst = np.maximum(np.maximum(shift, loss), unlike)
    return np.asarray(np.where(worst > 1, np.inf, (shift + loss + unlike) / 3))


def _candidates(
    poles: PoleSet,
    track: NDArray[np.int64],
    stable: NDArray[np.bool_],
    level: NDArray[np.int64],
    n_tracks: int,
) -> Tracks:
    """Tracks with enough votes, each with the pole that stands for it."""
    half = len(poles.orders) // 2
    upper = level >= half
    votes_of = np.bincount(track[upper], minlength=n_tracks) / max(len(poles.orders) - half, 1)
    total_of = np.bincount(track, minlength=n_tracks)
    chosen = np.flatnonzero((votes_of >= VOTES) | (total_of >= max(3, VOTES * 2 * half)))
    representative = []
    for t in chosen:
        members = np.flatnonzero(track == t)
        last = members[-max(3, len(members) // 2) :]
        centre = np.median(poles.pole[last].real) + 1j * np.median(poles.pole[last].imag)
        representative.append(int(last[np.argmin(np.abs(poles.pole[last] - centre))]))
    rep = np.array(representative, dtype=np.int64)
    order = np.argsort(poles.pole[rep].imag) if len(rep) else np.zeros(0, dtype=np.int64)
    rep, chosen = rep[order], chosen[order]
    name = np.full(n_tracks, -1)
    name[chosen] = np.arange(len(chosen))
    member = name[track] if n_tracks else track
    return Tracks(member.astype(np.int64), stable, rep, votes_of[chosen])
