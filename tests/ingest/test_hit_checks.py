"""Checks on single hits: what they must find, and what they must leave in peace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulate_hits import Blow, force_of, modal_response, random_record, record_of

from ema_pipeline.check_result import CheckResult
from ema_pipeline.ingest.hit_checks import check_hit, hits_of_test, usable_band_hz
from ema_pipeline.ingest.hits import find_hits
from ema_pipeline.ingest.pulse import find_pulse, find_second_impact, noise_of
from ema_pipeline.ingest.records import Hit, Record

RATE = 12800.0


def checked(record: Record) -> Hit:
    """The first hit of a record, checked."""
    return check_hit(record, find_hits(record)[0])


def verdict(hit: Hit, check: str, channel: str | None = None) -> CheckResult:
    """The verdict of one check."""
    return next(v for v in hit.verdicts if v.check == check and channel in (None, v.channel))


def clean(seed: int = 0, length_s: float = 0.5) -> Record:
    """A clean hit of 1 ms at 12.8 kHz on two modes."""
    rng = np.random.default_rng(seed)
    force = force_of(Blow(RATE, "half-sine", 1e-3, length_s=length_s), rng)
    poles = np.array([-60 + 1j * 2 * np.pi * 300, -90 + 1j * 2 * np.pi * 900])
    answers = [
        modal_response(force - np.median(force), RATE, poles, 1j * rng.normal(size=2)) for _ in range(2)
    ]
    answers = [a + 2e-4 * np.abs(a).max() * rng.standard_normal(a.size) for a in answers]
    return record_of(force, np.array(answers), RATE)


def test_clean_single_hits_pass_the_whole_gate_in_99_of_100_cases() -> None:
    rng = np.random.default_rng(11)
    bad = 0
    for _ in range(200):
        hit = checked(random_record(rng))
        bad += not hit.accepted or bool(hit.rejected_channels)
    assert bad <= 2


def test_second_hits_from_5_percent_and_2_to_50_ms_on_are_found_in_99_of_100_cases() -> None:
    rng = np.random.default_rng(12)
    missed = sum(checked(random_record(rng, double=True, channels=1)).accepted for _ in range(200))
    assert missed <= 2


@pytest.mark.parametrize("delay_s", [0.003, 0.0081, 0.02, 0.049])
def test_ratio_and_delay_of_a_second_impact_are_told(delay_s: float) -> None:
    force = force_of(Blow(RATE, "haversine", 1e-3, second=(0.12, delay_s, 1e-3)), np.random.default_rng(1))
    second = find_second_impact(force, find_pulse(force, int(np.argmax(force))), RATE, 0.025)
    assert second.ratio == pytest.approx(0.12, abs=0.015)
    assert second.delay_s == pytest.approx(delay_s, abs=2.5 / RATE)


def test_shoulder_of_a_second_blow_is_seen_inside_the_first_pulse() -> None:
    """4 ms pulses 2 ms apart: the force falls all the way, there is no second maximum."""
    force = force_of(
        Blow(RATE, "half-sine", 4e-3, second=(0.08, 2e-3, 4e-3), noise=2e-4), np.random.default_rng(2)
    )
    hit = checked(record_of(force, clean(length_s=0.4).responses, RATE))
    assert not hit.accepted


def test_tap_before_the_blow_is_a_double_hit_too() -> None:
    force = force_of(Blow(RATE, "half-sine", 1e-3, second=(8.0, 0.01, 1e-3)), np.random.default_rng(2))
    hit = checked(record_of(force, clean(length_s=0.4).responses, RATE))
    assert not hit.accepted
    assert "before" in hit.reason


def test_ringing_of_the_anti_alias_filter_is_no_second_hit() -> None:
    for seed in range(20):
        force = force_of(Blow(4000.0, "half-sine", 0.3e-3, high_pass_hz=1.0), np.random.default_rng(seed))
        second = find_second_impact(force, find_pulse(force, int(np.argmax(force))), 4000.0, 0.025)
        assert second.ratio < 0.025


@pytest.mark.parametrize("sign", [1, -1])
def test_overload_of_the_hammer_rejects_the_hit_and_of_a_response_only_its_channel(sign: int) -> None:
    record = clean()
    record = replace(record, force=sign * record.force, responses=sign * np.asarray(record.responses))
    peak = float(np.abs(record.force).max())
    hit = checked(replace(record, force_full_scale=peak))
    assert not hit.accepted
    assert "overload on hammer" in hit.reason
    full = replace(record.channels[1], full_scale=float(np.abs(record.responses[1]).max()))
    hit = checked(replace(record, channels=(record.channels[0], full)))
    assert hit.accepted
    assert hit.rejected_channels == {"a1"}
    assert checked(replace(record, force_full_scale=1.1 * peak)).accepted
    beyond = checked(replace(record, force_full_scale=0.5 * peak))
    assert "reaches 200 % of its full scale, which no input can: correct it in test.toml" in beyond.reason


@pytest.mark.parametrize(("peak_n", "limit_n"), [(0.05, 0.2), (100.0, None), (3e4, None), (5e5, 4e4)])
def test_a_peak_that_no_hammer_makes_is_told_with_the_limit_that_it_is_beyond(
    peak_n: float, limit_n: float | None
) -> None:
    record = clean()
    force = record.force - np.median(record.force)
    found = verdict(checked(replace(record, force=force * peak_n / force.max())), "force peak")
    assert found.value == pytest.approx(peak_n, rel=1e-3)
    assert found.passes == (limit_n is None)
    if limit_n is not None:
        assert found.limit == limit_n
        assert "unit" in found.message


@pytest.mark.parametrize("noise", [0.0, 1e-3, 5e-3])
def test_clipped_hammer_is_found_from_its_flat_top_with_and_without_noise(noise: float) -> None:
    for seed in range(10):
        record = clean(seed)
        rng = np.random.default_rng(seed)
        peak = float(record.force.max())
        force = np.minimum(record.force, 0.75 * peak) + noise * peak * rng.standard_normal(record.force.size)
        hit = checked(replace(record, force=force))
        assert "clipped" in hit.reason
        assert verdict(hit, "clipping", "hammer").value > 0.7


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_clipped_response_loses_its_channel_only(noise: float) -> None:
    for seed in range(10):
        record = clean(seed)
        rng = np.random.default_rng(seed)
        responses = record.responses.copy()
        level = 0.5 * float(np.abs(responses[0]).max())
        responses[0] = np.clip(responses[0], -level, level) + noise * level * rng.standard_normal(
            responses.shape[1]
        )
        hit = checked(replace(record, responses=responses))
        assert hit.accepted
        assert hit.rejected_channels == {"a0"}


@pytest.mark.parametrize(("noise", "rejected"), [(0.0, {"a0"}), (1e-3, set())])
@pytest.mark.parametrize("times", [1.5, 100.0])
def test_a_flat_top_far_below_the_stated_full_scale_is_told_and_taken_out_where_it_is_one_value(
    noise: float, rejected: set[str], times: float
) -> None:
    record = clean()
    responses = record.responses.copy()
    level = 0.3 * float(np.abs(responses[0]).max())
    added = noise * level * np.random.default_rng(0).standard_normal(responses.shape[1])
    responses[0] = np.clip(responses[0], -level, level) + added
    full = replace(record.channels[0], full_scale=times * level)
    hit = checked(replace(record, responses=responses, channels=(full, record.channels[1])))
    found = verdict(hit, "clipping", "a0")
    assert not found.passes
    assert found.value > found.limit
    assert ("of its full scale" in found.message) == (times > 4)
    assert hit.rejected_channels == (rejected if times > 4 else {"a0"})
    assert verdict(hit, "clipping", "a1").passes


@pytest.mark.parametrize("full_scale", [np.inf, 100.0])
def test_rounded_tops_far_below_full_scale_are_left_in_peace(full_scale: float) -> None:
    record = clean()
    x = np.asarray(record.responses)
    level = 0.5 * np.abs(x[0]).max()
    rounded = np.stack([x[0] / (1 + np.abs(x[0] / level) ** 8) ** (1 / 8), x[1]])
    full = replace(record.channels[0], full_scale=full_scale * level)
    found = verdict(
        checked(replace(record, responses=rounded, channels=(full, record.channels[1]))), "clipping", "a0"
    )
    assert found.passes == (full_scale < np.inf)
    assert found.passes == (found.value < found.limit)


def test_coarse_steps_of_a_converter_are_no_flat_tops() -> None:
    for seed in range(40):
        record = clean(seed)
        x = np.asarray(record.responses)
        step = np.abs(x).max() / (12 + seed)
        full = tuple(replace(c, full_scale=400 * step) for c in record.channels)
        hit = checked(replace(record, responses=np.round(x / step) * step, channels=full))
        assert all(v.passes and v.value < v.limit for v in hit.verdicts if v.check == "clipping")


@pytest.mark.parametrize(("harder", "clipped"), [(0.7, True), (3.0, False)])
def test_rounded_tops_are_clipped_unless_the_channel_goes_far_beyond_them_in_another_record(
    harder: float, clipped: bool
) -> None:
    record = clean()
    x = np.asarray(record.responses)
    level = 0.5 * np.abs(x[0]).max()
    rounded = np.stack([x[0] / (1 + np.abs(x[0] / level) ** 8) ** (1 / 8), x[1]])
    soft = replace(record, responses=rounded)
    hard = replace(record, file="hard.csv", force=harder * record.force, responses=harder * x)
    assert checked(soft).rejected_channels == {"a0"}
    first, second = hits_of_test([soft, hard])
    assert first.rejected_channels == ({"a0"} if clipped else set())
    assert not second.rejected_channels


def test_dead_channels_are_found_and_a_silent_working_sensor_is_not_dead() -> None:
    record = clean()
    rng = np.random.default_rng(3)
    n = record.force.size
    t = np.arange(n) / RATE
    cases = {
        "constant": np.zeros(n),
        "offset": np.full(n, 3.7),
        "one step": 1e-4 * rng.integers(0, 2, n),
        "hum": 0.2 * np.sin(2 * np.pi * 50.03 * t + 1)
        + 0.02 * np.sin(2 * np.pi * 150.09 * t)
        + 1e-4 * rng.standard_normal(n),
        "hum of 60 Hz": 0.2 * np.sin(2 * np.pi * 59.96 * t + 1) + 1e-4 * rng.standard_normal(n),
        "silent": 2e-3 * rng.standard_normal(n) + 1.2,
        "noise under hum": 2e-3 * rng.standard_normal(n) + 6e-3 * np.sin(2 * np.pi * 50 * t),
        "silent with hum": 2e-3 * rng.standard_normal(n) + 2e-3 * np.sin(2 * np.pi * 50 * t),
        "answer on hum": 0.1 * np.sin(2 * np.pi * 50 * t)
        + record.responses[1] / np.abs(record.responses[1]).max(),
    }
    dead = set()
    for name, samples in cases.items():
        hit = checked(replace(record, responses=np.stack([samples, record.responses[1]])))
        assert hit.accepted
        if hit.rejected_channels:
            assert not verdict(hit, "dead channel", "a0").passes, name
            dead.add(name)
    assert dead == {"constant", "offset", "one step", "hum", "hum of 60 Hz"}


def test_response_that_has_not_decayed_is_reported_with_its_ratio() -> None:
    assert verdict(checked(clean()), "response decay", "a0").passes
    rng = np.random.default_rng(0)
    force = force_of(Blow(RATE, "half-sine", 1e-3, length_s=0.4), rng)
    slow = modal_response(force - np.median(force), RATE, np.array([-5 + 2000j]), np.array([1j]))
    hit = checked(record_of(force, slow[None, :], RATE))
    ring = verdict(hit, "response decay", "a0")
    # exp(-5·0.36 s) between blocks of a twentieth of the record.
    assert ring.value == pytest.approx(np.exp(-5 * 0.36), rel=0.05)
    assert not ring.passes
    assert ring.consequence == "warn"
    assert hit.accepted


def test_usable_band_of_a_half_sine_is_where_its_known_spectrum_has_dropped_20_db() -> None:
    width = 1e-3
    rate = 102400.0
    x = np.arange(4096) / rate / width - 2
    force = np.where((x > 0) & (x < 1), np.sin(np.pi * np.clip(x, 0, 1)), 0.0)
    band, _ = usable_band_hz(force, find_pulse(force, int(np.argmax(force))), rate, 20.0)
    u = np.linspace(0.6, 1.4, 100001)
    spectrum = np.abs(np.cos(np.pi * u) / (1 - 4 * u**2))
    assert band == pytest.approx(u[np.argmax(spectrum < 0.1)] / width, rel=0.01)


def test_soft_tip_is_warned_about_but_not_rejected() -> None:
    hit = checked(clean())
    soft = verdict(hit, "force spectrum")
    assert not soft.passes
    assert soft.consequence == "warn"
    assert soft.limit == pytest.approx(RATE / 2.56)
    assert 1000 < soft.value < 1500
    assert hit.accepted


def test_noise_is_measured_beside_a_hit_an_offset_and_hum() -> None:
    rng = np.random.default_rng(5)
    record = clean()
    t = np.arange(record.force.size) / RATE
    quiet = record.force * 0 + 0.03 * rng.standard_normal(record.force.size) + 4 + np.sin(2 * np.pi * 50 * t)
    assert noise_of(quiet) == pytest.approx(0.03, rel=0.2)


def test_real_hits_raise_no_false_alarm(test_data: Path) -> None:
    from ema_pipeline.ingest.campaign import read_campaign
    from ema_pipeline.ingest.load import load_records

    folders = [
        test_data / "realdata" / "five_hits_25600hz",
        test_data / "realdata" / "aircraft_roving_hammer",
    ]
    folders += sorted(p for p in (test_data / "blind").iterdir() if p.is_dir())
    count = 0
    for folder in folders:
        for test in read_campaign(folder).tests:
            for hit in hits_of_test(list(load_records(test))):
                assert hit.accepted, (hit.file, hit.reason)
                assert not hit.rejected_channels, hit.file
                count += 1
    assert count >= 190


@pytest.mark.parametrize("constant", [False, True])
def test_channels_that_hold_the_same_samples_are_told_unless_they_are_dead(constant: bool) -> None:
    record = clean()
    one = np.zeros(record.force.size) if constant else np.asarray(record.responses)[0]
    copies = [
        v for v in checked(replace(record, responses=np.stack([one, one]))).verdicts if v.check == "copy"
    ]
    assert [v.message.partition(":")[0] for v in copies] == (
        [] if constant else ["channels 'a0' and 'a1' hold the same samples"]
    )
    assert not [v for v in checked(record).verdicts if v.check == "copy"]


@pytest.mark.parametrize("factor", [0.0, 1e-200])
def test_a_record_without_a_blow_is_left_out_while_the_others_go_on(factor: float) -> None:
    good = clean()
    dead = replace(good, file="dead.csv", force=factor * good.force)
    hits = hits_of_test([good, dead, replace(good, file="second.csv")])
    assert [h.file for h in hits] == [good.file, "dead.csv", "second.csv"]
    assert [h.accepted for h in hits] == [True, False, True]
    assert "no hit found on hammer channel" in hits[1].reason


def lost(hit: Hit) -> dict[str, str]:
    return {v.channel: v.message for v in hit.verdicts if v.check == "lost samples"}


@pytest.mark.parametrize("held", [False, True])
def test_a_block_that_was_lost_amid_a_signal_is_named_with_its_place(held: bool) -> None:
    record = clean()
    peak = int(np.argmax(record.force))
    cut = slice(peak + 800, peak + 1100)
    responses = np.asarray(record.responses).copy()
    responses[0, cut] = responses[0, cut.start - 1] if held else 0.0
    hit = checked(replace(record, responses=responses))
    assert list(lost(hit)) == ["a0"]
    assert hit.accepted
    assert hit.rejected_channels == {"a0"}
    if not held:
        assert "a0 stands at 0 for 300 samples, +0.0625 to +0.08594 s from the blow" in lost(hit)["a0"]
    force = record.force.copy()
    force[cut] = 0.0
    hit = checked(replace(record, force=force))
    assert list(lost(hit)) == ["hammer"]
    assert not hit.accepted


def test_what_stands_still_before_the_blow_behind_the_decay_or_within_a_step_was_not_lost() -> None:
    record = clean()
    peak = int(np.argmax(record.force))
    x = np.asarray(record.responses)
    before, behind = x.copy(), x.copy()
    before[:, : peak - 20] = 0.0
    behind[:, peak + 900 :] = 0.0
    coarse = np.round(x / np.abs(x).max() * 12) * np.abs(x).max() / 12
    t = np.arange(x.shape[1]) / RATE
    slow = np.round(20 * np.exp(-4 * t) * np.sin(2 * np.pi * 5 * t)) * np.ones((2, 1))
    assert max(np.diff(np.flatnonzero(np.diff(slow[0])))) > 300
    for responses in (x, before, behind, coarse, slow):
        assert lost(checked(replace(record, responses=responses))) == {}
    windowed = record.force - np.median(record.force)
    windowed[: peak - 100] = windowed[peak + 100 :] = 0.0
    assert lost(checked(replace(record, force=windowed))) == {}
    twice = windowed + np.roll(windowed, 2000)
    assert lost(checked(replace(record, force=twice))) == {}
