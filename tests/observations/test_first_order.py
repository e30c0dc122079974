"""Effects that are not there yet, all at one point of the model, against the problem with each of them alone."""

from __future__ import annotations

import numpy as np
import pytest
from imperfect_modes import GOOD, Hidden, planetary_modes

from ema_pipeline.diagnose.hypotheses import list_hypotheses
from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.observations.fitting import Model, refined, transferred
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.planetary import planetary


@pytest.mark.parametrize(
    ("has", "rounding"),
    # damped modes are told from the undamped ones, among which those of rigid bodies may be any of their sums
    [(None, 1e-6), (("local_damper@planet1", 60.0), 2e-3)],
)
def test_derivatives_are_those_of_the_problem_with_each_effect_alone(
    has: tuple[str, float] | None, rounding: float
) -> None:
    rig, library = planetary(), shipped_effects()
    measured = planetary_modes(rig, 3, GOOD, Hidden({"sun-planet1 mesh": 0.8}))
    observations = ModeObservations(rig, [prepare(m) for m in measured.values()])
    model = Model((parse_effect(has[0], rig),)) if has else Model()
    observations = observations.suited(model.effects)
    problem = model.problem(observations)
    begin = problem.start(dict.fromkeys(problem.sizes, has[1]) if has else None)
    fit = refined(observations, model, begin, steps=8 if not has else 0)
    hypotheses = [h for h in list_hypotheses(rig, library, model.labels) if h.placed.effect.linear]
    problems = [model.plus(h.placed, h.scales).problem(observations) for h in hypotheses]
    found = problem.first_order(fit.posterior, problems)
    asked_alone = {
        h.placed.effect.id for h, columns in zip(hypotheses, found, strict=True) if columns is None
    }
    assert asked_alone == {"flexible_support", "gyroscopic"}
    p = fit.posterior
    for h, one, columns in zip(hypotheses, problems, found, strict=True):
        if columns is None:
            continue
        x = transferred(p, one.unknowns)
        whole = one.residuals(x, p.scatters, matching=p.residuals.matching).jacobian
        at = [one.unknowns.index[name] for name in one.sizes if name not in problem.sizes]
        scale = np.max(np.abs(whole[:, at]), initial=1e-9)
        np.testing.assert_allclose(columns, whole[:, at], atol=rounding * scale, err_msg=h.label)
