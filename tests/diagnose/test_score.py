"""What effects promise to first order where they have a direction, or where sizes of a grid are tried."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from imperfect_modes import GOOD, planetary_modes

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose import first_fits
from ema_pipeline.diagnose.first_fits import _best_to_first_order, annealed_fit, first_fit
from ema_pipeline.diagnose.hypotheses import Hypothesis, list_hypotheses
from ema_pipeline.diagnose.score import Marginal, Score, scores
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.observations.fitting import Fit, Model, fit_base, refined, transferred
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.planetary import planetary

RIG = planetary()
STIFF_AXIS = ("bearing_anisotropy@sun", {"relative_stiffness": 0.04, "angle_deg": 50.0})


@cache
def of_rig() -> dict[str, Hypothesis]:
    return {n.label: h for h in list_hypotheses(RIG, shipped_effects()) for n in h.names}


@cache
def fitted(effect: str = "") -> tuple[ModeObservations, Fit]:
    """Modes of an imperfect rig with an effect, and the fit of the model without it at wide scatters."""
    hidden = [STIFF_AXIS] if effect else []
    measured: dict[str, MeasuredModes] = planetary_modes(rig_with_effects(RIG, hidden), 3, GOOD)
    observations = ModeObservations(RIG, [prepare(m) for m in measured.values()])
    return observations, fit_base(observations, Model())


def model_of(label: str) -> Model:
    one = of_rig()[label]
    return Model().plus(one.placed, one.scales)


def begun_near(label: str, effect: str = "", promise: dict[str, Score] | None = None) -> tuple[float, float]:
    """Log evidence that the first fit near the base model gains, and one annealed from usual sizes."""
    observations, base = fitted(effect)
    given = observations, base, {label: model_of(label)}, promise or {}
    near = first_fit(*given, of_rig()[label], near=True)
    far = annealed_fit(*given, {}, of_rig()[label])
    return near.log_evidence - base.log_evidence, far.log_evidence - base.log_evidence


def test_what_a_change_gains_is_what_a_fit_to_first_order_gains() -> None:
    _, base = fitted()
    p = base.posterior
    marginal = Marginal(base)
    rng = np.random.default_rng(1)
    change = rng.standard_normal(len(p.residuals.values))
    values, jacobian = p.residuals.weighted
    whitened = jacobian * p.prior_std

    def least(residuals: np.ndarray) -> float:
        """Half the least sum of squares of residuals and of unknowns in units of their prior."""
        rows = np.vstack([whitened, np.eye(len(p.x))])
        begin = np.concatenate([residuals, p.x / p.prior_std])
        return 0.5 * float(np.linalg.lstsq(rows, -begin, rcond=None)[1][0])

    expected = least(values) - least(values + change * p.residuals.weight)
    assert marginal.gained(change) == pytest.approx(expected, rel=1e-6)
    assert marginal.gained(-0.01 * change) > 0.5 * marginal.gained(-0.02 * change)  # a parabola over its size


def test_a_direction_is_told_by_the_score() -> None:
    """Of a stiff axis at 50° the best of four directions; a fit finds what that promises."""
    observations, base = fitted(STIFF_AXIS[0])
    one = of_rig()[STIFF_AXIS[0]]
    assert one.has_direction
    (score,) = scores(observations, base, [one])
    angle = 90.0 * score.size[1]
    assert angle == 45.0
    problem = model_of(one.label).problem(observations)
    x = transferred(base.posterior, problem.unknowns)
    x[[problem.unknowns.index[n] for n in problem.sizes]] = score.size
    fit = refined(observations, model_of(one.label), x, base.posterior.scatters, steps=40)
    assert score.gain > 3.0
    assert fit.log_evidence - base.log_evidence == pytest.approx(score.gain, rel=0.6)
    near, far = begun_near(one.label, one.label, {one.label: score})
    assert near == pytest.approx(fit.log_evidence - base.log_evidence, abs=0.3)
    assert near > far - 0.3


def test_an_effect_without_a_direction_has_none() -> None:
    has = {h.placed.effect.id for h in of_rig().values() if h.has_direction}
    assert has == {"bearing_anisotropy"}


@pytest.mark.parametrize("label", ["flexible_support@carrier", "flexible_support@sun"])
def test_where_sizes_of_a_grid_promise_nothing_a_fit_is_soon_ended(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where they promise something it is annealed from the best of them."""
    near, far = begun_near(label)
    assert max(near, far) < 1.0
    observations, base = fitted()
    gain, x = _best_to_first_order(observations, base, model_of(label), of_rig()[label])
    assert gain < first_fits.PROMISING
    assert np.all(np.isfinite(x))
    monkeypatch.setattr(first_fits, "PROMISING", gain)
    again, far = begun_near(label)
    assert again == pytest.approx(far, abs=0.2)
