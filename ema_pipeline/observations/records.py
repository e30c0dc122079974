"""Records of continuous excitation as observations: the model driven by the measured force, its response compared.

A response is compared line by line of its Fourier transform. Each band of frequency has a noise of its own, learned
with everything else, so that what no model explains at a resonance does not drown what it explains elsewhere. The state
at the start of a record is unknown; a periodic record is compared with the steady response.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.generic import is_place, place_rows
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.inference import Residuals, Scatter, Unknowns, joined
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.mechanics.simulation import FINE, DrivenSystem, Sensors, Slopes, substeps_for
from ema_pipeline.observations.linear_start import linear_start
from ema_pipeline.observations.parts import DAMPING
from ema_pipeline.observations.record_data import BANDS, DISCREPANCY, RecordData
from ema_pipeline.observations.record_model import Basis, RecordModel, loosened
from ema_pipeline.observations.record_motion import Motion, simulated
from ema_pipeline.observations.rig_model import RigModel, SizeMap
from ema_pipeline.observations.typical import Typical
from ema_pipeline.rigs.types import Rig

MOST_COORDINATES = 5
"""Coordinates of a model up to which its records are simulated."""
_WIDE = 20.0
"""Noise, in units of the discrepancy, with which fits begin: a linear model of a nonlinear rig misses a tenth."""
_BEGIN_SAMPLES = 50
"""Samples that tell the state at the start of a record which is held out, where the test states no transient."""
_EDGE = 400
"""Samples behind these that the interpolation of the force sees."""
_ROUNDS = 4
_MOST_NOISE = 1e3
_LEAST_NOISE = 1e-5
"""Noise, in units of the discrepancy, that nothing falls below."""
_SET_UP = 0.1
"""Mean of a displacement, as a share of its root mean square, from which its zero is arbitrary."""
_HEADROOM = 1.3
"""Factor by which effects may raise the highest natural frequency before steps become coarser than meant."""


class RecordObservations:
    """Records of one configuration of a rig.

    Parameters
    ----------
    rig : Rig
        Without effects.
    configuration : str
    records : sequence of DrivenRecord
        What the model is fitted to.
    held_out : sequence of DrivenRecord
        What it is judged by.
    frfs : FrfSet
        Of the same test: where the search for the linear values begins.
    basis : Basis, optional
        Of other records of the same test: unknowns and their units are then the same.
    like : RecordObservations, optional
        What these records are a part of: sizes to expect and noise are then counted in its units.
    modal : bool
        True where the rig was made of identified modes: effects can sit where sensors are only.
    phase : float
        By which the highest mode may turn in one step, rad.

    Raises
    ------
    EmaError
        Without records to fit, and for a rig that lacks a measured DOF.
    """

    def __init__(
        self,
        rig: Rig,
        configuration: str,
        records: Sequence[DrivenRecord],
        held_out: Sequence[DrivenRecord] = (),
        frfs: FrfSet | None = None,
        basis: Basis | None = None,
        like: RecordObservations | None = None,
        modal: bool = False,
        phase: float = FINE,
    ) -> None:
        if not records:
            raise EmaError('no record to fit; give at least one use = "fit"')
        self.rig, self.configuration = rig, configuration
        self.data = tuple(RecordData.of(r) for r in records)
        self.held_out = tuple(held_out)
        self.basis = basis or _basis(rig, configuration, records, frfs)
        self.like, self.modal, self.phase = like, modal, phase
        self.finds_states = (
            False  # True where states at the start are found from the first samples, not fitted
        )

    @cached_property
    def sample_rate_hz(self) -> float:
        """Of all records."""
        return self.data[0].record.sample_rate_hz

    @cached_property
    def rms(self) -> NDArray[np.float64]:
        """Root mean square of every response over the records that models are fitted to, (n_outputs,)."""
        if self.like is not None:
            return self.like.rms
        return np.asarray(np.sqrt(np.mean([d.rms**2 for d in self.data], axis=0)))

    @cached_property
    def scatters(self) -> Mapping[str, Scatter]:
        """See `Observations`: the noise of every response in every band, in units of the discrepancy."""
        width = self.sample_rate_hz / 2 / BANDS
        found = {}
        for o, dof in enumerate(self.basis.outputs):
            for b in range(BANDS):
                title = f"what no model explains at {dof.point}, {b * width:.4g} to {(b + 1) * width:.4g} Hz"
                name = self.noise_name(o, b)
                found[name] = Scatter(name, title, 1.0, 1.5, _WIDE, _MOST_NOISE, at_once=True)
        return found

    def noise_name(self, output: int, band: int) -> str:
        """Name of the scatter of one response in one band."""
        return f"noise of {self.basis.outputs[output].point} in band {band + 1}"

    @cached_property
    def linear_model(self) -> RecordModel:
        """The rig without effects."""
        return RecordModel(self.basis, (), {})

    @cached_property
    def substeps(self) -> int:
        """Steps per sample."""
        linear = self.linear_model.linear(self.linear_model.start())
        return substeps_for(linear, self.sample_rate_hz, self.phase / _HEADROOM)

    def scaled(self, placed: PlacedEffect) -> PlacedEffect:
        """An effect with the starts and prior scales of its sizes as these records suggest, if they can."""
        assembly = self.basis.rig.assembly(self.configuration)
        if placed.place not in assembly.bodies and not is_place(assembly, placed.place):
            return placed
        return self.typical(placed.place).scaled(placed)

    def typical(self, place: str) -> Typical:
        """Motion and restoring force at a place, of the linear model at the start of the search."""
        if self.like is not None:
            return self.like.typical(place)
        states, mass = self._linear_motion
        n = len(mass)
        assembly = self.basis.rig.assembly(self.configuration)
        found = []
        for row in place_rows(assembly, place):
            v = np.array([row.get(d, 0.0) for d in assembly.dofs])
            x = float(np.std(states[:, :n] @ v))
            rate = float(np.std(states[:, n : 2 * n] @ v))
            moved = 1 / float(v @ np.linalg.solve(mass, v))
            omega = rate / max(x, 1e-300)
            found.append((x, omega, moved * omega**2 * x))
        x, omega, force = max(found)
        root = np.sqrt(2)
        return Typical(root * max(x, 1e-300), max(omega, 1e-300), root * max(force, 1e-300))

    @cached_property
    def _linear_motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """States of the linear model in the first record, and its mass matrix."""
        model = self.linear_model
        x = model.start()
        system = model.driven(x)
        found = self.motion(self.data[0], system, np.zeros(system.size))
        if found is None:
            raise EmaError(f"rig '{self.rig.name}' without effects grows without bound; check its elements")
        return found.states, model.linear(x).mass

    @cached_property
    def begin_scale(self) -> NDArray[np.float64]:
        """Size of every displacement and velocity, (2n,): 1 σ of the unknown states at the start of records."""
        if self.like is not None:
            return self.like.begin_scale
        states, mass = self._linear_motion
        return np.asarray(np.maximum(np.std(states[:, : 2 * len(mass)], axis=0), 1e-300))

    @cached_property
    def slowest_rad_s(self) -> float:
        """Least decay rate of a mode of the linear model, halved."""
        system = self.linear_model.driven(self.linear_model.start())
        n = len(system.stiffness)
        first_order = np.block([[np.zeros((n, n)), np.eye(n)], [-system.stiffness, -system.damping]])
        return 0.5 * float(np.min(np.abs(np.linalg.eigvals(first_order).real)))

    @cached_property
    def sensors(self) -> Sensors:
        """What the response channels read."""
        return Sensors(self.basis.rows[1], self.basis.quantities)

    def motion(
        self, data: RecordData, system: DrivenSystem, begin: NDArray[np.float64], slopes: Slopes | None = None
    ) -> Motion | None:
        """What a system does in one record; None where its motion grows without bound."""
        return simulated(data, self.substeps, self.slowest_rad_s, self.sensors, system, begin, slopes)

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> RecordProblem:
        """See `Observations`."""
        return RecordProblem(self, RecordModel(self.basis, [self.scaled(e) for e in effects], scales))

    def with_records(
        self,
        records: Sequence[DrivenRecord],
        held_out: Sequence[DrivenRecord],
        basis: Basis | None = None,
        phase: float | None = None,
    ) -> RecordObservations:
        """The same test with other records, or pieces of them."""
        used = basis or self.basis
        return RecordObservations(
            self.rig, self.configuration, records, held_out, None, used, self.like or self, self.modal,
            phase or self.phase,
        )  # fmt: skip

    def folds(self) -> Sequence[tuple[RecordObservations, RecordObservations]]:
        """The records that the test holds out; none where it holds out none."""
        return self._folds

    @cached_property
    def _folds(self) -> tuple[tuple[RecordObservations, RecordObservations], ...]:
        if not self.held_out:
            return ()
        other = self.with_records(self.held_out, ())
        other.finds_states = True
        return ((self, other),)


def _basis(rig: Rig, configuration: str, records: Sequence[DrivenRecord], frfs: FrfSet | None) -> Basis:
    first = records[0]
    rig, shared, loose = loosened(rig, configuration)
    model = RigModel(rig, (), {}, shared)
    damping = DAMPING if model.has_ratio else ""
    centre = {} if frfs is None else linear_start(model, configuration, list(loose), damping, frfs)
    return Basis(
        rig=rig,
        configuration=configuration,
        shared=shared,
        loose=loose,
        inputs=tuple(replace(f.dof, sign=1) for f in first.forces),
        outputs=tuple(replace(c.dof, sign=1) for c in first.channels),
        quantities=tuple(c.quantity for c in first.channels),
        calibration=(
            *((f.name, f.calibration_std) for f in first.forces),
            *((c.name, c.calibration_std) for c in first.channels),
        ),
        force_rms=np.std(np.concatenate([r.force for r in records], axis=1), axis=1),
        zero_std=_zero_std(np.concatenate([r.responses for r in records], axis=1)),
        centre=centre,
    )


def _zero_std(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Prior 1 σ of what responses read at rest: nothing where their mean is small, else as large as that mean.

    A displacement with a small mean counts from the position at rest, and its mean tells of springs that differ
    between pull and push. With a large one it counts from wherever the sensor was set up.
    """
    mean, rms = np.abs(np.mean(responses, axis=1)), np.std(responses, axis=1)
    return np.asarray(np.where(mean > _SET_UP * rms, mean / np.maximum(DISCREPANCY * rms, 1e-300), 1e-9))


