"""The effects that the user added → error fitted and held out, rung by rung."""

from __future__ import annotations

from ema_pipeline.kinds import require_judge
from ema_pipeline.run.models import diagnosis_is_of_other_data
from ema_pipeline.run.types import Progress, Run

NAME = "ladder"
NEEDS = ("modal",)
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Measured with the settings of the diagnosis; the user's own effects take part."""
    alone = "base model" if not run.info.effects and diagnosis_is_of_other_data(run) else ""
    return run.settings.diagnose.model_dump_json() + run.effect_hashes() + alone


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit the base model and every rung above it."""
    return require_judge(run, NAME).ladder(run, progress)
