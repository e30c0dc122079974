"""Everything that a report can show; what was not done yet is None or empty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.fit.types import FitResult
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Hit
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import ModalModel


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
    levels : LevelStudy or None
        What moves with the force of the hits.
    """

    name: str
    hits: tuple[Hit, ...] = ()
    frfs: FrfSet | None = None
    modal: ModalModel | None = None
    pairing: Pairing | None = None
    system: LinearSystem | None = None
    levels: LevelStudy | None = None


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
        Of the model as it stands.
    comparison_after : Comparison or None
        Of the model with the effects that the diagnosis found, where it was made.
    diagnosis : Diagnosis or None
    ladder : Ladder or None
        Of the effects that the user added; without it that of the diagnosis is shown.
    warnings : tuple of str
        One plain sentence each.
    provenance : mapping of str to str
        Versions, files, hashes, dates: what a reader needs to do the run again.
    settings : mapping of str to mapping
        Stage to its settings, as text.
    """

    title: str
    rig: str | None = None
    configurations: tuple[ConfigurationResults, ...] = ()
    fit: FitResult | None = None
    comparison: Comparison | None = None
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    ladder: Ladder | None = None
    comparison_after: Comparison | None = None

    @property
    def shown_ladder(self) -> Ladder | None:
        """The user's own ladder, or else the diagnosis's."""
        if self.ladder is not None:
            return self.ladder
        return None if self.diagnosis is None else self.diagnosis.ladder
