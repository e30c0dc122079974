"""Hits at several force levels as observations: the modes of a linear rig, and how they move from hit to hit.

The measured modes of the level that is nearest to the linear structure are compared as `observations.modes` does. On
top of them every mode's frequency and damping in every single hit is compared with what the nonlinear elements of a
hypothesis make of them at the amplitudes that were measured (`observations.hit_modes`). Only differences between hits
on one point count: whatever a linear model has wrong is alike in all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect, effect_of
from ema_pipeline.inference import Apart, Posterior, Residuals, Unknowns, joined
from ema_pipeline.mechanics.laws import Nonlinear
from ema_pipeline.observations.amplitude_starts import begun, sized_anew
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.hit_data import HitData, comparable
from ema_pipeline.observations.hit_lattice import LEAST, SizeLattice, uninterpolated
from ema_pipeline.observations.hit_march import parts, rubs, steps_to_end
from ema_pipeline.observations.hit_residuals import (
    AMPLITUDE,
    DRIFT,
    LINEARISATION,
    HitResiduals,
    hit_scatters,
)
from ema_pipeline.observations.hit_rows import HitRows
from ema_pipeline.observations.mode_problem import ModeProblem
from ema_pipeline.observations.mode_rows import SHAPE, stacked
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.size_map import SizeMap

AMPLITUDE_STD = 0.02
"""1 σ of the logarithm of all amplitudes: the sensors' calibration, less what their number averages out."""
FAR_AMPLITUDE_STD, _FAR = 0.35, 0.3
"""That of the amplitude at which a law stands whose poles move by many decay rates, and the distance at which half of
its growth is reached. Teeth simulated with 1.74 µm of preload, whose modes move by 0.7, read as 2.28 µm."""
RUBBING_AMPLITUDE_STD = 0.25
"""The same in addition where friction is calculated in full: lines are weighed about as the fit of single hits weighs
them, and from one force to the next the evidence jumps."""

_MOST_STEPS = 6e6
"""Steps through all records, about as many microseconds, for which hits are marched to their end: some thirty sizes are
asked for."""

_LEAST_SHAPE = 0.25
"""Least discrepancy of shapes, in units of the default: those of a structure that is not linear agree with none better,
and a smaller one bends calibrations to them.
"""
_STEP, _MARCHED_STEP = 1e-3, 1e-2
"""Steps of the differences by sizes, in units of their prior σ."""
_BEYOND = 3.0
"""Growth of what linearisation leaves out per decay rate by which a pole moves: it is of first order in that."""


