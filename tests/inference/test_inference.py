"""The one posterior against limits known in closed form, and on problems that break careless algebra."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats
from numpy.typing import NDArray

from ema_pipeline.inference import (
    ERROR_LIMIT,
    Apart,
    Bounded,
    Posterior,
    Residuals,
    Scatter,
    Unknowns,
    anneal,
    beyond,
    descend,
    error_limit,
    joined,
    learn,
    lower_factor,
    reach,
    solve_lower,
    tails,
    widened,
)
from ema_pipeline.inference.scatter import LinearEvidence, determined

Array = NDArray[np.float64]
NOISE = "noise"
PARTS = "parts"


@dataclass(frozen=True)
class Linear:
    """y = A x + e, e of own standard deviation 1 beside a common scatter where `noise` is not zero."""

    unknowns: Unknowns
    a: Array
    y: Array
    own: float = 1.0

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        added = scatters.get(NOISE, 0.0) ** 2
        variance = self.own**2 + added
        sigma = np.sqrt(variance) * heat
        count = len(self.y)
        return Residuals(
            (self.y - self.a @ x) / sigma,
            -self.a / sigma if derivatives else np.zeros((0, len(x))),
            share={NOISE: np.full(count, added / variance)} if added else {},
            log_scale=0.5 * count * np.log(variance),
        )


def linear(seed: int = 0, rows: int = 12, columns: int = 4) -> tuple[Linear, Array]:
    rng = np.random.default_rng(seed)
    std = np.array([0.1, 0.4, 1.0, 2.0])[:columns]
    a = rng.normal(size=(rows, columns))
    x = std * rng.normal(size=columns)
    return Linear(Unknowns.plain([f"x{i}" for i in range(columns)], std), a, a @ x + rng.normal(size=rows)), x


def marginal(problem: Linear) -> Array:
    """Covariance of the data, everything unknown marginalised."""
    return np.eye(len(problem.y)) + problem.a @ np.diag(problem.unknowns.std**2) @ problem.a.T


# --- the linear Gaussian problem, whose posterior is known ------------------------------------------------


def test_the_maximum_of_a_linear_problem_is_its_ridge_solution() -> None:
    problem, _ = linear()
    found = descend(problem, {}, np.zeros(4), steps=60)
    precision = problem.a.T @ problem.a + np.diag(problem.unknowns.std**-2)
    np.testing.assert_allclose(found.x, np.linalg.solve(precision, problem.a.T @ problem.y), atol=2e-3)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-10)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(np.linalg.inv(precision))), rtol=1e-10)


def test_the_evidence_of_a_linear_problem_is_the_density_of_its_data() -> None:
    problem, _ = linear(1)
    found = descend(problem, {}, np.zeros(4), steps=60)
    density = scipy.stats.multivariate_normal(np.zeros(12), marginal(problem)).logpdf(problem.y)
    assert found.log_evidence - 0.5 * 12 * np.log(2 * np.pi) == pytest.approx(density, abs=2e-3)


def test_the_bayes_factor_of_nested_models_is_the_ratio_of_their_densities() -> None:
    full, _ = linear(2)
    part = Linear(Unknowns.plain(full.unknowns.names[:3], full.unknowns.std[:3]), full.a[:, :3], full.y)
    found = [descend(p, {}, np.zeros(len(p.unknowns)), steps=60).log_evidence for p in (full, part)]
    known = [scipy.stats.multivariate_normal(np.zeros(12), marginal(p)).logpdf(p.y) for p in (full, part)]
    assert found[0] - found[1] == pytest.approx(known[0] - known[1], abs=2e-3)


def test_the_error_is_the_root_mean_square_of_the_residual_whitened_by_everything_uncertain() -> None:
    problem, _ = linear(3)
    found = descend(problem, {}, np.zeros(4), steps=60)
    whitened = np.linalg.solve(np.linalg.cholesky(marginal(problem)), problem.y)
    assert found.error == pytest.approx(float(np.sqrt(np.mean(whitened**2))), rel=1e-4)


def test_a_penalty_counts_in_the_error_as_the_square_that_costs_as_much() -> None:
    # -log of a normal density is half a square: a penalty of 8 is worth a residual of 4
    penalised = Residuals(np.zeros(4), np.zeros((4, 0)), penalty=8.0)
    off = Residuals(np.array([4.0, 0.0, 0.0, 0.0]), np.zeros((4, 0)))
    found = [Posterior(Unknowns.plain((), 1.0), np.zeros(0), {}, r) for r in (penalised, off)]
    assert found[0].cost == found[1].cost == 8.0
    assert found[0].error == found[1].error == 2.0


def test_the_error_of_true_models_is_about_one() -> None:
    errors = []
    for seed in range(60):
        problem, _ = linear(seed, rows=40)
        errors.append(descend(problem, {}, np.zeros(4), steps=30).error ** 2)
    # the mean of 60 mean squares of 40 standard normal values has a standard deviation of 0.029
    assert np.mean(errors) == pytest.approx(1.0, abs=0.09)


def test_many_data_are_explained_with_a_smaller_error_than_few() -> None:
    random = np.random.default_rng(5)
    for count in (20, 35, 50):
        by_chance = np.sqrt(np.mean(random.standard_normal((40000, count)) ** 2, axis=1))
        assert np.mean(by_chance > error_limit(count)) == pytest.approx(1e-3, abs=5e-4)
    assert error_limit(0) == error_limit(1) == error_limit(10) == ERROR_LIMIT == 1.5
    assert error_limit(60) == error_limit(10**6) == 1.3
    assert error_limit(10**6, 3.0) == pytest.approx(2.6)
    assert error_limit(35, 3.0) == pytest.approx(2 * error_limit(35))


def test_that_an_effect_is_large_is_no_misfit() -> None:
    residuals = Residuals(np.full(10, 0.5), np.zeros((10, 2)))

    def error(size: float, sizes: frozenset[str]) -> float:
        unknowns = replace(Unknowns.plain(("part", "size"), 1.0), sizes=sizes)
        return Posterior(unknowns, np.array([1.0, size]), {}, residuals).error

    for size in (-7.0, -1.5, 1.0, 7.0):
        counted = min(abs(size), 2.0)
        assert error(size, frozenset(("size",))) == pytest.approx(np.sqrt((2.5 + 1.0 + counted**2) / 10))
        assert error(size, frozenset()) == pytest.approx(np.sqrt((2.5 + 1.0 + size**2) / 10))


def test_what_counts_on_its_own_as_well_is_not_hidden_by_many_other_data() -> None:
    values = np.concatenate([[2.0, 2.0, 6.0, 6.0, 0.0], np.full(95, 0.5)])
    block = np.array([-1, -1, 0, 0, 0] + [-1] * 95)
    unknowns = Unknowns.plain(("a", "b"), 1.0)
    whole = Residuals(values, np.zeros((100, 2)), block=block, penalty=1.0)
    apart = replace(whole, apart=Apart(values=5, projected=1, unknowns=1))
    one, both = (Posterior(unknowns, np.array([1.0, 3.0]), {}, r) for r in (whole, apart))
    assert one.error == both.error < 1.3
    assert one.error_apart == 0.0
    assert not one.fails()
    alone = Residuals(values[:5], np.zeros((5, 1)), block=block[:5], penalty=1.0, projected=1)
    assert both.error_apart == Posterior(Unknowns.plain(("a",), 1.0), np.ones(1), {}, alone).error > 1.5
    assert both.fails()
    assert not both.fails(5.0)
    assert one.telling == (one.error, 100)
    assert both.telling == (both.error_apart, 4)
    rough = replace(whole, apart=Apart(values=5, projected=1, unknowns=1, rough=True))
    last = Posterior(unknowns, np.array([1.0, 3.0]), {}, rough)
    assert (last.error_apart, last.telling, last.fails()) == (0.0, (last.error, 100), False)
    # beside data that tell on their own, all together may be calculated to first order only
    assert (one.error_limit(), both.error_limit(), last.error_limit()) == (1.3, 1.5, 1.3)
    tight = replace(rough, values=np.where(values < 1, 1.25, values))
    assert Posterior(unknowns, np.array([1.0, 3.0]), {}, tight).fails()


def test_ninety_per_cent_intervals_hold_nine_times_in_ten() -> None:
    inside = []
    for seed in range(150):
        problem, truth = linear(1000 + seed)
        found = descend(problem, {}, np.zeros(4), steps=30)
        inside += list(np.abs(found.x - truth) < 1.6449 * found.std)
    assert np.mean(inside) == pytest.approx(0.9, abs=0.04)


def test_an_unknown_that_no_datum_depends_on_keeps_its_prior() -> None:
    problem, _ = linear(4)
    a = problem.a.copy()
    a[:, 2] = 0.0
    found = descend(Linear(problem.unknowns, a, problem.y), {}, np.zeros(4), steps=30)
    assert found.value("x2") == 0.0

    def narrowing(name: str) -> float:
        after, before = found.of_sums([{name: 1.0}])
        return float(np.sqrt(after[0, 0] / before[0, 0]))

    assert narrowing("x2") == pytest.approx(1.0)
    assert narrowing("x3") < 0.5


# --- nonlinear problems, starts and bounds ----------------------------------------------------------------


@dataclass(frozen=True)
class Exponential:
    """y = Σ exp(B x): the kind of problem that logarithms of stiffnesses make."""

    unknowns: Unknowns
    b: Array
    y: Array

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        each = np.exp(self.b * x)
        sigma = 0.05 * heat
        jacobian = -self.b * each / sigma if derivatives else np.zeros((0, len(x)))
        return Residuals((self.y - np.sum(each, axis=1)) / sigma, jacobian)


def exponential(seed: int, lower: float = -np.inf, upper: float = np.inf) -> Exponential:
    rng = np.random.default_rng(seed)
    b = rng.uniform(0.3, 1.5, size=(9, 3))
    x = rng.normal(size=3)
    unknowns = Unknowns.plain(("a", "b", "c"), 1.0, lower=lower, upper=upper)
    return Exponential(unknowns, b, np.sum(np.exp(b * x), axis=1) + 0.05 * rng.normal(size=9))


@pytest.mark.parametrize("seed", range(5))
def test_a_nonlinear_fit_ends_where_scipy_ends(seed: int) -> None:
    problem = exponential(seed)

    def stacked(x: Array) -> Array:
        return np.concatenate([problem.residuals(x, {}).values, x])

    known = scipy.optimize.least_squares(stacked, np.zeros(3), xtol=1e-12, ftol=1e-12)
    found = anneal(problem, {}, np.zeros(3))
    assert found.cost == pytest.approx(known.cost, abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("start", ["inside", "on the bounds"])
@pytest.mark.parametrize(("lower", "upper"), [(-0.2, np.inf), (-np.inf, 0.5), (-0.3, 0.3)])
def test_bounds_are_kept_and_the_fit_within_them_is_the_best(
    seed: int, start: str, lower: float, upper: float
) -> None:
    problem = exponential(seed, lower, upper)

    def stacked(x: Array) -> Array:
        return np.concatenate([problem.residuals(x, {}).values, x])

    known = scipy.optimize.least_squares(stacked, np.zeros(3), bounds=(lower, upper), xtol=1e-12)
    edge = upper if np.isfinite(upper) else lower
    found = anneal(problem, {}, np.full(3, 0.0 if start == "inside" else edge))
    assert np.all((found.x >= lower) & (found.x <= upper))
    assert found.cost == pytest.approx(known.cost, abs=5e-3)


@dataclass
class Counted:
    """A problem that counts its evaluations, and whose pairs change with the first unknown where `jumps`."""

    problem: Exponential
    jumps: bool = False
    derivatives: int = 0
    trials: int = 0

    @property
    def unknowns(self) -> Unknowns:
        return self.problem.unknowns

    def residuals(
        self, x: Array, scatters: Mapping[str, float], *, derivatives: bool = True, **given: Any
    ) -> Residuals:
        self.derivatives += derivatives
        self.trials += not derivatives
        found = self.problem.residuals(x, scatters, derivatives=derivatives, **given)
        return replace(found, matching=(np.array([x[0]]),) if self.jumps else None)


def test_derivatives_are_carried_on_while_the_cost_falls_as_they_promise() -> None:
    counted = Counted(exponential(0))
    found = descend(counted, {}, np.zeros(3), steps=40)
    assert counted.derivatives < counted.trials
    exact = counted.problem.residuals(found.x, {})
    np.testing.assert_array_equal(found.residuals.values, exact.values)
    np.testing.assert_array_equal(found.residuals.jacobian, exact.jacobian)


def test_no_derivatives_are_carried_on_to_other_pairs() -> None:
    counted = Counted(exponential(0), jumps=True)
    found = descend(counted, {}, np.zeros(3), steps=40)
    plain = descend(exponential(0), {}, np.zeros(3), steps=40)
    assert counted.derivatives == counted.trials + 1  # every step was a way down
    assert found.cost == pytest.approx(plain.cost, abs=1e-4)


def test_a_fit_is_never_worse_than_its_start() -> None:
    for seed in range(10):
        problem = exponential(seed)
        start = np.random.default_rng(seed).normal(scale=2.0, size=3)
        before = problem.residuals(start, {}).cost + 0.5 * float(np.sum(start**2))
        assert descend(problem, {}, start, steps=1).cost <= before


@dataclass(frozen=True)
class Valleys:
    """One datum on a rippled slope: cold descents end in the nearest ripple."""

    unknowns: Unknowns = field(default_factory=lambda: Unknowns.plain(("x",), 10.0))

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        off = x[0] - 4.0
        ripple = 6.0 / heat**2
        values = np.array([2.0 * off / heat, ripple * np.sin(2.0 * off)])
        jacobian = np.array([[2.0 / heat], [2.0 * ripple * np.cos(2.0 * off)]])
        return Residuals(values, jacobian)


def test_annealing_leaves_the_local_optimum_that_a_cold_descent_ends_in() -> None:
    problem = Valleys()
    assert abs(descend(problem, {}, np.zeros(1), steps=50).x[0] - 4.0) > 0.5
    assert anneal(problem, {}, np.zeros(1)).x[0] == pytest.approx(4.0, abs=0.05)


# --- learned scatter --------------------------------------------------------------------------------------


def parts(seed: int, true: float, count: int = 200) -> Linear:
    """Deviations of many parts, each measured with a standard deviation of 0.01."""
    rng = np.random.default_rng(seed)
    x = true * rng.normal(size=count)
    unknowns = Unknowns.plain([f"part {i}" for i in range(count)], 1.0, PARTS)
    return Linear(unknowns, np.eye(count) / 0.01, (x + 0.01 * rng.normal(size=count)) / 0.01)


@pytest.mark.parametrize("true", [0.01, 0.03, 0.04])
def test_the_scatter_of_parts_is_learned_from_the_data(true: float) -> None:
    scatter = {PARTS: Scatter(PARTS, "parts", 0.02, 0.7, 0.04)}
    problem = parts(0, true)
    start = descend(problem, {PARTS: 0.02}, np.zeros(200))
    found = learn(problem, start, scatter, rounds=12)
    assert found.scatters[PARTS] == pytest.approx(true, rel=0.2)


def test_learned_scatter_maximises_the_marginal_density_with_its_prior() -> None:
    scatter = Scatter(PARTS, "parts", 0.02, 0.7)
    problem = parts(1, 0.03, 40)
    found = learn(problem, descend(problem, {PARTS: 0.02}, np.zeros(40)), {PARTS: scatter})

    def objective(log: float) -> float:
        variance = 1.0 + (np.exp(log) / 0.01) ** 2
        likelihood = -0.5 * float(np.sum(problem.y**2)) / variance - 20 * np.log(variance)
        return -float(likelihood - 0.5 * ((log - np.log(0.02)) / 0.7) ** 2)

    best = scipy.optimize.minimize_scalar(objective, bounds=(-6, -2), method="bounded")
    assert found.scatters[PARTS] == pytest.approx(np.exp(best.x), rel=0.02)


@pytest.mark.parametrize("true", [0.5, 2.0])
def test_the_scatter_that_adds_to_noise_is_learned_from_the_residuals(true: float) -> None:
    rng = np.random.default_rng(5)
    a = rng.normal(size=(400, 2))
    y = a @ np.array([0.5, -0.5]) + np.hypot(1.0, true) * rng.normal(size=400)
    problem = Linear(Unknowns.plain(("a", "b"), 1.0), a, y)
    scatter = {NOISE: Scatter(NOISE, "noise", 1.0, 0.7)}
    found = learn(problem, descend(problem, {NOISE: 1.0}, np.zeros(2)), scatter, rounds=40)
    assert found.scatters[NOISE] == pytest.approx(true, rel=0.2)


def test_no_scatter_is_learned_beyond_its_bound_so_that_a_failing_model_shows() -> None:
    scatter = Scatter(PARTS, "parts", 0.02, 0.7, most=2.5)
    problem = parts(2, 0.5)
    found = learn(problem, descend(problem, {PARTS: 0.02}, np.zeros(200)), {PARTS: scatter}, rounds=12)
    assert 0.049 < found.scatters[PARTS] <= 0.05
    assert found.error > 3


def test_a_scatter_that_is_known_stays_and_one_without_data_keeps_its_default() -> None:
    problem = parts(3, 0.05)
    known = {PARTS: Scatter(PARTS, "parts", 0.02, 0.0), "gains": Scatter("gains", "gains", 0.4, 0.5, 0.8)}
    found = learn(problem, descend(problem, {PARTS: 0.02, "gains": 0.8}, np.zeros(200)), known)
    assert found.scatters[PARTS] == 0.02
    assert found.scatters["gains"] == pytest.approx(0.4, rel=0.1)


def test_a_learned_scatter_far_from_its_default_costs_evidence() -> None:
    scatter = {PARTS: Scatter(PARTS, "parts", 0.02, 0.5)}
    problem = parts(4, 0.045)
    found = learn(problem, descend(problem, {PARTS: 0.02}, np.zeros(200)), scatter, rounds=12)
    expected = 0.5 * (np.log(found.scatters[PARTS] / 0.02) / 0.5) ** 2
    assert found.scatter_cost == pytest.approx(expected)
    assert found.log_evidence == pytest.approx(
        Posterior(found.unknowns, found.x, found.scatters, found.residuals).log_evidence - expected
    )


def test_the_evidence_at_other_scatters_is_the_density_of_the_data_there() -> None:
    problem = parts(6, 0.03, 8)
    evidence = LinearEvidence(descend(problem, {PARTS: 0.02}, np.zeros(8)))

    def density(scatter: float) -> float:
        std = np.hypot(1.0, scatter / 0.01)
        return float(np.sum(scipy.stats.norm(0.0, std).logpdf(problem.y)))

    for value in (0.005, 0.05):
        told = evidence.at({PARTS: value}) - evidence.at({PARTS: 0.02})
        assert told == pytest.approx(density(value) - density(0.02), abs=1e-6)


def masses(rng: np.random.Generator, scatter: Scatter) -> tuple[Linear, float]:
    """Three masses in proportion to each other, one of them with an unknown mass beside it."""
    true = scatter.default * np.exp(scatter.spread * rng.normal())
    x, added = true * rng.normal(size=3), 0.2 * rng.normal()
    a = np.array([[1.0, -1.0, 0.0, -1.0], [0.0, -1.0, 1.0, -1.0]]) / 1e-4
    unknowns = joined(
        Unknowns.plain(("m1", "m2", "m3"), 1.0, PARTS),
        Unknowns.plain(("added",), 0.2),
    )
    return Linear(unknowns, a, a @ np.append(x, added) + rng.normal(size=2)), float(added)


def test_intervals_hold_where_two_ratios_are_all_that_tells_how_much_masses_scatter() -> None:
    scatter = Scatter(PARTS, "parts", 0.005, 1.0, 0.02, 8.0)
    rng, inside = np.random.default_rng(7), []
    for _ in range(300):
        problem, added = masses(rng, scatter)
        found = learn(problem, descend(problem, {PARTS: 0.02}, np.zeros(4)), {PARTS: scatter})
        found = descend(problem, widened(found, {PARTS: scatter}), found.x)
        inside.append(abs(found.value("added") - added) < 1.6449 * found.std[3])
    # 300 intervals: 1 σ of the share is 1.7 %; a Gaussian with the right second moment is a little too wide
    assert 0.87 < np.mean(inside) < 0.965


def test_data_as_precise_as_the_prior_determine_half_of_every_unknown() -> None:
    # posterior variance half of the prior's: MacKay's number of well-determined parameters
    problem = Linear(Unknowns.plain([f"part {i}" for i in range(10)], 1.0, PARTS), np.eye(10), np.zeros(10))
    found = descend(problem, {PARTS: 1.0}, np.zeros(10))
    assert determined(found, PARTS) == pytest.approx(5.0)


def test_a_scatter_is_widened_to_the_root_mean_square_of_its_exact_density() -> None:
    count, scatter = 30, Scatter(PARTS, "parts", 0.02, 0.7, most=8.0)
    x = 0.03 * np.random.default_rng(6).normal(size=count)
    unknowns = Unknowns.plain([f"part {i}" for i in range(count)], 1.0, PARTS)
    exact = Linear(unknowns, np.eye(count) / 1e-6, x / 1e-6)
    found = learn(exact, descend(exact, {PARTS: 0.02}, np.zeros(count)), {PARTS: scatter})

    def moment(power: int) -> float:
        def density(log: float) -> float:
            told = (
                scipy.stats.norm(0.0, np.exp(log)).logpdf(x).sum() - 0.5 * ((log - np.log(0.02)) / 0.7) ** 2
            )
            return float(np.exp(told - 60.0 + power * log))

        return float(scipy.integrate.quad(density, np.log(0.01), np.log(0.09))[0])

    wide = widened(found, {PARTS: scatter})[PARTS]
    assert wide == pytest.approx(np.sqrt(moment(2) / moment(0)), rel=2e-3)
    known = {PARTS: Scatter(PARTS, "parts", 0.02, 0.0)}
    assert widened(found, known)[PARTS] == found.scatters[PARTS]


def test_a_part_lies_too_far_out_where_the_others_do_not_scatter_so_far() -> None:
    """The scatter as it is learned may have grown with the part itself."""
    unknowns = joined(
        Unknowns.plain([f"p{k}" for k in range(5)], 1.0, PARTS),
        Unknowns.plain(("twice",), 2.0, PARTS),
        Unknowns.plain(("gain",), 1.0, "gains"),
    )
    exact = Residuals(np.zeros(7), 1e6 * np.eye(7))
    x = 0.02 * np.array([-10.0, 1.0, -1.0, 1.0, 1.0, 2.0, 90.0])
    found = Posterior(unknowns, x, {PARTS: 0.2, "gains": 0.02}, exact)
    most = reach(found, {PARTS: 0.02})
    assert most["p0"] == pytest.approx(4 * 0.02)  # four that the default counts as, and the five others
    assert most["twice"] == pytest.approx(4 * 2 * 0.02 * np.sqrt(108 / 9))
    assert set(most) == {*(f"p{k}" for k in range(5)), "twice"}
    np.testing.assert_array_equal(beyond(found, most), [True, *[False] * 6])
    assert reach(found, {PARTS: 0.02}, furthest=1.0)["p0"] == pytest.approx(0.02)
    several = reach(
        replace(found, scatters={PARTS: 0.03, "gains": 0.02}), {PARTS: 0.02}
    )  # no further than is learned
    assert several["p1"] == several["twice"] / 2 == pytest.approx(4 * 0.03)


def test_parts_of_which_the_data_tell_nothing_do_not_tell_how_parts_scatter() -> None:
    """They stay at their means whatever they are; half a part is one that is told to half its variance."""
    unknowns = Unknowns.plain([f"p{k}" for k in range(4)], 1.0, PARTS)
    x = 0.02 * np.array([3.0, 0.0, 0.0, 0.0])
    told = Residuals(np.zeros(4), np.diag([1e6, 0.0, 0.0, 0.0]))
    most = reach(Posterior(unknowns, x, {PARTS: 0.2}, told), {PARTS: 0.02})
    assert most["p0"] == pytest.approx(4 * 0.02)
    assert most["p1"] == pytest.approx(4 * 0.02 * np.sqrt(13 / 5))
    half = Residuals(np.zeros(4), np.diag([1e6, 1 / 0.2, 0.0, 0.0]))
    assert reach(Posterior(unknowns, x, {PARTS: 0.2}, half), {PARTS: 0.02})["p0"] == pytest.approx(
        4 * 0.02 * np.sqrt(4 / 4.5)
    )


def test_a_bound_problem_holds_what_is_bound_and_leaves_the_rest() -> None:
    unknowns = Unknowns.plain(("a", "b"), 1.0)
    problem = Bounded(Linear(unknowns, np.eye(2) / 1e-3, np.array([0.5, -0.5]) / 1e-3), {"a": 0.1, "c": 0.0})
    found = descend(problem, {}, np.zeros(2))
    np.testing.assert_allclose(found.x, [0.1, -0.5], rtol=1e-4)


@pytest.mark.parametrize("count", [1, 5])
def test_blocks_that_may_be_wrong_together_have_the_multivariate_t_density(count: int) -> None:
    for size in (0.1, 1.0, 6.0):
        values = size * np.random.default_rng(count).normal(size=count)
        squares = float(values @ values)
        known = scipy.stats.multivariate_t(np.zeros(count), np.eye(count), df=tails.TAIL).logpdf(values)
        constant = 0.5 * count * np.log(2 * np.pi)  # that of standard normal values at 0
        assert float(tails.cost(squares, count)) == pytest.approx(-known - constant, abs=1e-9)
        ends = [float(tails.cost(squares + s, count)) for s in (-1e-6, 1e-6)]
        normal = 0.5  # slope of half a square
        assert float(tails.weight(squares, count)) * normal == pytest.approx(
            (ends[1] - ends[0]) / 2e-6, rel=1e-5
        )


# --- data that break careless algebra ---------------------------------------------------------------------


def checked(found: Posterior) -> Posterior:
    assert np.all(np.isfinite(found.x))
    assert np.all(np.isfinite(found.covariance))
    assert np.isfinite(found.log_evidence)
    assert np.isfinite(found.error)
    return found


def test_duplicated_unknowns_share_what_the_data_say_of_their_sum() -> None:
    y = np.array([2.0])
    problem = Linear(Unknowns.plain(("a", "b"), 1.0), np.full((1, 2), 1e6), 1e6 * y)
    found = checked(descend(problem, {}, np.zeros(2), steps=80))
    np.testing.assert_allclose(found.x, [1.0, 1.0], atol=1e-3)
    assert found.std[0] == pytest.approx(np.sqrt(0.5), rel=1e-3)


def test_no_data_leave_the_prior() -> None:
    problem = Linear(Unknowns.plain(("a", "b"), (1.0, 2.0)), np.zeros((0, 2)), np.zeros(0))
    found = checked(anneal(problem, {}, np.array([0.3, -0.4])))
    np.testing.assert_allclose(found.x, 0.0, atol=0.05)
    np.testing.assert_allclose(found.std, [1.0, 2.0])


def test_a_problem_without_unknowns_has_an_error_and_an_evidence() -> None:
    problem = Linear(Unknowns.plain((), 1.0), np.zeros((3, 0)), np.ones(3))
    found = descend(problem, {}, np.zeros(0))
    assert found.error == pytest.approx(1.0)
    assert found.log_evidence == pytest.approx(-1.5)


def test_contradictory_data_give_their_mean_and_an_error_above_one() -> None:
    problem = Linear(Unknowns.plain(("a",), 1.0), np.full((2, 1), 1e4), np.array([1e4, -1e4]))
    found = checked(descend(problem, {}, np.zeros(1), steps=30))
    assert found.x[0] == pytest.approx(0.0, abs=1e-6)
    assert found.error == pytest.approx(1e4, rel=1e-6)


@dataclass(frozen=True)
class Cliff:
    """A model without an answer beyond x = 1, as a trial mass below zero has none."""

    unknowns: Unknowns = field(default_factory=lambda: Unknowns.plain(("x",), 1.0))

    def residuals(
        self,
        x: Array,
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        if x[0] > 1.0:
            return Residuals(np.full(1, np.inf), np.zeros((1, 1)))
        return Residuals(np.array([10.0 * (2.0 - x[0])]), np.array([[-10.0]]))


def test_a_model_without_an_answer_beyond_some_point_is_fitted_up_to_there() -> None:
    found = checked(descend(Cliff(), {}, np.zeros(1), steps=60))
    assert 0.9 < found.x[0] <= 1.0


def test_a_start_without_an_answer_has_no_evidence() -> None:
    found = descend(Cliff(), {}, np.array([3.0]))
    assert found.log_evidence == -np.inf


def test_blocks_of_unknowns_keep_their_order_bounds_and_scatters() -> None:
    both = joined(
        Unknowns.plain(("a",), 0.1, lower=0.0), Unknowns.plain(("b", "c"), (2.0, 3.0), PARTS, upper=1.0)
    )
    assert both.names == ("a", "b", "c")
    np.testing.assert_allclose(both.prior_std({PARTS: 0.5}), [0.1, 1.0, 1.5])
    np.testing.assert_allclose(both.clipped(np.array([-1.0, 2.0, -9.0])), [0.0, 1.0, -9.0])
    np.testing.assert_array_equal(both.governed(PARTS), [False, True, True])


@pytest.mark.parametrize("scale", [1.0, 1e6, 1e12, 1e20])
def test_a_precision_has_its_factor_however_large_it_is(scale: float) -> None:
    """One row that is known far better than the machine resolves: the determinant is 1 + |row|²."""
    row = np.sqrt(scale) * np.array([1.0, 1.0, -2.0, 0.5])
    factor = lower_factor(np.eye(4) + np.outer(row, row))
    assert np.all(np.triu(factor, 1) == 0)
    assert np.all(np.diag(factor) > 0)
    np.testing.assert_allclose(factor @ factor.T, np.eye(4) + np.outer(row, row), rtol=1e-12, atol=1.0)
    log_det = 2 * float(np.sum(np.log(np.diag(factor))))
    assert log_det == pytest.approx(np.log1p(row @ row), abs=1e-3 if scale < 1e12 else 30.0)


def test_a_precision_that_rounding_spoilt_has_the_factor_of_the_nearest_one() -> None:
    spoilt = np.diag([1.0, 1e20, -3e3])  # as differences of 1e20 leave a 1
    np.testing.assert_allclose(lower_factor(spoilt), np.diag([1.0, 1e10, 1.0]), rtol=1e-12)


def test_a_triangular_solution_of_nothing_is_nothing() -> None:
    assert solve_lower(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
    np.testing.assert_allclose(
        solve_lower(np.array([[2.0, 9.0], [1.0, 4.0]]), np.array([4.0, 10.0])), [2.0, 2.0]
    )
