"""Points of single hits: a hit listed under another point than the one that was struck."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult, judged
from ema_pipeline.frf.signs import HitLines
from ema_pipeline.frf.types import FrfSet

POINT = "point"

STRANGE = 0.5
"""Squared correlation with the other hits of its point, over all sensors, below which a hit is not of that point. Blows
8° off their direction leave 0.9, resonances that move by their half-width one half."""

ALIKE = 0.75
"""The same with the FRFs of another point, from which it is of that one; one wrong hit of three there leaves 0.8."""

FEWEST_SENSORS = 2
"""One sensor sees two resonances in some ratio wherever the structure is struck."""


def check_points(
    pairs: Mapping[tuple[str, str], HitLines], frfs: FrfSet, band: tuple[int, int]
) -> list[CheckResult]:
    """Check that every hit is like the others on its point, and none like those on another.

    Parameters
    ----------
    pairs : dict of HitLines
        By (output, point that was struck), as text.
    frfs : FrfSet
        Averages of the same hits.
    band : tuple of int
        First and last line.

    Returns
    -------
    list of CheckResult
        For each point with at least two hits and two sensors, with consequence "warn": its value is the lowest
        squared correlation of a hit with the others.
    """
    verdicts = []
    for point in sorted({struck for _, struck in pairs}):
        at = sorted(output for output, struck in pairs if struck == point)
        hits = pairs[at[0], point].hits
        at = [output for output in at if sorted(pairs[output, point].hits) == sorted(hits)]
        if len(hits) > 1 and len(at) >= FEWEST_SENSORS:
            own, others = _lines(pairs, frfs, at, point, sorted(hits), band)
            verdicts.append(_judged(point, sorted(hits), own, others))
    return verdicts


def _lines(
    pairs: Mapping[tuple[str, str], HitLines],
    frfs: FrfSet,
    at: Sequence[str],
    point: str,
    hits: Sequence[str],
    band: tuple[int, int],
) -> tuple[NDArray[np.complex128], dict[str, NDArray[np.complex128]]]:
    """FRFs of single hits on a point at lines of all sensors, (n_hits, n), and averages of other points there, (n,).

    Every sensor counts by its own largest FRF, every line by the force, so that the noise is alike.
    """
    outputs, inputs = ([d.point for d in dofs] for dofs in (frfs.outputs, frfs.inputs))
    own: list[NDArray[np.complex128]] = []
    others: dict[str, list[NDArray[np.complex128]]] = {p: [] for p in inputs if p != point}
    for output in at:
        lines = pairs[output, point]
        single, force = lines.frfs(band)
        single = single[[lines.hits.index(hit) for hit in hits]]
        o, where = outputs.index(output), lines.lines[lines.inside(band)]
        level = np.max(np.abs(frfs.frf[o][:, where]), initial=0.0, where=frfs.hits[o][:, None] > 0)
        weight = np.sqrt(np.mean(force, axis=0)) / (level or 1.0)
        own.append(single * weight)
        for p, known in others.items():
            known.append(frfs.frf[o, inputs.index(p), where] * weight)
    stacked = {p: np.concatenate(known) for p, known in others.items()}
    return np.concatenate(own, axis=1), {p: y for p, y in stacked.items() if np.all(np.isfinite(y))}


def _judged(
    point: str,
    hits: Sequence[str],
    own: NDArray[np.complex128],
    others: Mapping[str, NDArray[np.complex128]],
) -> CheckResult:
    """The hit that is least like the others, and all that are like those on another point."""
    mine = [_likeness(x, np.sum(np.delete(own, k, axis=0), axis=0)) for k, x in enumerate(own)]
    found = []
    for hit, x, likeness in zip(hits, own, mine, strict=True):
        elsewhere = {p: _likeness(x, y) for p, y in others.items()}
        best = max(elsewhere, key=lambda p: elsewhere[p], default="")
        if best and likeness < STRANGE and elsewhere[best] > ALIKE:
            found.append(f"{hit} is listed under {point}, but like the hits on {best}")
    fault = "; ".join(found[:3]) + ": correct 'impact' in test.toml, or leave it out"
    return judged(POINT, min(mine), STRANGE, not found, "", "warn", fault, channel=point)


def _likeness(x: NDArray[np.complex128], y: NDArray[np.complex128]) -> float:
    """Squared correlation, 0…1."""
    size = float(np.vdot(x, x).real * np.vdot(y, y).real)
    return float(np.abs(np.vdot(x, y)) ** 2 / size) if size > 0 else 1.0
