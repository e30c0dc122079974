"""What a fit of single hits reads of driven modes."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.observations.hit_reading import line_weights, read_of_drive

POLE = complex(-10.0, 2 * np.pi * 160.0)
LINES = np.arange(147.0, 173.0, 0.25)
S = 2j * np.pi * LINES - POLE
SIZE = np.ones(2, complex)


def read(force: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return np.asarray(read_of_drive(S, force, SIZE, -POLE.real, weight)[0]) / -POLE.real


def test_a_mode_that_a_force_hardly_moves_is_read_with_equal_weights() -> None:
    """Friction that follows another mode for some hundredths of a second: far less is left over than there is noise."""
    time = np.arange(0, 0.5, 1 / 20000)
    force = 0.5 * np.sign(np.sin(2 * np.pi * 316.0 * time)) * (time < 0.06)
    lines = np.array([force @ np.exp(-2j * np.pi * f * time) / 20000 for f in LINES]) * np.ones((2, 1))
    equal, found, by_response = (
        read(lines, w)[0] for w in (np.ones(len(S)), line_weights(S, lines, SIZE), np.abs(S))
    )
    assert abs(found - equal) < 0.02 * abs(equal)
    assert abs(by_response - equal) > 0.5 * abs(equal)


def test_lines_weigh_by_one_over_what_is_left_over() -> None:
    random = np.random.default_rng(1)
    near = np.abs(LINES - 160.0) < 4.0
    scatter = np.where(near, 10.0, 1.0) / np.abs(S).min()
    hits = 200
    rest = random.standard_normal((hits, len(S))) + 1j * random.standard_normal((hits, len(S)))
    weight = line_weights(S, scatter * rest * S, np.ones(hits, complex))
    inside, outside = np.abs(LINES - 160.0) < 2.5, np.abs(LINES - 160.0) > 6.0
    ratio = np.mean(weight[outside]) / np.mean(weight[inside])
    assert abs(ratio / 10.0 - 1) < 0.1


@pytest.mark.parametrize("count", [0, 1])
def test_hits_that_tell_nothing_weigh_all_lines_alike(count: int) -> None:
    still = np.zeros(count, complex)
    weight = line_weights(S, np.ones((count, len(S)), complex), still)
    np.testing.assert_allclose(weight, 1.0)
