"""Single unknowns, all others integrated out, against integrals that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from ema_pipeline.inference import Posterior, Residuals, Unknowns, averaged_over_others, descend

Array = NDArray[np.float64]


SHARED = 0.7
"""Prior 1 σ of what the logarithms of all own damping ratios share."""


@dataclass(frozen=True)
class Dampers:
    """ln ζ of modes whose own damping scatters in its logarithm about what they share, and to which one damper adds.

    ζ = own·exp(g + z) + share·c, with c the first unknown and g the second; ln ζ is measured to `noise`.
    """

    unknowns: Unknowns
    share: Array
    measured: Array
    own: float = 0.01
    noise: float = 1e-3

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        own = self.own * np.exp(x[1] + x[2:])
        model = own + self.share * x[0]
        slope = np.column_stack([self.share, own, np.diag(own)]) / model[:, None]
        sigma = self.noise * heat
        jacobian = -slope / sigma if derivatives else np.zeros((0, len(x)))
        return Residuals((np.log(self.measured) - np.log(model)) / sigma, jacobian)


def dampers(scatter: float, size: float, drawn: Array, std: float) -> Dampers:
    share = np.array([0.17, 0.018, 0.06])
    unknowns = Unknowns.plain(
        ("c", "g", "z0", "z1", "z2"), np.array([std, SHARED, scatter, scatter, scatter])
    )
    unknowns = replace(unknowns, lower=np.array([0.0, -9.0, -9.0, -9.0, -9.0]), sizes=frozenset({"c"}))
    return Dampers(unknowns, share, 0.01 * np.exp(drawn) + share * size)


def exact(problem: Dampers, linear_beyond: float = np.inf) -> tuple[float, float]:
    """Mean and σ of the damper: own damping ratios have log-normal densities, in closed form for each size."""
    most = np.min(problem.measured / problem.share)
    c = np.linspace(0.0, most, 40001)[:-1]
    left = problem.measured - problem.share * c[:, None]
    covariance = problem.unknowns.std[2] ** 2 * np.eye(3) + SHARED**2
    density = scipy.stats.multivariate_normal(np.zeros(3), covariance).logpdf(np.log(left / problem.own))
    density -= np.log(left).sum(axis=1)
    z = c / problem.unknowns.std[0]
    density -= 0.5 * z**2 - 0.5 * np.maximum(z - linear_beyond, 0.0) ** 2
    weight = np.exp(density - density.max())
    mean = weight @ c / weight.sum()
    return float(mean), float(np.sqrt(weight @ (c - mean) ** 2 / weight.sum()))


def fitted(problem: Dampers) -> Posterior:
    return descend(problem, {}, np.array([0.5, 0.0, 0.0, 0.0, 0.0]), steps=200)


@pytest.mark.parametrize("drawn", [[0.0, 0.0, 0.0], [0.4, -0.2, 0.1], [-0.3, 0.5, 0.2]])
def test_a_damper_has_the_mean_and_deviation_of_its_own_distribution(drawn: list[float]) -> None:
    problem = dampers(0.4, 1.0, np.array(drawn), std=100.0)
    found = fitted(problem)
    told = averaged_over_others(problem, found, ["c"])
    mean, std = exact(problem)
    assert told.x[0] == pytest.approx(mean, abs=0.03 * std)
    assert told.std[0] == pytest.approx(std, rel=0.05)
    # the curvature at the joint maximum misses the long tail
    assert found.x[0] > mean + 0.05 * std
    assert found.std[0] < 0.93 * std
    np.testing.assert_array_equal(told.x[1:], found.x[1:])
    np.testing.assert_allclose(told.std[1:], found.std[1:])


def test_the_prior_of_a_large_size_counts_with_an_even_slope() -> None:
    problem = dampers(0.4, 1.0, np.zeros(3), std=0.3)
    told = averaged_over_others(problem, fitted(problem), ["c"])
    mean, std = exact(problem, linear_beyond=2.0)
    assert told.x[0] == pytest.approx(mean, abs=0.1 * std)
    assert told.x[0] > exact(problem)[0] + 0.1 * std


def test_an_unknown_at_its_bound_stays_there() -> None:
    problem = dampers(0.4, 0.0, np.zeros(3), std=1.0)
    told = averaged_over_others(problem, fitted(problem), ["c"])
    assert 0.0 <= told.x[0] < 0.02
    assert np.all(np.isfinite(told.std))


def test_values_that_no_model_can_have_count_nothing() -> None:
    problem = dampers(0.4, 1.0, np.zeros(3), std=100.0)

    @dataclass(frozen=True)
    class Ended(Dampers):
        """With more damping the model has no modes."""

        def residuals(self, x: Array, scatters: Mapping[str, float], **more: Any) -> Residuals:
            if x[0] > 1.02:
                return Residuals(np.full(3, np.inf), np.zeros((3, 5)))
            return super().residuals(x, scatters, **more)

    ended = Ended(problem.unknowns, problem.share, problem.measured)
    found = fitted(problem)
    told = averaged_over_others(ended, found, ["c"])
    assert told.x[0] < averaged_over_others(problem, found, ["c"]).x[0]
    assert told.x[0] + 0.1 * told.std[0] < 1.02


def test_a_fit_that_stopped_on_the_wrong_side_of_a_step_is_begun_again() -> None:
    """Beyond a step the density is far larger: what is known is what is known from there."""

    @dataclass(frozen=True)
    class Step:
        unknowns: Unknowns

        def residuals(self, x: Array, scatters: object, **_: object) -> Residuals:
            jacobian = np.array([[-5.0, -5.0], [-2.0, 2.0]])
            values = np.array([5.0 * (1.0 - x[0] - x[1]), 2.0 * (x[1] - x[0])])
            return Residuals(values, jacobian, penalty=0.0 if x[0] < 0.3 else 20.0)

    problem = Step(Unknowns.plain(("a", "b"), 5.0))
    stopped = descend(problem, {}, np.array([0.6, 0.6]), steps=60)
    assert stopped.x == pytest.approx([0.5, 0.5], abs=0.01)
    told = averaged_over_others(problem, stopped, ["a"])
    assert told.cost < stopped.cost - 10
    assert told.x[0] < 0.3
    assert told.x[0] + told.std[0] > 0.2


def test_of_a_linear_problem_nothing_changes() -> None:
    @dataclass(frozen=True)
    class Linear:
        unknowns: Unknowns
        a: Array
        y: Array

        def residuals(self, x: Array, scatters: object, **_: object) -> Residuals:
            return Residuals(self.y - self.a @ x, -self.a)

    rng = np.random.default_rng(3)
    problem = Linear(Unknowns.plain(("a", "b"), 5.0), rng.normal(size=(8, 2)), rng.normal(size=8))
    found = descend(problem, {}, np.zeros(2), steps=60)
    told = averaged_over_others(problem, found, ["a", "b"])
    np.testing.assert_allclose(told.x, found.x, atol=0.02 * found.std.min())
    np.testing.assert_allclose(told.std, found.std, rtol=0.03)
