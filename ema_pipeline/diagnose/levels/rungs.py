"""Fits of the base model and of what is added to it, one effect after the other."""

from __future__ import annotations

from collections.abc import Sequence

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated
from ema_pipeline.diagnose.levels.problem import NoiseFloor
from ema_pipeline.diagnose.levels.search import Growing, again, fit_base, fit_effect, fit_linear
from ema_pipeline.diagnose.progress import Progress
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.errors import EmaError

_FOLLOWED_STEPS = 15


def climb(case: LevelCase, effects: Sequence[str], floor: NoiseFloor, tell: Progress) -> list[Simulated]:
    """Fits of the base model and of every rung above it, at one floor of the noise."""
    models = [fit_base(case, Hypothesis(), floor, {})]
    for i, label in enumerate(effects):
        tell(i / len(effects), f"fitting {label}")
        hypothesis = models[-1].hypothesis.plus(label)
        windows = Growing(case, floor, models[-1])
        if not depends_on_level(label, case.library):
            found = fit_linear(windows, hypothesis, models[-1])
            if found is None:
                raise EmaError(
                    f"'{label}' has no time response, so hits cannot be simulated with it: take it out"
                )
        else:
            found = fit_effect(windows, hypothesis, models[-1])
        models.append(again(case, found, floor, _FOLLOWED_STEPS))
    return models
