"""Effects that are not there yet, all at one point of the model, against the problem with each of them alone."""

from __future__ import annotations

import numpy as np
from imperfect_modes import GOOD, Hidden, chain, chain_modes, planetary_modes

from ema_pipeline.diagnose.hypotheses import list_hypotheses
from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.observations.fitting import Model, refined, transferred
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.planetary import planetary


def compared(observations: ModeObservations, model: Model, damping: float = 0.0) -> set[str]:
    """Compare the derivatives by all effects with those of a problem with each; what had to be asked of alone."""
    problem = model.problem(observations)
    begin = problem.start(dict.fromkeys(problem.sizes, damping))
    p = refined(observations, model, begin, steps=0 if damping else 8).posterior
    everything = list_hypotheses(observations.rig, shipped_effects(), model.labels)
    hypotheses = [h for h in everything if h.placed.effect.linear]
    problems = [model.plus(h.placed, h.scales).problem(observations) for h in hypotheses]
    alone = set()
    for h, one, columns in zip(hypotheses, problems, problem.first_order(p, problems), strict=True):
        if columns is None:
            alone.add(h.placed.effect.id)
            continue
        x = transferred(p, one.unknowns)
        whole = one.residuals(x, p.scatters, matching=p.residuals.matching).jacobian
        at = [one.unknowns.index[name] for name in one.sizes if name not in problem.sizes]
        scale = np.max(np.abs(whole[:, at]), initial=1e-9)
        np.testing.assert_allclose(columns, whole[:, at], atol=1e-6 * scale, err_msg=h.label)
    assert len(alone) < len({h.placed.effect.id for h in hypotheses})
    return alone


def test_derivatives_are_those_of_the_problem_with_each_effect_alone() -> None:
    rig = planetary()
    measured = planetary_modes(rig, 3, GOOD, Hidden({"sun-planet1 mesh": 0.8}))
    observations = ModeObservations(rig, [prepare(m) for m in measured.values()])
    assert compared(observations, Model()) == {"flexible_support", "gyroscopic"}


def test_so_they_are_where_a_damper_couples_the_modes() -> None:
    """Of a rig that is held: modes of rigid bodies may be any sums of each other, on which derivatives depend."""
    rig = chain()
    plain = ModeObservations(rig, [prepare(m) for m in chain_modes(3, GOOD).values()])
    model = Model((parse_effect("damper@m2", rig),))
    observations = plain.suited(model.effects)
    assert observations is not plain
    assert "spring" not in compared(observations, model, damping=60.0)
