"""Frequencies that rise or fall within the decay: one mode each, however many poles follow them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from scipy.signal import fftconvolve
from simulate_modal import Hits, TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.records import Record
from ema_pipeline.modal.drift.align import Alignment
from ema_pipeline.modal.drift.local import DecayChange
from ema_pipeline.modal.hit_to_hit import identify_hits, within_decay
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

RATE, SAMPLES, TRIGGER = 1024.0, 4096, 20
FREQUENCY_HZ = np.array([52.0, 131.0, 247.0, 360.0])
DECAY = np.array([1.6, 2.2, 3.0, 4.5])
"""1/s; damping ratios of 0.2 to 0.5 %."""
SHAPES = np.array(
    [
        [1.0, 0.4, -0.5, 0.8, 0.3],
        [0.7, -0.8, 0.6, 0.9, -0.4],
        [0.9, 0.7, -0.3, -0.6, 0.8],
        [0.6, -0.5, 0.9, 0.4, 0.7],
    ]
)
"""(n_modes, n_sensors); the first sensor is at the point that is struck."""


def moving_records(sensors: list[int], n_hits: int, rise: float, noise: float = 3e-3) -> list[Record]:
    """Hits on the first point; frequencies rise by `rise` from the start of each decay to its end."""
    rng = np.random.default_rng(8)
    time = np.arange(SAMPLES) / RATE
    blow = np.sin(np.pi * np.arange(1, 4) / 4)
    force, responses = np.zeros((1, n_hits, SAMPLES)), np.zeros((1, n_hits, len(sensors), SAMPLES))
    for h in range(n_hits):
        peak = rng.uniform(0.9, 1.1)
        below = rise * peak**2 * FREQUENCY_HZ
        turned = (1 - np.exp(-2 * DECAY[:, None] * time)) / (2 * DECAY[:, None])
        phase = 2 * np.pi * (FREQUENCY_HZ[:, None] * time - below[:, None] * turned)
        decays = np.exp(-DECAY[:, None] * time) * np.cos(phase)
        answer = (SHAPES[:, sensors] * SHAPES[:, [0]]).T @ decays
        force[0, h, TRIGGER : TRIGGER + 3] = 100 * peak * blow
        shifted = np.zeros((len(sensors), SAMPLES))
        shifted[:, TRIGGER:] = answer[:, : SAMPLES - TRIGGER]
        responses[0, h] = 100 * peak * fftconvolve(shifted, blow[None], axes=1)[:, :SAMPLES]
    size = noise * np.sqrt(np.mean(responses**2, axis=(0, 1, 3)))
    responses += size[:, None] * rng.standard_normal(responses.shape)
    force += noise * np.sqrt(np.mean(force**2)) * rng.standard_normal(force.shape)
    return records_of(Hits(force, responses, RATE, TRIGGER, 0.0, size), sensors, [0])


def identified(records: list[Record]) -> ModalModel:
    hits = accepted(records)
    frfs = estimate_frfs(hits, FrfSettings())
    return identify_hits(lambda: hits, lambda: frfs, FrfSettings(), ModalSettings()).modal


@pytest.mark.parametrize("rise", [0.001, 0.004])
@pytest.mark.parametrize("sensors", [[0], [1, 3], [0, 2, 4], [0, 1, 2, 3, 4]], ids=str)
def test_modes_whose_frequencies_rise_within_the_decay_are_not_split(sensors: list[int], rise: float) -> None:
    model = identified(moving_records(sensors, 3, rise))
    found = [m.frequency_hz for m in model.modes]
    assert found == pytest.approx(FREQUENCY_HZ, rel=1.5 * rise)
    for mode, decay in zip(model.modes, DECAY, strict=True):
        assert -mode.pole.real == pytest.approx(decay, rel=0.35)


def test_two_close_modes_at_one_sensor_are_no_movement() -> None:
    """Their residues are real to each other; those of the poles that follow a movement are 90° apart."""
    system = TrueSystem(
        np.array([60.0, 140.0, 141.6, 300.0]), np.array([0.004, 0.004, 0.012, 0.004]), np.ones((4, 1))
    )
    made = simulate_hits(
        system, [0], [0], f_max=400, record_s=6.0, n_hits=3, force_noise=2e-3, response_noise=2e-3,
        rng=np.random.default_rng(5),
    )  # fmt: skip
    model = identified(records_of(made, [0], [0]))
    assert [m.frequency_hz for m in model.modes] == pytest.approx(system.frequency_hz, rel=2e-3)


def test_a_mode_in_the_flank_of_a_doubtful_one_shares_its_doubt() -> None:
    system = TrueSystem(np.array([60.0, 140.0, 300.0]), np.array([0.02, 0.02, 0.01]), np.ones((3, 1)))
    made = simulate_hits(
        system, [0], [0], f_max=400, record_s=3.0, n_hits=1, force_noise=2e-3, response_noise=2e-3,
        rng=np.random.default_rng(5),
    )  # fmt: skip
    model = identified(records_of(made, [0], [0]))
    doubt = DecayChange(model.modes[0].pole, -30 * model.modes[0].pole.real, 0.1)
    one_hit = Alignment(0.0, 0.0, 1, (), changes=(doubt,))
    beside = replace(model.modes[1], pole=model.modes[0].pole + 2j * -model.modes[0].pole.real)
    changed = within_decay(replace(model, modes=(model.modes[0], beside, model.modes[2])), one_hit, 0.0)
    assert "one mode does not describe its decay" in changed.modes[0].flags[-1]
    assert f"flank of the mode at {model.modes[0].frequency_hz:.5g} Hz" in changed.modes[1].flags[-1]
    assert changed.modes[1].frequency_std_hz > 0.4 * doubt.width / (2 * np.pi)
    assert changed.modes[2] == model.modes[2]
