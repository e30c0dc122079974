"""Sizes that give a mode a frequency, against systems that can be solved by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.mechanics.tuned import tuned_sizes

MASS = np.diag([2.0, 1.0])
STIFFNESS = np.array([[7e4, -2e4], [-2e4, 2e4]])
GROUND = np.diag([1.0, 0.0])
NONE = np.zeros((2, 2))


def frequencies(mass: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    values = np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real
    return np.sort(np.sqrt(np.maximum(values, 0.0))) / (2 * np.pi)


def test_a_free_body_on_a_spring_has_the_frequency_that_its_stiffness_gives() -> None:
    sizes, shapes = tuned_sizes(np.eye(1) * 3.0, np.zeros((1, 1)), np.zeros((1, 1)), np.eye(1), 5.0)
    assert sizes.tolist() == pytest.approx([3.0 * (2 * np.pi * 5.0) ** 2])
    assert shapes.shape == (1, 1)


def test_a_spring_or_a_mass_at_one_body_has_one_size_for_every_frequency() -> None:
    for mass_change, stiffness_change in ((NONE, GROUND), (GROUND, NONE)):
        for hz in (10.0, 20.0, 40.0):
            sizes, shapes = tuned_sizes(MASS, STIFFNESS, mass_change, stiffness_change, hz)
            assert len(sizes) == 1
            changed = MASS + sizes[0] * mass_change, STIFFNESS + sizes[0] * stiffness_change
            left = (changed[1] - (2 * np.pi * hz) ** 2 * changed[0]) @ shapes[:, 0]
            assert np.max(np.abs(left)) < 1e-6 * np.max(np.abs(changed[1] @ shapes[:, 0]))


def test_a_change_of_all_masses_alike_has_a_size_for_every_mode() -> None:
    own = frequencies(MASS, STIFFNESS)
    sizes, shapes = tuned_sizes(MASS, STIFFNESS, MASS, NONE, 17.0)
    assert np.sort(sizes) == pytest.approx((own / 17.0) ** 2 - 1)
    assert shapes.shape == (2, 2)


def test_what_no_real_size_does_and_what_changes_nothing_have_none() -> None:
    assert len(tuned_sizes(MASS, STIFFNESS, NONE, NONE, 17.0)[0]) == 0
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])  # its eigenvalues are imaginary
    assert len(tuned_sizes(np.eye(2), np.eye(2) * 1e4, NONE, turned, 1.0)[0]) == 0
    assert len(tuned_sizes(np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), np.eye(1), 0.0)[0]) == 0
