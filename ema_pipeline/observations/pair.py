"""Modes of two tests of one rig as one observation: everything is shared but the drift, and the effects act in B only.

Parts, sensors and calibration are the same unknowns in both tests, by their names. What the model itself misses of a
mode (its frequency, its damping ratio, its shape) is the same in both tests, too: it makes the residuals of a pair of
modes correlated, and cancels from their difference. So a change is seen against what differs from one test to the next,
not against what is uncertain of the rig.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.inference import Residuals, Scatter, Unknowns
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_problem import ModeProblem
from ema_pipeline.observations.mode_rows import FREQUENCY, SHAPE, Compared, Rows, stacked
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.parts import DAMPING_SCATTER
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.settings import Settings

A, B = "A", "B"
"""Names of the two tests."""


class RepeatSettings(Settings):
    """What two tests of one structure differ by, 1 σ, beside each test's own scatter and a drift of all frequencies.

    Medians of the priors: how well these two tests repeat is learned from the modes that do not change.
    """

    frequency: float = Field(1e-4, gt=0, lt=0.1, description="of each frequency, relative")
    damping: float = Field(
        0.01,
        gt=0,
        lt=2,
        description="of ln ζ: a structure taken apart and bolted together again may need 0.1",
    )
    shape: float = Field(0.003, gt=0, lt=1, description="of a shape's entries, in units of the largest")

    def scatters(self) -> dict[str, Scatter]:
        """As scatters, by the scatter of the model that each takes the place of in a difference."""
        return {
            kind: Scatter(f"{name}_repeat", f"{title} from test to test", stated, _SPREAD, 0.0, _MOST)
            for kind, name, title, stated in (
                (FREQUENCY, "frequency", "frequency", self.frequency),
                (DAMPING_SCATTER, "damping", "ln ζ", self.damping),
                (SHAPE, "shape", "shapes", self.shape),
            )
        }


_SPREAD, _MOST = 1.0, 5.0
"""1 σ of the logarithm of how well two tests repeat, and its largest value in units of what is stated: some tests of a
rig that nobody touched agree to their last digit, and a bolt that was tightened anew may change ln ζ by a tenth."""

Pairs = Mapping[str, NDArray[np.int64]]
"""Mode of B for every mode of A, -1 for none, by configuration."""


class PairObservations(Observations):
    """Measured modes of two tests of one rig.

    Parameters
    ----------
    a, b : ModeObservations
        Of one rig, with the tests' names `A` and `B`.
    pairs : dict of str to ndarray of int
        Which modes are the same, see `Pairs`.
    common : sequence of str
        Labels of effects that the rig had in both tests.
    repeat : RepeatSettings, optional
    """

    def __init__(
        self,
        a: ModeObservations,
        b: ModeObservations,
        pairs: Pairs,
        common: Sequence[str] = (),
        repeat: RepeatSettings | None = None,
    ) -> None:
        # rows of both tests are taken kind by kind; imaginary parts of real shapes are asked of each test alone
        a, b = a.without_lag(), b.without_lag()
        self.a, self.pairs, self.common = a, dict(pairs), frozenset(common)
        self.settings = repeat or RepeatSettings()
        self.repeat = self.settings.scatters()
        self.b = b.with_data([self._commensurate(d) for d in b.data])
        self.scatters = {**a.scatters, **{s.name: s for s in self.repeat.values()}}

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> PairProblem:
        """See `Observations`."""
        known = [e for e in effects if e.label in self.common]
        return PairProblem(
            self,
            ModeProblem(self.a, RigModel(self.a.rig, known, scales, self.a.shared)),
            ModeProblem(self.b, RigModel(self.a.rig, effects, scales, self.a.shared)),
        )

    def folds(self, count: int = 4) -> list[tuple[PairObservations, PairObservations]]:
        """Every `count`-th mode of both tests held out in turn, over all configurations; pairs stay together."""
        fold_a, fold_b = self._folds(count)
        used = sorted({k for of in (fold_a, fold_b) for folds in of.values() for k in folds})
        return [(self._only(fold_a, fold_b, k, False), self._only(fold_a, fold_b, k, True)) for k in used]

    def _folds(self, count: int) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.int64]]]:
        """Fold of every mode, by configuration."""
        fold_a, offset = {}, 0
        for d in self.a.data:
            fold_a[d.configuration] = (np.arange(len(d)) + offset) % count
            offset += len(d)
        fold_b = {}
        for d in self.b.data:
            fold = (np.arange(len(d)) + offset) % count
            offset += len(d)
            pairs = self.pairs.get(d.configuration, np.zeros(0, int))
            on = np.flatnonzero(pairs >= 0)
            fold[pairs[on]] = fold_a[d.configuration][on]
            fold_b[d.configuration] = fold
        return fold_a, fold_b

    def _only(
        self,
        fold_a: Mapping[str, NDArray[np.int64]],
        fold_b: Mapping[str, NDArray[np.int64]],
        k: int,
        held: bool,
    ) -> PairObservations:
        keep_a = {c: (f == k) == held for c, f in fold_a.items()}
        keep_b = {c: (f == k) == held for c, f in fold_b.items()}
        pairs = {}
        for c, to in self.pairs.items():
            new = np.cumsum(keep_b[c]) - 1
            of_kept = to[keep_a[c]]
            pairs[c] = np.where((of_kept >= 0) & keep_b[c][of_kept], new[of_kept], -1)
        a = self.a.with_data([d.only(keep_a[d.configuration]) for d in self.a.data])
        b = self.b.with_data([d.only(keep_b[d.configuration]) for d in self.b.data])
        return PairObservations(a, b, pairs, tuple(self.common), self.settings)

    def _commensurate(self, d: ModeData) -> ModeData:
        """The modes of a configuration in B with their shapes in the scale of their partners in A."""
        pairs = self.pairs.get(d.configuration)
        of_a = next((one for one in self.a.data if one.configuration == d.configuration), None)
        if pairs is None or of_a is None or not d.shapes.shape[1]:
            return d
        at = {dof.point: (i, dof.sign) for i, dof in enumerate(of_a.dofs)}
        factor = np.ones(len(d))
        for i, j in enumerate(pairs):
            common = [(at[dof.point], s, dof.sign) for s, dof in enumerate(d.dofs) if dof.point in at]
            if j < 0 or not common:
                continue
            ya = np.nan_to_num([sign * of_a.shapes[i, k] for (k, sign), _, _ in common])
            yb = np.nan_to_num([sign * d.shapes[j, s] for _, s, sign in common])
            size = float(yb @ yb)
            if size > 0 and ya @ yb != 0:
                factor[j] = float(ya @ yb) / size
        return dataclasses.replace(
            d, shapes=d.shapes * factor[:, None], shape_std=d.shape_std * np.abs(factor)[:, None]
        )


@dataclass(frozen=True)
class _Side:
    """One test's differences in terms of all unknowns."""

    found: Compared
    data: ModeData


