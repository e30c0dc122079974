"""Records of continuous excitation and one model: residuals of the responses' lines, with their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.inference import Residuals, Unknowns, joined
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.mechanics.simulation import HYSTERESIS, DrivenSystem, Slopes
from ema_pipeline.observations.base import EffectProblem
from ema_pipeline.observations.record_data import BANDS, DISCREPANCY, RecordData
from ema_pipeline.observations.record_model import RecordModel
from ema_pipeline.observations.record_motion import Motion
from ema_pipeline.observations.rig_model import SizeMap

if TYPE_CHECKING:
    from ema_pipeline.observations.records import RecordObservations

_BEGIN_SAMPLES = 50
"""Samples that tell the state at the start of a record which is held out, where the test states no transient."""
_EDGE = 400
"""Samples behind these that the interpolation of the force sees."""
_MEMORY = 0.5
"""1 σ of the memory of an element at the start of a record, as a share of the largest or of a typical one."""
_ROUNDS = 4
_LEAST_NOISE = 1e-5
"""Noise, in units of the discrepancy, that nothing falls below."""


class RecordProblem(EffectProblem):
    """Records and the rig with a list of effects."""

    def __init__(self, observations: RecordObservations, model: RecordModel) -> None:
        self.observations, self.model = observations, model

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """See `EffectProblem`."""
        return self.model.sizes

    @cached_property
    def unknowns(self) -> Unknowns:
        """The model's unknowns, and the state at the start of every record that is not periodic.

        States are named after the model: what one model makes of them leads a fit of another one astray.
        """
        effects = "".join(f", {e.label}" for e in self.model.rig_model.effects)
        return joined(
            self.model.unknowns,
            *(
                Unknowns.plain([f"{state} at the start of {d.record.name}{effects}" for state in self._states], 1.0)
                for d in self.observations.data
                if not d.periodic
            ),
        )

    @cached_property
    def _states(self) -> tuple[str, ...]:
        """What is unknown at the start of a record: displacements, velocities, memories of elements that have one."""
        moving = (f"state {k + 1}" for k in range(len(self.observations.begin_scale)))
        return (*moving, *(f"memory of {name}" for name, _ in self.model.memories))

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """See `EffectProblem`."""
        return np.concatenate(
            [self.model.start(sizes), np.zeros(len(self.unknowns) - len(self.model.unknowns))]
        )

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
            own = 0 if data.periodic else len(self._states)
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
        """What the model does in every record; None where it grows without bound in one, or has no positive mass."""
        common, states = len(self.model.unknowns), len(self._states)
        try:
            here = self.model.driven(x[:common])
            slopes = self.model.slopes(x[:common], here, states) if derivatives else None
        except (EmaError, np.linalg.LinAlgError):  # a step of the search past what can exist
            return None
        found, place = [], common
        for data in self.observations.data:
            begin, mine = np.zeros(here.size), slopes
            if not data.periodic:
                begin = self._begin(data, here, x[place : place + states], slopes)
                place += states
            elif slopes is not None:
                mine = slopes.first(self.model.marched)
            motion = self.observations.motion(data, here, begin, mine)
            if (
                motion is None
                or not np.all(np.isfinite(motion.read))
                or not np.all(np.isfinite(motion.change))
            ):
                return None
            found.append(motion)
        return found

    def _begin(
        self, data: RecordData, system: DrivenSystem, x: NDArray[np.float64], slopes: Slopes | None
    ) -> NDArray[np.float64]:
        """State at the start of a record, (2n + m,), whose unknowns are `x`; its derivatives into `slopes`."""
        o, moving = self.observations, len(self.observations.begin_scale)
        begin, marched = np.zeros(system.size), self.model.marched
        begin[:moving] = o.begin_scale * x[:moving]
        if data.within is not None:
            begin[:moving] += o.suggested(data)
        if slopes is not None:
            slopes.begin[...] = 0.0
            slopes.begin[np.arange(moving), marched + np.arange(moving)] = o.begin_scale
        for k, (_, j) in enumerate(self.model.memories, start=moving):
            bounded = system.kinds[j] == HYSTERESIS  # its memory is a force, that of others a stretch
            size = float(system.numbers[j, 1] if bounded else np.abs(system.rows[j]) @ o.begin_scale[: moving // 2])
            begin[moving + j] = _MEMORY * size * x[k]
            if slopes is not None:
                slopes.begin[moving + j, marched + k] = _MEMORY * size
                if bounded:
                    slopes.begin[moving + j, :marched] = _MEMORY * x[k] * slopes.numbers[j, 1, :marched]
        return begin

    def settled(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """`x` with the states at the start of the records that their first samples alone determine."""
        found, place = x.copy(), len(self.model.unknowns)
        for data in self.observations.data:
            if not data.periodic:
                part = slice(place, place + len(self._states))
                found[part] = self._first_state(data.record, found[: len(self.model.unknowns)])
                place += len(self._states)
        return found

    def _first_state(self, record: DrivenRecord, common: NDArray[np.float64]) -> NDArray[np.float64]:
        """State at the start of one record, in units of its prior σ, by a few Gauss-Newton steps."""
        count = min(max(record.transient, _BEGIN_SAMPLES), record.n_samples)
        seen = count + _EDGE
        part = replace(record, force=record.force[:, :seen], responses=record.responses[:, :seen])
        short = RecordProblem(self.observations.with_records([part], ()), self.model)
        rms, gains = self.observations.rms, self.model.gains(common)
        offsets, states = self.model.response_offsets(common, rms), len(self._states)
        x = np.concatenate([common, np.zeros(states)])
        memory = np.eye(states)[len(self.observations.begin_scale) :] * DISCREPANCY
        for _ in range(_ROUNDS):
            motions = short.motions(x, derivatives=True)
            if motions is None:
                return np.zeros(states)
            gap = (part.responses.T - motions[0].read * gains - offsets)[:count] / rms
            slope = motions[0].change[:count, :, self.model.marched :] * (gains / rms)[:, None]
            matrix = np.concatenate([slope.reshape(-1, states), memory])
            right = np.concatenate([gap.ravel(), -memory @ x[len(common) :]])
            step = np.linalg.lstsq(matrix, right, rcond=1e-8)[0]
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
            found[:, :, place : place + len(self._states)] = lines[:, :, marched:]
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
