"""Measured modes as observations: frequencies, damping ratios and shapes of every configuration.

Every sensor has its own calibration and reads a share of the motion across it; both are unknowns that all modes and
configurations share. Shapes are compared up to a factor, which is projected out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.settings import UncertaintySettings
from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.inference import Residuals, Scatter, Unknowns, joined
from ema_pipeline.ingest.records import CALIBRATION_STD
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, ModeDerivatives
from ema_pipeline.mechanics.terms import Matrices
from ema_pipeline.observations.parts import (
    MASS_SCATTER,
    MASS_STD,
    PART_SCATTER,
    STIFFNESS_STD,
    Dependence,
    dependence,
)
from ema_pipeline.observations.rig_model import RigModel, SizeMap
from ema_pipeline.rigs.types import Rig

CALIBRATION = "calibration"
DAMPING_SCATTER = "damping_scatter"
FREQUENCY = "frequency_scatter"
SHAPE = "shape_scatter"

DRIFT_STD = 3e-4
"""1 σ of what all frequencies of one configuration are off together: 2 K in steel."""

UNEXPLAINED = 12.0
"""Cost, in the log posterior, of a measured mode without a model mode."""
UNSEEN = 3.0
"""Cost of a model mode in the band that was not measured: it may lie on a node of every sensor or hit point."""

_SHAPE_REACH = 0.3
"""Entries below this share of the largest have its uncertainty: they are differences of larger motions."""
_FREQUENCY_REACH = 0.1
"""Difference of ln f that costs a pair as much as shapes that have nothing in common; wider while a fit is annealed."""
_FREQUENCY_REACH_ALONE = 0.3
_LEAVE = 0.3
"""Cost above the best at which an assignment leaves a measured mode without a partner."""

_CLOSE_PAIR = 0.2
"""Difference of ln f within which two modes may have changed places."""
_WRONG = 4.0
"""σ from which a shape is another one."""

_ACROSS = {"x": "y", "y": "x", "zeta": "eta", "eta": "zeta"}


def scatters_of(rig: Rig) -> dict[str, Scatter]:
    """The hyper-parameters of measured modes, with the defaults that the rig states."""
    known = (
        Scatter(PART_SCATTER, "stiffness of parts", STIFFNESS_STD, 0.7, 0.04),
        # Drawings and scales are trusted more than masses deserve (fasteners, oil, cables): a wide prior.
        Scatter(MASS_SCATTER, "mass of parts", MASS_STD, 1.0, 0.02, 8.0),
        Scatter(CALIBRATION, "calibration", CALIBRATION_STD, 0.7, 0.04),
        Scatter(DAMPING_SCATTER, "ln ζ from mode to mode", rig.modal_damping_scatter, 0.5, 0.5),
        Scatter(FREQUENCY, "frequency", 3e-4, 0.7, 1e-3, 5.0),
        Scatter(SHAPE, "shapes", 0.015, 0.5, 0.03, 3.0),
    )
    return {s.name: s for s in known}


@dataclass(frozen=True)
class ModeData:
    """One configuration's measured modes, prepared: real shapes with their largest entry 1.

    Attributes
    ----------
    configuration : str
    log_frequency, log_frequency_std : ndarray, (m,)
    log_damping, log_damping_std : ndarray, (m,)
        NaN where not measured.
    shapes, shape_std : ndarray, (m, s)
        NaN where not measured; s may be 0.
    dofs : tuple of Dof
    band_hz : tuple of float
    complete : bool
        False where modes of the band were taken out on purpose: what the model has besides is then no contradiction.
    """

    configuration: str
    log_frequency: NDArray[np.float64]
    log_frequency_std: NDArray[np.float64]
    log_damping: NDArray[np.float64]
    log_damping_std: NDArray[np.float64]
    shapes: NDArray[np.float64]
    shape_std: NDArray[np.float64]
    dofs: tuple[Dof, ...]
    band_hz: tuple[float, float]
    complete: bool = True

    def __len__(self) -> int:
        return len(self.log_frequency)

    def only(self, keep: NDArray[np.bool_]) -> ModeData:
        """The modes of a mask, (m,)."""
        names = (
            "log_frequency",
            "log_frequency_std",
            "log_damping",
            "log_damping_std",
            "shapes",
            "shape_std",
        )
        return dataclasses.replace(self, complete=False, **{n: getattr(self, n)[keep] for n in names})


def _known_or(std: NDArray[np.float64], assumed: float) -> NDArray[np.float64]:
    """Standard deviations, the assumed one where none is known."""
    return np.where(np.isfinite(std) & (std > 0), std, assumed)


def prepare(measured: MeasuredModes, settings: UncertaintySettings | None = None) -> ModeData:
    """Measured modes in the form that residuals need; where no scatter is known, `settings` say what is assumed."""
    settings = settings or UncertaintySettings()
    m, f = len(measured), measured.frequency_hz
    shapes = np.zeros((m, 0))
    std = np.zeros((m, 0))
    dofs: tuple[Dof, ...] = ()
    if measured.shapes is not None and measured.dofs:
        dofs = measured.dofs
        shapes, std = np.zeros((m, len(dofs))), np.zeros((m, len(dofs)))
        for r in range(m):
            y = measured.shapes[r]
            real = np.real(y * np.exp(-0.5j * np.angle(np.nansum(y**2))))
            size = float(np.nanmax(np.abs(real), initial=0.0)) or 1.0
            shapes[r] = real / size
            given = np.full(len(dofs), np.nan) if measured.shape_std is None else measured.shape_std[r]
            std[r] = _known_or(given / size, settings.shape_std_assumed)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = _known_or(measured.frequency_std_hz / f, settings.frequency_std_assumed)
        damping = np.where(measured.damping_ratio > 0, measured.damping_ratio, np.nan)
        damping_std = _known_or(measured.damping_std / damping, settings.damping_std_assumed)
    band = measured.band_hz or (0.9 * float(np.min(f, initial=1.0)), 1.1 * float(np.max(f, initial=1.0)))
    return ModeData(
        measured.configuration, np.log(f), relative, np.log(damping), damping_std, shapes, std, dofs, band,
        complete=measured.band_hz is not None,  # a list of frequencies does not say that there are no others
    )  # fmt: skip


class ModeObservations:
    """Measured modes of a rig's configurations.

    Parameters
    ----------
    rig : Rig
        Without effects.
    data : sequence of ModeData
    channels : dict of str to ChannelQuality, optional
        By DOF; the defaults where left out.
    shared : Dependence, optional
        Of the rig, where it is known already.
    sensors : tuple of str, optional
        DOFs whose calibration is unknown; those of `data` where left out.
    """

    def __init__(
        self,
        rig: Rig,
        data: Sequence[ModeData],
        channels: Mapping[str, ChannelQuality] | None = None,
        shared: Dependence | None = None,
        sensors: tuple[str, ...] = (),
    ) -> None:
        self.rig = rig
        self.data = tuple(d for d in data if len(d))
        self.sensors = sensors or tuple(dict.fromkeys(d.point for one in data for d in one.dofs))
        self.channels = dict(channels or {})
        self.shared = shared or dependence(rig)
        self.scatters = scatters_of(rig)
        self._has: dict[tuple[str, Dof], bool] = {}

    def channel(self, sensor: str) -> ChannelQuality:
        """What is known of the channel that measures a DOF; the defaults where nothing was stated."""
        return self.channels.get(sensor, ChannelQuality())

    def has(self, configuration: str, dof: Dof) -> bool:
        """True where the rig can be measured at `dof`; asked for every model, so remembered."""
        key = (configuration, dof)
        if key not in self._has:
            self._has[key] = self.rig.knows(configuration, dof)
        return self._has[key]

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> ModeProblem:
        """See `Observations`."""
        return ModeProblem(self, RigModel(self.rig, effects, scales, self.shared))

    def with_data(self, data: Sequence[ModeData]) -> ModeObservations:
        """The same rig and channels with other modes."""
        return ModeObservations(self.rig, data, self.channels, self.shared, self.sensors)

    def folds(self, count: int = 4) -> list[tuple[ModeObservations, ModeObservations]]:
        """Every `count`-th mode held out in turn, over all configurations."""
        total = sum(len(d) for d in self.data)
        pairs = []
        for k in range(min(count, total)):
            kept, out, offset = [], [], 0
            for d in self.data:
                held = (np.arange(len(d)) + offset) % count == k
                offset += len(d)
                kept.append(d.only(~held))
                out.append(d.only(held))
            pairs.append((self.with_data(kept), self.with_data(out)))
        return pairs


def _calibration(sensor: str, channel: ChannelQuality) -> str:
    """Name of the unknown: one channel that was moved from DOF to DOF has one calibration."""
    return f"calibration of {channel.name or sensor}"


def _drift(configuration: str) -> str:
    """Name of the unknown: temperature and time move all frequencies of one configuration alike."""
    return f"drift of {configuration}"


def _transverse(sensor: str) -> str:
    return f"transverse sensitivity at {sensor}"


@dataclass(frozen=True)
class Sensing:
    """What the sensors of one configuration read: rows of the motion along and across each, and their unknowns."""

    along: NDArray[np.float64]
    across: NDArray[np.float64]
    gain: NDArray[np.int64]
    transverse: NDArray[np.int64]


@dataclass(frozen=True)
class ModeRows:
    """Measurement minus model over 1 σ of one mode; NaN where not measured.

    Attributes
    ----------
    configuration : str
    measured, model : int
        Indices of the measured mode and of its model mode.
    frequency, damping : float
    shape : ndarray, (n_sensors,)
    """

    configuration: str
    measured: int
    model: int
    frequency: float
    damping: float
    shape: NDArray[np.float64]

    @property
    def shape_off(self) -> float:
        """Largest difference of the shape, in σ; 0 where none was measured."""
        return float(np.max(np.abs(np.nan_to_num(self.shape)), initial=0.0))


class ModeProblem:
    """Measured modes and the rig with a list of effects."""

    def __init__(self, observations: ModeObservations, model: RigModel) -> None:
        self.observations, self.model = observations, model
        self.offset = len(model.unknowns)
        self._sensing: dict[tuple[str, tuple[Dof, ...]], Sensing] = {}

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.model.sizes

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`."""
        return np.concatenate([self.model.start(sizes), np.zeros(len(self.unknowns) - self.offset)])

    def begun(self, x: NDArray[np.float64], scatters: Mapping[str, float]) -> NDArray[np.float64] | None:
        """See `EffectProblem`: modes change with every size."""
        return None

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """See `EffectProblem`."""
        return self.model.parameter_values(x[: self.offset])

    @cached_property
    def unknowns(self) -> Unknowns:
        """The model's unknowns, every sensor's calibration, and its transverse sensitivity where it has one."""
        sensors = {s: self.observations.channel(s) for s in self.observations.sensors}
        gains = {_calibration(s, c): c.calibration_std / CALIBRATION_STD for s, c in sensors.items()}
        gains = {name: std for name, std in gains.items() if std > 0}
        across = {s: c.transverse for s, c in sensors.items() if c.transverse > 0 and self._has_across(s)}
        drifts = [_drift(d.configuration) for d in self.observations.data]
        return joined(
            self.model.unknowns,
            Unknowns.plain(drifts, DRIFT_STD),
            Unknowns.plain(tuple(gains), list(gains.values()), CALIBRATION),
            Unknowns.plain([_transverse(s) for s in across], list(across.values())),
        )

    def _has_across(self, sensor: str) -> bool:
        body, _, direction = sensor.rpartition(".")
        other = _ACROSS.get(direction)
        if other is None:
            return False
        return any(self.observations.has(d.configuration, Dof(body, other)) for d in self.observations.data)

    def sensing(self, data: ModeData) -> Sensing:
        """What the sensors of one configuration's modes read."""
        key = (data.configuration, data.dofs)
        if key not in self._sensing:
            self._sensing[key] = self._found_sensing(data)
        return self._sensing[key]

    def _found_sensing(self, d: ModeData) -> Sensing:
        along = self.model.sensor_rows(d.configuration, d.dofs)
        across = np.zeros_like(along)
        gain = np.full(len(d.dofs), -1)
        transverse = np.full(len(d.dofs), -1)
        for i, dof in enumerate(d.dofs):
            gain[i] = self.unknowns.index.get(
                _calibration(dof.point, self.observations.channel(dof.point)), -1
            )
            transverse[i] = self.unknowns.index.get(_transverse(dof.point), -1)
            if transverse[i] >= 0:
                other = Dof(dof.body, _ACROSS[dof.direction])
                if self.observations.has(d.configuration, other):
                    across[i] = self.model.sensor_rows(d.configuration, (other,))[0]
        return Sensing(along, across, gain, transverse)

    def paired(
        self, data: ModeData, x: NDArray[np.float64], match: NDArray[np.int64] | None = None
    ) -> Paired | None:
        """Modes of the model at `x` and their partners among `data`, found anew where `match` is left out.

        None where the model has no modes there.
        """
        solution = self._modes(data.configuration, x)
        if solution is None:
            return None
        at = _Configuration(self, data, self.sensing(data), x, {}, 1.0)
        return Paired(solution, at.matched(solution) if match is None else match)

    def _modes(self, configuration: str, x: NDArray[np.float64]) -> EigenSolution | None:
        matrices = self.model.matrices(configuration, x[: self.offset], derivatives=False)
        return EigenSolution.of(matrices.dense, matrices.skew, matrices.damping_ratio)

    def solution(self, configuration: str, x: NDArray[np.float64]) -> EigenSolution:
        """Modes of the model at `x`.

        Raises
        ------
        EmaError
            If the model has none there.
        """
        solution = self._modes(configuration, x)
        if solution is None:
            raise EmaError(
                f"{configuration}: the model has no modes at the fitted values; check the rig's masses"
            )
        return solution

    def escapes(
        self, x: NDArray[np.float64], scatters: Mapping[str, float], found: Residuals
    ) -> list[NDArray[np.float64]]:
        """See `EffectProblem`: close pairs of modes whose order is the wrong way round, split the other way.

        No descent leads through the point where two modes coincide. The least probable part of the way is saved by
        moving all unknowns as little as their priors allow.
        """
        assert isinstance(found.matching, tuple)
        variance = self.unknowns.prior_std(scatters) ** 2
        rows, starts, at = self.rows(found), [], 0
        for data, match in zip(self.observations.data, found.matching, strict=True):
            own = [r for r in rows if r.configuration == data.configuration]
            modes = self.solution(data.configuration, x)
            std = np.hypot(data.log_frequency_std, scatters[FREQUENCY])
            for (i, a), (j, b) in pairwise(enumerate(own)):
                split = float(np.log(modes.frequency_hz[b.model] / max(modes.frequency_hz[a.model], 1e-6)))
                if abs(split) < _CLOSE_PAIR and a.shape_off > _WRONG and b.shape_off > _WRONG:
                    slope = (
                        found.jacobian[at + i] * std[a.measured] - found.jacobian[at + j] * std[b.measured]
                    )
                    reach = float(slope @ (variance * slope))
                    if reach > 0:
                        starts.append(self.unknowns.clipped(x - 2 * split * variance * slope / reach))
            at += len(own) + int(np.sum(np.isfinite(data.log_damping[match >= 0])))
            at += int(np.sum(np.isfinite(data.shapes[match >= 0])))
        return starts

    def rows(self, found: Residuals) -> list[ModeRows]:
        """Residuals sorted by the mode that they belong to, every measured mode that has a model mode."""
        assert isinstance(found.matching, tuple)
        out, at = [], 0
        for data, match in zip(self.observations.data, found.matching, strict=True):
            on = np.flatnonzero(match >= 0)
            frequency = found.values[at : at + len(on)]
            at += len(on)
            damped = np.isfinite(data.log_damping[on])
            damping = np.full(len(on), np.nan)
            damping[damped] = found.values[at : at + int(np.sum(damped))]
            at += int(np.sum(damped))
            seen = np.isfinite(data.shapes[on])
            shape = np.full(seen.shape, np.nan)
            shape[seen] = found.values[at : at + int(np.sum(seen))]
            at += int(np.sum(seen))
            out += [
                ModeRows(
                    data.configuration,
                    int(r),
                    int(match[r]),
                    float(frequency[k]),
                    float(damping[k]),
                    shape[k],
                )
                for k, r in enumerate(on)
            ]
        return out

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
        given = matching if isinstance(matching, tuple) else (None,) * len(self.observations.data)
        parts = [
            _Configuration(self, d, self.sensing(d), x, scatters, heat).residuals(m, derivatives)
            for d, m in zip(self.observations.data, given, strict=True)
        ]
        return stacked(parts, len(x))


