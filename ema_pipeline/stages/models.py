"""Measured modes of a run as observations, and its models: with the effects that the user added, and fitted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from ema_pipeline.effects.library import depends_on_level, parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.parameters import FittedModes, restored
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import FitResult
from ema_pipeline.frf.channels import ChannelQuality, channel_uncertainty, merged
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.modes import ModeObservations, prepare
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Run
from ema_pipeline.stages.modes import measured_frfs, measured_modes


def mode_observations(run: Run) -> ModeObservations:
    """The measured modes of all configurations.

    Raises
    ------
    EmaError
        If the run has no rig.
    """
    if run.rig is None:
        raise EmaError(f"{run.store.folder}: this needs a model; run again with --rig")
    settings = cast(FitSettings, run.settings["fit"])
    measured = measured_modes(run)
    frfs = measured_frfs(run)
    channels: dict[str, ChannelQuality] = {}
    for name, modes in measured.items():
        for dof in modes.dofs:
            quality = channel_uncertainty(frfs.get(name), dof)
            channels[dof.point] = merged(channels.get(dof.point), quality)
    return ModeObservations(run.rig, [prepare(m, settings) for m in measured.values()], channels)


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


def fitted_modes(run: Run, fit: FitResult) -> FittedModes:
    """The fitted model of stored results."""
    return restored(mode_observations(run), known_model(run), fit)