class AmplitudeObservations(Observations):
    """Modes of a rig, and of single hits at several force levels.

    Parameters
    ----------
    modes : ModeObservations
        Of the level nearest to the linear structure, of every configuration.
    hits : sequence of HitData
        Of the configurations that were struck at several levels.
    of_modes : bool
        True where the hits tell only how far the modes of their level lie from those of the linear structure.
    lattice : SizeLattice, optional
        About the fit whose structure stands for all with friction, and where hits are marched; each structure its own
        where left out.
    rubbing : dict of str to set of str
        Effects whose hits are marched as those of teeth are, and the names of their elements, by label.
    cut_off : bool
        True where friction damps: modes with many times the usual damping are known less well.
    """

    linearised = True
    slow = True

    def __init__(
        self,
        modes: ModeObservations,
        hits: Sequence[HitData],
        of_modes: bool = False,
        lattice: SizeLattice | None = None,
        rubbing: Mapping[str, frozenset[str]] | None = None,
        cut_off: bool = False,
    ) -> None:
        # what depends on the amplitude lets shapes lag as well, and hits tell of it by their sizes in quadrature
        self.modes = modes = modes.without_lag()
        self.hits, self.of_modes, self.lattice = tuple(hits), of_modes, lattice
        self.rubbing, self.cut_off = dict(rubbing or {}), cut_off
        self.level_dependent = any(
            h.level_dependent and not modes.rig.assembly(h.configuration).nonlinear for h in hits
        )
        shape = dataclasses.replace(modes.scatters[SHAPE], least=_LEAST_SHAPE)
        self.scatters = {**modes.scatters, SHAPE: shape, **hit_scatters()}

    @cached_property
    def rows(self) -> tuple[HitRows, ...]:
        """What is compared of the hits of every configuration."""
        defaults = {name: s.default for name, s in self.scatters.items()}
        return tuple(HitRows(h, defaults, self.cut_off) for h in self.hits)

    def about(self, effects: Sequence[PlacedEffect], found: Posterior) -> AmplitudeObservations:
        """See `Observations`: what friction changes, and marched hits, are found about the structure of this fit."""
        return self._about(effects, found, self.rubbing)

    def in_full(
        self, effects: Sequence[PlacedEffect], found: Posterior
    ) -> tuple[AmplitudeObservations, AmplitudeObservations] | None:
        """See `Observations`: hits are marched where there is friction, which equivalent linearisation finds too small.

        Friction ends a decay, and holds a body once it rests: no small change of a pole. Tests whose records would take
        minutes for one size are left as they are.
        """
        if any(h.pulses is None for h in self.hits) or sum(map(steps_to_end, self.hits)) > _MOST_STEPS:
            return None
        rubbing = {e.label: names for e in effects if (names := self.friction_of(e))}
        if rubbing.keys() <= self.rubbing.keys():
            return None
        of = {h.configuration: h for h in self.hits}
        modes = self.modes.with_data(
            [of[d.configuration].with_friction(d) if d.configuration in of else d for d in self.modes.data]
        )
        known = AmplitudeObservations(modes, self.hits, self.of_modes, cut_off=True)
        return known._about(effects, found, rubbing), known._about(effects, found, self.rubbing)

    def friction_of(self, effect: PlacedEffect) -> frozenset[str]:
        """See `Observations`: none where anything else that it adds depends on the amplitude."""
        if effect.effect.linear:
            return frozenset()
        rig = self.modes.rig
        added = [e for name in rig.configurations for e in effect.nonlinear_of(rig.assembly(name))]
        return frozenset(e.name for e in added) if all(rubs(e) for e in added) else frozenset()

    def _about(
        self, effects: Sequence[PlacedEffect], found: Posterior, rubbing: Mapping[str, frozenset[str]]
    ) -> AmplitudeObservations:
        plain = AmplitudeObservations(
            self.modes, self.hits, self.of_modes, rubbing=rubbing, cut_off=self.cut_off
        )
        return plain._of(self.modes, self.hits, self.of_modes, SizeLattice(plain, effects, found))

    def _of(
        self,
        modes: ModeObservations,
        hits: Sequence[HitData],
        of_modes: bool = False,
        lattice: SizeLattice | None = None,
    ) -> AmplitudeObservations:
        """Some of the data, known in the same way."""
        return AmplitudeObservations(
            modes, hits, of_modes, lattice or self.lattice, self.rubbing, self.cut_off
        )

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> AmplitudeProblem:
        """See `Observations`."""
        return AmplitudeProblem(self, effects, scales)

    def holding_out_explained(self, found: Residuals) -> AmplitudeObservations:
        """See `Observations`."""
        assert isinstance(found.matching, tuple)
        modes = self.modes.holding_out_explained(dataclasses.replace(found, matching=found.matching[0]))
        return self if modes is self.modes else self._of(modes, self.hits)

    def folds(self) -> list[tuple[AmplitudeObservations, AmplitudeObservations]]:
        """Every fourth mode held out in turn, then every force level."""
        return self._folds

    @cached_property
    def _folds(self) -> list[tuple[AmplitudeObservations, AmplitudeObservations]]:
        of_modes = [
            (
                self._of(kept, self.hits),
                self._of(out, self.hits, True),
            )
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
                    self._of(self.modes, [h for h in kept if comparable(h)]),
                    self._of(without_modes, [h for h in out if comparable(h)]),
                )
            )
        return pairs


