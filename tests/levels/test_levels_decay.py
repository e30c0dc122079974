"""Backbones and damping curves from decays, against limits known by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulate_levels import sampled_hit

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.levels import LevelSettings, LevelStudy, study_levels
from ema_pipeline.levels.decay import decays
from ema_pipeline.levels.tracks import doubles
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

RATE_HZ = 2048.0
SAMPLES = 4096
STIFFNESS = (2 * np.pi * 60.0) ** 2  # N/m for 1 kg: 60 Hz
DAMPING = 0.004


def struck(restoring: Callable[[float, float], float], peak_n: float, seed: int) -> HitSamples:
    """A mass of 1 kg on a spring, a damper and `restoring` (N, of displacement and velocity), struck once."""
    start, contact = 0.05, 4e-3
    time = np.arange(SAMPLES) / RATE_HZ

    def force(t: float | np.ndarray) -> np.ndarray:
        phase = (t - start) / contact
        return np.where(np.abs(phase) < 0.5, peak_n * np.cos(np.pi * phase) ** 2, 0.0)

    def acceleration(t: float, x: float, v: float) -> float:
        viscous = 2 * DAMPING * np.sqrt(STIFFNESS) * v
        return float(force(t)) - STIFFNESS * x - viscous - restoring(x, v)

    found = solve_ivp(
        lambda t, y: (y[1], acceleration(t, y[0], y[1])),
        (0, time[-1]), (0.0, 0.0), t_eval=time, rtol=1e-7, atol=1e-12, max_step=1.5e-3,
    )  # fmt: skip
    measured = np.array([[acceleration(t, x, v) for t, x, v in zip(time, *found.y, strict=True)]])
    rng = np.random.default_rng(seed)
    noise = 1e-4 * measured.std()
    hammer = force(time) + 1e-4 * rng.normal(size=SAMPLES)
    measured = measured * np.array([[1.0], [0.7], [-0.4]])  # three sensors on one body, two of them aslant
    return sampled_hit(f"h{seed}.csv", hammer, measured + noise * rng.normal(size=measured.shape), RATE_HZ)


def study(hits: list[HitSamples]) -> LevelStudy:
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings(low_hz=30, high_hz=110))
    return study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), ModalSettings(low_hz=30, high_hz=110),
        lambda done, text: None,
    )  # fmt: skip


def single_mode(frfs: FrfSet) -> ModalModel:
    """The modes without the echoes that a fit makes of a mode which moves."""
    modal = identify(frfs, ModalSettings(low_hz=30, high_hz=110))
    found = tuple(m for m, echo in zip(modal.modes, doubles(modal), strict=True) if not echo)
    assert len(found) == 1
    return replace(modal, modes=found)


CUBIC = 8e9
"""N/m³."""


@pytest.fixture(scope="module")
def duffing() -> list[HitSamples]:
    return [struck(lambda x, v: CUBIC * x**3, 100.0, seed) for seed in (1, 2)]


def test_the_backbone_of_a_cubic_spring_is_that_of_duffings_equation(duffing: list[HitSamples]) -> None:
    frfs = estimate_frfs(duffing)
    curves = decays(lambda: duffing, frfs, single_mode(frfs))
    assert len(curves) == 2
    for curve in curves:
        linear = np.sqrt(STIFFNESS) / (2 * np.pi)
        expected = linear * (1 + 3 * CUBIC * curve.amplitude_m**2 / (8 * STIFFNESS))
        shift = expected - linear
        assert shift.max() > 0.1  # Hz: there is something to see
        error = np.abs(curve.frequency_hz - expected)
        assert np.all(error < 2 * curve.frequency_std_hz)


def test_the_damping_of_a_sliding_contact_falls_as_two_forces_over_pi_stiffness_amplitude() -> None:
    friction = 0.05
    hits = [struck(lambda x, v: friction * float(np.tanh(v / 1e-4)), 40.0, seed) for seed in (1, 2)]
    frfs = estimate_frfs(hits)
    curves = decays(lambda: hits, frfs, single_mode(frfs))
    assert len(curves) == 2
    for curve in curves:
        added = 2 * friction / (np.pi * STIFFNESS * curve.amplitude_m)
        large = added < 1.5 * DAMPING  # far above standstill, where the formula holds
        assert np.count_nonzero(large) >= 3
        expected = DAMPING + added
        error = np.abs(curve.damping_ratio - expected)[large]
        assert np.all(error < 2 * curve.damping_std[large] + 0.03 * expected[large])
        assert curve.damping_ratio[large][-1] > 1.3 * curve.damping_ratio[large][0]


def test_decays_alone_show_a_cubic_spring_from_hits_of_one_level(duffing: list[HitSamples]) -> None:
    found = study(duffing)
    assert len(found.levels) == 1
    assert found.level_dependent
    assert "hardening" in {t for m in found.modes for t in m.trend.split(", ")}
    assert "not linear" in found.summary


def test_one_level_of_a_linear_structure_says_what_cannot_be_known() -> None:
    found = study([struck(lambda x, v: 0.0, peak, seed) for seed, peak in ((1, 95.0), (2, 105.0))])
    assert not found.level_dependent
    assert "cannot" in found.summary
    assert "two or three forces" in found.summary
