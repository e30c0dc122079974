"""Measured modes of a run as observations, and its models: with the effects that the user added, and fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.effects.base import Effect
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import uncertainty_of_dofs
from ema_pipeline.observations.fitting import Model, model_with
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.reach import within_reach
from ema_pipeline.rigs.types import Rig
from ema_pipeline.run.measured import (
    level_studies,
    measured_frfs,
    measured_modes,
    modes_key,
    modes_of_structure,
)
from ema_pipeline.run.types import Run
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    from ema_pipeline.correlate.types import Comparison, Pairing
    from ema_pipeline.fit.parameters import FittedModes
    from ema_pipeline.observations.amplitude import AmplitudeObservations


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
    measured, frfs = measured_modes(run), measured_frfs(run)
    channels = uncertainty_of_dofs((frfs.get(name), modes.dofs) for name, modes in measured.items())
    data = [within_reach(prepare(m, run.settings.fit), rig) for m in measured.values()]
    return ModeObservations(rig, data, channels)


def amplitude_observations(run: Run) -> AmplitudeObservations | None:
    """Modes and hits of all configurations; None where none was struck at several levels."""
    from ema_pipeline.levels.harmonics import may_be_products
    from ema_pipeline.observations.amplitude import AmplitudeObservations
    from ema_pipeline.observations.hit_data import prepare_hits

    hits, products = [], {}
    for name, study in level_studies(run).items():
        if study.hit_modes is None:
            continue
        modal = modes_of_structure(run, name)
        forces = [level.force_n for level in study.levels]
        data = prepare_hits(
            name, study.hit_modes, modal, forces, study.linear_level, study.clearly_level_dependent, run.rig
        )
        if data is not None:
            hits.append(data)
            products[name] = may_be_products(modal.modes)
    if not hits:
        return None
    modes = mode_observations(run)
    marked = [  # modes that are not compared are the last ones
        replace(d, product=products[d.configuration][: len(d)] if d.configuration in products else None)
        for d in modes.data
    ]
    return AmplitudeObservations(modes.with_data(marked), hits)


def known_model(run: Run, hits: AmplitudeObservations | None = None) -> Model:
    """The model with the effects that the user added, see `model_with`."""
    assert run.rig is not None
    return model_with(run.info.effects, run.rig, library_of(run, hits), with_hits=hits is not None)


def library_of(run: Run, hits: AmplitudeObservations | None) -> Mapping[str, Effect]:
    """The run's library, nonlinear springs with the sizes to expect where hits struck with several forces."""
    from ema_pipeline.observations.sizes_in_hits import sized_by_hits

    return run.library if hits is None else sized_by_hits(run.library, hits.hits)


def correlate(
    run: Run, rig: Rig, fitted: FittedModes, with_frfs: bool = True
) -> tuple[dict[str, Pairing], Comparison]:
    """Pair the measured modes with those of a fitted model, and compare the two."""
    from ema_pipeline.correlate.pairing import pair_system
    from ema_pipeline.fit.comparison import compare

    settings, measured = run.settings.correlate, measured_modes(run)
    pairings = {
        name: pair_system(rig, fitted.system(name), modes, settings.pairing)
        for name, modes in measured.items()
    }
    return pairings, compare(
        fitted, measured, measured_frfs(run) if with_frfs else None, pairings, settings.compare
    )


def diagnosed_scatters(run: Run) -> dict[str, float]:
    """The scatters at which the diagnosis compares models, so that one model has one error; empty without one."""
    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    return {} if found is None else {s.name: s.learned for s in found.ladder.scatters}


def diagnosed_choices(run: Run) -> Choices:
    """What the user had excluded and included when the diagnosis was made; as it is now where there is none."""
    if not run.store.key("diagnose", ALL):
        return run.info.choices
    return run.store.find("diagnose", ALL, "choices", Choices) or NO_CHOICES


def diagnosis_is_of_other_data(run: Run) -> bool:
    """True where hits or modes were excluded or included since the diagnosis."""
    return diagnosed_choices(run) != run.info.choices


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
