"""Hits sorted into force levels, and modes followed over them."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.levels.sort import sort_levels


@pytest.mark.parametrize("hits_per_level", [1, 2, 4])
def test_levels_a_factor_of_three_apart_are_found_in_spite_of_an_unsteady_hand(hits_per_level: int) -> None:
    rng = np.random.default_rng(hits_per_level)
    truth = np.tile(np.repeat([0, 1, 2], hits_per_level), 3)
    points = np.repeat(["a", "b", "c"], 3 * hits_per_level)
    for _ in range(30):
        forces = np.array([30.0, 100.0, 300.0])[truth] * np.exp(0.1 * rng.normal(size=len(truth)))
        assert np.array_equal(sort_levels(points.tolist(), forces.tolist(), 1.5), truth)


@pytest.mark.parametrize("draw", ["normal", "uniform"])
def test_the_scatter_of_one_hand_is_not_split_into_levels(draw: str) -> None:
    rng = np.random.default_rng(4)
    split = 0
    for _ in range(100):
        scatter = rng.normal(size=24) if draw == "normal" else rng.uniform(-1.7, 1.7, size=24)
        forces = 100 * np.exp(0.15 * scatter)
        split += sort_levels([str(i % 4) for i in range(24)], forces.tolist(), 1.5).max() > 0
    assert split <= 2


def test_every_point_may_have_its_own_forces() -> None:
    levels = sort_levels(list("aaabbb"), [30, 100, 300, 60, 200, 600], 1.5)
    assert levels.tolist() == [0, 1, 2, 0, 1, 2]


def test_points_struck_with_different_forces_are_no_levels() -> None:
    assert sort_levels(list("aabb"), [30, 31, 100, 103], 1.5).tolist() == [0, 0, 0, 0]


def test_forces_closer_than_the_ratio_asked_for_are_one_level() -> None:
    forces = [100, 101, 180, 181]
    assert sort_levels(list("aaaa"), forces, 1.5).tolist() == [0, 0, 1, 1]
    assert sort_levels(list("aaaa"), forces, 2.0).tolist() == [0, 0, 0, 0]


def test_forces_of_one_level_that_fall_into_two_by_chance_are_one() -> None:
    """Hits of an unpractised hand on a linear rig; as many meant for two levels, or a point struck twice at each."""
    points = ["carrier.x"] * 2 + ["sun.y"] * 2 + ["sun.u"] * 2 + ["planet1.x"] * 2 + ["planet2.y"] * 2
    chance = [131.0, 171.0, 61.0, 136.0, 141.0, 135.0, 118.0, 63.0, 77.0, 180.0]
    assert not np.any(sort_levels(points, chance, 1.8))
    meant = [61.0, 171.0, 61.0, 136.0, 70.0, 135.0, 63.0, 118.0, 77.0, 180.0]
    np.testing.assert_array_equal(sort_levels(points, meant, 1.8), [0, 1] * 5)
    once_more = [*points, "planet2.y", "planet2.y"]
    np.testing.assert_array_equal(
        sort_levels(once_more, [*chance, 75.0, 175.0], 1.8), [1, 1, 0, 1, 1, 1, 1, 0, 0, 1, 0, 1]
    )
