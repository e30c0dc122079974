"""One configuration's measured modes against the model's at one point: pairing, residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, ModeDerivatives
from ema_pipeline.mechanics.terms import Matrices
from ema_pipeline.observations.close_modes import Groups, Mixed, Slopes
from ema_pipeline.observations.coinciding import directions, held_in, hidden_partners
from ema_pipeline.observations.comparison_kernel import scaled_rows, turning_rows
from ema_pipeline.observations.known_shapes import KnownShapes, ShapeEntries, in_groups
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_pairing import paired
from ema_pipeline.observations.mode_rows import (
    FREQUENCY,
    FREQUENCY_NOISE,
    SHAPE,
    SHAPE_NOISE,
    UNEVEN_DAMPING,
    Compared,
    Rows,
)
from ema_pipeline.observations.parts import DAMPING_SCATTER
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.sensing import Sensing, SensorReadings
from ema_pipeline.observations.without_partner import Alone, unseen

_NO_SLOPE = np.zeros((0, 0, 0))
_LEAST_FREQUENCY_STD = 3e-4
"""1 σ of ln f that no model predicts better: how two modes nearer than that mix is not known."""
_DAMPING_STD = 0.02
"""1 σ of ln ζ that no model is better than, where each mode has a damping ratio of its own."""
_ADDED_LOSS = 2.0
"""1 σ of ln ζ of a mode that only springs hold which effects add: what these lose is not known. A mode lifted from 0 Hz
by a spring without loss had 0.11 % where the others had 0.5 to 3 %."""
_HELD = 0.5
"""Share of a mode's strain energy in such springs from which its damping is not that of the other modes alone."""


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
        What the sensors read of the model's modes, turned and real.
    known : KnownShapes
    measured : ndarray, (k, s)
        Real shapes, less what their unknowns say they hold of others.
    mixed : Mixed
        What that is.
    groups : list of (ndarray of int, Groups)
        See `Comparison._groups`.
    """

    match: NDArray[np.int64]
    anew: bool
    to: NDArray[np.int64]
    hidden: NDArray[np.int64]
    read: NDArray[np.float64]
    known: KnownShapes
    measured: NDArray[np.float64]
    mixed: Mixed
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
    slope : Slopes, optional
        Derivatives of these.
    whole : complex ndarray, (k, s), optional
        What the sensors read as it is, where imaginary parts of some shapes are compared.
    whirling_slope, lagging_slope : complex ndarray, (w, s, n), optional
        Derivatives of that of these.
    """

    log_frequency: NDArray[np.float64]
    shapes: NDArray[np.float64]
    turned: NDArray[np.float64]
    slope: Slopes | None = None
    whole: NDArray[np.complex128] | None = None
    whirling_slope: NDArray[np.complex128] | None = None
    lagging_slope: NDArray[np.complex128] | None = None


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
        if len(pairs.known.whirling.places):
            rows += (self._complex_shapes(pairs, shapes),)
        if len(pairs.known.lagging.places):
            rows += (self._imaginary_parts(pairs, shapes),)
        left = self._alone(pairs.match)
        return Compared(
            rows=rows,
            match=pairs.match,
            log_scale=left.usual,
            penalty=left.penalty + self._unseen(solution, to, hidden),
            split=left.split,
            unexplained=left.unexplained,
            projected=self._projected(on, hidden),
        )

    def _projected(self, on: NDArray[np.int64], hidden: NDArray[np.int64]) -> int:
        """Number of values of shapes that are spent on factors, phases, and how much of hidden modes they hold."""
        if not self.data.shapes.shape[1]:
            return 0
        twice = self.data.whirling[on] | (hidden >= 0)
        return len(on) + int(np.count_nonzero(twice)) + int(np.count_nonzero(self.data.lagging[on]))

    def unpaired(self) -> float:
        """`Residuals.penalty` with new pairs; infinite where the model has no modes."""
        own = self.x[: len(self.model.unknowns)]
        solution = self.model.modes(self.data.configuration, own, derivatives=False)[1]
        if solution is None:
            return float("inf")
        match = self.matched(solution)
        _, to, hidden = self._partners(solution, match)
        return self._alone(match).penalty + self._unseen(solution, to, hidden)

    def _alone(self, match: NDArray[np.int64]) -> Alone:
        return Alone.of(self.data, np.flatnonzero(match < 0), self.scatters, self.defaults)

    def _unseen(self, solution: EigenSolution, to: NDArray[np.int64], hidden: NDArray[np.int64]) -> float:
        along = self.sensing.along
        read = along @ solution.shapes[: along.shape[1]]
        return unseen(self.data, solution.frequency_hz, np.concatenate([to, hidden[hidden >= 0]]), read)

    def _partners(
        self, solution: EigenSolution, match: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Modes with a partner, these, and `hidden_partners`."""
        on = np.flatnonzero(match >= 0)
        to, sensors = match[on], self.data.sensors_for_another[on]
        read = self.readings.turned(solution)
        hidden = hidden_partners(solution, to, sensors, read)
        return on, to, held_in(self.data.compared_shapes[on], read, to, hidden)

    def _pairs(self, solution: EigenSolution, matching: object) -> _Pairs:
        """Kept, since derivatives are mostly wanted where a trial step was found to lead."""
        if self._last is None or not self._last.are(matching):
            given = isinstance(matching, np.ndarray)
            match = np.asarray(matching) if given else self.matched(solution)
            on, to, hidden = self._partners(solution, match)
            known = KnownShapes.of(self.data, on, hidden >= 0, self.scatters[SHAPE])
            unknowns = self.sensing.mixing[known.mixes]
            measured = known.shapes.copy()
            np.subtract.at(measured, known.mixed, self.x[unknowns, None] * known.along)
            mixed = Mixed(np.stack([known.mixed, unknowns], axis=1), known.along)
            read = self.readings.turned(solution)
            groups = self._groups(solution, read, known, measured, to)
            self._last = _Pairs(match, not given, to, hidden, read, known, measured, mixed, groups)
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
        own = np.sum(matrices.damping_log[self.model.common_damping :, of] ** 2, axis=0)
        model = np.log(solution.damping_ratio[of])
        test = np.hypot(d.log_damping_std[modes], (own > 0) * _DAMPING_STD)
        lost = self._lost_in_effects(solution)[of]
        usual = np.hypot(test, self.defaults[DAMPING_SCATTER])
        slope = None
        if slopes is not None:
            slope = np.zeros((len(modes), len(self.x)))
            modal = matrices.damping_ratio[of, None] * self.model.damping_power(self.x)
            by_model = slopes.damping_ratio[damped] + modal * slopes.log_frequency[damped]
            by_model /= solution.damping_ratio[of, None]
            slope[:, : by_model.shape[1]] = by_model
        return Rows(
            d.log_damping[modes] - model, np.hypot(test, lost),
            np.sqrt(np.maximum(1 - own, 0.0)), DAMPING_SCATTER, 1.0, modes, slope=slope, model=model,
            wider=float(np.sum(np.log(np.hypot(usual, lost) / usual))),
        )  # fmt: skip

    def _lost_in_effects(self, solution: EigenSolution) -> NDArray[np.float64]:
        """1 σ of ln ζ by what springs of effects may lose, of every mode, (n,)."""
        own = self.x[: len(self.model.unknowns)]
        share = self.model.strain_in_effects(self.data.configuration, own, solution)
        return _ADDED_LOSS * np.maximum(share - _HELD, 0.0) / (1 - _HELD)

    def _groups(
        self,
        solution: EigenSolution,
        read: NDArray[np.float64],
        known: KnownShapes,
        measured: NDArray[np.float64],
        to: NDArray[np.int64],
    ) -> list[tuple[NDArray[np.int64], Groups]]:
        """Close modes that are compared as groups, those whose shapes the sensors tell apart.

        Places of the modes, (g, c), and what they are, of every size c.
        """
        damped, log_std, members_of = solution.damped, self.data.log_frequency_std, known.members
        if damped is not None and np.any(damped.turned[to]):
            members_of = in_groups(np.where(damped.turned[to], -1, self.data.group[known.on]))
        found = []
        for members in members_of:
            on = known.on[members]
            groups = Groups(
                read[:, to[members]].transpose(1, 0, 2),
                measured[members],
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
        to = pairs.to
        log = np.log(np.maximum(solution.frequency_hz[to], 1e-6))
        shapes = np.ascontiguousarray(pairs.read[:, to].T)
        found = _Predicted(log, shapes, np.zeros(shapes.shape))
        if len(pairs.known.whirling.places) or len(pairs.known.lagging.places):
            found.whole = np.ascontiguousarray(self.readings.of(solution)[:, to].T, complex)
        if slopes is not None:
            found.slope, found.whirling_slope, found.lagging_slope = self._slopes(solution, pairs, slopes)
        for members, group in pairs.groups:
            found.log_frequency[members] = group.log_frequency
            found.shapes[members], found.turned[members] = group.shapes, group.turned
            if found.slope is not None and slopes is not None:
                group.turn_slopes(found.slope, members, slopes.reduced, slopes.between, pairs.mixed)
        return found

    def _slopes(
        self, solution: EigenSolution, pairs: _Pairs, slopes: ModeDerivatives
    ) -> tuple[Slopes, NDArray[np.complex128], NDArray[np.complex128]]:
        """Derivatives of frequencies and real shapes, and of those whose imaginary parts are compared."""
        to, known = pairs.to, pairs.known
        log = np.zeros((len(to), len(self.x)))
        log[:, : slopes.log_frequency.shape[1]] = slopes.log_frequency
        read = self.readings.slopes(slopes.shapes, solution, to)
        real = self.readings.real_slopes(read, solution, to)
        whirling, lagging = (read[e.places].astype(complex) for e in (known.whirling, known.lagging))
        return Slopes(log, real, np.zeros(real.shape)), whirling, lagging

    def _shapes(self, pairs: _Pairs, shapes: _Predicted) -> Rows:
        """Shapes with the factor projected out that fits them best, and what coinciding modes add; none of whirling
        modes.
        """
        known, entries, by = pairs.known, pairs.known.real, shapes.slope
        read_slope, turned_slope = (_NO_SLOPE, _NO_SLOPE) if by is None else (by.shapes, by.turned)
        difference = np.empty(len(entries.mode))
        slope = np.empty((0 if by is None else len(difference), len(self.x)))
        scaled_rows(
            entries.places, known.seen, pairs.measured, known.weight, shapes.shapes, shapes.turned,
            read_slope, turned_slope, pairs.mixed.at, pairs.mixed.along, difference, slope,
        )  # fmt: skip
        if np.any(pairs.hidden >= 0):
            self._without_hidden(pairs, shapes, difference, slope)
        return self._rows_of_shapes(entries, difference, None if by is None else slope, SHAPE_NOISE)

    def _without_hidden(
        self,
        pairs: _Pairs,
        shapes: _Predicted,
        difference: NDArray[np.float64],
        slope: NDArray[np.float64],
    ) -> None:
        """Take off what modes without a partner explain of the differences of those that they coincide with."""
        known, places = pairs.known, pairs.known.real.places
        ends = np.cumsum(np.count_nonzero(known.seen[places], axis=1))
        hidden, weight = pairs.hidden[places], known.weight[places]
        for k, along in directions(hidden, pairs.read, shapes.shapes[places], weight):
            seen = known.seen[places[k]]
            rows = slice(int(ends[k]) - int(np.count_nonzero(seen)), int(ends[k]))
            along, weighed = along[seen], (weight[k] * along)[seen]
            difference[rows] -= along * (weighed @ difference[rows])
            if len(slope):
                slope[rows] -= along[:, None] * (weighed @ slope[rows])

    def _complex_shapes(self, pairs: _Pairs, shapes: _Predicted) -> Rows:
        """Real and imaginary parts of whirling modes' shapes, a complex factor projected out."""
        entries, by = pairs.known.whirling, shapes.whirling_slope
        return self._rows_of_shapes(entries, *self._turned_to_fit(pairs, shapes, entries.places, by), "")

    def _imaginary_parts(self, pairs: _Pairs, shapes: _Predicted) -> Rows:
        """Imaginary parts of shapes whose real parts are compared by themselves, a complex factor projected out."""
        entries, by = pairs.known.lagging, shapes.lagging_slope
        difference, slope = self._turned_to_fit(pairs, shapes, entries.places, by)
        half = len(entries.mode)
        slope = None if slope is None else slope[half:]
        return self._rows_of_shapes(entries, difference[half:], slope, SHAPE_NOISE, UNEVEN_DAMPING)

    def _turned_to_fit(
        self,
        pairs: _Pairs,
        shapes: _Predicted,
        places: NDArray[np.int64],
        by: NDArray[np.complex128] | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Differences of some shapes from what is read, times the complex factor that fits each best, and derivatives:
        all real parts, then all imaginary ones.
        """
        known = pairs.known
        difference = np.empty(2 * int(np.count_nonzero(known.seen[places])))
        slope = np.empty((0 if by is None else len(difference), len(self.x)))
        turning_rows(
            places, known.seen, known.complex_shapes, known.complex_weight, shapes.whole,
            _NO_SLOPE.astype(complex) if by is None else by, difference, slope,
        )  # fmt: skip
        return difference, None if by is None else slope

    def _rows_of_shapes(
        self,
        entries: ShapeEntries,
        difference: NDArray[np.float64],
        slope: NDArray[np.float64] | None,
        noise: str,
        scatter: str = SHAPE,
    ) -> Rows:
        return Rows(
            difference, entries.own, entries.unit, scatter, 1 + 0.1 * (self.heat - 1), entries.mode, entries.sensor,
            entries.close, slope, noise=noise, least=entries.least, blur=entries.blur,
        )  # fmt: skip
