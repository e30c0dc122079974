"""Force-displacement loops of an isolator as observations.

The displacement is prescribed, so the model is the sum of the forces of all elements along the isolator's stretch.
The sensitivities of the two channels are unknowns that all loops share; the offset of each loop's force is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.errors import EmaError
from ema_pipeline.inference import Residuals, Scatter, Unknowns, descend, joined
from ema_pipeline.ingest.defaults import CALIBRATION_STD
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.assembly import Spring
from ema_pipeline.mechanics.cycles import Cycles
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.loop_data import LoopData, left_out, typical_of
from ema_pipeline.observations.loop_forces import ForceAtPoint, Isolator, IsolatorForce
from ema_pipeline.observations.parts import Dependence, dependence, part_key
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.observations.typical import SIZE_SHARE, Typical
from ema_pipeline.rigs.types import Rig

FORCE_SCATTER = "force_scatter"
"""Relative scatter of the force that no model of the library explains."""
DISCREPANCY = 5e-4
"""Default of `FORCE_SCATTER`: sensors and drives of loop tests are linear to some hundredths of a per cent."""
NOISE_SCATTER = "noise_scatter"
"""Noise of the force beyond what its cycles show, as a share of that: few cycles, chatter that differs each time."""
UNSEEN_NOISE = 0.1
"""Default of `NOISE_SCATTER`: half a per cent of the variance, about what ten cycles leave open of it."""
MOST = 1e3
"""Factor by which these scatters may exceed their defaults: the error is counted in measured noise all the same."""
FORCE, DISPLACEMENT = "calibration of force", "calibration of displacement"
CHANNELS = (FORCE, DISPLACEMENT)
"""Unknowns of the two channels: logarithms of what is read over what is."""

SETTING_STD = 0.7
"""1 σ of the logarithm of a loop's force scale where loops are of several settings: mostly within a factor of four."""
_SPREAD = 1.5
"""Unknowns of shapes from which fits are started: this much below and above their centre, and at it."""
_TRIAL_STEPS = 4
_NEAR_STEPS = 10


@dataclass(frozen=True)
class Spread:
    """Variance of the measured coefficients, N², each scatter's share in it, and its ratio to the noise's."""

    variance: NDArray[np.float64]
    share: Mapping[str, NDArray[np.float64]]
    relative: NDArray[np.float64]


