"""What is diagnosed: hits at several levels, the rig, and the parameters from which its fits start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import Hypothesis, make_rig
from ema_pipeline.diagnose.levels.data import HitWindows
from ema_pipeline.diagnose.levels.problem import NoiseFloor, TimeFit, TimeProblem, Whitening, whitenings
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.effects.base import EffectParameter
from ema_pipeline.effects.library import Library, shipped_effects
from ema_pipeline.rigs.types import Parameter, Rig


@dataclass(frozen=True)
class LevelCase:
    """Hits at several levels and a rig.

    Attributes
    ----------
    rig : Rig
        The model as it stands.
    windows : tuple of HitWindows
    settings : DiagnoseSettings
    library : mapping of id to Effect, or None for the shipped one
    starts : tuple of dict of str to float
        Parameters of the linear part, from fits to the modes of single levels.
    top_hz : float
        Frequency of the highest mode.
    share : float
        Of the windows that are there to be compared.
    left_out : tuple of str
        Names of hits that are not, see `diagnose.levels.views`.
    """

    rig: Rig
    windows: tuple[HitWindows, ...]
    settings: DiagnoseSettings
    library: Library | None
    starts: tuple[Mapping[str, float], ...]
    top_hz: float
    share: float = 1.0
    left_out: tuple[str, ...] = ()

    @property
    def floor(self) -> NoiseFloor:
        """Floor of the noise while hypotheses are searched."""
        return NoiseFloor(self.settings.levels.noise_start, self.settings.levels.common_error)

    @property
    def data(self) -> float:
        """Independent numbers that all hits together are worth."""
        return self.settings.levels.data_per_mode * sum(w.modes * len(w.names) for w in self.windows)

    def weights(self, floor: NoiseFloor) -> list[Whitening]:
        """Weights of all lines."""
        return whitenings(self.windows, floor, self.settings.levels.data_per_mode)

    def problem(self, hypothesis: Hypothesis, sizes: Mapping[str, float] | None = None) -> TimeProblem:
        """The fit of a hypothesis; `sizes` are typical values of its effects' parameters."""
        return TimeProblem(self._rig(hypothesis, sizes), self.windows, self._substeps())

    def beginning(self, share: float) -> LevelCase:
        """The first part of all windows."""
        if share == 1.0:
            return self
        shorter = tuple(w.shortened(share) for w in self.windows)
        return replace(self, windows=shorter, share=share * self.share)

    def only(self, kept: Sequence[NDArray[np.bool_]]) -> LevelCase:
        """The case with some of the hits, by configuration; the others are named in `left_out`."""
        pairs = list(zip(self.windows, kept, strict=True))
        out = [str(n) for w, k in pairs for n in np.array(w.names)[~k]]
        return replace(self, windows=tuple(w.only(k) for w, k in pairs), left_out=(*self.left_out, *out))

    def softer(self) -> LevelCase:
        """Without the hits of the hardest level, after which parts strike most often."""
        return self.without_level(self.levels[-1]) if len(self.levels) > 1 else self

    def rough(self) -> LevelCase:
        """Softest and hardest hits, short windows, long steps: enough to tell orders of magnitude."""
        kept = [
            w.only((w.level == w.level.min()) | (w.level == w.level.max())).shortened(_SHORT)
            for w in self.windows
        ]
        return replace(self.coarse(), windows=tuple(kept))

    def coarse(self) -> LevelCase:
        """All hits, with longer steps."""
        coarse = self.settings.levels.model_copy(update={"points_per_period": _COARSE})
        return replace(self, settings=self.settings.model_copy(update={"levels": coarse}))

    def _substeps(self) -> int:
        rate = min(w.sample_rate_hz for w in self.windows)
        return max(int(np.ceil(self.settings.levels.points_per_period * self.top_hz / rate)), 1)

    def _rig(self, hypothesis: Hypothesis, sizes: Mapping[str, float] | None) -> Rig:
        rig = make_rig(self.rig, hypothesis, self.library, self.settings.parameter_range)
        for name, value in (sizes or {}).items():
            p = rig.parameters[name]
            rig = replace(rig, parameters={**rig.parameters, name: replace(p, value=value)})
        return rig

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels that can be held out: those of configurations that have several."""
        return tuple(sorted({int(k) for w in self.windows if len(set(w.level)) > 1 for k in w.level}))

    def without_level(self, level: int) -> LevelCase:
        """The case without the hits of one level; configurations with a single level keep it."""
        kept = [w.only(w.level != level) if len(set(w.level)) > 1 else w for w in self.windows]
        return replace(self, windows=tuple(kept))

    def parameters_of(self, label: str) -> tuple[EffectParameter, ...]:
        """Parameters of the effect ``id@place``; none for a parameter out of tolerance."""
        known = shipped_effects() if self.library is None else self.library
        family = label.partition("@")[0]
        return known[family].parameters if family in known else ()


@dataclass(frozen=True)
class Simulated:
    """A hypothesis at its optimum.

    Attributes
    ----------
    hypothesis : Hypothesis
    sizes : dict of str to float
        Typical values of its effects' parameters: the scales of the fit.
    fit : TimeFit
    std : dict of str to float
    evidence : float
        -2 log evidence (Laplace), up to a constant common to all hypotheses of the same data.
    """

    hypothesis: Hypothesis
    sizes: dict[str, float]
    fit: TimeFit
    std: dict[str, float]
    evidence: float

    @property
    def values(self) -> dict[str, float]:
        """All fitted parameters."""
        return self.fit.values


def level_hypotheses(case: LevelCase, base: Hypothesis) -> list[Hypothesis]:
    """Every effect of the library that is not linear, at every place of the measured configurations."""
    known = shipped_effects() if case.library is None else case.library
    rig = make_rig(case.rig, base, case.library, case.settings.parameter_range)
    there = {n.rpartition(".")[0] for n in rig.parameters if "@" in n}
    found = []
    for effect_id in sorted(known):
        if known[effect_id].linear:
            continue
        configurations = [w.configuration for w in case.windows]
        places = dict.fromkeys(
            p for c in configurations for p in known[effect_id].find_places(rig.assembly(c))
        )
        found += [base.plus(f"{effect_id}@{p}") for p in places if f"{effect_id}@{p}" not in there]
    return found


def judged(
    problem: TimeProblem, hypothesis: Hypothesis, sizes: Mapping[str, float], found: TimeFit
) -> Simulated:
    """Evidence and standard deviations at an optimum.

    The size of an effect is spread evenly over the logarithm, `_DECADES` to either side of what the library names as
    clearly visible, and over both signs where it has two.
    """
    space = problem.space
    slopes = np.abs(space.slopes(found.x))
    hessian = found.hessian + 1e-9 * np.eye(len(space.names))
    cost = 0.0
    for i, (name, c) in enumerate(zip(space.names, space.coordinates, strict=True)):
        if name not in sizes:
            continue
        width = prior_width(c.parameter)
        unit = max(abs(found.values[name]) / slopes[i], 1e-6)  # one e-fold, in the coordinate
        hessian[i, i] += 1 / (width * unit) ** 2
        cost += 2 * np.log(width * unit / np.sqrt(2 * np.pi))
    covariance = np.linalg.inv(hessian)
    for i, name in enumerate(space.names):
        if name in sizes:
            cost -= np.log(covariance[i, i])
    # what the data say, without the prior of the sizes, is the uncertainty that is told
    told = np.linalg.inv(found.hessian + 1e-9 * np.eye(len(space.names)))
    std = {n: float(np.sqrt(max(told[i, i], 0.0)) * slopes[i]) for i, n in enumerate(space.names)}
    return Simulated(hypothesis, dict(sizes), found, std, float(found.objective + cost))


def error_of(case: LevelCase, model: Simulated) -> float:
    """Root-mean-square of data and nominal values, in standard uncertainties."""
    prior = float(np.sum(case.problem(model.hypothesis, model.sizes).space.has_prior))
    return float(np.sqrt(model.fit.objective / (case.data + prior)))


def prior_width(p: Parameter | EffectParameter) -> float:
    """Range of a size beforehand, in e-folds; both signs together."""
    return float((2 if p.minimum < 0 else 1) * 2 * _DECADES * np.log(10))


_DECADES = 4
_SHORT = 0.3
_COARSE = 3.0


def size_grid(p: EffectParameter, per_decade: int) -> NDArray[np.float64]:
    """Values of an effect's first parameter to start a fit from: `_DECADES` to either side of its start, both signs."""
    sizes = abs(p.start) * np.logspace(-_DECADES, _DECADES, 2 * _DECADES * per_decade + 1)
    grid = np.concatenate([sizes, -sizes]) if p.minimum < 0 else sizes
    return np.asarray(grid[(grid >= p.minimum) & (grid <= p.maximum)])


def sized(case: LevelCase, hypothesis: Hypothesis, values: Sequence[float]) -> dict[str, float]:
    """Values of the parameters of the effect added last, by their names among the rig's."""
    label = hypothesis.labels[-1]
    return {f"{label}.{p.name}": v for p, v in zip(case.parameters_of(label), values, strict=True)}
