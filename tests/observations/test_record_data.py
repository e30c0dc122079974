"""One record prepared for comparison: lines, bands, noise over periods, windows and integrated signals."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.ingest.driven import DrivenRecord, ForceChannel
from ema_pipeline.ingest.records import ResponseChannel
from ema_pipeline.observations.record_data import BANDS, RecordData

RATE = 256.0


def record(
    responses: NDArray[np.float64],
    quantities: tuple[str, ...] = ("displacement",),
    force: NDArray[np.float64] | None = None,
    period: int = 0,
    transient: int = 0,
) -> DrivenRecord:
    channels = tuple(ResponseChannel(f"r{k}", Dof("m", "x"), q) for k, q in enumerate(quantities))
    given = np.ones((1, responses.shape[1])) if force is None else force
    return DrivenRecord(
        "one", "one.h5", "", "fit", RATE, (ForceChannel("f", Dof("m", "x"), 0.02, 0.0),), given, channels, responses,
        period, transient=transient,
    )  # fmt: skip


@pytest.mark.parametrize("samples", [64, 65])
def test_lines_of_white_noise_keep_its_variance_and_those_of_a_sine_hold_its_energy(samples: int) -> None:
    """An orthonormal transform, but for the line at the Nyquist frequency, which even numbers of samples have."""
    signal = np.random.default_rng(0).standard_normal((1, samples))
    data = RecordData.of(record(signal))
    nyquist = 0.0 if samples % 2 else np.sum(signal * (-1.0) ** np.arange(samples)) ** 2 / samples
    assert np.sum(data.measured**2) == pytest.approx(np.sum(signal**2) - nyquist)
    assert data.measured.shape == (1, 1, 2 * ((samples + 1) // 2 - 1) + 1)
    assert data.measured[0, 0, 0] == pytest.approx(np.sqrt(samples) * np.mean(signal))
    sine = np.cos(2 * np.pi * 3 * np.arange(samples) / samples)[None]
    lines = RecordData.of(record(sine)).measured[0, 0]
    assert np.flatnonzero(np.abs(lines) > 1e-9).tolist() == [3]
    assert lines[3] ** 2 == pytest.approx(samples / 2)


def test_only_displacements_are_compared_by_their_mean() -> None:
    data = RecordData.of(record(np.ones((2, 64)), ("acceleration", "displacement")))
    assert data.measured[0, :, 0].tolist() == [0.0, pytest.approx(8.0)]


def test_bands_divide_the_lines_evenly_and_the_mean_is_of_the_first() -> None:
    band = RecordData.of(record(np.ones((1, 8 * 2 * BANDS + 2)))).band
    waves = np.repeat(np.arange(BANDS), 8)
    np.testing.assert_array_equal(band, [0, *waves, *waves])
    np.testing.assert_array_equal(RecordData.of(record(np.ones((1, 8)))).band, [0, 0, 2, 5, 0, 2, 5])


def test_noise_of_a_mean_period_is_that_of_its_periods_by_their_number() -> None:
    """Each sensor and band has its own; a transient that is stated, or shows, is no noise."""
    random, periods, period = np.random.default_rng(1), 40, 256
    sound = np.tile(np.sin(2 * np.pi * np.arange(period) / period), periods)
    white = 0.3 * random.standard_normal(len(sound))
    slow = np.fft.irfft(np.fft.rfft(white) * (np.arange(len(sound) // 2 + 1) < len(sound) / 4))  # up to half
    responses = np.stack([sound + white, sound + slow])
    force = np.tile(random.standard_normal(period), periods)[None]
    data = RecordData.of(record(responses, ("displacement",) * 2, force, period))
    assert (data.record.n_samples, data.periodic, data.windowed) == (period, True, False)
    np.testing.assert_allclose(data.record.responses, responses.reshape(2, periods, period).mean(axis=1))
    expected = 0.3 / np.sqrt(periods)
    np.testing.assert_allclose(data.noise[0], expected, rtol=0.1)
    np.testing.assert_allclose(data.noise[1, : BANDS // 2], expected, rtol=0.1)
    assert np.all(data.noise[1, BANDS // 2 :] < 0.2 * expected)
    led_in = responses.copy()
    led_in[:, :period] += 3.0
    for given, left in ((record(led_in, ("displacement",) * 2, force, period), 1),
                        (record(led_in, ("displacement",) * 2, force, period, transient=period + 1), 2)):  # fmt: skip
        later = RecordData.of(given)
        np.testing.assert_allclose(
            later.record.responses, responses.reshape(2, periods, period)[:, left:].mean(axis=1)
        )
        np.testing.assert_allclose(later.noise[0], expected, rtol=0.1)
        assert later.record.transient == 0


def test_of_few_periods_a_transient_is_not_guessed_and_one_is_always_left() -> None:
    period = 64
    one = np.random.default_rng(2).standard_normal(period)
    three = np.concatenate([one + 5.0, one, one])[None]
    data = RecordData.of(record(three, period=period))
    np.testing.assert_allclose(data.record.responses[0], one + 5.0 / 3)
    twice = np.concatenate([one + 5.0, one + 5.0, one, one, one, one])[None]
    data = RecordData.of(record(twice, period=period))  # the first is no further off than another one
    np.testing.assert_allclose(data.record.responses[0], one + 10.0 / 6)
    last = RecordData.of(record(three, period=period, transient=5 * period))
    np.testing.assert_allclose(last.record.responses[0], one)
    assert not np.any(last.noise)
    two = RecordData.of(record(np.concatenate([one - 1.0, one + 1.0])[None], period=period))
    assert np.all(two.noise[0, 1:] < 1e-12)  # their difference is a mean, which is of the first band
    assert two.noise[0, 0] > 0


def test_level_is_the_mean_of_five_lines_and_nought_where_a_noiseless_record_has_none() -> None:
    wave = 7e3 * np.sin(2 * np.pi * 20 * np.arange(256) / 256) + np.sin(2 * np.pi * 90 * np.arange(256) / 256)
    level = RecordData.of(record(wave[None], period=256)).level[0]
    expected = np.zeros(127)
    expected[17:22] = np.sqrt(7e3**2 * 128 / 2 / 5)
    expected[87:92] = np.sqrt(128 / 2 / 5)
    np.testing.assert_allclose(level[1:], [*expected, *expected], atol=1e-3)
    assert level[0] == level[1]


@pytest.mark.parametrize(("period", "first", "last"), [(0, 60, 850), (400, 0, 400)])
def test_windows_lie_evenly_between_the_ends_that_no_state_is_known_at(
    period: int, first: int, last: int
) -> None:
    responses = np.random.default_rng(3).standard_normal((1, period or 900))
    whole = RecordData.of(record(responses, period=period, transient=10))
    data = whole.windows(100, 300)
    assert (data.length, data.samples, data.windowed, data.periodic) == (100, 100, True, False)
    assert data.starts[0] == first
    assert first + 100 > last - (data.starts[-1] + 100) >= 0
    assert len(data.starts) == 3
    assert np.ptp(np.diff(data.starts)) <= 100
    np.testing.assert_array_equal(data.responses[2, 0], responses[0, data.starts[2] :][:100])
    assert data.compared.start == 0
    every = whole.windows(100, 10**6)
    np.testing.assert_array_equal(np.diff(every.starts), 100)
    assert len(every.starts) == (last - first) // 100
    assert whole.windows(100, 1).starts.tolist() == [first]
    assert whole.windows(3, 200).length == 64
    half = whole.windows(10**6, 10**6).length
    assert half == (200 if period else 445)


def test_force_of_a_window_is_that_of_the_record_at_its_samples() -> None:
    force = np.cumsum(np.random.default_rng(4).standard_normal((1, 512)), axis=1)
    whole = RecordData.of(record(np.zeros((1, 512)), force=force))
    substeps = 3
    fine = whole.fine_force(substeps)
    assert fine.shape == (1, 2 * substeps * 511 + 1, 2)
    np.testing.assert_allclose(fine[0, :: 2 * substeps, 0], force[0], atol=1e-9)
    assert np.all(fine[..., 1] == 1.0)
    data = whole.windows(70, 10**6)
    parts = data.fine_force(substeps)
    assert parts.shape == (len(data.starts), 2 * substeps * 69 + 1, 2)
    for part, start in zip(parts, data.starts, strict=True):
        np.testing.assert_array_equal(part, fine[0, 2 * substeps * start :][: 2 * substeps * 69 + 1])


@pytest.mark.parametrize(("quantity", "power"), [("displacement", 0), ("velocity", 1), ("acceleration", 2)])
def test_motion_of_a_sine_is_known_from_any_of_its_derivatives(quantity: str, power: int) -> None:
    """What is slower than the structure is noise, but for a displacement, which is read as it is."""
    time = np.arange(512) / RATE
    omega, slow = 2 * np.pi * 10.0, 2 * np.pi * 0.5
    low = 2 * np.pi * 2.5
    wave, near, drift = (np.exp(1j * w * time) for w in (omega, low, slow))
    signal = ((1j * omega) ** power * wave + (1j * low) ** power * near + drift).imag
    ((x,), (v,)) = RecordData.of(record(signal[None], (quantity,), period=512)).motion(2.0)
    seen = power == 0
    np.testing.assert_allclose(x, (wave + near + seen * drift).imag, atol=1e-9)
    np.testing.assert_allclose(v, (omega * wave + low * near + seen * slow * drift).real, atol=1e-7)


@pytest.mark.parametrize(("quantity", "power"), [("velocity", 1), ("acceleration", 2)])
def test_motion_of_a_record_that_does_not_repeat_is_not_led_from_its_end_to_its_start(
    quantity: str, power: int
) -> None:
    """A burst near its end, above a drift that a mere transform would take for a jump."""
    time = np.arange(512) / RATE
    burst = np.exp(-(((time - 1.6) / 0.1) ** 2)) * np.cos(2 * np.pi * 20.0 * time)
    omega = 2j * np.pi * RATE * np.fft.rfftfreq(512)
    signal = np.fft.irfft(np.fft.rfft(burst) * omega**power) + 1e3 * time
    led, plain = (RecordData.of(record(signal[None], (quantity,), period=p)).motion(5.0) for p in (0, 512))
    truth = burst, np.fft.irfft(np.fft.rfft(burst) * omega)
    for mine, jumping, true in zip(led, plain, truth, strict=True):
        assert np.max(np.abs(mine[0] - true)) < 0.2 * np.max(np.abs(jumping[0] - true))
