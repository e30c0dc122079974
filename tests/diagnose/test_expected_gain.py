"""What an effect is expected to gain, against what it gains: the model without it fitted anew, its scatters learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from ema_pipeline.diagnose.expected_gain import ExpectedGain
from ema_pipeline.diagnose.score import Marginal
from ema_pipeline.inference import Posterior, Residuals, Scatter, Unknowns, descend, learn, tails
from ema_pipeline.inference.problem import in_blocks
from ema_pipeline.observations.fitting import Fit, Model

Array = NDArray[np.float64]
ROWS = 30
OFFSET = Unknowns.plain(["offset"], 0.5)
SCATTERS = {
    "noise": Scatter("noise", "factor on the stated noise", 1.0, 0.5),
    "repeat": Scatter("repeat", "from test to test", 0.3, 1.5, 0.0, 10.0),
}
KNOWN = {
    "noise": Scatter("noise", "factor on the stated noise", 1.0, 0.0),
    "repeat": Scatter("repeat", "from test to test", 0.3, 0.0),
}


@dataclass(frozen=True)
class Repeated:
    """Differences between two tests: the first half with a stated noise of 1, the rest with one of 0.1."""

    y: Array
    unknowns: Unknowns = OFFSET

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        own = np.repeat([1.0, 0.1], ROWS // 2)
        noise, repeat = (scatters["noise"] * own) ** 2, np.full(ROWS, scatters["repeat"] ** 2)
        variance = noise + repeat
        sigma = np.sqrt(variance) * heat
        return Residuals(
            (self.y - x[0]) / sigma,
            -np.ones((ROWS, 1)) / sigma[:, None] if derivatives else np.zeros((0, 1)),
            share={"noise": noise / variance, "repeat": repeat / variance},
            log_scale=0.5 * float(np.sum(np.log(variance / (own**2 + 0.3**2)))),
        )


def fitted(y: Array, scatters: Mapping[str, Scatter]) -> Posterior:
    problem = Repeated(y)
    start = descend(problem, {n: s.default for n, s in scatters.items()}, np.zeros(1))
    return learn(problem, start, scatters, rounds=40)


def quiet() -> Array:
    """Tests that repeat far better than is stated."""
    return 0.02 * np.random.default_rng(3).standard_normal(ROWS)


@pytest.mark.parametrize("size", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("rows", [slice(15, 18), slice(15, 30, 2)])
def test_a_model_without_the_effect_takes_it_for_scatter(size: float, rows: slice) -> None:
    """Scatters that are far below what was stated rise together: the effect gains far less than half its square."""
    effect = np.zeros(ROWS)
    effect[rows] = size
    before, after = fitted(quiet(), SCATTERS), fitted(quiet() + effect, SCATTERS)
    gains = ExpectedGain(before, SCATTERS, Marginal(Fit(Model(), before)))
    sigma = np.sqrt(
        (before.scatters["noise"] * np.repeat([1.0, 0.1], 15)) ** 2 + before.scatters["repeat"] ** 2
    )
    change = gains.change(effect / sigma)
    true = before.log_evidence - after.log_evidence
    assert gains.of(change) == pytest.approx(true, rel=0.15, abs=0.7)
    assert gains.of(change) < 0.4 * 0.5 * change.total
    assert gains.of(change, 0.25) < gains.of(change)


def test_scatters_that_are_known_take_nothing_up() -> None:
    found = fitted(quiet(), KNOWN)
    gains = ExpectedGain(found, KNOWN, Marginal(Fit(Model(), found)))
    change = gains.change(np.eye(ROWS)[20] * 4.0)
    assert change.total == pytest.approx(16.0, rel=0.1)  # but for the offset, which follows a little
    assert gains.of(change) == pytest.approx(0.5 * change.total)
    assert gains.of(gains.change(np.zeros(ROWS))) == 0.0


def test_a_shape_that_is_far_off_gains_as_its_density_has_tails() -> None:
    block = np.repeat(np.arange(6), 5)
    alone = fitted(quiet(), KNOWN)
    found = replace(alone, residuals=replace(alone.residuals, block=block))
    gains = ExpectedGain(found, KNOWN, Marginal(Fit(Model(), found)))
    change = gains.change(np.eye(ROWS)[20] * 20.0)
    before = found.expected_squares(weighted=False)
    after = before + change.residuals / found.residuals.weight**2
    costs = [float(np.sum(tails.cost(*in_blocks(squares, block)))) for squares in (before, after)]
    assert gains.of(change) == pytest.approx(0.5 * change.rest + costs[1] - costs[0])
    assert gains.of(change) < 0.2 * 0.5 * change.total


@pytest.mark.parametrize("size", [0.02, 0.1, 0.4])
def test_the_cost_is_the_least_within_the_range_of_the_scatters(size: float) -> None:
    """Against another search, of a scatter that would fall below its least and of one that has reached its most."""
    narrow = {
        "noise": Scatter("noise", "factor on the stated noise", 1.0, 0.5, least=0.4),
        "repeat": Scatter("repeat", "from test to test", 0.05, 1.5, most=1.5),
    }
    found = fitted(quiet(), narrow)
    assert found.scatters["noise"] == pytest.approx(0.4, rel=0.02)
    gains = ExpectedGain(found, narrow, Marginal(Fit(Model(), found)))
    change = gains.change(size * np.eye(ROWS)[20] / 0.1)
    at = {n: np.log([s.least * s.default or 1e-9, s.most * s.default]) for n, s in narrow.items()}

    def least(residuals: Array, unknowns: Array) -> float:
        def cost(logs: Array) -> float:
            now = dict(zip(narrow, np.exp(logs), strict=True))
            t = [(now[n] / found.scatters[n]) ** 2 for n in narrow]
            share = [found.residuals.share[n] for n in narrow]
            variance = share[0] * t[0] + share[1] * t[1]
            square = found.expected_squares() + residuals
            prior = sum((np.log(now[n] / s.default) / s.spread) ** 2 for n, s in narrow.items())
            return 0.5 * float(np.sum(np.log(variance) + square / variance) + prior)

        begin = [np.log(found.scatters[n]) for n in narrow]
        return float(minimize(cost, begin, bounds=list(at.values()), method="Nelder-Mead").fun)

    true = least(change.residuals, change.unknowns) - least(np.zeros(ROWS), np.zeros(2))
    assert gains.of(change) == pytest.approx(0.5 * change.rest + true, abs=0.1)
