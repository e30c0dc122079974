"""Hits at several force levels as observations: the modes of a linear rig, and how they move from hit to hit.

The measured modes of the level that is nearest to the linear structure are compared as `observations.modes` does. On
top of them every mode's frequency and damping in every single hit is compared with what the nonlinear elements of a
hypothesis make of them at the amplitudes that were measured (`observations.hit_modes`). Only differences between hits
on one point count: whatever a linear model has wrong is alike in all of them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect, effect_of
from ema_pipeline.inference import Residuals, Scatter, Unknowns, joined
from ema_pipeline.mechanics.laws import Nonlinear, Spring
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.observations.hit_modes import HitData, Linear, comparable, shifted_poles
from ema_pipeline.observations.mode_residuals import FREQUENCY, FREQUENCY_NOISE, SHAPE
from ema_pipeline.observations.mode_rows import stacked
from ema_pipeline.observations.modes import ModeObservations, ModeProblem, Paired
from ema_pipeline.observations.parts import DAMPING_SCATTER, part_key
from ema_pipeline.observations.rig_model import LOG_STD, RigModel, SizeMap

DRIFT = "drift"
HIT_FREQUENCY = "hit_frequency_scatter"
HIT_DAMPING = "hit_damping_scatter"
LINEARISATION = "linearisation"
AMPLITUDE = "amplitude of all modes"
"""Unknown by whose exponential all amplitudes are multiplied."""
AMPLITUDE_STD = 0.02
"""1 σ of the logarithm of all amplitudes: the sensors' calibration, less what their number averages out."""
FAR_AMPLITUDE_STD, _FAR = 0.35, 0.3
"""That of the amplitude at which a law stands whose poles move by many decay rates, and the distance at which half of
its growth is reached. Teeth simulated with 1.74 µm of preload, whose modes move by 0.7, read as 2.28 µm."""

_LEAST_SHAPE = 0.25
"""Least discrepancy of shapes, in units of the default: those of a structure that is not linear agree with none better,
and a smaller one bends calibrations to them.
"""
_BEYOND = 3.0
"""Growth of what linearisation leaves out per decay rate by which a pole moves: it is of first order in that."""
_REMEMBERED = 16
"""Last points at which the shifts are kept: a step is tried without derivatives, then taken with them."""
_STEP = 1e-3
"""Step of the differences by sizes, in units of their prior σ."""
_DECADES = 6.0
_ALONG, _ACROSS = 19, 3
"""Sizes that are tried to begin with: their range, and their number for an effect's first size and the others."""


def hit_scatters() -> dict[str, Scatter]:
    """The hyper-parameters that single hits add to those of measured modes."""
    known = (
        Scatter(DRIFT, "ln f of all modes from hit to hit", 1e-4, 1.0, 1e-4, 20.0),
        Scatter(HIT_FREQUENCY, "ln f of one mode from hit to hit", 3e-5, 1.0, 3e-5, 5.0),
        Scatter(HIT_DAMPING, "ln ζ of one mode from hit to hit", 5e-3, 1.0, 5e-3, 15.0),
        Scatter(LINEARISATION, "equivalent linearisation", 0.15, 0.3, 0.15, 2.0),
    )
    return {s.name: s for s in known}


