"""Sensors that are late: found and sized by what all modes share; shapes that dampers make complex are no delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from numpy.typing import NDArray
from simulate_modal import TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.channel_delays import ChannelDelays, channel_delays
from ema_pipeline.modal.hit_to_hit import identify_hits
from ema_pipeline.modal.plain_residues import PlainResidues, plain_residues
from ema_pipeline.modal.settings import ModalSettings

RNG = np.random.default_rng(4)
SYSTEM = TrueSystem(
    np.array([41.0, 83.0, 131.0, 190.0]),
    np.array([0.012, 0.009, 0.01, 0.008]),
    RNG.uniform(0.3, 1.0, (4, 4)) * np.sign(RNG.standard_normal((4, 4))),
)
BAND = 5.0, 240.0


def hits_of(delay_s: NDArray[np.float64], system: TrueSystem = SYSTEM) -> list[HitSamples]:
    """Hits on two points, four sensors of which some are late."""
    made = simulate_hits(
        system, [0, 1, 2, 3], [0, 2], f_max=260, record_s=3.0, n_hits=3, rng=np.random.default_rng(11),
        force_noise=1e-3, response_noise=1e-3, calibration=0.04, pretrigger=40,
    )  # fmt: skip
    n = made.responses.shape[-1]
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(n, 1 / made.sample_rate_hz) * delay_s[:, None])
    late = np.fft.irfft(np.fft.rfft(made.responses) * turn, n)
    return accepted(records_of(replace(made, responses=late), [0, 1, 2, 3], [0, 2]))


def found(hits: list[HitSamples]) -> ChannelDelays | None:
    frfs = estimate_frfs(hits)
    return channel_delays(frfs, plain_residues(frfs, BAND))


@pytest.mark.parametrize("delay", [2e-3, 5e-4, -1e-3])
def test_a_sensor_that_is_late_is_sized_and_shapes_are_real_again(delay: float) -> None:
    hits = hits_of(np.array([0.0, delay, 0.0, 0.0]))
    delays = found(hits)
    assert delays is not None
    assert np.flatnonzero(delays.delay_s).tolist() == [1]
    assert abs(delays.delay_s[1] - delay) < 3 * delays.std_s[1]
    assert delays.std_s[1] < 2e-5
    assert f"{'late' if delay > 0 else 'early'}. FRFs were corrected" in delays.note

    modal = identify_hits(lambda: hits, lambda: estimate_frfs(hits), FrfSettings(), ModalSettings()).modal
    assert modal.sensor_notes == (delays.note,)
    assert [m.mpc > 0.999 for m in modal.modes] == [True] * 4


def test_several_sensors_are_late_by_different_times() -> None:
    true = np.array([0.0, 4e-4, 8e-4, 1.2e-3])
    delays = found(hits_of(true))
    assert delays is not None
    apart = delays.delay_s - true
    assert apart - apart.mean() == pytest.approx(np.zeros(4), abs=5e-5)


def test_sensors_that_are_not_late_are_left_alone() -> None:
    assert found(hits_of(np.zeros(4))) is None
    two = TrueSystem(SYSTEM.frequency_hz[:2], SYSTEM.damping_ratio[:2], SYSTEM.shapes[:2])
    assert found(hits_of(np.array([0.0, 1e-3, 0.0, 0.0]), two)) is None  # two modes cannot show it


@pytest.mark.parametrize("seed", range(6))
def test_complex_shapes_are_no_delay(seed: int) -> None:
    """Phases of 0.2 rad at all sensors, as dampers make them: another one in each mode."""
    rng = np.random.default_rng(seed)
    frfs = estimate_frfs(hits_of(np.zeros(4)))
    peaks = [
        PlainResidues(
            2 * np.pi * hz,
            np.outer(rng.uniform(0.3, 1, 2), rng.uniform(0.3, 1, 4) * np.exp(0.2j * rng.standard_normal(4))),
            np.full((2, 4), 1e-8),
        )
        for hz in (41.0, 83.0, 131.0, 190.0, 260.0, 330.0)
    ]
    assert channel_delays(frfs, peaks) is None
