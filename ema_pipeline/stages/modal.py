"""FRFs → modes with uncertainties, and the circle fits beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.stages.base import Progress, Run, file_hash
from ema_pipeline.stages.frf import without_coherence
from ema_pipeline.stages.hits import accepted_hits

if TYPE_CHECKING:
    from ema_pipeline.modal.types import ModalModel
    from ema_pipeline.pipeline import ModalStageSettings

NAME = "modal"
NEEDS = ("ingest", "hits", "frf")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """What the user chose, and the table of modes where it stands in place of FRFs."""
    table = file_hash(Path(run.info.raw)) if run.info.kind == "modes" else ""
    return table + run.info.choices.of(configuration).of_modes().fingerprint()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Identify the modes, look at each of them with circle fits, and take out what the user excluded."""
    from ema_pipeline.modal.chosen import chosen

    return {"modal": chosen(_identified(run, configuration, progress), run.info.choices.of(configuration))}


def _identified(run: Run, configuration: str, progress: Progress) -> ModalModel:
    from ema_pipeline.correlate.measured import to_modal_model
    from ema_pipeline.correlate.mode_table import read_mode_table
    from ema_pipeline.modal.chosen import wanted
    from ema_pipeline.modal.circle import attach_circles, identify_by_circle
    from ema_pipeline.modal.identify import identify
    from ema_pipeline.modal.moving import identify_hits
    from ema_pipeline.modal.pooling import pooled

    if run.info.kind == "modes":
        measured = read_mode_table(Path(run.info.raw), run.require_model(NAME))
        return to_modal_model(measured[configuration])
    settings = cast("ModalStageSettings", run.settings[NAME])

    def load_frfs() -> FrfSet:
        return without_coherence(run.store, configuration)

    if settings.method == "circle":
        return identify_by_circle(load_frfs(), settings.circle)
    included = run.info.choices.of(configuration).included_modes
    if run.info.kind == "continuous":
        frfs = load_frfs()
        modal = identify(
            frfs, settings.identify, progress, wanted=wanted(included, frfs.response_decay_rad_s)
        )
        return attach_circles(frfs, modal, settings.circle)
    found = identify_hits(
        lambda: accepted_hits(run.store, configuration),
        load_frfs,
        cast(FrfSettings, run.settings["frf"]),
        settings.identify,
        progress,
        included,
    )
    modal = attach_circles(found.frfs, found.modal, settings.circle)
    return pooled(modal, found.alignment, found.frfs.record_s, found.frfs.response_decay_rad_s)
