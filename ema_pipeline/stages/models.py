"""Measured modes of a run as observations, and its models: with the effects that the user added, and fitted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.effects.library import depends_on_level, parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf.channels import ChannelQuality, channel_uncertainty, merged
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Run
from ema_pipeline.stages.modes import measured_frfs, measured_modes, modes_key
from ema_pipeline.store import ALL


def mode_observations(run: Run) -> ModeObservations:
    """The measured modes of all configurations.

    Raises
    ------
    EmaError
        If the run has no rig.
    """
    if run.rig is None:
        raise EmaError(f"{run.store.folder}: this needs a model; run again with --rig")
    at = ("observations", modes_key(run))
    if at not in run.memory:
        run.memory[at] = _mode_observations(run, run.rig)
    return cast(ModeObservations, run.memory[at])


def _mode_observations(run: Run, rig: Rig) -> ModeObservations:
    settings = cast(FitSettings, run.settings["fit"])
    measured = measured_modes(run)
    frfs = measured_frfs(run)
    channels: dict[str, ChannelQuality] = {}
    for name, modes in measured.items():
        for dof in modes.dofs:
            quality = channel_uncertainty(frfs.get(name), dof)
            channels[dof.point] = merged(channels.get(dof.point), quality)
    return ModeObservations(rig, [prepare(m, settings) for m in measured.values()], channels)


def model_with(
    run: Run, rig: Rig, labels: Sequence[str], model: Model | None = None, with_hits: bool = False
) -> Model:
    """A model with effects ``id@place`` added.

    Parameters
    ----------
    run : Run
        Holds the user's own effects.
    rig : Rig
        With the effects that `model` has.
    labels : sequence of str
    model : Model, optional
        What the effects are added to; the base model where left out.
    with_hits : bool
        False leaves out effects that depend on the force level: modes of one level do not show them.
    """
    model = model or Model()
    for label in labels:
        if not with_hits and depends_on_level(label, run.library):
            continue
        placed = parse_effect(label, rig, library=run.library)
        scales: dict[str, float] = {}
        for configuration in rig.configurations:
            assembly = rig.assembly(configuration)
            if placed.effect.fits(assembly, placed.place):
                scales = {
                    placed.parameter_name(k): v
                    for k, v in placed.effect.scales(assembly, placed.place).items()
                }
                break
        model = model.plus(placed, scales)
    return model


def known_model(run: Run, with_hits: bool = False) -> Model:
    """The model with the effects that the user added, see `model_with`."""
    assert run.model is not None
    return model_with(run, run.model, run.info.effects, with_hits=with_hits)


def diagnosed_scatters(run: Run) -> dict[str, float]:
    """The scatters at which the diagnosis compares models, so that one model has one error; empty without one."""
    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    return {} if found is None else {s.name: s.learned for s in found.ladder.scatters}


def diagnosed_choices(run: Run) -> Choices:
    """What the user had excluded and included when the diagnosis was made; as it is now where there is none."""
    if not run.store.key("diagnose", ALL):
        return run.info.choices
    return run.store.find("diagnose", ALL, "choices", Choices) or NO_CHOICES


def rung_unknowns(ladder: Ladder | None, effects: Sequence[str]) -> dict[str, float]:
    """Unknowns of the ladder's model with these effects; empty where it has none."""
    rungs = () if ladder is None else ladder.rungs
    return next((r.unknowns for r in rungs if r.effects == tuple(effects)), {})


def earlier_unknowns(run: Run, effects: Sequence[str]) -> dict[str, float]:
    """Unknowns of the model with these effects from the diagnosis of the same modes; else of an earlier base fit.

    Empty where there is neither.
    """
    found = (
        run.store.find("diagnose", ALL, "diagnosis", Diagnosis) if _of_these_modes(run, "diagnose") else None
    )
    told = {} if found is None else rung_unknowns(found.ladder, effects)
    return told or ({} if effects else base_unknowns(run))


def base_unknowns(run: Run) -> dict[str, float]:
    """Unknowns of an earlier fit of the base model to the same modes; empty where there is none."""
    known = run.store.find("fit", ALL, "base_unknowns", dict[str, float])
    return known if known and _of_these_modes(run, "fit") else {}


def _of_these_modes(run: Run, stage: str) -> bool:
    """True where a stage's results were made of the measured modes as they are now."""
    return run.store.find(stage, ALL, "modes_key", str) == modes_key(run)