class AmplitudeObservations:
    """Modes of a rig, and of single hits at several force levels.

    Parameters
    ----------
    modes : ModeObservations
        Of the level nearest to the linear structure, of every configuration.
    hits : sequence of HitData
        Of the configurations that were struck at several levels.
    of_modes : bool
        True where the hits tell only how far the modes of their level lie from those of the linear structure.
    """

    linearised = True

    def __init__(self, modes: ModeObservations, hits: Sequence[HitData], of_modes: bool = False) -> None:
        self.modes, self.hits, self.of_modes = modes, tuple(hits), of_modes
        self.level_dependent = any(
            h.level_dependent and not modes.rig.assembly(h.configuration).nonlinear for h in hits
        )
        shape = dataclasses.replace(modes.scatters[SHAPE], least=_LEAST_SHAPE)
        self.scatters = {**modes.scatters, SHAPE: shape, **hit_scatters()}

    def suited(self, effects: Sequence[PlacedEffect]) -> AmplitudeObservations:
        """See `Observations`."""
        return self

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> AmplitudeProblem:
        """See `Observations`."""
        return AmplitudeProblem(self, effects, scales)

    def holding_out_explained(self, found: Residuals) -> AmplitudeObservations:
        """See `Observations`."""
        assert isinstance(found.matching, tuple)
        modes = self.modes.holding_out_explained(dataclasses.replace(found, matching=found.matching[0]))
        return self if modes is self.modes else AmplitudeObservations(modes, self.hits)

    def folds(self) -> list[tuple[AmplitudeObservations, AmplitudeObservations]]:
        """Every fourth mode held out in turn, then every force level."""
        return self._folds

    @cached_property
    def _folds(self) -> list[tuple[AmplitudeObservations, AmplitudeObservations]]:
        of_modes = [
            (AmplitudeObservations(kept, self.hits), AmplitudeObservations(out, self.hits, of_modes=True))
            for kept, out in self.modes.folds()
        ]
        return of_modes + self._levels_in_turn()

    def _levels_in_turn(self) -> list[tuple[AmplitudeObservations, AmplitudeObservations]]:
        """Every force level held out, with the nearest other level beside it that it is compared with."""
        levels = sorted({int(k) for h in self.hits for k in h.level})
        pairs = []
        for k in levels if len(levels) > 2 else []:
            beside = levels[1] if k == levels[0] else levels[0]
            kept = [h.only(h.level != k) for h in self.hits]
            out = [h.only((h.level == k) | (h.level == beside)) for h in self.hits]
            without_modes = self.modes.with_data(())
            pairs.append(
                (
                    AmplitudeObservations(self.modes, [h for h in kept if comparable(h)]),
                    AmplitudeObservations(without_modes, [h for h in out if comparable(h)]),
                )
            )
        return pairs


