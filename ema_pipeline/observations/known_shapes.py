"""Measured shapes of modes that have a partner, with their uncertainties, in the form that they are compared in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_rows import shape_unit

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

_FITTED_AS_ONE_STD = 0.3
"""1 σ, in the largest entry, of what the shape of two modes that were fitted as one has that neither of them has: every
sensor shows another mix of the two where hits differ."""
_KEPT = 64
"""Sets of modes that are kept."""


@dataclass(frozen=True)
class ShapeEntries:
    """Entries of some shapes, mode by mode and sensor by sensor, without those that were not measured.

    Attributes
    ----------
    places : ndarray of int, (k,)
        The modes, among those with a partner.
    mode, sensor : ndarray of int, (n_rows,)
        Measured mode and sensor of every entry.
    own, least, unit : ndarray, (n_rows,)
        1 σ of the test, see `Rows`, and the unit of the scatter that adds to it.
    blur : ndarray, (n_rows,), optional
        1 σ of what hidden modes add, where there are any.
    close : ndarray of bool, (n_rows,)
        True where the mode is close to another.
    """

    places: Integers
    mode: Integers
    sensor: Integers
    own: Real
    least: Real
    unit: Real
    close: NDArray[np.bool_]
    blur: Real | None = None

    def twice(self) -> ShapeEntries:
        """With every entry once for its real part, then once for its imaginary one."""
        parts = (self.mode, self.sensor, self.own, self.least, self.unit, self.close)
        return ShapeEntries(self.places, *(np.concatenate([p, p]) for p in parts))


@dataclass(frozen=True)
class KnownShapes:
    """Measured shapes of the modes that have a partner.

    Attributes
    ----------
    on : ndarray of int, (k,)
        These modes.
    seen : ndarray of bool, (k, s)
        Where they were measured.
    shapes, weight : ndarray, (k, s)
        Real shapes, and one over the variance of each entry; 0 where not measured.
    complex_shapes, complex_weight : ndarray, (k, s)
        The same of shapes with their imaginary parts.
    real, whirling, lagging : ShapeEntries
        Those that are compared as real ones, as complex ones, and by their imaginary parts beside the real ones.
    members : tuple of ndarray of int, (g, c)
        Places, among `on`, of the modes of groups, by their number c.
    mixes : ndarray of int, (q,)
        Places in `ModeData.holds` of the modes among them whose shapes may hold some of others'.
    mixed : ndarray of int, (q,)
        These modes, among `on`.
    along : ndarray, (q, s)
        Of the others, per unit of what is held.
    """

    on: Integers
    seen: NDArray[np.bool_]
    shapes: Real
    weight: Real
    complex_shapes: NDArray[np.complex128]
    complex_weight: Real
    real: ShapeEntries
    whirling: ShapeEntries
    lagging: ShapeEntries
    members: tuple[Integers, ...]
    mixes: Integers
    mixed: Integers
    along: Real

    @classmethod
    def of(cls, data: ModeData, on: Integers, blurred: NDArray[np.bool_], scatter: float) -> KnownShapes:
        """Of modes `on`, `blurred` where a hidden one may be in them, at this scatter of shapes.

        They stay the same from step to step of a fit: the last ones are kept with the data.
        """
        key, kept = (on.tobytes(), blurred.tobytes(), scatter), data.shapes_compared
        if key not in kept:
            if len(kept) >= _KEPT:
                kept.clear()
            kept[key] = cls._found(data, on, blurred, scatter)
        return kept[key]

    @classmethod
    def _found(cls, data: ModeData, on: Integers, blurred: NDArray[np.bool_], scatter: float) -> KnownShapes:
        shapes, turning = data.known_shapes[on], data.complex_shapes[on]
        own, seen, whirls = data.compared_std[on], data.seen[on] > 0, data.whirling[on]
        unit, complex_unit = shape_unit(shapes), shape_unit(turning)
        broad = data.broad_std[on, None] + np.zeros(shapes.shape)
        blur = np.where(blurred, _FITTED_AS_ONE_STD, 0.0)[:, None] + np.zeros(shapes.shape)

        def entries(places: Integers, least: Real, unit: Real, blur: Real | None = None) -> ShapeEntries:
            mode, sensor = np.nonzero(seen[places])
            at, measured = (places[mode], sensor), on[places[mode]]
            hides = None if blur is None or not np.any(blur[at]) else blur[at]
            return ShapeEntries(
                places, measured, sensor, own[at], least[at], unit[at], data.close[measured], hides
            )

        place = np.full(len(data), -1)
        place[on] = np.arange(len(on))
        mixes = np.flatnonzero(place[data.holds[:, 0]] >= 0)
        return cls(
            on=on,
            seen=seen,
            shapes=shapes,
            weight=seen / (own**2 + broad**2 + (scatter * unit) ** 2 + blur**2),
            complex_shapes=turning,
            complex_weight=seen / (own**2 + broad**2 + (scatter * complex_unit) ** 2),
            real=entries(np.flatnonzero(~whirls), broad, unit, blur),
            whirling=entries(np.flatnonzero(whirls), broad, complex_unit).twice(),
            lagging=entries(np.flatnonzero(data.lagging[on]), data.lag_std[on], data.lag_unit[on]),
            members=in_groups(data.group[on]),
            mixes=mixes,
            mixed=place[data.holds[mixes, 0]],
            along=data.known_shapes[data.holds[mixes, 1]],
        )


def in_groups(number: Integers) -> tuple[Integers, ...]:
    """Places of modes of one group, whose numbers are alike and not below 0, by their number c: (g, c) each."""
    numbers, counts = np.unique(number[number >= 0], return_counts=True)
    return tuple(
        np.array([np.flatnonzero(number == g) for g in numbers[counts == c]])
        for c in np.unique(counts[counts > 1])
    )
