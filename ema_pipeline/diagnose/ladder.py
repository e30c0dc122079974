"""The ladder of models: base model, plus one effect, plus another, each with its error on seen and unseen data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.fitting import Case, Fitted, fit_hypothesis, fit_null, ground, refit
from ema_pipeline.diagnose.heldout import HeldOut, error_of, held_out
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.noise import NoiseLevel, estimate_noise
from ema_pipeline.diagnose.progress import Progress
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import EffectSize, Ladder, Rung
from ema_pipeline.diagnose.witness import Witness, frf_lines
from ema_pipeline.effects.library import Library
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import Optimum
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.types import Rig
from ema_pipeline.threads import single_blas_thread


@dataclass(frozen=True)
class Yardstick:
    """What all rungs of a ladder are measured with.

    Attributes
    ----------
    fit : FitSettings
        At the noise level.
    counted : ndarray of bool, (R,)
        Measured modes that at least one model explains that is worth a look.
    outlier_cost : ndarray, (R,)
        What a mode without partner counts at least.
    prior_count : int
        Nominal values of the base model.
    """

    fit: FitSettings
    counted: NDArray[np.bool_]
    outlier_cost: NDArray[np.float64]
    prior_count: int

    def unpaired(self, fitted: Fitted) -> NDArray[np.float64]:
        """What each measured mode costs where it has no partner."""
        return np.maximum(self.outlier_cost, fitted.alone)

    def error(self, fitted: Fitted) -> float:
        """Error on the data that the model was fitted to."""
        return error_of(
            fitted.costs,
            fitted.counts,
            self.unpaired(fitted),
            self.counted,
            fitted.prior_cost,
            self.prior_count,
        )

    def heldout_error(self, fitted: Fitted, out: HeldOut) -> float:
        """Error on data that the fits had not seen."""
        return error_of(
            out.modes, fitted.counts, self.unpaired(fitted), self.counted, sum(out.parameters.values()),
            self.prior_count,
        )  # fmt: skip

    def heldout_score(self, out: HeldOut) -> float:
        """-2 log of how probable the unseen data were, a lost mode counting as one of any shape anywhere.

        Unlike the error it is not ruled by the mode that is predicted worst: where two effects are missing, the first
        one mends some modes and leaves others as wrong as they were.
        """
        lost = np.where(np.isfinite(out.modes), out.modes, np.inf)
        return float(np.sum(np.minimum(lost, self.outlier_cost)[self.counted]) + sum(out.parameters.values()))


def yardstick(case: Case, fit: FitSettings, models: Sequence[Fitted]) -> Yardstick:
    """The yardstick for some models of one case, the base model first."""
    counted = np.any([m.explained for m in models], axis=0)
    problem = case.problem(Hypothesis(), fit)
    return Yardstick(fit, counted, problem.mixture().outlier_cost, models[0].prior_count)


def make_rung(case: Case, stick: Yardstick, base: Fitted, fitted: Fitted, folds: int) -> Rung:
    """A rung, held-out error included."""
    out = held_out(case, fitted, stick.fit, folds)
    units = {p.name: p.unit for p in case.problem(fitted.hypothesis, stick.fit).rig.parameters.values()}
    sizes = {n: EffectSize(v, fitted.std[n], units[n]) for n, v in fitted.values.items()}
    paired = stick.counted & np.isfinite(fitted.costs)
    return Rung(
        effects=fitted.hypothesis.labels,
        error=stick.error(fitted),
        heldout_error=stick.heldout_error(fitted, out),
        chi2=float(np.sum(fitted.costs[paired])) + fitted.prior_cost,
        objective=fitted.objective,
        parameters=sizes,
        log_evidence=float(-0.5 * (fitted.evidence - base.evidence)),
        unexplained=int(np.sum(~fitted.explained)),
    )


def noise_of(case: Case, fitted: Fitted) -> NoiseLevel:
    """Noise level that a model fitted at the floors leaves."""
    problem = case.problem(fitted.hypothesis, case.settings.fit)
    found = Optimum(problem.space.point(fitted.values), fitted.objective, fitted.costs, fitted.inlier, "")
    return estimate_noise(problem, found, case.settings.noise_least)


def make_ladder(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    effects: Sequence[str],
    settings: DiagnoseSettings | None = None,
    library: Library | None = None,
    progress: Progress | None = None,
    frfs: Mapping[str, FrfSet] | None = None,
) -> Ladder:
    """The ladder that adds `effects` one after the other.

    Parameters
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
    effects : sequence of str
        Labels ``id@place`` (or ``out_of_tolerance@parameter``) in the order of the rungs; empty for the base
        model alone.
    settings : DiagnoseSettings, optional
    library : mapping of id to Effect, optional
    progress : callable, optional
    frfs : mapping of configuration to FrfSet, optional
        A second witness, see `diagnose.witness`.

    Returns
    -------
    Ladder
        len(effects) + 1 rungs, all at the noise level that the best of them leaves.

    Raises
    ------
    EmaError
        For unknown effects and places, an effect named twice, or no measured modes.
    """
    case = Case(rig, dict(measured), settings or DiagnoseSettings(), library)
    tell = progress or (lambda share, text: None)
    if len(set(effects)) != len(effects):
        raise EmaError(f"effect named twice in {', '.join(effects)}; name each once")
    with single_blas_thread():
        plain = fitted_rungs(case, effects, case.settings.fit, tell)
        best = min(plain, key=lambda f: f.evidence)
        level = noise_of(case, best)
        tell(0.6, "noise level")
        fit = level.applied(case.settings.fit)
        final = [refit(case, f.hypothesis, fit, f.values) for f in plain]
        witness = Witness(case, frf_lines(frfs or {}, case.measured))
        return with_frfs(assemble_ladder(case, final, level, "", tell), final, witness)


def fitted_rungs(case: Case, effects: Sequence[str], fit: FitSettings, tell: Progress) -> list[Fitted]:
    """Fits of the base model and of every rung above it."""
    models = [fit_null(case, Hypothesis(), fit, None)]
    for i, label in enumerate(effects):
        tell(0.1 + 0.4 * i / len(effects), f"fitting {label}")
        last = models[-1]
        models.append(fit_hypothesis(case, last.hypothesis.plus(label), fit, ground(case, last, fit)))
    return models


def assemble_ladder(
    case: Case, models: Sequence[Fitted], level: NoiseLevel, note: str, tell: Progress,
    also: Sequence[Fitted] = (),
) -> Ladder:  # fmt: skip
    """Rungs of fitted models; `also` are further models that may explain modes which these do not."""
    stick = yardstick(case, level.applied(case.settings.fit), [*models, *also])
    rungs = []
    for i, m in enumerate(models):
        tell(0.6 + 0.4 * i / len(models), "predicting held-out data")
        rungs.append(make_rung(case, stick, models[0], m, case.settings.folds))
    return Ladder(tuple(rungs), level.frequency, level.damping, level.shape, note)


def with_frfs(ladder: Ladder, models: Sequence[Fitted], witness: Witness) -> Ladder:
    """The ladder with what the FRFs say of each of its models."""
    rungs = zip(ladder.rungs, models, strict=True)
    return replace(ladder, rungs=tuple(replace(r, frf_error=witness.error(m).error) for r, m in rungs))