class LoopObservations(Observations):
    """Measured loops of a rig's isolator.

    Parameters
    ----------
    rig : Rig
        Without effects.
    loops : sequence of Loop
    own_scales : bool
        Whether every loop has a factor of its own on the model's force: tests of one device at several settings,
        e.g. tensions.
    calibration : dict of str to float, optional
        Relative 1 σ of the sensitivities of ``force`` and ``displacement``.
    whole : LoopObservations, optional
        What these loops are a part of: unknowns and their units are then the same as of the whole.

    Raises
    ------
    EmaError
        Without loops, and for a rig that has no isolator.
    """

    def __init__(
        self,
        rig: Rig,
        loops: Sequence[Loop],
        *,
        own_scales: bool = False,
        calibration: Mapping[str, float] | None = None,
        whole: LoopObservations | None = None,
    ) -> None:
        if not loops:
            raise EmaError("no loops to explain; record steady sine tests")
        self.rig, self.loops, self.own_scales = rig, tuple(loops), own_scales
        self.calibration = dict(calibration or {})
        known = {d.loop.name: d for d in whole.data} if whole else {}
        self.data: tuple[LoopData, ...] = tuple(known.get(loop.name) or LoopData.of(loop) for loop in loops)
        self.isolator: Isolator = whole.isolator if whole else Isolator.of(rig)
        self.named: tuple[str, ...] = whole.named if whole else tuple(loop.name for loop in loops)
        self.typical: Typical = whole.typical if whole else typical_of(self.data)
        self.shared: Dependence = whole.shared if whole else self._dependence()
        self.starts: dict[tuple[str, ...], NDArray[np.float64]] = whole.starts if whole else {}
        scatters = (
            Scatter(FORCE_SCATTER, "force that no model explains", DISCREPANCY, 1.5, most=MOST),
            Scatter(NOISE_SCATTER, "noise that the cycles do not show", UNSEEN_NOISE, 1.5, most=MOST),
        )
        self.scatters = {s.name: s for s in scatters}

    @cached_property
    def measured(self) -> NDArray[np.float64]:
        """Coefficients of all loops' forces, N, (n_rows,)."""
        return np.concatenate([d.measured for d in self.data])

    @cached_property
    def _variances(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Own variance of all coefficients, and what a discrepancy of 1 adds, N², (n_rows,)."""
        own = np.concatenate([d.own_std for d in self.data]) ** 2
        return own, np.concatenate([d.unit for d in self.data]) ** 2

    def spread(self, scatters: Mapping[str, float]) -> Spread:
        """Variance of all coefficients at these scatters."""
        own, unit = self._variances
        added = {
            FORCE_SCATTER: scatters[FORCE_SCATTER] ** 2 * unit,
            NOISE_SCATTER: scatters[NOISE_SCATTER] ** 2 * own,
        }
        variance = own + sum(added.values())
        return Spread(variance, {n: a / variance for n, a in added.items()}, variance / own)

    @cached_property
    def cycles(self) -> Cycles:
        """The measured motion of all loops."""
        return Cycles.of(
            [d.frequency_hz for d in self.loops],
            [d.series for d in self.loops],
            [d.phase for d in self.loops],
        )

    def _dependence(self) -> Dependence:
        """Families that the isolator's elements depend on. One isolator is tested: it is its family's only part."""
        whole = dependence(self.rig)
        mine = {
            part_key(e) for e, _ in self.isolator.elements(self.rig.assembly(self.isolator.configuration))
        }
        rows = {k: r for k, r in whole.elements[self.isolator.configuration].items() if k in mine}
        kept = [i for i, _ in enumerate(whole.families) if any(r[i] for r in rows.values())]
        return Dependence(
            whole.unknowns.only(kept),
            {self.isolator.configuration: {k: r[kept] for k, r in rows.items()}},
            tuple(whole.families[i] for i in kept),
            (),
        )

    def scaled(self, effect: PlacedEffect) -> PlacedEffect:
        """The effect with the starts and prior scales of its sizes as these loops' force and motion suggest."""
        return self.typical.scaled(effect)

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> LoopProblem:
        """See `Observations`."""
        mine = [self.scaled(e) for e in effects]
        return LoopProblem(self, RigModel(self.rig, mine, scales, self.shared))

    def fitted_near(
        self, effects: Sequence[PlacedEffect], values: Mapping[str, float]
    ) -> tuple[LoopProblem, NDArray[np.float64]]:
        """The problem of a model, and its fit begun at known values of its parameters, (n,)."""
        problem = self.problem(effects, {})
        x = problem.start({n: v for n, v in values.items() if n in problem.sizes})
        for name in problem.model.dependence.families:
            if name in values:
                x[problem.unknowns.index[name]] = np.log(values[name] / self.rig.parameters[name].value)
        scatters = {n: s.default for n, s in self.scatters.items()}
        return problem, descend(problem, scatters, x, steps=_NEAR_STEPS).x

    def with_loops(self, kept: Sequence[int]) -> LoopObservations:
        """The same rig and channels with some of the loops."""
        return LoopObservations(
            self.rig,
            [self.loops[i] for i in kept],
            own_scales=self.own_scales,
            calibration=self.calibration,
            whole=self,
        )

    def folds(self) -> list[tuple[LoopObservations, LoopObservations]]:
        """Each amplitude held out in turn, each frequency, and each setting where there are several."""
        return self._folds

    @cached_property
    def _folds(self) -> list[tuple[LoopObservations, LoopObservations]]:
        pairs = []
        for out in left_out(self.loops, settings_differ=self.own_scales):
            kept = [i for i in range(len(self.loops)) if i not in out]
            pairs.append((self.with_loops(kept), self.with_loops(out)))
        return pairs


class LoopProblem(EffectProblem):
    """Measured loops and the isolator with a list of effects."""

    def __init__(self, observations: LoopObservations, model: RigModel) -> None:
        self.observations, self.model = observations, model
        self.offset = len(model.unknowns)

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.model.sizes

    @cached_property
    def unknowns(self) -> Unknowns:
        """The model's unknowns, the calibration of both channels, and the scales of the loops."""
        stated = self.observations.calibration
        std = [stated.get(c, CALIBRATION_STD) for c in ("force", "displacement")]
        scales = self.observations.named if self.observations.own_scales else ()
        return joined(
            self.model.unknowns,
            Unknowns.plain((FORCE, DISPLACEMENT), np.maximum(std, 1e-9)),
            Unknowns.plain([f"force scale of {name}" for name in scales], SETTING_STD),
        )

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """See `EffectProblem`."""
        return self.model.parameter_values(x[: self.offset])

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`: the spring as stiff as the loops, and the best of several shapes where none is given.

        Laws with memory have local optima in their shapes (yield, exponent, relaxation time, play), so several are
        tried by a few steps each.
        """
        x = np.concatenate([self.model.start(sizes), np.zeros(len(self.unknowns) - self.offset)])
        if sizes is not None or not self.model.effects:
            self._match_stiffness(x)
            return x
        known, labels = self.observations.starts, tuple(e.label for e in self.model.effects)
        if labels not in known:
            self._match_stiffness(x)
            scatters = {n: s.start for n, s in self.observations.scatters.items()}
            tried = [descend(self, scatters, shape, steps=_TRIAL_STEPS) for shape in self._shapes(x)]
            known[labels] = min(tried, key=lambda found: found.cost).x
        return known[labels].copy()

    def _match_stiffness(self, x: NDArray[np.float64]) -> None:
        """Make the springs as stiff as the loops are at their first harmonic."""
        found = self.force_law.elements(x[: self.offset])
        stiffness = sum(e.stiffness * factor**2 for e, factor in found if isinstance(e, Spring))
        measured = float(np.median([d.stiffness for d in self.observations.data]))
        if stiffness > 0 and measured > 0:
            families = slice(0, len(self.model.dependence.families))
            x[families] = np.log(measured / stiffness)

    def _shapes(self, x: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        """Points that differ from `x` in the shapes of one effect each."""
        yield x
        for one in self.model.effects:
            names = [one.parameter_name(p.name) for p in one.effect.parameters]
            shapes = [n for n in names if self._is_shape(n)]
            options = [self._options(n) for n in shapes]
            for values in product(*options) if shapes else ():
                moved = x.copy()
                for name, value in zip(shapes, values, strict=True):
                    moved[self.unknowns.index[name]] = value
                yield self.unknowns.clipped(moved)

    def _is_shape(self, name: str) -> bool:
        return self.sizes[name].logarithmic or self.sizes[name].parameter.unit == "m"

    def _options(self, name: str) -> tuple[float, ...]:
        size = self.sizes[name]
        if size.logarithmic:
            low, high = size.bounds
            return tuple(dict.fromkeys(float(np.clip(v, low, high)) for v in (-_SPREAD, 0.0, _SPREAD)))
        return tuple(share / SIZE_SHARE for share in (0.05, 0.3))

    @cached_property
    def force_law(self) -> IsolatorForce:
        """Force of the isolator along the measured motion."""
        return IsolatorForce(self.observations.isolator, self.model, self.observations.cycles)

    def forces(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Force that the channel reads along every loop, offsets left out, N, each (n_points,)."""
        whole = self._gains(x) * self._at(x).total
        return [whole[part] for part in self.observations.cycles.points.parts]

    def force_scales(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Force scale of every loop by its name; empty unless loops have scales of their own."""
        index = self.unknowns.index
        names = [loop.name for loop in self.observations.loops] if self.observations.own_scales else []
        return {name: float(np.exp(x[index[f"force scale of {name}"]])) for name in names}

    def _at(self, x: NDArray[np.float64]) -> ForceAtPoint:
        return self.force_law.at(x[: self.offset], float(x[self.unknowns.index[DISPLACEMENT]]))

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
        here, gains = self._at(x), self._gains(x)
        slopes = self._slopes(here, len(x)) if derivatives else np.zeros((len(gains), 0))
        columns = gains[:, None] * np.hstack([here.total[:, None], slopes])
        if not np.all(np.isfinite(columns)):
            return Residuals(np.full(1, np.inf), np.zeros((1, len(x))))
        parts = self.observations.cycles.points.parts
        predicted = np.concatenate(
            [d.basis.T @ columns[part] for d, part in zip(self.observations.data, parts, strict=True)]
        )
        spread = self.observations.spread(scatters)
        sigma = np.sqrt(spread.variance) * heat
        return Residuals(
            values=(self.observations.measured - predicted[:, 0]) / sigma,
            jacobian=-predicted[:, 1:] / sigma[:, None] if derivatives else np.zeros((0, len(x))),
            share=spread.share,
            log_scale=0.5 * float(np.sum(np.log(spread.relative))),
            relative=np.sqrt(spread.relative),
        )

    def _gains(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Factor between the elements' force and what the channel reads, (n_points,)."""
        o, index = self.observations, self.unknowns.index
        each = np.full(len(o.loops), x[index[FORCE]])
        if o.own_scales:
            each += [x[index[f"force scale of {loop.name}"]] for loop in o.loops]
        return np.repeat(np.exp(each), [len(loop.phase) for loop in o.loops])

    def _slopes(self, here: ForceAtPoint, count: int) -> NDArray[np.float64]:
        """Derivatives of the force by all unknowns, before it is read, (n_points, n)."""
        o, index = self.observations, self.unknowns.index
        slopes = np.zeros((len(here.total), count))
        slopes[:, : self.offset] = here.slopes()
        slopes[:, index[FORCE]] = here.total
        slopes[:, index[DISPLACEMENT]] = here.slope_by_reading()
        if o.own_scales:
            for loop, part in zip(o.loops, o.cycles.points.parts, strict=True):
                slopes[part, index[f"force scale of {loop.name}"]] = here.total[part]
        return slopes
