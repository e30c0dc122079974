"""FRFs → modes with uncertainties, and the circle fits beside them."""

from __future__ import annotations

from pathlib import Path

from ema_pipeline.files import file_hash
from ema_pipeline.kinds import kind_of
from ema_pipeline.run.types import Progress, Run

NAME = "modal"
NEEDS = ("ingest", "hits", "frf")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """What the user chose, and the file of the modes where they are not made of FRFs."""
    table = "" if "frf" in kind_of(run.info).measures else file_hash(Path(run.info.raw))
    return table + run.info.choices.of(configuration).of_modes().fingerprint()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Identify the modes, look at each of them with circle fits, and take out what the user excluded."""
    from ema_pipeline.modal.chosen import chosen

    found = kind_of(run.info).modes(run, configuration, progress)
    return {"modal": chosen(found, run.info.choices.of(configuration))}