@dataclass(frozen=True)
class Paired:
    """Modes of the model at one point, and which of them each measured mode belongs to.

    Attributes
    ----------
    solution : EigenSolution
    match : ndarray of int, (m,)
        -1 for a measured mode without a partner.
    """

    solution: EigenSolution
    match: NDArray[np.int64]


def stacked(parts: Sequence[Residuals], n: int) -> Residuals:
    """Residuals of several parts of the data as one."""
    names = dict.fromkeys(k for p in parts for k in p.share)
    return Residuals(
        values=np.concatenate([p.values for p in parts] or [np.zeros(0)]),
        jacobian=np.concatenate([p.jacobian for p in parts] or [np.zeros((0, n))]),
        share={k: np.concatenate([p.share.get(k, np.zeros(len(p.values))) for p in parts]) for k in names},
        log_scale=sum(p.log_scale for p in parts),
        penalty=sum(p.penalty for p in parts),
        matching=tuple(p.matching for p in parts),
        projected=sum(p.projected for p in parts),
    )


class _Configuration:
    """Residuals of one configuration at one point."""

    def __init__(
        self,
        problem: ModeProblem,
        data: ModeData,
        sensing: Sensing,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        heat: float,
    ) -> None:
        self.problem, self.data, self.sensing, self.x, self.heat = problem, data, sensing, x, heat
        self.scatters = scatters
        self.gain = np.where(sensing.gain >= 0, np.exp(x[np.maximum(sensing.gain, 0)]), 1.0)
        cross = np.where(sensing.transverse >= 0, x[np.maximum(sensing.transverse, 0)], 0.0)
        self.reading = self.gain[:, None] * (sensing.along + cross[:, None] * sensing.across)

    def residuals(self, matching: object, derivatives: bool) -> Residuals:
        model = self.problem.model
        own = self.x[: self.problem.offset]
        matrices = model.matrices(self.data.configuration, own, derivatives)
        solution = EigenSolution.of(matrices.dense, matrices.skew, matrices.damping_ratio)
        if solution is None:
            return Residuals(np.full(1, np.inf), np.zeros((1, len(self.x))), matching=matching)
        match = matching if isinstance(matching, np.ndarray) else self.matched(solution)
        return self._compared(matrices, solution, self._seen(solution), match, derivatives)

    def _seen(self, solution: EigenSolution) -> NDArray[np.float64]:
        """What the sensors read of every shape, (s, n)."""
        return np.asarray(self.reading @ solution.shapes[: self.reading.shape[1]])

    def matched(self, solution: EigenSolution) -> NDArray[np.int64]:
        """Index of the model mode of every measured one, -1 for none, (m,)."""
        d, predicted = self.data, self._seen(solution)
        log = np.log(np.maximum(solution.frequency_hz, 1e-6))
        apart = np.abs(log[None] - d.log_frequency[:, None])
        if d.shapes.shape[1]:
            y = np.nan_to_num(d.shapes)
            seen = np.isfinite(d.shapes).astype(float)
            cross = (y @ predicted) ** 2
            norm = np.sum(y**2, axis=1)[:, None] * (seen @ predicted**2)
            reach = _FREQUENCY_REACH * (1 + 0.1 * (self.heat - 1))
            cost = -cross / np.maximum(norm, 1e-300) + np.minimum(apart / reach, 3.0)
        else:
            # convex, so that close modes keep their order: two crossed pairs would cost as much as two straight ones
            cost = np.minimum(apart * (1 + apart) / _FREQUENCY_REACH_ALONE, 3.0) - 1.0
        m = len(d)
        padded = np.hstack([cost, np.full((m, m), _LEAVE)])
        column = scipy.optimize.linear_sum_assignment(padded)[1]
        return np.where(column < cost.shape[1], column, -1)

    def _compared(
        self,
        matrices: Matrices,
        solution: EigenSolution,
        predicted: NDArray[np.float64],
        match: NDArray[np.int64],
        derivatives: bool,
    ) -> Residuals:
        on = np.flatnonzero(match >= 0)
        slopes = None
        if derivatives:
            slopes = ModeDerivatives.of(matrices, solution, match[on], self.problem.model.has_ratio)
        rows = (
            self._frequencies(solution, on, match[on], slopes),
            self._damping(solution, on, match[on], slopes),
            self._shapes(solution, predicted, on, match[on], slopes),
        )
        defaults = {k: s.default for k, s in self.problem.observations.scatters.items()}
        done = [r.whitened(self.scatters, defaults) for r in rows]
        return Residuals(
            values=np.concatenate([v for v, _, _, _ in done]),
            jacobian=np.concatenate([j for _, j, _, _ in done]),
            share={
                r.scatter: np.concatenate(
                    [
                        s if other is r else np.zeros(len(s))
                        for other, (_, _, s, _) in zip(rows, done, strict=True)
                    ]
                )
                for r in rows
            },
            log_scale=sum(c for _, _, _, c in done) + self._usual(np.flatnonzero(match < 0), defaults),
            penalty=UNEXPLAINED * float(np.sum(match < 0)) + UNSEEN * self._unseen(solution, match),
            matching=match,
            projected=len(on) if self.data.shapes.shape[1] else 0,
        )

    def _usual(self, alone: NDArray[np.int64], defaults: Mapping[str, float]) -> float:
        """What modes without a partner would cost on average if they were explained.

        Without it, leaving a mode out would gain what its rows cost, and no effect would ever bring it back.
        """
        d = self.data
        seen = np.isfinite(d.shapes[alone])
        reach = np.maximum(_SHAPE_REACH, np.abs(d.shapes[alone]))[seen]
        damped = alone[np.isfinite(d.log_damping[alone])]
        total = -0.5 * int(np.sum(np.any(seen, axis=1)))
        for own, unit, name in (
            (d.log_frequency_std[alone], 1.0, FREQUENCY),
            (d.log_damping_std[damped], 1.0, DAMPING_SCATTER),
            (d.shape_std[alone][seen], reach, SHAPE),
        ):
            now, usual = (own**2 + (at[name] * unit) ** 2 for at in (self.scatters, defaults))
            total += 0.5 * float(np.sum(np.log(now / usual) + 1.0))
        return total

    def _frequencies(
        self,
        solution: EigenSolution,
        on: NDArray[np.int64],
        match: NDArray[np.int64],
        slopes: ModeDerivatives | None,
    ) -> _Rows:
        d = self.data
        drift = self.problem.unknowns.index[_drift(d.configuration)]
        slope = self._none
        if slopes is not None:
            slope = self._padded(slopes.log_frequency)
            slope[:, drift] = 1.0
        return _Rows(
            d.log_frequency[on] - np.log(np.maximum(solution.frequency_hz[match], 1e-6)) - self.x[drift],
            d.log_frequency_std[on],
            np.ones(len(on)),
            FREQUENCY,
            self.heat,
            slope,
        )

    def _damping(
        self,
        solution: EigenSolution,
        on: NDArray[np.int64],
        match: NDArray[np.int64],
        slopes: ModeDerivatives | None,
    ) -> _Rows:
        d = self.data
        measured = np.isfinite(d.log_damping[on])
        on, ratio = on[measured], solution.damping_ratio[match][measured]
        slope = self._none
        if slopes is not None:
            slope = self._padded(slopes.damping_ratio[measured] / ratio[:, None])
        return _Rows(
            d.log_damping[on] - np.log(ratio),
            d.log_damping_std[on],
            np.ones(len(on)),
            DAMPING_SCATTER,
            1.0,
            slope,
        )

    def _shapes(
        self,
        solution: EigenSolution,
        predicted: NDArray[np.float64],
        on: NDArray[np.int64],
        match: NDArray[np.int64],
        slopes: ModeDerivatives | None,
    ) -> _Rows:
        """Shapes with the factor projected out that fits them best."""
        d, p = self.data, predicted[:, match].T
        seen = np.isfinite(d.shapes[on])
        y, own = np.nan_to_num(d.shapes[on]), d.shape_std[on]
        unit = np.maximum(_SHAPE_REACH, np.abs(y))
        weight = seen / (own**2 + (self.scatters[SHAPE] * unit) ** 2)
        squared = np.maximum(np.sum(weight * p**2, axis=1), 1e-300)
        scale = np.sum(weight * p * y, axis=1) / squared
        slope = self._none
        if slopes is not None:
            dp = self._shape_slopes(slopes.shapes, solution.shapes[:, match], p)
            towards = weight * (y - 2 * scale[:, None] * p) / squared[:, None]
            factor = np.einsum("ks,ksn->kn", towards, dp)
            slope = (scale[:, None, None] * dp + p[:, :, None] * factor[:, None, :])[seen]
        difference = (y - scale[:, None] * p)[seen]
        return _Rows(difference, own[seen], unit[seen], SHAPE, 1 + 0.1 * (self.heat - 1), slope)

    @property
    def _none(self) -> NDArray[np.float64]:
        return np.zeros((0, len(self.x)))

    def _unseen(self, solution: EigenSolution, match: NDArray[np.int64]) -> int:
        """Model modes well inside the band that no measured mode is paired with."""
        if not self.data.complete:
            return 0
        low, high = self.data.band_hz
        inside = (solution.frequency_hz > 1.05 * low) & (solution.frequency_hz < 0.95 * high)
        inside[match[match >= 0]] = False
        return int(np.sum(inside))

    def _padded(self, by_model: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives by the model's unknowns, filled up with zeros for the sensors', (k, n)."""
        return np.pad(by_model, ((0, 0), (0, len(self.x) - by_model.shape[1])))

    def _shape_slopes(
        self, by_model: NDArray[np.float64], shapes: NDArray[np.float64], predicted: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives of what the sensors read of some shapes by all unknowns, (k, s, n)."""
        width, s = self.reading.shape[1], self.sensing
        k, count = predicted.shape
        slope = np.zeros((k, count, len(self.x)))
        read = self.reading @ by_model[:width].reshape(width, k * by_model.shape[2])
        slope[:, :, : by_model.shape[2]] = read.reshape(count, k, by_model.shape[2]).transpose(1, 0, 2)
        has = np.flatnonzero(s.gain >= 0)
        slope[:, has, s.gain[has]] += predicted[:, has]
        has = np.flatnonzero(s.transverse >= 0)
        slope[:, has, s.transverse[has]] += (self.gain[:, None] * (s.across @ shapes[:width])).T[:, has]
        return slope


@dataclass(frozen=True)
class _Rows:
    """Differences of one kind: own 1 σ, the unit of the scatter that adds to it, heat, and derivatives of the model."""

    difference: NDArray[np.float64]
    own: NDArray[np.float64]
    unit: NDArray[np.float64]
    scatter: str
    heat: float
    slope: NDArray[np.float64]

    def whitened(
        self, scatters: Mapping[str, float], defaults: Mapping[str, float]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
        """Values, derivatives, share of the scatter in the variance, and the price of its width."""
        added = (scatters[self.scatter] * self.unit) ** 2
        variance = self.own**2 + added
        usual = self.own**2 + (defaults[self.scatter] * self.unit) ** 2
        sigma = np.sqrt(variance) * self.heat
        jacobian = -self.slope / sigma[:, None] if len(self.slope) else self.slope
        price = 0.5 * float(np.sum(np.log(variance / usual)))
        return self.difference / sigma, jacobian, added / variance, price
