"""Intervals from the scatter over struck points: points that pull, and neighbours that are alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from simulate_modal import frf_set, random_system

from ema_pipeline.modal.data import FitData, arrange
from ema_pipeline.modal.fit import Estimate, normalised, solve_linear
from ema_pipeline.modal.fit_covariance import (
    FEWEST_GROUPS,
    PointScores,
    of_all_blocks,
    scatter_over_points,
    scores_of_points,
)
from ema_pipeline.modal.serial import lags, variance_of_sum, widening

INSIDE = 1.645
"""Standard deviations of a 90 % interval."""


def series(rng: np.random.Generator, n_series: int, n: int, alike: float) -> np.ndarray:
    """Normal series of unit variance, each value with `alike` of the one before it, (n, n_series)."""
    fresh = rng.standard_normal((n + 100, n_series)) * np.sqrt(1 - alike**2)
    return np.asarray(lfilter([1.0], [1.0, -alike], fresh, axis=0)[100:])


def weighted_mean(values: np.ndarray, weight: np.ndarray) -> tuple[float, PointScores]:
    """The simplest fit: one number from a value per point, and what each point asks of it."""
    mean = float(weight @ values / weight.sum())
    scores = weight * (values - mean)
    return mean, PointScores(scores[:, None], weight[:, None], np.array([[weight.sum()]]))


def test_neighbours_that_do_not_depend_on_each_other_count_in_full() -> None:
    values = series(np.random.default_rng(1), 4000, 40, 0.0)
    off = values - values.mean(axis=0)
    std = np.sqrt(variance_of_sum(off)) / 40
    assert 0.88 < np.mean(np.abs(values.mean(axis=0)) < INSIDE * std) < 0.92


@pytest.mark.parametrize(("alike", "least"), [(0.3, 0.82), (0.6, 0.74)])
def test_neighbours_that_are_alike_count_as_fewer(alike: float, least: float) -> None:
    values = series(np.random.default_rng(2), 4000, 75, alike)
    mean, off = values.mean(axis=0), values - values.mean(axis=0)
    independent = np.sqrt(np.sum(off**2, axis=0)) / 75
    covered = np.mean(np.abs(mean) < INSIDE * np.sqrt(variance_of_sum(off)) / 75)
    assert np.mean(np.abs(mean) < INSIDE * independent) < least - 0.04
    assert covered > least


def test_every_second_value_alike_widens_and_opposite_neighbours_do_not_narrow() -> None:
    rng = np.random.default_rng(3)
    two_lines = np.stack([series(rng, 1, 40, 0.8)[:, 0], series(rng, 1, 40, 0.8)[:, 0]], axis=1).ravel()
    assert widening(two_lines) > 1.15
    assert widening(np.tile([1.0, -1.0], 20)) == 1.0
    assert widening(np.ones(5)) == widening(np.ones(1)) == 1.0
    assert [lags(n) for n in (5, 75, 100)] == [2, 3, 4]


def test_a_point_that_pulls_counts_as_in_the_fit_without_it() -> None:
    rng = np.random.default_rng(4)
    # opposite neighbours: nothing but the jackknife is left
    values = np.abs(rng.standard_normal(12)) * np.tile([1.0, -1.0], 6)
    weight = rng.uniform(1, 3, 12)
    weight[4] = 20.0
    _, found = weighted_mean(values, weight)
    without = np.array([weighted_mean(np.delete(values, k), np.delete(weight, k))[0] for k in range(12)])
    exact = 11 / 12 * np.sum((without - without.mean()) ** 2)
    assert scatter_over_points(found)[0] == pytest.approx(exact, rel=1e-9)


def test_intervals_hold_where_few_points_tell_most() -> None:
    rng = np.random.default_rng(5)
    inside, narrow = [], []
    for _ in range(2000):
        values, weight = rng.standard_normal(37), rng.gamma(0.5, size=37)  # 14 of 37 points tell most
        mean, found = weighted_mean(values, weight)
        plain = np.sqrt(np.sum((found.scores / weight.sum()) ** 2) * 37 / 36)
        inside.append(abs(mean) < INSIDE * np.sqrt(scatter_over_points(found)[0]))
        narrow.append(abs(mean) < INSIDE * plain)
    assert np.mean(narrow) < 0.85
    assert 0.865 < np.mean(inside) < 0.92


def test_few_points_tell_nothing_and_one_that_tells_all_is_not_left_out() -> None:
    few = FEWEST_GROUPS - 1
    assert scatter_over_points(weighted_mean(np.arange(float(few)), np.ones(few))[1])[0] == 0.0
    weight = np.array([1e9, 1, 1, 1, 1, 1.0])
    assert np.isfinite(scatter_over_points(weighted_mean(np.arange(6.0), weight)[1])[0])


@pytest.mark.parametrize("transposed", [False, True], ids=["references are points", "rows are points"])
def test_points_add_up_to_the_fit_of_all(transposed: bool) -> None:
    rng = np.random.default_rng(6)
    system = random_system(rng, n_modes=3, n_dofs=9, low_hz=40, high_hz=90, min_spacing=0.1)
    few, many = [0, 4], list(range(9))
    points = (few, many) if transposed else (many, few)
    lines = np.arange(0, 120, 0.25)
    frfs = frf_set(lines, system.accelerance(lines, *points), *points)
    data: FitData = arrange(frfs, (20.0, 110.0))
    assert data.transposed == transposed
    start = Estimate(system.poles * (1 + 1e-3j), normalised(system.shapes[:, few].astype(complex)))
    weight = np.where(data.measured[..., None], np.ones(data.frf.shape), 0.0)

    def of(rows: slice) -> PointScores:
        some = data.rows(rows)
        return scores_of_points(transposed, start, solve_linear(some, weight[rows], start))

    whole, blocks = of(slice(None)), of_all_blocks([of(slice(0, 4)), of(slice(4, 9))], transposed)
    assert whole.scores.shape == whole.own.shape == (9 if transposed else 2, len(whole.information))
    np.testing.assert_allclose(whole.own.sum(axis=0), np.diag(whole.information), rtol=1e-6)
    for name in ("scores", "own", "information"):
        a, b = getattr(whole, name), getattr(blocks, name)
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(a).max())
    np.testing.assert_allclose(whole.step.gradient, whole.scores.sum(axis=0))
