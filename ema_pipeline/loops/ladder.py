"""The ladder of an isolator: linear spring, plus one effect, plus another, with errors on seen and unseen loops."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ema_pipeline.diagnose.types import EffectSize, Ladder, Rung
from ema_pipeline.errors import EmaError
from ema_pipeline.loops.effects import PARAMETERS, Structure, effect_ids, label_of
from ema_pipeline.loops.fitting import Fitted, loop_set
from ema_pipeline.loops.heldout import folds, heldout_error, settings_differ
from ema_pipeline.loops.identify import loop_fits
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.model import SPRING_GAP, STIFFNESS, UNITS
from ema_pipeline.loops.search import fit_variants, log_evidence, widening_of
from ema_pipeline.loops.settings import HysteresisSettings
from ema_pipeline.loops.types import Loop, LoopModel
from ema_pipeline.threads import single_blas_thread

Progress = Callable[[float, str], None]

RICH = Structure(tuple(e for e in PARAMETERS if e != "relaxation"))
"""What the misfit that any model leaves is measured with."""


def together(loops: Sequence[Loop], settings: HysteresisSettings) -> LoopSet:
    """Loops to be explained by one model.

    Raises
    ------
    EmaError
        Without loops.
    """
    if not loops:
        raise EmaError("no loops to explain; record steady sine tests")
    own = settings.own_scales == "yes" or (
        settings.own_scales == "auto" and settings_differ(loops, settings.significance)
    )
    return loop_set(loops, RICH, own and len(loops) > 1)


def folds_of(loops: LoopSet, settings: HysteresisSettings) -> tuple[tuple[int, ...], ...]:
    """Loops to leave out, fold by fold."""
    return folds(loops.loops, settings.held_out_parts, settings_differ=loops.own_scale)


def make_loop_ladder(
    loops: Sequence[Loop],
    effects: Sequence[str],
    settings: HysteresisSettings | None = None,
    progress: Progress | None = None,
) -> tuple[Ladder, tuple[LoopModel, ...]]:
    """The ladder that adds effects one after the other, and every rung's loops.

    Parameters
    ----------
    loops : sequence of Loop
    effects : sequence of str
        Labels ``id@isolator`` in the order of the rungs; empty for the linear spring alone.
    settings : HysteresisSettings, optional
    progress : callable, optional

    Returns
    -------
    Ladder
        len(effects) + 1 rungs.
    tuple of LoopModel
        The same models beside the measured loops.

    Raises
    ------
    EmaError
        Without loops, and for effects that a loop does not show.
    """
    settings = settings or HysteresisSettings()
    tell = progress or (lambda share, text: None)
    ids = effect_ids(effects)
    with single_blas_thread():
        cases = together(loops, settings)
        models: list[Fitted] = []
        for count in range(len(ids) + 1):
            tell(0.5 * count / (len(ids) + 1), f"fitting {ids[count - 1] if count else 'the linear spring'}")
            start = models[-1].values if models else None
            models.append(fit_variants(cases, Structure(ids[:count]), start))
        ladder = assemble(
            cases, models, widening_of(models[-1], cases), folds_of(cases, settings), "", tell, start=0.5
        )
        return ladder, tuple(loop_model(cases, m) for m in models)


def assemble(
    loops: LoopSet,
    models: Sequence[Fitted],
    widening: float,
    left_out: Sequence[Sequence[int]],
    note: str,
    tell: Progress,
    start: float = 0.0,
    skipped: Sequence[str] = (),
) -> Ladder:
    """Rungs of fitted models, the poorest first; `skipped` are effects of the base, which no rung names."""
    rungs = []
    base = log_evidence(loops, models[0], widening)
    for i, model in enumerate(models):
        tell(start + (1 - start) * i / len(models), "predicting loops held out")
        rungs.append(
            Rung(
                effects=tuple(label_of(e) for e in model.structure.effects if e not in skipped),
                error=error_of(loops, model),
                heldout_error=heldout_error(loops, model, left_out),
                chi2=model.chi2,
                objective=model.chi2 / widening,
                parameters=sizes(model, widening),
                log_evidence=log_evidence(loops, model, widening) - base,
                unexplained=0,
            )
        )
    return Ladder(tuple(rungs), 0.0, 0.0, 0.0, note)


def error_of(loops: LoopSet, fitted: Fitted) -> float:
    """Root-mean-square residual in standard deviations of the force."""
    return float(np.sqrt(fitted.chi2 / loops.freedom))


def sizes(fitted: Fitted, widening: float) -> dict[str, EffectSize]:
    """All parameters: the rig's ``stiffness``, and those of the effects as ``id@isolator.name``."""
    known = known_sizes(fitted, widening)
    found = {STIFFNESS: known[STIFFNESS]}
    for effect in fitted.structure.effects:
        found |= {f"{label_of(effect)}.{n}": s for n, s in effect_sizes(known, effect).items()}
    return found


def known_sizes(fitted: Fitted, widening: float) -> dict[str, EffectSize]:
    """All parameters by their names in the loop's model."""
    std = np.sqrt(np.maximum(np.diag(fitted.covariance(widening)), 0.0))
    return {
        name: EffectSize(fitted.values[name], float(s), UNITS[name])
        for name, s in zip(fitted.names, std, strict=True)
    }


def effect_sizes(known: dict[str, EffectSize], effect: str) -> dict[str, EffectSize]:
    """Sizes of one effect, by its own names of its parameters."""
    found = {own: known[name] for own, name in PARAMETERS[effect].items() if name in known}
    if effect == "backlash" and SPRING_GAP in known:
        found["gap"] = known[SPRING_GAP]
    return found


def loop_model(loops: LoopSet, fitted: Fitted) -> LoopModel:
    """A model beside the measured loops."""
    scales = {}
    if loops.own_scale:
        scales = {one.name: float(s) for one, s in zip(loops.loops, fitted.scales, strict=True)}
    return LoopModel(tuple(label_of(e) for e in fitted.structure.effects), loop_fits(loops, fitted), scales)
