"""Frequencies that move together from hit to hit, and the trends that are left without them."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.levels.common_drift import common_drift
from ema_pipeline.levels.hit_trends import hit_trends
from ema_pipeline.levels.single import HitPoles

FORCES = np.array([30.0, 30.0, 100.0, 100.0, 300.0, 300.0])
NOISE = 1e-6
DRIFT = -1e-5 * np.arange(12)
"""Of a test in which two points are struck softly first and hard last, while the day grows warmer."""


def log_changes(modes: int, drift: bool, moving: float = 0.0) -> np.ndarray:
    """Changes of ln f; of the first mode, if it moves, with the square of the force."""
    random = np.random.default_rng(modes)
    log = NOISE * random.standard_normal((12, modes))
    log[:, 0] += moving * np.tile((FORCES / 300.0) ** 2, 2)
    return log + DRIFT[:, None] if drift else log


def hits(log: np.ndarray) -> HitPoles:
    random = np.random.default_rng(1)
    count, modes = log.shape
    hz = np.linspace(50.0, 400.0, modes) * np.exp(log)
    sheet, ones = np.repeat([0, 1], 6), np.ones(log.shape)
    damping = 0.01 * (1 + 1e-4 * random.standard_normal(log.shape))
    size = ones + 1e-3 * (random.standard_normal(log.shape) + 1j * random.standard_normal(log.shape))
    force = np.tile(FORCES, 2)
    motion = force[:, None] * 1e-7 * ones
    return HitPoles(
        tuple(f"h#{i}" for i in range(count)), sheet, sheet, force, hz, NOISE * hz, damping, 1e-6 * ones,
        motion.astype(complex), motion, size, 1e-3 * ones,
    )  # fmt: skip


def p_of(log: np.ndarray) -> tuple[float, float]:
    """Of all modes together, and of the frequency of the first one."""
    level = np.tile([0, 0, 1, 1, 2, 2], 2)
    found = hit_trends(hits(log), level, np.zeros(log.shape[1], bool))
    return found.p_value, found.frequency[0].p


@pytest.mark.parametrize(("modes", "moving"), [(3, 0.0), (6, 0.0), (6, 2e-4)])
def test_what_moves_all_modes_alike_is_drift(modes: int, moving: float) -> None:
    log = log_changes(modes, drift=True, moving=moving)
    found = hits(log)
    drift = common_drift(found.frequency_hz, found.frequency_std_hz, found.sheet)
    for sheet in (0, 1):
        on = found.sheet == sheet
        np.testing.assert_allclose(drift[on] - drift[on].mean(), DRIFT[on] - DRIFT[on].mean(), atol=3e-6)


@pytest.mark.parametrize(("modes", "drift"), [(2, True), (1, True), (6, False)])
def test_too_few_modes_tell_no_drift_and_noise_is_none(modes: int, drift: bool) -> None:
    found = hits(log_changes(modes, drift))
    assert not np.any(common_drift(found.frequency_hz, found.frequency_std_hz, found.sheet))


def test_a_mode_that_a_hit_does_not_tell_is_left_out() -> None:
    found = hits(log_changes(6, drift=True))
    std = found.frequency_std_hz.copy()
    std[3, 2], found.frequency_hz[3, 2] = np.inf, np.nan
    assert np.all(np.isfinite(common_drift(found.frequency_hz, std, found.sheet)))


def test_hits_that_grow_harder_while_all_frequencies_drift_show_no_nonlinearity() -> None:
    everything, first = p_of(log_changes(6, drift=True))
    assert everything > 0.05
    assert first > 0.01


@pytest.mark.parametrize("drift", [False, True])
def test_a_mode_that_moves_with_the_force_is_found_beside_drift(drift: bool) -> None:
    everything, first = p_of(log_changes(6, drift, moving=2e-4))
    assert everything < 1e-5
    assert first < 1e-5
