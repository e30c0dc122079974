"""The diagnosis of level-dependent effects in plain sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ema_pipeline.diagnose.explain import label_text
from ema_pipeline.diagnose.levels.ladder import LevelErrors


def misfit_text(forces_n: Sequence[float], errors: LevelErrors) -> str:
    """``0.8 % at 30 N, 21 % at 300 N``, of held-out levels where there are any."""
    values = np.where(np.isfinite(errors.heldout_misfit), errors.heldout_misfit, errors.misfit)
    return ", ".join(
        f"{100 * v:.2g} % at {f:.3g} N" for f, v in zip(forces_n, values, strict=True) if np.isfinite(v)
    )


def why(signs: str, forces_n: Sequence[float], before: LevelErrors, after: LevelErrors) -> str:
    """Tell-tale signs, and how much nearer the simulated hits come."""
    fall = before.misfit - after.misfit
    k = int(np.nanargmax(fall))
    if not fall[k] > 1e-4:
        return f"Its signs: {signs}. No measured hit is simulated better with it."
    return (
        f"Its signs: {signs}. The simulated hits come nearer to the measured ones, most at {forces_n[k]:.3g} N: "
        f"{100 * before.misfit[k]:.2g} % of the signal was missed without it, {100 * after.misfit[k]:.2g} % with it."
    )


def names(labels: Sequence[str]) -> str:
    """Labels as phrases."""
    return ", ".join(label_text(label) for label in labels)