class PairProblem(EffectProblem):
    """Two tests and the rig with a list of effects in B."""

    def __init__(self, observations: PairObservations, a: ModeProblem, b: ModeProblem) -> None:
        self.observations, self.a, self.b = observations, a, b
        self._defaults = {name: s.default for name, s in observations.scatters.items()}
        self._to_a = np.array([self.unknowns.index[n] for n in a.unknowns.names], int)
        self._to_b = np.array([self.unknowns.index[n] for n in b.unknowns.names], int)

    @cached_property
    def unknowns(self) -> Unknowns:
        """Those of B, then those that A alone has; what has one name is one unknown."""
        known = self.b.unknowns.index
        own = [i for i, n in enumerate(self.a.unknowns.names) if n not in known]
        a, b = self.a.unknowns, self.b.unknowns
        return Unknowns(
            names=(*b.names, *(a.names[i] for i in own)),
            std=np.concatenate([b.std, a.std[own]]),
            scatter=(*b.scatter, *(a.scatter[i] for i in own)),
            lower=np.concatenate([b.lower, a.lower[own]]),
            upper=np.concatenate([b.upper, a.upper[own]]),
            sizes=b.sizes | a.sizes,
        )

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.b.sizes

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`."""
        x = np.zeros(len(self.unknowns))
        x[self._to_b] = self.b.start(sizes)
        return x

    @property
    def sole_parts(self) -> Mapping[str, tuple[str, float]]:
        """See `EffectProblem`."""
        return self.b.sole_parts

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """See `EffectProblem`."""
        return self.b.parameter_values(x[self._to_b])

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
        given = matching if isinstance(matching, dict) else {}
        sides: dict[str, list[_Side | None]] = {}
        matches: dict[tuple[str, str], NDArray[np.int64]] = {}
        for k, (problem, to) in enumerate(((self.a, self._to_a), (self.b, self._to_b))):
            test = (A, B)[k]
            for data in problem.observations.data:
                at = problem.comparison(data, x[to], scatters, heat)
                found = at.compared(given.get((test, data.configuration)), derivatives)
                if found is None:
                    return Residuals(np.full(1, np.inf), np.zeros((1, len(x))), matching=matching)
                matches[test, data.configuration] = found.match
                sides.setdefault(data.configuration, [None, None])[k] = _Side(self._spread(found, to), data)
        parts = [self._together(c, a, b, scatters) for c, (a, b) in sides.items()]
        return dataclasses.replace(stacked(parts, len(x)), matching=matches)

    def _spread(self, found: Compared, to: NDArray[np.int64]) -> Compared:
        """Derivatives by one test's unknowns as derivatives by all."""
        rows = []
        for r in found.rows:
            slope = None
            if r.slope is not None:
                slope = np.zeros((len(r), len(self.unknowns)))
                slope[:, to] = r.slope
            rows.append(dataclasses.replace(r, slope=slope))
        return dataclasses.replace(found, rows=tuple(rows))

    def _together(
        self, configuration: str, a: _Side | None, b: _Side | None, scatters: Mapping[str, float]
    ) -> Residuals:
        """Whitened residuals of both tests of a configuration."""
        n = len(self.unknowns)
        parts = []
        for kind in range(3):
            first = a.found.rows[kind] if a else None
            second = b.found.rows[kind] if b else None
            if first is not None and second is not None and a is not None and b is not None:
                i, j = self._partners(configuration, a.data, b.data, first, second)
            else:
                i = j = np.zeros(0, int)
            parts.append(self._whitened(first, second, i, j, scatters, n))
        joint = stacked(parts, n)
        both = [s.found for s in (a, b) if s is not None]
        return dataclasses.replace(
            joint,
            log_scale=joint.log_scale + sum(f.log_scale for f in both),
            penalty=sum(f.penalty for f in both),
            unexplained=sum(f.unexplained for f in both),
            projected=sum(f.projected for f in both),
        )

    def _partners(
        self, configuration: str, a: ModeData, b: ModeData, first: Rows, second: Rows
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of A and of B that are of the same mode, and of the same sensor where they are of shapes."""
        pairs = self.observations.pairs.get(configuration, np.zeros(0, int))
        key_a = (
            np.where(pairs[first.mode] >= 0, pairs[first.mode], -1) if len(pairs) else np.full(len(first), -1)
        )
        key_b = second.mode.copy()
        if first.sensor is not None and second.sensor is not None:
            at = {(d.point, d.sign): s for s, d in enumerate(b.dofs)}
            place = np.array([at.get((d.point, d.sign), -1) for d in a.dofs], int)[first.sensor]
            width = len(b.dofs)
            key_a = np.where((key_a >= 0) & (place >= 0), key_a * width + place, -1)
            key_b = key_b * width + second.sensor
        common = np.intersect1d(key_a, key_b, return_indices=True)
        return common[1][common[0] >= 0], common[2][common[0] >= 0]

    def _whitened(
        self,
        first: Rows | None,
        second: Rows | None,
        i: NDArray[np.int64],
        j: NDArray[np.int64],
        scatters: Mapping[str, float],
        n: int,
    ) -> Residuals:
        """Rows of A by themselves; those of B less what their partners in A tell of them."""
        parts = []
        if first is not None:
            parts.append(self._alone(first, scatters, n))
        if second is not None:
            if first is not None and len(i):
                parts.append(self._given(first, second, i, j, scatters, n))
            rest = np.setdiff1d(np.arange(len(second)), j)
            parts.append(self._alone(_taken(second, rest), scatters, n))
        return stacked(parts, n)

    def _alone(self, r: Rows, scatters: Mapping[str, float], n: int) -> Residuals:
        repeat = self.observations.repeat[r.scatter].name
        now, usual = ((s[r.scatter] * r.unit) ** 2 for s in (scatters, self._defaults))
        repeat_now, repeat_usual = ((s[repeat] * r.unit) ** 2 for s in (scatters, self._defaults))
        own, own_usual = ((r.noise_at(s) * r.own) ** 2 for s in (scatters, self._defaults))
        variance = own + now + repeat_now
        shares = {r.scatter: now / variance, repeat: repeat_now / variance}
        if r.noise:
            shares[r.noise] = own / variance
        return _scaled(r, r.difference, r.slope, variance, own_usual + usual + repeat_usual, shares, n)

    def _given(
        self,
        first: Rows,
        second: Rows,
        i: NDArray[np.int64],
        j: NDArray[np.int64],
        scatters: Mapping[str, float],
        n: int,
    ) -> Residuals:
        """Rows of B given their partners in A: what the model misses of a mode is the same in both."""
        a, b = _taken(first, i), _taken(second, j)
        repeat = self.observations.repeat[a.scatter].name
        told = _conditional(a, b, scatters, repeat)
        usual = _conditional(a, b, self._defaults, repeat).variance
        if a.scatter == DAMPING_SCATTER:
            difference, slope = _damping_given(a, b, told.slope)
        else:
            difference, slope = b.difference - told.slope * a.difference, None
            if a.slope is not None and b.slope is not None:
                slope = b.slope - told.slope[:, None] * a.slope
        return _scaled(b, difference, slope, told.variance, usual, told.shares, n)


@dataclass(frozen=True)
class _Conditional:
    """Regression of B's differences on A's, variance of what is left, and the scatters' shares of it."""

    slope: NDArray[np.float64]
    variance: NDArray[np.float64]
    shares: dict[str, NDArray[np.float64]]


def _conditional(a: Rows, b: Rows, scatters: Mapping[str, float], repeat: str) -> _Conditional:
    """What A tells of B.

    Differences are d = u·δ + e, with one δ ~ N(0, scatter²) in both tests and an e of each test's own.
    """
    scatter, again = scatters[a.scatter], scatters[repeat]
    noise_a, noise_b = ((r.noise_at(scatters) * r.own) ** 2 for r in (a, b))
    again_a, again_b = ((again * r.unit) ** 2 for r in (a, b))
    slope = scatter**2 * a.unit * b.unit / (noise_a + again_a + (scatter * a.unit) ** 2)
    left = (scatter * (b.unit - slope * a.unit)) ** 2
    noise, repeated = noise_b + slope**2 * noise_a, again_b + slope**2 * again_a
    variance = left + noise + repeated
    shares = {a.scatter: left / variance, repeat: repeated / variance}
    if a.noise:
        shares[a.noise] = noise / variance
    return _Conditional(slope, variance, shares)


_LEAST_DAMPING = 0.05
"""Least damping ratio of B, as a share of the model's, that is taken for possible."""


def _damping_given(
    a: Rows, b: Rows, regression: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Differences of ln ζ in B given A, and derivatives of what the model says of it.

    What the model misses of a mode's damping, A tells; what an effect adds to it in B is added to the true damping of
    the mode, not to the model's: ζ_B = ζ_A·exp(regression·difference) + (ζ_B - ζ_A of the model).
    """
    assert a.model is not None
    assert b.model is not None
    base, own, changed = np.exp(a.model + regression * a.difference), np.exp(a.model), np.exp(b.model)
    expected = base + changed - own
    kept = expected > _LEAST_DAMPING * changed
    expected = np.where(kept, expected, _LEAST_DAMPING * changed)
    difference = b.difference + b.model - np.log(expected)
    if a.slope is None or b.slope is None:
        return difference, None
    of_a = base * (1 - regression) - own
    slope = (of_a[:, None] * a.slope + changed[:, None] * b.slope) / expected[:, None]
    return difference, np.where(kept[:, None], slope, b.slope)


def _taken(r: Rows, at: NDArray[np.int64]) -> Rows:
    """Some of the rows."""
    return dataclasses.replace(
        r,
        difference=r.difference[at],
        own=r.own[at],
        unit=r.unit[at],
        mode=r.mode[at],
        sensor=None if r.sensor is None else r.sensor[at],
        close=None if r.close is None else r.close[at],
        slope=None if r.slope is None else r.slope[at],
        model=None if r.model is None else r.model[at],
    )


def _scaled(
    r: Rows,
    difference: NDArray[np.float64],
    slope: NDArray[np.float64] | None,
    variance: NDArray[np.float64],
    usual: NDArray[np.float64],
    share: Mapping[str, NDArray[np.float64]],
    n: int,
) -> Residuals:
    """Differences that stand for the rows `r` in units of their standard uncertainties."""
    sigma = np.sqrt(variance) * r.heat
    whole = r.sensor is not None and r.heat == 1.0  # a shape may be wrong as a whole; far off everything is
    return Residuals(
        values=difference / sigma,
        jacobian=np.zeros((0, n)) if slope is None else slope / -sigma[:, None],
        share=dict(share) if slope is not None else {},
        log_scale=0.5 * float(np.sum(np.log(variance / usual))),
        block=np.unique(r.mode, return_inverse=True)[1] if whole else None,
        mixed=r.close,
    )
