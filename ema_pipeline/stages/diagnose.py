"""What was measured, and the model → which physics the model is missing."""

from __future__ import annotations

from ema_pipeline.kinds import require_judge
from ema_pipeline.run.types import Progress, Run

NAME = "diagnose"
NEEDS = ("frf", "modal")
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """The user's own effects take part."""
    return run.effect_hashes()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit every effect of the library on top of the current model, and judge what the data support."""
    return require_judge(run, NAME).diagnose(run, progress) | {"choices": run.info.choices}
