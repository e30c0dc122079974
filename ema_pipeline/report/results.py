"""Everything that a report can show; what was not done yet is None or empty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ema_pipeline.check_result import CheckResult
from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.diagnose.hysteresis_loop import HysteresisLoop
from ema_pipeline.diagnose.types import Diagnosis, Ladder, Rung
from ema_pipeline.fit.types import FitResult
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Hit, Transducer
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.loops.types import IsolatorResult, Loop, LoopModel
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.observations.free_run import RecordError


@dataclass(frozen=True)
class ConfigurationResults:
    """Results of one configuration.

    Attributes
    ----------
    name : str
    hits : tuple of Hit
        All hits that were found, with their verdicts.
    frfs, modal, pairing : FrfSet, ModalModel, Pairing or None
        None where the stage has not run.
    system : LinearSystem or None
        The model that `pairing` was made with; its `dofs` and `sensors` turn the model's shapes into
        what the sensors read. Without it only the measured shapes are drawn.
    transducers : tuple of Transducer
        As the test's description states them.
    base_system : LinearSystem or None
        The fitted model without any added effect.
    system_after : LinearSystem or None
        The fitted model with the effects that the diagnosis found.
    like_parts : tuple of LinearSystem or None
        The base model, the current model and the one that the diagnosis proposes, all like parts being alike.
    levels : LevelStudy or None
        What moves with the force of the hits.
    driven : int
        Records of continuous excitation.
    """

    name: str
    hits: tuple[Hit, ...] = ()
    frfs: FrfSet | None = None
    modal: ModalModel | None = None
    pairing: Pairing | None = None
    system: LinearSystem | None = None
    levels: LevelStudy | None = None
    transducers: tuple[Transducer, ...] = ()
    base_system: LinearSystem | None = None
    system_after: LinearSystem | None = None
    like_parts: tuple[LinearSystem | None, ...] = (None, None, None)
    driven: int = 0


@dataclass(frozen=True)
class LoopResults:
    """Results of a test of force-displacement loops.

    Attributes
    ----------
    isolators : mapping of str to IsolatorResult
        By configuration.
    loops : tuple of Loop
        Of all configurations.
    models : tuple of LoopModel
        Of the ladder, the linear spring first; empty before there was one.
    """

    isolators: Mapping[str, IsolatorResult]
    loops: tuple[Loop, ...]
    models: tuple[LoopModel, ...] = ()

    @property
    def compared(self) -> tuple[LoopModel, ...]:
        """The linear spring and the last model, once where they are the same."""
        return self.models if len(self.models) < 2 else (self.models[0], self.models[-1])


@dataclass(frozen=True)
class RunResults:
    """Results of one run over one or several configurations.

    Attributes
    ----------
    title : str
    rig : str or None
    configurations : tuple of ConfigurationResults
    fit : FitResult or None
    comparison : Comparison or None
        Of the current model.
    comparison_base : Comparison or None
        Of the modes with the base model, where effects were added.
    comparison_after : Comparison or None
        Of the model with the effects that the diagnosis found, where it was made.
    diagnosis : Diagnosis or None
    deviations : tuple of dict of str to float
        How far everything uncertain had to move from what is stated, in σ: of the base model, the current model,
        and the one that the diagnosis proposes.
    added : tuple of str
        Effects that the user added, ``id@place``.
    diagnosed_on : tuple of str
        Effects of the model that the diagnosis was made of.
    folder : str
        Results folder, as a user would type it.
    ladder : Ladder or None
        Of the effects that the user added; without it that of the diagnosis is shown.
    provenance : mapping of str to str
        Versions, files, hashes, dates: what a reader needs to do the run again.
    settings : mapping of str to mapping
        Stage to its settings, as text.
    choices, diagnosed_choices : Choices
        Hits and modes that the user excluded or included: now, and when the diagnosis was made.
    simulation : tuple of RecordError
        Free-run errors in the records of a continuous test; empty where none were simulated.
    not_diagnosed : str
        Why nothing was diagnosed; empty where it was, or was not asked for.
    hysteresis : tuple of HysteresisLoop
        Loops of Bouc-Wen elements that records were simulated with.
    loops : LoopResults or None
        Of a test of force-displacement loops.
    sensitivities : tuple of CheckResult
        Channels whose scale or sign the model contradicts, see `fit.channel_faults`.
    missing_files : tuple of str
        Files of results in the folder that are no longer there.
    effect_files : tuple of str
        Files with the user's own effects that were named in this call, as a user would type them. No command that is
        shown names another one, since results may come from a stranger.
    """

    title: str
    rig: str | None = None
    configurations: tuple[ConfigurationResults, ...] = ()
    fit: FitResult | None = None
    comparison: Comparison | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    ladder: Ladder | None = None
    comparison_after: Comparison | None = None
    sensitivities: tuple[CheckResult, ...] = ()
    comparison_base: Comparison | None = None
    deviations: tuple[dict[str, float], ...] = ({}, {}, {})
    added: tuple[str, ...] = ()
    diagnosed_on: tuple[str, ...] = ()
    choices: Choices = NO_CHOICES
    diagnosed_choices: Choices = NO_CHOICES
    folder: str = ""
    simulation: tuple[RecordError, ...] = ()
    not_diagnosed: str = ""
    hysteresis: tuple[HysteresisLoop, ...] = ()
    loops: LoopResults | None = None
    missing_files: tuple[str, ...] = ()
    effect_files: tuple[str, ...] = ()

    @property
    def diagnosis_is_old(self) -> bool:
        """True where effects, hits or modes were added or taken out since the diagnosis was made."""
        then, now = (self.diagnosed_on, self.diagnosed_choices), (self.added, self.choices)
        return self.diagnosis is not None and now != then

    @property
    def provisional(self) -> bool:
        """True where the model in use lacks something, so that its values hold only for a model that lacks nothing.

        A diagnosis of this model decides: it judges by single hits, too, and a fit may bend parts to the data.
        """
        if self.fit is None:
            return False
        told = "" if self.diagnosis is None or self.diagnosis_is_old else self.diagnosis.verdict
        return (
            self.fit.error > self.fit.error_limit if told in ("", "not_enough_data") else told != "adequate"
        )

    @property
    def current_rung(self) -> Rung | None:
        """The model in use as a ladder has it; None where no ladder holds just its effects."""
        rungs = () if self.shown_ladder is None else self.shown_ladder.rungs
        return next((r for r in rungs if r.effects == self.added), None)

    @property
    def shown_ladder(self) -> Ladder | None:
        """The user's own ladder, or else the diagnosis's."""
        if self.ladder is not None:
            return self.ladder
        return None if self.diagnosis is None else self.diagnosis.ladder
