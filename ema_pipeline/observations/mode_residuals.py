"""One configuration's measured modes against the model's at one point: pairing, residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import Residuals
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, ModeDerivatives
from ema_pipeline.mechanics.terms import Matrices
from ema_pipeline.observations.close_modes import Groups, Slopes, Turned
from ema_pipeline.observations.coinciding import directions, hidden_partners
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_pairing import paired, turned
from ema_pipeline.observations.mode_rows import (
    FREQUENCY,
    FREQUENCY_NOISE,
    SHAPE,
    SHAPE_NOISE,
    Compared,
    Rows,
    shape_unit,
    whitened,
)
from ema_pipeline.observations.parts import DAMPING_SCATTER
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.sensing import Sensing, SensorReadings
from ema_pipeline.observations.without_partner import Alone, unseen

_LEAST_FREQUENCY_STD = 3e-4
"""1 σ of ln f that no model predicts better: how two modes nearer than that mix is not known."""
_FITTED_AS_ONE_STD = 0.3
"""1 σ, in the largest entry, of what the shape of two modes that were fitted as one has that neither of them has: every
sensor shows another mix of the two where hits differ."""
_DAMPING_STD = 0.02
"""1 σ of ln ζ that no model is better than, where each mode has a damping ratio of its own."""


@dataclass(frozen=True)
class _Known:
    """Measured shapes of modes that have a partner.

    Attributes
    ----------
    on : ndarray of int, (k,)
        Measured modes.
    shapes, own, unit, blur, weight : ndarray, (k, s)
        What is compared, its 1 σ in the test, the unit of the scatter that adds to it, the 1 σ of what a hidden mode
        adds, and one over the variance.
    mixed : list of (int, int, int)
        Place of a mode, another measured mode, and the unknown that says how much of that it holds.
    """

    on: NDArray[np.int64]
    shapes: NDArray[np.float64]
    own: NDArray[np.float64]
    unit: NDArray[np.float64]
    blur: NDArray[np.float64]
    weight: NDArray[np.float64]
    mixed: list[tuple[int, int, int]]


@dataclass(frozen=True)
class _Pairs:
    """Measured modes and those of the model that they are, and what is known of them without derivatives.

    Attributes
    ----------
    match : ndarray of int, (m,)
        Model mode of every measured one, -1 for none.
    anew : bool
        True where the pairs were found here, False where they were given.
    to : ndarray of int, (k,)
        Modes of the model that are partners of `known.on`.
    hidden : ndarray of int, (k,)
        See `hidden_partners`.
    read : ndarray, (s, n)
        What the sensors read of the model's modes.
    known : _Known
    groups : list of (ndarray of int, Groups)
        See `Comparison._groups`.
    """

    match: NDArray[np.int64]
    anew: bool
    to: NDArray[np.int64]
    hidden: NDArray[np.int64]
    read: NDArray[np.float64]
    known: _Known
    groups: list[tuple[NDArray[np.int64], Groups]]

    def are(self, matching: object) -> bool:
        """True where `matching` leads to the same pairs at the same point."""
        return np.array_equal(self.match, matching) if isinstance(matching, np.ndarray) else self.anew


@dataclass
class _Predicted:
    """What the model says of modes that have a partner.

    Attributes
    ----------
    log_frequency : ndarray, (k,)
        ln of Hz, without drift.
    shapes, turned : ndarray, (k, s)
        What the sensors read, and what close modes hold of each other beside it; both up to one factor per mode.
    slope : _Predicted, optional
        Derivatives by all unknowns, with n as the last axis of each.
    """

    log_frequency: NDArray[np.float64]
    shapes: NDArray[np.float64]
    turned: NDArray[np.float64]
    slope: _Predicted | None = None

    def put(self, members: NDArray[np.int64], of: Groups | Turned) -> None:
        """Some modes as they are in their groups, (g, c)."""
        self.log_frequency[members] = of.log_frequency
        self.shapes[members], self.turned[members] = of.shapes, of.turned


class Comparison:
    """Residuals of one configuration at one point.

    Parameters
    ----------
    model : RigModel
    data : ModeData
    sensing : Sensing
    x : ndarray, (n,)
        The model's unknowns, then the sensors'.
    scatters, defaults : dict of str to float
        As they are tried, and those to which the price of wider ones refers.
    heat : float
    """

    def __init__(
        self,
        model: RigModel,
        data: ModeData,
        sensing: Sensing,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        defaults: Mapping[str, float],
        heat: float = 1.0,
    ) -> None:
        self.model, self.data, self.sensing, self.x, self.heat = model, data, sensing, x, heat
        self.scatters, self.defaults = scatters, defaults
        self.readings = SensorReadings(sensing, x)
        self._last: _Pairs | None = None

    def residuals(self, matching: object, derivatives: bool) -> Residuals:
        """Residuals with the pairs of `matching`, or with new ones where it is no array."""
        found = self.compared(matching, derivatives)
        if found is None:
            return Residuals(np.full(1, np.inf), np.zeros((1, len(self.x))), matching=matching)
        return whitened(found, self.scatters, self.defaults, len(self.x))

    def compared(self, matching: object, derivatives: bool) -> Compared | None:
        """Differences with the pairs of `matching`, or with new ones; None where the model has no modes."""
        own = self.x[: len(self.model.unknowns)]
        matrices, solution = self.model.modes(self.data.configuration, own, derivatives)
        if solution is None:
            return None
        pairs = self._pairs(solution, matching)
        on, to, hidden = pairs.known.on, pairs.to, pairs.hidden
        slopes = None
        if derivatives:
            number = np.full(len(on), -1)
            for members, _ in pairs.groups:
                number[members] = members[:, :1]
            slopes = ModeDerivatives.of(matrices, solution, to, number)
        shapes = self._predicted(solution, pairs, slopes)
        rows: tuple[Rows, ...] = (
            self._frequencies(shapes, on),
            self._damping(solution, matrices, on, to, slopes),
            self._shapes(pairs, shapes),
        )
        if np.any(self.data.whirling[on]):
            rows += (self._complex_shapes(solution, on, to, slopes),)
        left = self._alone(pairs.match)
        return Compared(
            rows=rows,
            match=pairs.match,
            log_scale=left.usual,
            penalty=left.penalty + self._unseen(solution, to, hidden),
            split=left.split,
            unexplained=left.unexplained,
            projected=len(on) + int(np.sum(self.data.whirling[on] | (hidden >= 0)))
            if self.data.shapes.shape[1]
            else 0,
        )

    def unpaired(self) -> float:
        """`Residuals.penalty` with new pairs; infinite where the model has no modes."""
        own = self.x[: len(self.model.unknowns)]
        solution = self.model.modes(self.data.configuration, own, derivatives=False)[1]
        if solution is None:
            return float("inf")
        match = self.matched(solution)
        _, to, _, hidden = self._partners(solution, match)
        return self._alone(match).penalty + self._unseen(solution, to, hidden)

    def _alone(self, match: NDArray[np.int64]) -> Alone:
        return Alone.of(self.data, np.flatnonzero(match < 0), self.scatters, self.defaults)

    def _unseen(self, solution: EigenSolution, to: NDArray[np.int64], hidden: NDArray[np.int64]) -> float:
        return unseen(self.data, solution.frequency_hz, np.concatenate([to, hidden[hidden >= 0]]))

    def _partners(
        self, solution: EigenSolution, match: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
        """Modes with a partner, these, what the sensors read of all the model's, and `hidden_partners`."""
        on, read = np.flatnonzero(match >= 0), turned(self.readings.of(solution))
        sensors = np.count_nonzero(self.data.seen[on], axis=1) * self.data.may_hide_another[on]
        return on, match[on], read, hidden_partners(solution, match[on], sensors, read)

    def _pairs(self, solution: EigenSolution, matching: object) -> _Pairs:
        """Kept, since derivatives are mostly wanted where a trial step was found to lead."""
        if self._last is None or not self._last.are(matching):
            given = isinstance(matching, np.ndarray)
            match = np.asarray(matching) if given else self.matched(solution)
            on, to, read, hidden = self._partners(solution, match)
            known = self._known(on, hidden)
            groups = self._groups(solution, read, known, to)
            self._last = _Pairs(match, not given, to, hidden, read, known, groups)
        return self._last

    def matched(self, solution: EigenSolution) -> NDArray[np.int64]:
        """Index of the model mode of every measured one, -1 for none, (m,)."""
        return paired(self.data, solution.frequency_hz, self.readings.of(solution), self.heat)

    def _frequencies(self, predicted: _Predicted, on: NDArray[np.int64]) -> Rows:
        d = self.data
        slope = None if predicted.slope is None else predicted.slope.log_frequency
        if slope is not None:
            slope[:, self.sensing.drift] = 1.0
        return Rows(
            d.log_frequency[on] - predicted.log_frequency - self.x[self.sensing.drift],
            d.log_frequency_std[on],
            np.ones(len(on)),
            FREQUENCY,
            self.heat,
            on,
            slope=slope,
            noise=FREQUENCY_NOISE,
        )

    def _damping(
        self,
        solution: EigenSolution,
        matrices: Matrices,
        on: NDArray[np.int64],
        to: NDArray[np.int64],
        slopes: ModeDerivatives | None,
    ) -> Rows:
        d = self.data
        damped = np.isfinite(d.log_damping[on])
        modes, of = on[damped], to[damped]
        # of modes whose damping is an unknown of its own, that unknown scatters, and not what is left
        own = np.any(matrices.damping_log[int(self.model.has_ratio) :, of], axis=0)
        model = np.log(solution.damping_ratio[of])
        slope = None
        if slopes is not None:
            slope = np.zeros((len(modes), len(self.x)))
            by_model = slopes.damping_ratio[damped] / solution.damping_ratio[of, None]
            slope[:, : by_model.shape[1]] = by_model
        return Rows(
            d.log_damping[modes] - model, np.hypot(d.log_damping_std[modes], own * _DAMPING_STD),
            np.where(own, 0.0, 1.0), DAMPING_SCATTER, 1.0, modes, slope=slope, model=model,
        )  # fmt: skip

    def _known(self, on: NDArray[np.int64], hidden: NDArray[np.int64]) -> _Known:
        """Measured shapes of modes with a partner, less what their unknowns say they hold of others."""
        d = self.data
        y, own = d.known_shapes[on], d.compared_std[on]
        unit = shape_unit(y)
        mixed = self._mixed(on)
        for k, other, unknown in mixed:
            y[k] -= self.x[unknown] * d.known_shapes[other]
        blur = np.repeat(np.where(hidden >= 0, _FITTED_AS_ONE_STD, 0.0)[:, None], y.shape[1], axis=1)
        variance = own**2 + (self.scatters[SHAPE] * unit) ** 2 + blur**2
        return _Known(on, y, own, unit, blur, d.seen[on] / variance, mixed)

    def _groups(
        self, solution: EigenSolution, predicted: NDArray[np.float64], known: _Known, to: NDArray[np.int64]
    ) -> list[tuple[NDArray[np.int64], Groups]]:
        """Close modes that are compared as groups, those whose shapes the sensors tell apart.

        Places of the modes, (g, c), and what they are, of every size c.
        """
        number, damped = self.data.group[known.on], solution.damped
        if damped is not None:
            number = np.where(damped.turned[to], -1, number)
        numbers, counts = np.unique(number[number >= 0], return_counts=True)
        found = []
        for count in np.unique(counts[counts > 1]):
            members = np.array([np.flatnonzero(number == g) for g in numbers[counts == count]])
            on, log_std = known.on[members], self.data.log_frequency_std
            groups = Groups(
                predicted[:, to[members]].transpose(1, 0, 2),
                known.shapes[members],
                known.weight[members],
                solution.frequency_hz[to[members]],
                np.exp(self.data.log_frequency[on]),
                self.heat * np.hypot(log_std[on], _LEAST_FREQUENCY_STD),
            )
            apart = groups.told_apart
            if np.any(apart):
                found.append((members[apart], groups if np.all(apart) else groups.only(apart)))
        return found

    def _predicted(
        self, solution: EigenSolution, pairs: _Pairs, slopes: ModeDerivatives | None
    ) -> _Predicted:
        """What the model says of the frequencies and shapes of modes with a partner, close ones as groups."""
        n, to, read = len(self.x), pairs.to, pairs.read
        log = np.log(np.maximum(solution.frequency_hz[to], 1e-6))
        found = _Predicted(log, read[:, to].T, np.zeros((len(to), len(read))))
        if slopes is not None:
            log_slope = np.zeros((len(to), n))
            log_slope[:, : slopes.log_frequency.shape[1]] = slopes.log_frequency
            slope = self.readings.real_slopes(slopes.shapes, solution, to)
            found.slope = _Predicted(log_slope, slope, np.zeros(slope.shape))
        for members, group in pairs.groups:
            found.put(members, group)
            if found.slope is not None and slopes is not None:
                by = self._group_slopes(found.slope.shapes[members], slopes, pairs.known, members)
                found.slope.put(members, group.slopes(by))
        return found

    def _group_slopes(
        self,
        read: NDArray[np.float64],
        slopes: ModeDerivatives,
        known: _Known,
        members: NDArray[np.int64],
    ) -> Slopes:
        """Derivatives of what groups are made of, those of their modes' shapes `read` given."""
        g, c = members.shape
        reduced = np.zeros((g, c, c, len(self.x)))
        reduced[..., : slopes.reduced.shape[2]] = slopes.reduced[members[:, :, None], members[:, None, :]]
        measured = np.zeros(read.shape)
        place = {int(k): (i, j) for (i, j), k in np.ndenumerate(members)}
        for k, other, unknown in known.mixed:
            if k in place:
                measured[(*place[k], slice(None), unknown)] = -self.data.known_shapes[other]
        return Slopes(read, reduced, measured)

    def _shapes(self, pairs: _Pairs, shapes: _Predicted) -> Rows:
        """Shapes with the factor projected out that fits them best, and what coinciding modes add; none of whirling
        modes.
        """
        known = pairs.known
        whirling = self.data.whirling[known.on]
        places = np.flatnonzero(~whirling)
        real = places if np.any(whirling) else slice(None)  # most rigs have none, and need no copies
        on, hidden = known.on[real], pairs.hidden[real]
        place = {int(k): i for i, k in enumerate(places)}
        seen = self.data.seen[on] > 0
        y, weight, p, turned = (
            known.shapes[real],
            known.weight[real],
            shapes.shapes[real],
            shapes.turned[real],
        )
        weighted = weight * p
        squared = np.maximum(np.sum(weighted * p, axis=1), 1e-300)
        scale = np.sum(weighted * y, axis=1) / squared
        slope = None
        if shapes.slope is not None:
            dp = shapes.slope.shapes[real]
            towards = weight * (y - 2 * scale[:, None] * p) / squared[:, None]
            scaled = (towards[:, None, :] @ dp)[:, 0]
            slope = dp + shapes.slope.turned[real]
            slope *= scale[:, None, None]
            for k, other, unknown in known.mixed:
                if k in place:
                    along = self.data.known_shapes[other]
                    slope[place[k], :, unknown] += along
                    scaled[place[k], unknown] -= weighted[place[k]] @ along / squared[place[k]]
            slope += (p + turned)[:, :, None] * scaled[:, None, :]
        difference = y - scale[:, None] * (p + turned)
        for k, along in directions(hidden, pairs.read, p, weight):
            difference[k] -= along * (weight[k] @ (along * difference[k]))
            if slope is not None:
                slope[k] -= along[:, None] * ((weight[k] * along) @ slope[k])
        mode, sensor = np.nonzero(seen)
        if slope is not None:
            slope = slope.reshape(-1, slope.shape[2]) if np.all(seen) else slope[seen]
        return Rows(
            difference[seen], known.own[real][seen], known.unit[real][seen], SHAPE, 1 + 0.1 * (self.heat - 1), on[mode],
            sensor, self.data.close[on[mode]], slope, noise=SHAPE_NOISE, blur=known.blur[real][seen],
        )  # fmt: skip

    def _mixed(self, on: NDArray[np.int64]) -> list[tuple[int, int, int]]:
        """Place in `on`, other mode and unknown of every shape that may hold some of another's."""
        place = {int(r): k for k, r in enumerate(on)}
        return [
            (place[a], b, int(unknown))
            for (a, b, _), unknown in zip(self.data.mixes, self.sensing.mixing, strict=True)
            if a in place
        ]

    def _complex_shapes(
        self,
        solution: EigenSolution,
        on: NDArray[np.int64],
        to: NDArray[np.int64],
        slopes: ModeDerivatives | None,
    ) -> Rows:
        """Real and imaginary parts of whirling modes' shapes, a complex factor projected out."""
        d, whirl = self.data, np.flatnonzero(self.data.whirling[on])
        on, to = on[whirl], to[whirl]
        p, y, seen = self.readings.of(solution)[:, to].T.astype(complex), d.complex_shapes[on], d.seen[on] > 0
        own = d.compared_std[on]
        unit = shape_unit(y)
        weight = seen / (own**2 + (self.scatters[SHAPE] * unit) ** 2)
        squared = np.maximum(np.sum(weight * np.abs(p) ** 2, axis=1), 1e-300)
        factor = np.sum(weight * np.conj(p) * y, axis=1) / squared
        slope = None
        if slopes is not None:
            dp = self.readings.slopes(slopes.shapes[:, whirl], solution, to).astype(complex)
            turns = np.einsum("ks,ksn->kn", weight * y, np.conj(dp))
            grows = 2 * np.real(np.einsum("ks,ksn->kn", weight * np.conj(p), dp))
            change = (turns - factor[:, None] * grows) / squared[:, None]
            both = factor[:, None, None] * dp + p[:, :, None] * change[:, None, :]
            slope = np.concatenate([np.real(both)[seen], np.imag(both)[seen]])
        left = (y - factor[:, None] * p)[seen]
        mode, sensor = (np.concatenate([at, at]) for at in np.nonzero(seen))
        return Rows(
            np.concatenate([left.real, left.imag]), own[mode, sensor], unit[mode, sensor], SHAPE,
            1 + 0.1 * (self.heat - 1), on[mode], sensor, d.close[on[mode]], slope,
        )  # fmt: skip