class AmplitudeProblem:
    """Hits at several levels, and the rig with a list of effects."""

    def __init__(
        self,
        observations: AmplitudeObservations,
        effects: Sequence[PlacedEffect],
        scales: Mapping[str, float],
    ) -> None:
        self.observations = observations
        self.modes: ModeProblem = observations.modes.problem(effects, scales)
        self._nonlinear = tuple(e.label for e in effects if not e.effect.linear)
        self._positions: dict[str, tuple[HitData, NDArray[np.int64], NDArray[np.int64]]] = {}
        self.moved: dict[tuple[object, ...], NDArray[np.complex128]] = {}

    @property
    def model(self) -> RigModel:
        """The rig with the effects."""
        return self.modes.model

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.modes.sizes

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`."""
        x = self.modes.start(sizes)
        return np.concatenate([x, np.zeros(len(self.unknowns) - len(x))])

    def escapes(
        self, x: NDArray[np.float64], scatters: Mapping[str, float], found: Residuals
    ) -> list[NDArray[np.float64]]:
        """See `EffectProblem`: none."""
        return []

    @property
    def sole_parts(self) -> Mapping[str, tuple[str, float]]:
        """See `EffectProblem`."""
        return self.modes.sole_parts

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """See `EffectProblem`."""
        return self.modes.parameter_values(x)

    @cached_property
    def unknowns(self) -> Unknowns:
        """Those of the modes, the scale of all amplitudes, every hit's drift and what linearisation leaves out."""
        hits = self.observations.hits
        drift = [f"drift of {h.configuration} {n}" for h in hits for n in h.names]
        sheets = [(h, s) for h in hits for s in np.unique(h.sheet)]
        left = [_left_name(h, s, r) for h, s in sheets for r in range(len(h.modes))]
        beyond = [1 + _BEYOND * h.reach(s) for h, s in sheets]
        return joined(
            self.modes.unknowns,
            Unknowns.plain((AMPLITUDE,), self._amplitude_std),
            Unknowns.plain(drift, 1.0, DRIFT),
            Unknowns.plain(
                left, np.concatenate([*beyond, np.zeros(0)]), LINEARISATION, lower=-1.5, upper=1.5
            ),
        )

    @property
    def _amplitude_std(self) -> float:
        moves = [h.moves for h in self.observations.hits]
        total = sum(weight for _, weight in moves)
        far = sum(apart * weight for apart, weight in moves) / total if total else 0.0
        return float(np.hypot(AMPLITUDE_STD, FAR_AMPLITUDE_STD * far / (far + _FAR)))

    def positions(self, data: HitData) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Positions of the hits' drift, (h,), and of what linearisation leaves out, (h, m)."""
        known = self._positions.get(data.configuration)
        if known is None or known[0] is not data:
            index, name = self.unknowns.index, data.configuration
            drift = np.array([index[f"drift of {name} {n}"] for n in data.names])
            modes = range(len(data.modes))
            left = np.array([[index[_left_name(data, s, r)] for r in modes] for s in data.sheet])
            known = self._positions[name] = data, drift, left
        return known[1], known[2]

    @cached_property
    def nonlinear_sizes(self) -> tuple[int, ...]:
        """Positions of the sizes of effects that depend on the amplitude."""
        names = [n for n in self.sizes if effect_of(n) in self._nonlinear]
        return tuple(self.unknowns.index[n] for n in names)

    def begun(self, x: NDArray[np.float64], scatters: Mapping[str, float]) -> NDArray[np.float64] | None:
        """`x` with the sizes of the effect added last at the best of a grid; None where it is linear.

        From far off there is often no slope that leads to the right size: teeth that never part, friction that locks,
        and a quadratic spring of no size change nothing.
        """
        last = self.model.effects[-1] if self.model.effects else None
        if last is None or last.effect.linear or not self.observations.hits:
            return None
        names = [last.parameter_name(p.name) for p in last.effect.parameters]
        at = [self.unknowns.index[n] for n in names]
        grids = [_grid(self.sizes[n], _ALONG if i == 0 else _ACROSS) for i, n in enumerate(names)]
        matching = self.residuals(x, scatters, derivatives=False).matching
        best, least = x, np.inf
        for values in itertools.product(*grids):
            trial = x.copy()
            trial[at] = values
            found = self.residuals(trial, scatters, matching=matching, derivatives=False)
            cost = found.cost + 0.5 * float(np.sum(np.square(values)))
            if cost < least:
                best, least = trial, cost
        return best

    def residuals(
        self,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        """See `Problem`."""
        given = matching if isinstance(matching, tuple) and len(matching) == 2 else (None, None)
        count = len(self.modes.unknowns)
        modes = self.modes.residuals(
            x[:count], scatters, heat=heat, matching=given[0], derivatives=derivatives
        )
        pairs = given[1] if isinstance(given[1], tuple) else (None,) * len(self.observations.hits)
        wide = np.pad(modes.jacobian, ((0, 0), (0, len(x) - count)))
        parts = [dataclasses.replace(modes, values=modes.values.copy(), jacobian=wide)]
        for data, pair in zip(self.observations.hits, pairs, strict=True):
            given_pair = pair if isinstance(pair, np.ndarray) else None
            paired = self.modes.paired(data.reference, x[:count], given_pair)
            if paired is None:
                parts.append(Residuals(np.full(1, np.inf), np.zeros((1, len(x)))))
                continue
            hits = _Hits(self, data, paired, x, scatters, heat)
            hits.shift_reference(parts[0], derivatives)
            if self.observations.of_modes:
                parts.append(Residuals(np.zeros(0), np.zeros((0, len(x))), matching=paired.match))
            else:
                parts.append(hits.residuals(derivatives))
        return dataclasses.replace(
            stacked(parts, len(x)), matching=(modes.matching, tuple(p.matching for p in parts[1:]))
        )


def _grid(size: SizeMap, points: int) -> NDArray[np.float64]:
    """Unknowns of a size to try: evenly over `_DECADES` decades of it, of both signs where it has two."""
    low, high = size.bounds
    if size.logarithmic:
        reach = 0.5 * _DECADES * np.log(10) / LOG_STD
        grid = np.linspace(-reach, reach, points) if points > 1 else np.zeros(1)
    else:
        one = np.logspace(1 - _DECADES, 1, points)
        grid = np.concatenate([one, -one])
    return np.asarray(grid[(grid >= low) & (grid <= high)])


def _left_name(data: HitData, sheet: int, mode: int) -> str:
    return f"linearisation of {data.configuration} mode {data.modes[mode] + 1} at point {sheet + 1}"


class _Hits:
    """Residuals of one configuration's hits at one point of the unknowns."""

    def __init__(
        self,
        problem: AmplitudeProblem,
        data: HitData,
        paired: Paired,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        heat: float,
    ) -> None:
        self.problem, self.data, self.paired, self.x = problem, data, paired, x
        self.scatters, self.heat = scatters, heat
        self.scale = problem.unknowns.index[AMPLITUDE]
        self.drift, self.left = problem.positions(data)

    def residuals(self, derivatives: bool) -> Residuals:
        """Frequencies, then damping ratios, each without its mean over a sheet's hits."""
        data, x = self.data, self.x
        used = data.used  # whether the model has the mode or not: to leave it out must not pay
        hit, mode = np.nonzero(used)
        predicted = self.predicted
        jacobian = np.zeros((2 * len(hit) if derivatives else 0, len(x)))
        if derivatives:
            for i, change in self.changes.items():
                jacobian[:, i] = -change[:, hit, mode].ravel()
            rows = np.arange(2 * len(hit))
            jacobian[rows[: len(hit)], self.drift[hit]] = -1.0
            jacobian[rows, np.tile(self.left[hit, mode], 2)] = -predicted[:, hit, mode].ravel()
        difference = np.stack([data.log_frequency, np.log(np.where(used, data.damping, 1.0))])
        difference = difference - predicted
        difference[0] -= x[self.drift][:, None]
        values = difference[:, hit, mode]
        own = np.stack([data.log_frequency_std, data.damping_std / np.where(used, data.damping, 1.0)])
        own = np.hypot(own, np.stack([data.linearised_std * data.usual_damping, data.linearised_std]))
        return self._whitened(values, own[:, hit, mode], jacobian, data.sheet[hit], mode)

    @cached_property
    def predicted(self) -> NDArray[np.float64]:
        """Changes of ln f and of ln ζ of every hit and mode, (2, h, m)."""
        return self._read(np.exp(self.x[self.left]) * self._moved(self.x))

    @cached_property
    def changes(self) -> dict[int, NDArray[np.float64]]:
        """Derivatives of `predicted` by sizes and by the scale of amplitudes, by their position."""
        x, moved, left = self.x, self._moved(self.x), np.exp(self.x[self.left])
        found = {}
        for i in (*self.problem.nonlinear_sizes, self.scale):
            if i == self.scale and not np.any(moved):
                continue
            ahead = x.copy()
            ahead[i] += _STEP if ahead[i] + _STEP <= self.problem.unknowns.upper[i] else -_STEP
            found[i] = self._read(left * (self._moved(ahead) - moved) / (ahead[i] - x[i]))
        return found

    def shift_reference(self, modes: Residuals, derivatives: bool) -> None:
        """Move the model's values behind the residuals of the level's modes to where its hits find them.

        Even the hits nearest to the linear structure lock friction, or part teeth.
        """
        if not np.any(self.predicted):
            return
        weight = self.data.reference_weights
        for kind, (row, mode, sigma) in enumerate(self._rows_of_reference(modes)):
            modes.values[row] -= np.sum(weight * self.predicted[kind], axis=0)[mode] / sigma
            if not derivatives:
                continue
            for i, change in self.changes.items():
                modes.jacobian[row, i] -= np.sum(weight * change[kind], axis=0)[mode] / sigma
            for h in range(len(weight)):
                share = (weight[h] * self.predicted[kind, h])[mode] / sigma
                modes.jacobian[row, self.left[h, mode]] -= share

    def _rows_of_reference(
        self, modes: Residuals
    ) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Rows of frequencies and of damping ratios of the hits' modes, their place among these, and 1 σ."""
        at, scatters = 0, self.scatters
        assert isinstance(modes.matching, tuple)
        for data, match in zip(self.problem.modes.observations.data, modes.matching, strict=True):
            on = np.flatnonzero(match >= 0)
            damped = on[np.isfinite(data.log_damping[on])]
            whole = data if data.whole is None else data.whole
            if data.configuration == self.data.configuration and len(whole) == len(self.data.reference):
                of_hits = {int(r): k for k, r in enumerate(self.data.modes)}
                mine = {r: of_hits[int(p)] for r, p in enumerate(data.places) if int(p) in of_hits}
                found = []
                for rows, start, own, scatter, heat in (
                    (on, at, scatters[FREQUENCY_NOISE] * data.log_frequency_std, FREQUENCY, self.heat),
                    (damped, at + len(on), data.log_damping_std, DAMPING_SCATTER, 1.0),
                ):
                    kept = [(start + i, mine[int(r)], int(r)) for i, r in enumerate(rows) if int(r) in mine]
                    row, mode, measured = np.array(kept, int).reshape(-1, 3).T
                    found.append((row, mode, np.hypot(own[measured], scatters[scatter]) * heat))
                return found
            at += len(on) + len(damped) + data.shape_rows(on)
        return []

    def _read(self, moved: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Changes of ln f and of ln ζ that changes of poles (h, m) make, (2, h, m)."""
        usual, omega = self.data.usual_damping, self.data.omega
        frequency = moved.imag / omega
        damping = -moved.real / omega - usual * frequency
        return np.stack([frequency, damping / usual])

    def _moved(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Change of every mode's pole in every hit, 1/s, (h, m)."""
        own = x[: self.problem.modes.offset]
        key = (self.data.configuration, own.tobytes(), float(x[self.scale]), self.paired.match.tobytes())
        known = self.problem.moved
        if key not in known:
            if len(known) >= _REMEMBERED:
                known.clear()
            known[key] = self._found_moved(x)
        return known[key]

    def _found_moved(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        data, model = self.data, self.problem.model
        own = x[: self.problem.modes.offset]
        assembly = model.assembly(data.configuration, own[model.shape_start :])
        elements = assembly.nonlinear
        total = np.zeros(data.log_frequency.shape, complex)
        match = self.paired.match[data.modes]
        on = np.flatnonzero(match >= 0)
        if not elements or not len(on):
            return total
        rows = element_rows(assembly, elements)
        solution = self.paired.solution
        stretch = rows @ solution.shapes[: rows.shape[1]]
        linear = Linear.of(data, stretch, match, solution.eigenvalues, self._displacement(x, match, on))
        return shifted_poles(data, [self._scaled(e, x) for e in elements], linear)

    def _displacement(
        self, x: NDArray[np.float64], match: NDArray[np.int64], on: NDArray[np.int64]
    ) -> NDArray[np.complex128]:
        """Amplitude of each modal coordinate just after each blow, as the sensors saw it, (h, m)."""
        data = self.data
        reading = self.problem.model.sensor_rows(data.configuration, data.dofs)
        seen = reading @ self.paired.solution.shapes[: reading.shape[1], match[on]]
        factor = np.einsum("om,mo->m", seen, data.shapes[on]) / np.maximum(np.sum(seen**2, axis=0), 1e-300)
        result = np.zeros(data.motion.shape, complex)
        result[:, on] = np.nan_to_num(data.motion[:, on]) * factor * np.exp(x[self.scale])
        return result

    def _scaled(self, element: Nonlinear, x: NDArray[np.float64]) -> Nonlinear:
        """An element that replaces a spring, with the stiffness that the spring has at these unknowns."""
        model = self.problem.model
        row = model.dependence.elements[self.data.configuration].get(part_key(element))
        if row is None or not isinstance(element, Spring):
            return element
        factor = float(np.exp(row @ x[: len(row)]))
        return dataclasses.replace(element, stiffness=element.stiffness * factor)

    def _whitened(
        self,
        values: NDArray[np.float64],
        own: NDArray[np.float64],
        jacobian: NDArray[np.float64],
        sheet: NDArray[np.int64],
        mode: NDArray[np.int64],
    ) -> Residuals:
        """Rows at unit σ, without what all hits of a sheet share: its mean has no prior."""
        count = values.shape[1]
        defaults = self.problem.observations.scatters
        added = np.repeat([self.scatters[HIT_FREQUENCY], self.scatters[HIT_DAMPING]], count) ** 2
        usual = np.repeat([defaults[HIT_FREQUENCY].default, defaults[HIT_DAMPING].default], count) ** 2
        noise = own.ravel() ** 2
        variance, default = noise + added, noise + usual
        group = sheet * (int(mode.max(initial=0)) + 1) + mode
        block = np.tile(np.unique(group, return_inverse=True)[1], 2)
        group = np.unique(np.concatenate([group, group + group.max(initial=0) + 1]), return_inverse=True)[1]
        sigma = np.sqrt(variance) * self.heat
        r = _without_mean(values.ravel() / sigma, 1 / sigma, group)
        j = jacobian
        if len(jacobian):
            j = _without_mean(jacobian / sigma[:, None], 1 / sigma, group)
        scale = 0.5 * float(np.sum(np.log(variance / default)))
        scale += 0.5 * float(
            np.sum(np.log(np.bincount(group, 1 / variance) / np.bincount(group, 1 / default)))
        )
        first = np.arange(2 * count) < count
        share = {HIT_FREQUENCY: np.where(first, added / variance, 0.0)}
        share[HIT_DAMPING] = np.where(first, 0.0, added / variance)
        groups = int(group.max(initial=-1)) + 1
        return Residuals(r, j, share, scale, matching=self.paired.match, projected=groups, block=block)


def _without_mean(
    rows: NDArray[np.float64], weight: NDArray[np.float64], group: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Whitened rows less their weighted mean in every group."""
    norm = np.bincount(group, weight**2)
    flat = rows.reshape(len(rows), -1)
    summed = scipy.sparse.csr_array((weight, (group, np.arange(len(rows)))), shape=(len(norm), len(rows)))
    total = np.asarray(summed.dot(flat))
    return np.asarray((flat - weight[:, None] * (total / norm[:, None])[group]).reshape(rows.shape))
