"""Two tests of one rig as observations."""

import numpy as np
from imperfect_modes import GOOD, chain, chain_modes

from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.pair import A, B, PairObservations


def test_imaginary_parts_of_real_shapes_are_no_part_of_a_pair() -> None:
    """Neither their values nor the phases that would be spent on them."""
    rig = chain()
    a, b = (
        ModeObservations(rig, [prepare(chain_modes(seed, GOOD)["all"])], test=name)
        for seed, name in ((1, A), (2, B))
    )
    assert all(np.all(of.data[0].lagging) for of in (a, b))
    pair = PairObservations(a, b, {"all": np.arange(5)})
    problem = pair.problem((), {})
    scatters = {n: s.default for n, s in pair.scatters.items()}
    found = problem.residuals(problem.start(), scatters)
    assert len(found.values) == 2 * (5 + 5 + 25)
    assert found.count == 2 * (5 + 5 + 25 - 5)