class RecordProblem:
    """Records and the rig with a list of effects."""

    def __init__(self, observations: RecordObservations, model: RecordModel) -> None:
        self.observations, self.model = observations, model

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.model.sizes

    @cached_property
    def unknowns(self) -> Unknowns:
        """The model's unknowns, and the state at the start of every record that is not periodic."""
        return joined(
            self.model.unknowns,
            *(
                Unknowns.plain(
                    [f"state {k + 1} at the start of {d.record.name}" for k in range(self._states)], 1.0
                )
                for d in self.observations.data
                if not d.periodic
            ),
        )

    @property
    def _states(self) -> int:
        return len(self.observations.begin_scale)

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`."""
        return np.concatenate(
            [self.model.start(sizes), np.zeros(len(self.unknowns) - len(self.model.unknowns))]
        )

    def begun(self, x: NDArray[np.float64], scatters: Mapping[str, float]) -> NDArray[np.float64] | None:
        """See `EffectProblem`: responses change with every size."""
        return None

    def escapes(
        self, x: NDArray[np.float64], scatters: Mapping[str, float], found: Residuals
    ) -> list[NDArray[np.float64]]:
        """See `EffectProblem`: none."""
        return []

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """See `EffectProblem`."""
        return self.model.parameter_values(x[: len(self.model.unknowns)])

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
        if self.observations.finds_states:
            x = self.settled(x)
        motions = self.motions(x, derivatives)
        if motions is None:
            return Residuals(np.full(1, np.inf), np.zeros((1, len(x))))
        common, gains = len(self.model.unknowns), self.model.gains(x)
        values, rows, spread = [], [], []
        place = common
        for data, motion in zip(self.observations.data, motions, strict=True):
            read = motion.read * gains
            read += self.model.response_offsets(x, self.observations.rms)
            predicted = data.lines(np.ascontiguousarray(read[data.compared].T))
            variance = self._variance(data, scatters)
            sigma = np.sqrt(variance.total) * heat
            values.append(((data.measured - predicted) / sigma).ravel())
            spread.append(variance)
            own = 0 if data.periodic else self._states
            if derivatives:
                rows.append(self._rows(data, motion, gains, place, len(x)) / -sigma[..., None])
            place += own
        relative = np.concatenate([v.relative.ravel() for v in spread])
        return Residuals(
            values=np.concatenate(values),
            jacobian=np.concatenate([r.reshape(-1, len(x)) for r in rows])
            if derivatives
            else np.zeros((0, len(x))),
            share=self._shares(spread, scatters),
            log_scale=float(np.sum(np.log(relative))),
            relative=relative,
        )

    def motions(self, x: NDArray[np.float64], derivatives: bool = False) -> list[Motion] | None:
        """What the model does in every record; None where it grows without bound in one."""
        o, common = self.observations, len(self.model.unknowns)
        here = self.model.driven(x[:common])
        states = self._states
        slopes = self.model.slopes(x[:common], here, states) if derivatives else None
        found, place = [], common
        for data in o.data:
            begin, mine = np.zeros(here.size), slopes
            if not data.periodic:
                begin[:states] = o.begin_scale * x[place : place + states]
                place += states
                if slopes is not None:
                    slopes.begin[np.arange(states), self.model.marched + np.arange(states)] = o.begin_scale
            elif slopes is not None:
                mine = slopes.first(self.model.marched)
            motion = o.motion(data, here, begin, mine)
            if (
                motion is None
                or not np.all(np.isfinite(motion.read))
                or not np.all(np.isfinite(motion.change))
            ):
                return None
            found.append(motion)
        return found

    def settled(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """`x` with the states at the start of the records that their first samples alone determine."""
        found, place = x.copy(), len(self.model.unknowns)
        for data in self.observations.data:
            if not data.periodic:
                part = slice(place, place + self._states)
                found[part] = self._first_state(data.record, found[: len(self.model.unknowns)])
                place += self._states
        return found

    def _first_state(self, record: DrivenRecord, common: NDArray[np.float64]) -> NDArray[np.float64]:
        """State at the start of one record, in units of its prior σ, by a few Gauss-Newton steps."""
        count = min(max(record.transient, _BEGIN_SAMPLES), record.n_samples)
        seen = count + _EDGE
        part = replace(record, force=record.force[:, :seen], responses=record.responses[:, :seen])
        short = RecordProblem(self.observations.with_records([part], ()), self.model)
        rms, gains = self.observations.rms, self.model.gains(common)
        offsets = self.model.response_offsets(common, rms)
        x = np.concatenate([common, np.zeros(self._states)])
        for _ in range(_ROUNDS):
            motions = short.motions(x, derivatives=True)
            if motions is None:
                return np.zeros(self._states)
            gap = (part.responses.T - motions[0].read * gains - offsets)[:count] / rms
            slope = motions[0].change[:count, :, self.model.marched :] * (gains / rms)[:, None]
            step = np.linalg.lstsq(slope.reshape(-1, self._states), gap.ravel(), rcond=1e-8)[0]
            x[len(common) :] += step
        return x[len(common) :]

    def _rows(
        self,
        data: RecordData,
        motion: Motion,
        gains: NDArray[np.float64],
        place: int,
        count: int,
    ) -> NDArray[np.float64]:
        """Derivatives of a record's lines by all unknowns, (n_outputs, n_rows, n)."""
        marched, outputs = self.model.marched, np.arange(len(gains))
        moved = (motion.change * gains[:, None])[data.compared].transpose(1, 2, 0)
        lines = data.lines(np.ascontiguousarray(moved)).transpose(0, 2, 1)
        found = np.zeros((len(gains), lines.shape[1], count))
        found[:, :, :marched] = lines[:, :, :marched]
        if not data.periodic:
            found[:, :, place : place + self._states] = lines[:, :, marched:]
        read = np.ascontiguousarray((motion.read * gains)[data.compared].T)
        ones = np.ones_like(read) * (DISCREPANCY * self.observations.rms)[:, None]
        found[outputs, :, self.model.gain_columns.start + outputs] = data.lines(read)
        found[outputs, :, self.model.offset_columns.start + outputs] = data.lines(ones)
        return found

    def _variance(self, data: RecordData, scatters: Mapping[str, float]) -> Variance:
        """Variance of a record's lines at these scatters."""
        o = self.observations
        unit = DISCREPANCY * o.rms[:, None]
        noise = np.maximum(data.noise, _LEAST_NOISE * unit)
        each = np.array([[scatters[o.noise_name(k, b)] for b in range(BANDS)] for k in range(len(unit))])
        added = (each * unit) ** 2
        stated = noise**2 + unit**2
        total = noise**2 + added
        return Variance(
            total[:, data.band],
            (added / total)[:, data.band],
            np.sqrt(total / stated)[:, data.band],
            data.band,
        )

    def _shares(
        self, spread: Sequence[Variance], scatters: Mapping[str, float]
    ) -> dict[str, NDArray[np.float64]]:
        """Share of every scatter in the variance of every row."""
        o = self.observations
        found = {}
        for k in range(len(o.basis.outputs)):
            for b in range(BANDS):
                parts = []
                for v in spread:
                    share = np.zeros(v.share.shape)
                    share[k] = np.where(v.band == b, v.share[k], 0.0)
                    parts.append(share.ravel())
                found[o.noise_name(k, b)] = np.concatenate(parts)
        return found


@dataclass(frozen=True)
class Variance:
    """Of the lines of one record, each (n_outputs, n_rows): the whole, the learned share, and σ over the stated one."""

    total: NDArray[np.float64]
    share: NDArray[np.float64]
    relative: NDArray[np.float64]
    band: NDArray[np.int64]
