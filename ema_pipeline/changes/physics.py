"""Two tests of one rig → which physical effects B has and A has not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ema_pipeline.correlate.matching import match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.types import Candidate, Diagnosis
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import merged
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.pair import A, B, PairObservations, RepeatSettings
from ema_pipeline.run.measured import measured_modes
from ema_pipeline.run.models import known_model, mode_observations
from ema_pipeline.run.types import Run

Progress = Callable[[float, str], None]

_FURTHER_FINALISTS = 2
"""Small changes show only beside learned scatters: two tests repeat far better than is stated."""


@dataclass(frozen=True)
class PhysicalChange:
    """A diagnosis of what differs.

    Attributes
    ----------
    diagnosis : Diagnosis
        Of the pair; its limits are the least changes that these two tests would show.
    reverse : bool
        True where the effect is one that A has and B has not.
    """

    diagnosis: Diagnosis
    reverse: bool = False

    @property
    def claimed(self) -> tuple[Candidate, ...]:
        """Effects that the data support."""
        return tuple(c for c in self.diagnosis.candidates if c.claimed)


def physical_change(
    a: Run, b: Run, progress: Progress = lambda share, text: None, repeat: RepeatSettings | None = None
) -> PhysicalChange:
    """What the rig of two tests is missing in B alone, or else in A alone.

    Many effects have one sign only (a mass is added, a stiffness is lost): what is nothing that B has more than A may
    be something that A has more than B.

    Parameters
    ----------
    a, b : Run
        With one rig, and modes.
    progress : callable
    repeat : RepeatSettings, optional
        What two tests of one structure differ by.

    Raises
    ------
    EmaError
        If the tests have no configuration, or no pair of modes, in common.
    """
    forward = PhysicalChange(_diagnosed(a, b, lambda share, text: progress(0.6 * share, text), repeat))
    if forward.diagnosis.verdict == "effect":
        return forward
    backward = PhysicalChange(
        _diagnosed(b, a, lambda share, text: progress(0.6 + 0.4 * share, text), repeat), reverse=True
    )
    better = backward.claimed and _gain(backward) > _gain(forward) + 1.0
    return backward if better else forward


def _gain(found: PhysicalChange) -> float:
    """Log evidence of all that is claimed."""
    return found.diagnosis.ladder.rungs[-1].log_evidence if found.claimed else 0.0


def _diagnosed(a: Run, b: Run, progress: Progress, repeat: RepeatSettings | None) -> Diagnosis:
    from ema_pipeline.diagnose.diagnosis import diagnose
    from ema_pipeline.threads import single_blas_thread

    model = b.require_model("changes")
    settings = b.settings.diagnose
    settings = settings.model_copy(
        update={"further_finalists": max(settings.further_finalists, _FURTHER_FINALISTS)}
    )
    with single_blas_thread():
        found = diagnose(
            pair_observations(a, b, repeat),
            model,
            b.library,
            known_model(b),
            settings,
            progress,
        )
    return replace(found, candidates=tuple(_as_change(c) for c in found.candidates))


_OF_THE_SENSORS, _OTHERWISE = "sensor_mass", "mass"


def _as_change(c: Candidate) -> Candidate:
    """A mass that came between two tests with the same sensors is called a mass, where it may be either."""
    other = f"{_OTHERWISE}@{c.at}"
    if c.effect != _OF_THE_SENSORS or other not in c.equivalents:
        return c
    names = (c.label, *(e for e in c.equivalents if e != other))
    return replace(c, effect=_OTHERWISE, title="mass at a body", equivalents=names)


def modes_of_both(a: Run, b: Run) -> tuple[dict[str, MeasuredModes], dict[str, MeasuredModes], list[str]]:
    """Measured modes of two runs, and the configurations that both have.

    Raises
    ------
    EmaError
        Where there is none.
    """
    of_a, of_b = measured_modes(a), measured_modes(b)
    common = [c for c in of_a if c in of_b]
    if not common:
        raise EmaError(
            f"{a.info.raw} and {b.info.raw}: no configuration in common ({', '.join(of_a)}; "
            f"{', '.join(of_b)}); compare tests of the same configurations"
        )
    return of_a, of_b, common


def pair_observations(a: Run, b: Run, repeat: RepeatSettings | None = None) -> PairObservations:
    """The modes of two runs as one observation."""
    of_a, of_b, common = modes_of_both(a, b)
    pairs = {c: match_modes(of_a[c], of_b[c]) for c in common}
    if not any((p >= 0).any() for p in pairs.values()):
        raise EmaError(f"{a.store.folder} and {b.store.folder}: no mode of one is a mode of the other")
    first, second = mode_observations(a), mode_observations(b)
    channels = dict(first.channels)
    for point, quality in second.channels.items():
        channels[point] = merged(channels.get(point), quality)
    sensors = tuple(dict.fromkeys((*first.sensors, *second.sensors)))

    def observed(own: ModeObservations, name: str) -> ModeObservations:
        data = [d for d in own.data if d.configuration in common]
        return ModeObservations(first.rig, data, channels, first.shared, sensors, name)

    pairs = {c: p for c, p in pairs.items() if any(d.configuration == c for d in first.data)}
    return PairObservations(observed(first, A), observed(second, B), pairs, a.info.effects, repeat)
