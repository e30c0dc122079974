"""Free-run error of a model in every record: simulated with the measured force alone, from one state at the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.record_problem import RecordProblem
from ema_pipeline.observations.records import RecordObservations

_SHOWN_SAMPLES = 1500
_SHOWN_LINES = 400

UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}


@dataclass(frozen=True)
class RecordError:
    """One response in one record, measured and simulated.

    Attributes
    ----------
    record, use : str
    sensor : Dof
    quantity : str
    rmse : float
        Root mean square of the difference, transient left out, SI.
    relative : float
        Over the root mean square of the response about its mean.
    before : float
        `rmse` of the model without added effects.
    samples : int
        That were compared.
    sample_rate_hz : float
    at_s : float
        Start of the excerpt in the record.
    measured, simulated, linear : ndarray, (n_shown,)
        Excerpt at the largest response: measured, by the last model, by the one without added effects.
    frequency_hz, size, rest, rest_before : ndarray, (n_lines,)
        Amplitude of the response, and of the differences of both models, averaged over neighbouring lines.
    """

    record: str
    use: str
    sensor: Dof
    quantity: str
    rmse: float
    relative: float
    before: float
    samples: int
    sample_rate_hz: float
    at_s: float
    measured: NDArray[np.float64]
    simulated: NDArray[np.float64]
    linear: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    size: NDArray[np.float64]
    rest: NDArray[np.float64]
    rest_before: NDArray[np.float64]

    @property
    def unit(self) -> str:
        """SI unit of the response."""
        return UNITS[self.quantity]


def free_run(
    observations: RecordObservations, models: Sequence[tuple[Model, Mapping[str, float]]]
) -> tuple[RecordError, ...]:
    """Errors of two models in all records, those held out too.

    Parameters
    ----------
    observations : RecordObservations
    models : sequence of (Model, dict of str to float)
        The one without added effects and the last one, each with its fitted unknowns by name.
    """
    found: list[RecordError] = []
    for record in (*(d.record for d in observations.data), *observations.held_out):
        one = observations.with_records([record], ())
        runs = []
        for model, unknowns in models:
            problem = model.problem(one)
            assert isinstance(problem, RecordProblem)
            runs.append(_simulated(one, problem, unknowns))
        found += _errors(one, runs)
    return tuple(found)


def _simulated(
    one: RecordObservations, problem: RecordProblem, unknowns: Mapping[str, float]
) -> NDArray[np.float64]:
    """Readings of a model in one record, (n_samples, n_outputs); NaN where it grows without bound."""
    x = np.zeros(len(problem.unknowns))
    for name, value in unknowns.items():
        if name in problem.unknowns.index:
            x[problem.unknowns.index[name]] = value
    states = problem.unknowns.names[len(problem.model.unknowns) :]
    if states and not any(n in unknowns for n in states):
        x = problem.settled(x)
    motions = problem.motions(x)
    if motions is None:
        return np.full(one.data[0].record.responses.T.shape, np.nan)
    common = x[: len(problem.model.unknowns)]
    return motions[0].read[0] * problem.model.gains(common) + problem.model.response_offsets(common, one.rms)


def _errors(one: RecordObservations, runs: Sequence[NDArray[np.float64]]) -> list[RecordError]:
    """Every response of one record."""
    data = one.data[0]
    record, part = data.record, data.compared
    linear, last = runs
    found = []
    for o, channel in enumerate(record.channels):
        measured = record.responses[o]
        gaps = [(measured - r[:, o])[part] for r in (linear, last)]
        rmse = [float(np.sqrt(np.mean(g**2))) for g in gaps]
        shown = _excerpt(measured, part)
        frequency, lines = _smoothed(
            np.stack([measured[part] - np.mean(measured[part]), *gaps]), record.sample_rate_hz
        )
        found.append(
            RecordError(
                record=record.name,
                use=record.use,
                sensor=one.basis.outputs[o],
                quantity=channel.quantity,
                rmse=rmse[1],
                relative=rmse[1] / max(float(np.std(measured[part])), 1e-300),
                before=rmse[0],
                samples=len(gaps[0]),
                sample_rate_hz=record.sample_rate_hz,
                at_s=shown.start / record.sample_rate_hz,
                measured=measured[shown],
                simulated=last[shown, o],
                linear=linear[shown, o],
                frequency_hz=frequency,
                size=lines[0],
                rest_before=lines[1],
                rest=lines[2],
            )
        )
    return found


def _excerpt(measured: NDArray[np.float64], part: slice) -> slice:
    """A stretch about the largest response."""
    start = part.start or 0
    centre = start + int(np.argmax(np.abs(measured[start:])))
    first = int(np.clip(centre - _SHOWN_SAMPLES // 2, start, max(len(measured) - _SHOWN_SAMPLES, start)))
    return slice(first, min(first + _SHOWN_SAMPLES, len(measured)))


def _smoothed(signals: NDArray[np.float64], rate: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Amplitudes, root mean square within groups of lines, (n_signals, n_lines)."""
    count = signals.shape[1]
    size = np.abs(np.fft.rfft(signals * np.hanning(count), axis=1))[:, 1:] * 4 / count
    width = max(size.shape[1] // _SHOWN_LINES, 1)
    kept = size.shape[1] // width * width
    grouped = size[:, :kept].reshape(len(size), -1, width)
    frequency = (np.arange(grouped.shape[1]) * width + (width + 1) / 2) * rate / count
    return frequency, np.sqrt(np.mean(grouped**2, axis=2))
