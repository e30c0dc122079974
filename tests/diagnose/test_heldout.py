"""Prediction of what was held out, against the normal distribution that a linear model has in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from ema_pipeline.diagnose.heldout import NOTHING_HELD_OUT, _marginal, held_out
from ema_pipeline.inference import Residuals, Scatter, Unknowns, descend
from ema_pipeline.observations.fitting import Fit, Model

Array = NDArray[np.float64]
PRIOR_STD = 2.0
close = partial(pytest.approx, rel=1e-4)
"""As far as a descent goes."""
Y = np.array([1.3, 0.2, 2.1, -0.4, 1.0, 3.0])


@dataclass(frozen=True)
class Level:
    """Values of one unknown level with a noise of 1, held out in pairs, and what a pair costs besides."""

    y: Array
    further: Residuals = field(default_factory=lambda: Residuals(np.zeros(0), np.zeros((0, 1))))
    unknowns: Unknowns = field(default_factory=lambda: Unknowns.plain(["level"], PRIOR_STD))
    scatters: Mapping[str, Scatter] = field(default_factory=dict)

    def problem(self, effects: object, scales: object) -> Level:
        return self

    def start(self, sizes: object = None) -> Array:
        return np.zeros(1)

    def residuals(self, x: Array, scatters: object, **how: object) -> Residuals:
        return replace(self.further, values=self.y - x[0], jacobian=-np.ones((len(self.y), 1)))

    def folds(self) -> Sequence[tuple[Level, Level]]:
        at = np.arange(0, len(self.y), 2)
        return [(Level(np.delete(self.y, [i, i + 1])), replace(self, y=self.y[i : i + 2])) for i in at]


def closed_form(y: Array, relative: float = 1.0) -> tuple[float, float]:
    """Sum of squares and log density but for ln 2π of all pairs, each predicted from the others."""
    squares = density = 0.0
    for i in range(0, len(y), 2):
        others, pair = np.delete(y, [i, i + 1]), y[i : i + 2]
        variance = 1 / (len(others) + PRIOR_STD**-2.0)
        spread = np.eye(2) + variance
        off = pair - variance * others.sum()
        density += multivariate_normal.logpdf(off, cov=spread) + np.log(2 * np.pi)
        off, spread = relative * off, np.eye(2) + relative**2 * variance
        squares += off @ np.linalg.solve(spread, off)
    return squares, density


def prediction(observations: Level):
    found = descend(Level(observations.y), {}, np.zeros(1))
    return held_out(observations, Fit(Model(), found))


def test_a_linear_model_predicts_as_its_normal_distribution_does() -> None:
    squares, density = closed_form(Y)
    found = prediction(Level(Y))
    assert found.error == close(np.sqrt(squares / 6))
    assert found.log_density == close(density)


def test_values_on_their_own_are_blocks_of_one() -> None:
    alone = Residuals(np.zeros(0), np.zeros((0, 1)), log_scale=0.7, block=np.full(2, -1))
    squares, density = closed_form(Y)
    found = prediction(Level(Y, alone))
    assert found.error == close(np.sqrt(squares / 6))
    assert found.log_density == close(density - 3 * 0.7)


def test_what_has_no_partner_and_wider_scatters_cost_what_they_cost() -> None:
    squares, density = closed_form(Y)
    found = prediction(Level(Y, Residuals(np.zeros(0), np.zeros((0, 1)), log_scale=0.7, penalty=1.5)))
    assert found.log_density == close(density - 3 * (0.7 + 1.5))
    assert found.error == close(np.sqrt((squares + 3 * 2 * 1.5) / 6))


@pytest.mark.parametrize(("projected", "count"), [(1, 3), (2, 3)])
def test_values_that_were_spent_on_factors_do_not_count(projected: int, count: int) -> None:
    """One of a part counts at the least."""
    squares, _ = closed_form(Y)
    found = prediction(Level(Y, Residuals(np.zeros(0), np.zeros((0, 1)), projected=projected)))
    assert found.error == close(np.sqrt(squares / count))


def test_a_penalty_costs_as_much_beside_blocks() -> None:
    alone = Residuals(np.zeros(0), np.zeros((0, 1)), log_scale=0.7, penalty=1.5, block=np.full(2, -1))
    squares, density = closed_form(Y)
    found = prediction(Level(Y, alone))
    assert found.error == close(np.sqrt((squares + 3 * 2 * 1.5) / 6))
    assert found.log_density == close(density - 3 * (0.7 + 1.5))


def test_sums_over_several_unknowns_are_those_of_the_normal_distribution() -> None:
    random = np.random.default_rng(1)
    values, jacobian, root = (random.standard_normal(n) for n in (6, (6, 3), (3, 3)))
    spread = np.eye(6) + jacobian @ root @ root.T @ jacobian.T
    squares, half = _marginal(values, jacobian @ root)
    assert squares == pytest.approx(values @ np.linalg.solve(spread, values))
    assert half == pytest.approx(0.5 * np.linalg.slogdet(spread)[1])


@dataclass(frozen=True)
class Threshold:
    """Values of what begins at a threshold: next to nothing where the fit to the others, which tells nothing, is."""

    y: Array
    unknowns: Unknowns = field(default_factory=lambda: Unknowns.plain(["size"], PRIOR_STD))
    scatters: Mapping[str, Scatter] = field(default_factory=dict)

    def problem(self, effects: object, scales: object) -> Threshold:
        return self

    def start(self, sizes: object = None) -> Array:
        return np.zeros(1)

    def residuals(self, x: Array, scatters: object, **how: object) -> Residuals:
        return Residuals(self.y - np.exp(2 * x[0]), np.full((len(self.y), 1), -2 * np.exp(2 * x[0])))

    def folds(self) -> Sequence[tuple[Threshold, Threshold]]:
        return [(Threshold(self.y[:0]), self)]


@pytest.mark.parametrize("size", [1.0, 1.5, 2.0])
def test_what_is_uncertain_follows_the_data_that_are_held_out(size: float) -> None:
    """Against the density by quadrature; to first order about the fit to the others it is off by up to 84."""
    y = np.exp(2 * size) + np.array([0.4, -0.3, 0.1])
    x = np.linspace(-10, 4, 200001)
    log = -0.5 * np.sum((y[:, None] - np.exp(2 * x)) ** 2, axis=0) - 0.5 * (x / PRIOR_STD) ** 2
    density = np.log(np.sum(np.exp(log)) * (x[1] - x[0]) / np.sqrt(2 * np.pi) / PRIOR_STD)
    observations = Threshold(y)
    found = held_out(observations, Fit(Model(), descend(observations, {}, np.zeros(1))))
    assert found.log_density == pytest.approx(density, abs=0.2)
    off, spread = y - 1.0, np.eye(3) + 4 * PRIOR_STD**2  # the error is that of the prediction itself
    assert found.error == close(np.sqrt(off @ np.linalg.solve(spread, off) / 3))


def test_errors_count_in_the_stated_uncertainty_where_there_is_one() -> None:
    squares, density = closed_form(Y, 3.0)
    found = prediction(Level(Y, Residuals(np.zeros(0), np.zeros((0, 1)), relative=np.full(2, 3.0))))
    assert found.error == close(np.sqrt(squares / 6))
    assert found.log_density == close(density)


def test_a_part_that_cannot_be_foretold_makes_the_model_impossible() -> None:
    odd = Y.copy()
    odd[2] = np.inf
    last = Level(odd[2:4])
    fit = Fit(Model(), descend(Level(Y), {}, np.zeros(1)))

    @dataclass(frozen=True)
    class OneOf(Level):
        def folds(self) -> Sequence[tuple[Level, Level]]:
            return [(Level(Y[:2]), Level(Y[2:4])), (Level(Y[:2]), last)]

    assert held_out(OneOf(Y), fit).log_density == -np.inf
    assert np.isfinite(held_out(OneOf(Y), fit).error)
    assert held_out(Level(Y[:0]), fit) is NOTHING_HELD_OUT