class AmplitudeProblem(EffectProblem):
    """Hits at several levels, and the rig with a list of effects."""

    def __init__(
        self,
        observations: AmplitudeObservations,
        effects: Sequence[PlacedEffect],
        scales: Mapping[str, float],
    ) -> None:
        self.observations, self.effects, self.scales = observations, tuple(effects), scales
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

    def unpaired(self, x: NDArray[np.float64], scatters: Mapping[str, float], heat: float = 1.0) -> float:
        """See `EffectProblem`."""
        return self.modes.unpaired(x[: len(self.modes.unknowns)], scatters, heat)

    def tuned(self, x: NDArray[np.float64], name: str) -> list[float]:
        """See `EffectProblem`."""
        return self.modes.tuned(x[: len(self.modes.unknowns)], name)

    def modes_added(self, x: NDArray[np.float64], further: NDArray[np.float64]) -> int:
        """See `EffectProblem`."""
        count = len(self.modes.unknowns)
        return self.modes.modes_added(x[:count], further[:count])

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
        rubs = RUBBING_AMPLITUDE_STD if self.observations.rubbing else 0.0
        return float(np.linalg.norm([AMPLITUDE_STD, FAR_AMPLITUDE_STD * far / (far + _FAR), rubs]))

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

    @cached_property
    def marched_sizes(self) -> tuple[int, ...]:
        """Positions of the sizes of effects whose hits are marched: of teeth, all of whose sizes are lengths, and of
        what is calculated in full.
        """
        if any(h.pulses is None for h in self.observations.hits):
            return ()
        lengths = {
            e.label
            for e in self.effects
            if not e.effect.linear and all(p.unit == "m" for p in e.effect.parameters)
        }
        marched = lengths | self.observations.rubbing.keys()
        return tuple(self.unknowns.index[n] for n in self.sizes if effect_of(n) in marched)

    @cached_property
    def _friction(self) -> Mapping[str, frozenset[str]]:
        """Names of the elements of every effect that is all friction, by label."""
        found = {e.label: self.observations.friction_of(e) for e in self.effects}
        return {label: names for label, names in found.items() if names}

    @cached_property
    def lattice_groups(self) -> tuple[tuple[int, ...], ...]:
        """Positions of the sizes that span a lattice about one fit each: of every friction that is linearised, and of
        all that is marched, whose elements move each other.
        """
        linearised: dict[str, list[int]] = {}
        for i in self.nonlinear_sizes:
            name = self.unknowns.names[i]
            if self.rubs(name) and i not in self.marched_sizes:
                linearised.setdefault(effect_of(name), []).append(i)
        return tuple(filter(None, (*map(tuple, linearised.values()), self.marched_sizes)))

    def rubs(self, name: str) -> bool:
        """True for a size of an effect that is all friction."""
        return effect_of(name) in self._friction

    def in_full(self, name: str) -> bool:
        """True for a size of an effect that is calculated in full, beside teeth."""
        return effect_of(name) in self.observations.rubbing

    def is_marched(self, element: Nonlinear) -> bool:
        """True for an element whose hits are marched."""
        if not self.marched_sizes:
            return False
        return parts(element) or any(element.name in names for names in self.observations.rubbing.values())

    def on_lattice(self, element: Nonlinear) -> bool:
        """True for an element that is found on the lattice about one fit, where there is one."""
        return self.is_marched(element) or any(element.name in names for names in self._friction.values())

    def step(self, i: int, x: NDArray[np.float64]) -> float:
        """Step of the difference by the unknown at position `i`; of what is marched finer ones show its own steps.

        Of friction on a lattice it goes back, to where larger motions lead as well: into the same cell, in which force,
        rate and amplitude together change nothing.
        """
        name = self.unknowns.names[i]
        if not self.rubs(name):
            return _MARCHED_STEP if i in self.marched_sizes else _STEP
        if self.observations.lattice is None:
            return _STEP
        if self.sizes[name].logarithmic:
            return -_MARCHED_STEP
        return -_MARCHED_STEP * float(x[i]) if x[i] > LEAST else _STEP

    def begun(self, x: NDArray[np.float64], scatters: Mapping[str, float]) -> list[NDArray[np.float64]]:
        """See `EffectProblem`: nothing where the effect added last is linear."""
        return begun(self, x, scatters)

    def sized_anew(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """See `EffectProblem`."""
        return sized_anew(self, x)

    def uninterpolated(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `EffectProblem`: with the lengths of teeth on the lattice of marched hits."""
        return uninterpolated(self, x)

    def residuals(
        self,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
        by_sizes: bool = True,
    ) -> Residuals:
        """See `Problem`; without `by_sizes` derivatives by sizes that depend on the amplitude are left at zero."""
        given = matching if isinstance(matching, tuple) and len(matching) == 2 else (None, None)
        count = len(self.modes.unknowns)
        modes = self.modes.residuals(
            x[:count], scatters, heat=heat, matching=given[0], derivatives=derivatives
        )
        pairs = given[1] if isinstance(given[1], tuple) else (None,) * len(self.observations.hits)
        wide = np.pad(modes.jacobian, ((0, 0), (0, len(x) - count)))
        parts = [dataclasses.replace(modes, values=modes.values.copy(), jacobian=wide)]
        for k, (data, pair) in enumerate(zip(self.observations.hits, pairs, strict=True)):
            given_pair = pair if isinstance(pair, np.ndarray) else None
            paired = self.modes.paired(data.reference, x[:count], given_pair)
            if paired is None:
                parts.append(Residuals(np.full(1, np.inf), np.zeros((1, len(x)))))
                continue
            hits = HitResiduals(self, data, paired, x, scatters, heat)
            hits.shift_reference(parts[0], derivatives and by_sizes)
            if self.observations.of_modes:
                parts.append(Residuals(np.zeros(0), np.zeros((0, len(x))), matching=paired.match))
            else:
                parts.append(hits.residuals(self.observations.rows[k], derivatives, by_sizes))
        return dataclasses.replace(
            stacked(parts, len(x)),
            matching=(modes.matching, tuple(p.matching for p in parts[1:])),
            apart=Apart(len(modes.values), modes.projected, count, rough=bool(self._nonlinear)),
        )


def _left_name(data: HitData, sheet: int, mode: int) -> str:
    return f"linearisation of {data.configuration} mode {data.modes[mode] + 1} at point {sheet + 1}"
