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
from ema_pipeline.mechanics.driven_system import BOUC_WEN, DrivenSystem, Slopes
from ema_pipeline.observations.base import EffectProblem
from ema_pipeline.observations.record_data import BANDS, DISCREPANCY, SHARE, RecordData
from ema_pipeline.observations.record_model import RecordModel
from ema_pipeline.observations.record_motion import Motion
from ema_pipeline.observations.size_map import SizeMap

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
_NO_SLOPES = np.zeros((0, 0, 0, 0))

Lines = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Of one record (n_windows, n_outputs, n_rows), SI, and their derivatives by all n unknowns (..., n)."""


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
        """The model's unknowns, and the state at the start of every window, or record, that is not periodic.

        States are named after the model: what one model makes of them leads a fit of another one astray.
        """
        effects = "".join(f", {e.label}" for e in self.model.rig_model.effects)
        return joined(
            self.model.unknowns,
            *(
                Unknowns.plain(
                    [
                        f"{s} at sample {at} of {d.record.name}{effects}"
                        for at in d.starts
                        for s in self._states
                    ],
                    1.0,
                )
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
        predicted = self._predicted(x, derivatives)
        if predicted is None:
            return Residuals(np.full(1, np.inf), np.zeros((1, len(x))))
        values, rows, spread = [], [], []
        for data, (lines, slopes) in zip(self.observations.data, predicted, strict=True):
            variance = self._variance(data, scatters)
            sigma = np.sqrt(variance.total) * heat
            values.append(((data.measured - lines) / sigma).ravel())
            spread.append(variance)
            if derivatives:
                rows.append((slopes / -sigma[..., None]).reshape(-1, len(x)))
        windows = [len(d.starts) for d in self.observations.data]
        relative = np.concatenate(
            [np.tile(v.relative.ravel(), n) for v, n in zip(spread, windows, strict=True)]
        )
        return Residuals(
            values=np.concatenate(values),
            jacobian=np.concatenate(rows) if derivatives else np.zeros((0, len(x))),
            share=self._shares(spread, scatters) if derivatives else {},
            log_scale=float(np.sum(np.log(relative))),
            relative=relative,
        )

    def _predicted(self, x: NDArray[np.float64], derivatives: bool) -> list[Lines] | None:
        """Lines of every record, with their derivatives where they are asked for; None where there is no motion.

        No scatter changes them. A fit begins where the one before it, at other scatters, has ended: the last ones with
        derivatives are cached.
        """
        known = self.observations.last_prediction
        if derivatives and known is not None and known[0] is self and np.array_equal(known[1], x):
            return known[2]
        at = self.settled(x) if self.observations.finds_states else x
        motions = self.motions(at, derivatives)
        if motions is None:
            return None
        gains, offsets = self.model.gains(at), self.model.response_offsets(at, self.observations.rms)
        found, place = [], len(self.model.unknowns)
        for data, motion in zip(self.observations.data, motions, strict=True):
            lines = data.lines(_by_output((motion.read * gains + offsets)[:, data.compared]))
            slopes = self._rows(data, motion, gains, place, len(x)) if derivatives else _NO_SLOPES
            found.append((lines, slopes))
            place += self._own(data)
        if derivatives:
            self.observations.last_prediction = (self, x.copy(), found)
        return found

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
            begin, mine = np.zeros((1, here.size)), slopes
            if not data.periodic:
                own = self._own(data)
                begin, mine = self._begin(data, here, x[place : place + own], slopes)
                place += own
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

    def _own(self, data: RecordData) -> int:
        """Number of unknowns that a record has for itself."""
        return 0 if data.periodic else len(self._states) * len(data.starts)

    def _begin(
        self, data: RecordData, system: DrivenSystem, x: NDArray[np.float64], slopes: Slopes | None
    ) -> tuple[NDArray[np.float64], Slopes | None]:
        """States at the start of a record's windows, (n_windows, 2n + m), of unknowns `x`; slopes with theirs."""
        o, moving, marched = self.observations, len(self.observations.begin_scale), self.model.marched
        unknown = x.reshape(len(data.starts), -1)
        begin = np.zeros((len(data.starts), system.size))
        begin[:, :moving] = o.suggested(data) + o.begin_scale * unknown[:, :moving]
        change = np.zeros((*begin.shape, 0 if slopes is None else marched + len(self._states)))
        if slopes is not None:
            change[:, np.arange(moving), marched + np.arange(moving)] = o.begin_scale
        for k, (_, j) in enumerate(self.model.memories, start=moving):
            force = system.kinds[j] == BOUC_WEN  # what it remembers; others remember a stretch
            size = system.numbers[j, 1] if force else np.abs(system.rows[j]) @ o.begin_scale[: moving // 2]
            begin[:, moving + j] = _MEMORY * size * unknown[:, k]
            if slopes is not None:
                change[:, moving + j, marched + k] = _MEMORY * size
                if force:
                    change[:, moving + j, :marched] = _MEMORY * np.outer(
                        unknown[:, k], slopes.numbers[j, 1, :marched]
                    )
        return begin, None if slopes is None else replace(slopes, begin=change)

    def settled(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """`x` with the states at the start of the records that their first samples alone determine."""
        found, place = x.copy(), len(self.model.unknowns)
        for data in self.observations.data:
            if not data.periodic:
                part = slice(place, place + self._own(data))
                found[part] = self._first_states(data, found[: len(self.model.unknowns)])
                place += self._own(data)
        return found

    def _first_states(self, data: RecordData, common: NDArray[np.float64]) -> NDArray[np.float64]:
        """States at the start of a record or of its windows, in units of their prior σ, by a few Gauss-Newton steps."""
        count = data.samples
        if not data.windowed:  # the start of the record tells it
            count = min(max(data.record.transient, _BEGIN_SAMPLES), data.samples)
            seen = slice(count + _EDGE)
            part = replace(
                data.record, force=data.record.force[:, seen], responses=data.record.responses[:, seen]
            )
            data = RecordData.of(part)
        short = RecordProblem(self.observations.with_records([data], ()), self.model)
        rms, gains = self.observations.rms, self.model.gains(common)
        offsets, states = self.model.response_offsets(common, rms), len(self._states)
        measured = data.responses.transpose(0, 2, 1)
        x = np.zeros((len(data.starts), states))
        memory = np.eye(states)[len(self.observations.begin_scale) :] * DISCREPANCY
        for _ in range(_ROUNDS):
            motions = short.motions(np.concatenate([common, x.ravel()]), derivatives=True)
            if motions is None:
                return np.zeros(x.size)
            gap = ((measured - motions[0].read * gains - offsets) / rms)[:, :count]
            slope = motions[0].change[:, :count, :, self.model.marched :] * (gains / rms)[:, None]
            for k in range(len(x)):
                matrix = np.concatenate([slope[k].reshape(-1, states), memory])
                right = np.concatenate([gap[k].ravel(), -memory @ x[k]])
                x[k] += np.linalg.lstsq(matrix, right, rcond=1e-8)[0]
        return x.ravel()

    def _rows(
        self,
        data: RecordData,
        motion: Motion,
        gains: NDArray[np.float64],
        place: int,
        count: int,
    ) -> NDArray[np.float64]:
        """Derivatives of a record's lines by all unknowns, (n_windows, n_outputs, n_rows, n)."""
        marched = self.model.marched
        moved = (motion.change * gains[:, None])[:, data.compared].transpose(0, 2, 3, 1)
        lines = data.lines(np.ascontiguousarray(moved)).transpose(0, 1, 3, 2)
        found = np.zeros((*lines.shape[:3], count))
        found[..., :marched] = lines[..., :marched]
        if not data.periodic:
            own = len(self._states)
            for k in range(len(data.starts)):
                found[k, :, :, place + k * own : place + (k + 1) * own] = lines[k, :, :, marched:]
        read = _by_output((motion.read * gains)[:, data.compared])
        ones = np.ones_like(read) * (DISCREPANCY * self.observations.rms)[:, None]
        read, ones = data.lines(read), data.lines(ones)
        for o in range(len(gains)):
            found[:, o, :, self.model.gain_columns.start + o] = read[:, o]
            found[:, o, :, self.model.offset_columns.start + o] = ones[:, o]
        return found

    def _variance(self, data: RecordData, scatters: Mapping[str, float]) -> Variance:
        """Variance of a record's lines at these scatters."""
        o = self.observations
        unit = DISCREPANCY * o.rms[:, None]
        own = np.maximum(data.noise, _LEAST_NOISE * unit)[:, data.band] ** 2
        each = np.array([[scatters[o.noise_name(k, b)] for b in range(BANDS)] for k in range(len(unit))])
        added = ((each * unit) ** 2)[:, data.band]
        level = (DISCREPANCY * data.level) ** 2
        of_response = scatters[SHARE] ** 2 * level
        total = own + added + of_response
        stated = own + unit**2 + o.scatters[SHARE].default ** 2 * level
        return Variance(total, added / total, of_response / total, np.sqrt(total / stated), data.band)

    def _shares(
        self, spread: Sequence[Variance], scatters: Mapping[str, float]
    ) -> dict[str, NDArray[np.float64]]:
        """Share of every scatter in the variance of every row."""
        o = self.observations
        windows = [len(data.starts) for data in o.data]

        def rows(of: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
            return np.concatenate([np.tile(one.ravel(), n) for one, n in zip(of, windows, strict=True)])

        found = {SHARE: rows([v.of_response for v in spread])}
        for k in range(len(o.basis.outputs)):
            for b in range(BANDS):
                parts = []
                for v in spread:
                    share = np.zeros(v.share.shape)
                    share[k] = np.where(v.band == b, v.share[k], 0.0)
                    parts.append(share)
                found[o.noise_name(k, b)] = rows(parts)
        return found


def _by_output(read: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n_windows, n_samples, n_outputs) to (n_windows, n_outputs, n_samples)."""
    return np.ascontiguousarray(read.transpose(0, 2, 1))


@dataclass(frozen=True)
class Variance:
    """Of a window's lines, each (n_outputs, n_rows): the whole, what noise and the response add, σ over the stated."""

    total: NDArray[np.float64]
    share: NDArray[np.float64]
    of_response: NDArray[np.float64]
    relative: NDArray[np.float64]
    band: NDArray[np.int64]
