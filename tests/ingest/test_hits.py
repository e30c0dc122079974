"""Finding hits in records and giving them one length."""

from __future__ import annotations

import gzip
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from simulate_hits import Blow, force_of, modal_response, record_of

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.hit_checks import check_hit, hits_of_test
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.hits import align_hits, find_hits, trim_hits
from ema_pipeline.ingest.pulse import find_pulse
from ema_pipeline.ingest.records import Record, cut_hit

RATE = 5120.0


def recording(times: list[float], heights: list[float], length_s: float, sign: int = 1) -> Record:
    """A continuous recording: half-sine blows of 1 ms, noise, an offset, and a response of 30 rad/s decay."""
    rng = np.random.default_rng(0)
    t = np.arange(int(length_s * RATE)) / RATE
    force = 0.02 * rng.standard_normal(t.size)
    response = 0.01 * rng.standard_normal(t.size)
    for time, height in zip(times, heights, strict=True):
        x = (t - time) / 1e-3
        force += height * np.where((x > 0) & (x < 1), np.sin(np.pi * np.clip(x, 0, 1)), 0)
        since = np.clip(t - time, 0, None)
        response += 0.1 * height * np.exp(-30 * since) * np.sin(2 * np.pi * 200 * since)
    return record_of(sign * force - 7.0, response[None, :], RATE)


def test_record_with_one_hit_is_used_whole() -> None:
    record = recording([0.1], [50.0], 2.0)
    (hit,) = find_hits(record)
    assert (hit.start, hit.stop) == (0, record.force.size)
    assert hit.peak / RATE == pytest.approx(0.1005, abs=2e-4)
    assert hit.peak_force == pytest.approx(50, rel=0.05)


def test_hammer_with_negative_polarity_and_offset_is_found_with_its_sign() -> None:
    (hit,) = find_hits(recording([0.1], [50.0], 2.0, sign=-1))
    assert hit.peak_force == pytest.approx(-50, rel=0.05)


def test_every_hit_of_a_continuous_recording_is_found_whatever_its_size() -> None:
    times, heights = [0.5, 2.1, 3.4, 5.2, 6.6], [80.0, 20.0, 45.0, 12.0, 60.0]
    record = recording(times, heights, 8.0)
    hits = find_hits(record)
    assert [round(h.peak / RATE, 1) for h in hits] == times
    assert [h.number for h in hits] == [1, 2, 3, 4, 5]
    assert all(a.stop <= b.start for a, b in pairwise(hits))
    aligned = align_hits(hits, RATE)
    lengths = {h.stop - h.start for h in aligned}
    assert len(lengths) == 1
    assert all(h.start < h.peak - 3 for h in aligned)
    assert all(check_hit(record, h).accepted for h in aligned)


def test_two_blows_40_ms_apart_are_one_hit_with_a_failed_double_hit_verdict() -> None:
    record = recording([0.5, 0.54, 2.0, 3.5], [50.0, 30.0, 50.0, 50.0], 5.0)
    hits = [check_hit(record, h) for h in find_hits(record)]
    assert [h.accepted for h in hits] == [False, True, True]
    assert "second impact" in hits[0].reason
    assert "ms after the peak" in hits[0].reason
    double = next(v for v in hits[0].verdicts if v.check == "double hit")
    assert double.value == pytest.approx(0.6, abs=0.05)


def test_bounce_far_closer_than_the_usual_spacing_is_no_hit_of_its_own() -> None:
    record = recording([1.0, 3.0, 3.3, 5.0, 7.0], [50.0, 50.0, 15.0, 50.0, 50.0], 9.0)
    hits = [check_hit(record, h) for h in find_hits(record)]
    assert [h.accepted for h in hits] == [True, False, True, True]


def test_record_without_a_blow_is_refused_and_the_message_names_file_and_channel() -> None:
    rng = np.random.default_rng(1)
    for force in (np.zeros(4096), rng.standard_normal(4096), np.sin(np.arange(4096) * 0.3) + 4):
        with pytest.raises(EmaError, match=r"r\.csv.*hammer"):
            find_hits(record_of(force, rng.standard_normal((1, 4096)), RATE))


def test_slow_drift_of_the_hammer_amplifier_is_no_blow() -> None:
    record = recording([0.1], [20.0], 8.0)
    t = np.arange(record.force.size) / RATE
    drifting = replace(record, force=record.force + 3 * np.sin(2 * np.pi * 0.2 * t))
    assert len(find_hits(drifting)) == 1


def test_hit_without_room_is_rejected_rather_than_shortening_all_others() -> None:
    record = recording([0.5, 2.5, 4.5, 6.5], [50.0] * 4, 6.8)
    aligned = align_hits(find_hits(record), RATE)
    assert [h.accepted for h in aligned] == [True, True, True, False]
    assert "only 0.309 s" in aligned[-1].reason
    assert aligned[0].stop - aligned[0].start > 1.9 * RATE


def test_every_impact_point_keeps_a_hit_when_lengths_differ() -> None:
    long = recording([0.5], [50.0], 4.0)
    short = replace(recording([0.1], [50.0], 1.0), file="s.csv", impact=long.impact.parse("p9.z"))
    hits = hits_of_test([long, replace(long, file="l2.csv"), short])
    assert all(h.accepted for h in hits)
    assert len({h.stop - h.start for h in hits}) == 1


def test_records_that_do_not_decay_start_at_the_blow_and_decayed_ones_stay_whole() -> None:
    decayed = recording([0.1], [50.0], 2.0)
    (hit,) = hits_of_test([decayed])
    assert (hit.start, hit.stop) == (0, decayed.force.size)
    cut = recording([0.03], [50.0], 0.13)
    (hit,) = hits_of_test([cut])
    samples = cut_hit(cut, hit)
    pulse = find_pulse(samples.force, hit.peak - hit.start)
    assert 16 <= pulse.start <= 18  # what rings ahead of the pulse under the noise stays in
    assert samples.force.size % 2 == 0
    later = replace(recording([0.04], [50.0], 0.14), file="later.csv")
    both = hits_of_test([cut, later])
    assert len({h.peak - h.start for h in both}) == 1
    assert len({h.stop - h.start for h in both}) == 1
    (whole,) = hits_of_test([cut], HitSettings(trim="none"))
    assert (whole.start, whole.stop) == (0, cut.force.size)
    assert trim_hits((whole,), [cut], HitSettings(trim="none")) == (whole,)


def test_a_hit_at_the_end_of_its_record_spoils_no_test_that_rings_on() -> None:
    usual = recording([0.03], [50.0], 0.13)
    others = [replace(usual, file=f"{k}.csv") for k in range(3)]
    hits = hits_of_test([*others, replace(recording([0.122], [50.0], 0.13), file="late.csv")])
    assert [h.accepted for h in hits] == [True, True, True, False]
    assert "to the next hit or the end, the test uses" in hits[-1].reason
    assert hits[0].stop - hits[0].start > 0.09 * RATE


def test_a_record_that_begins_within_the_blow_is_told_as_that() -> None:
    rng = np.random.default_rng(0)
    force = 0.02 * rng.standard_normal(4000)
    force[:4] += [50.0, 30.0, -4.0, 2.0]
    (hit,) = hits_of_test([record_of(force, 0.1 * rng.standard_normal((1, 4000)), 2560.0)])
    assert not hit.accepted
    assert "does the record begin or end within the blow?" in hit.reason


def test_trimmed_hits_start_alike_and_keep_every_pulse_whole() -> None:
    """The soft tip's pulse of 16 ms begins long before its peak, the hard tip's of 1 ms shortly before."""
    pulses = [
        force_of(Blow(RATE, "half-sine", width, length_s=1.0), np.random.default_rng(1))
        for width in (1e-3, 16e-3)
    ]
    slow = np.array([-0.5 + 1j * 2 * np.pi * 120])
    records = [
        record_of(
            f, modal_response(f - np.median(f), RATE, slow, np.array([1j]))[None, :], RATE, file=f"{k}.csv"
        )
        for k, f in enumerate(pulses)
    ]
    hits = hits_of_test(records)
    leads = [h.peak - h.start for h in hits]
    assert leads[0] == leads[1]
    assert len({h.stop - h.start for h in hits}) == 1
    for hit, force in zip(hits, pulses, strict=True):
        assert hit.start > 0
        cut_off = force[: hit.start] - np.median(force)
        assert np.abs(cut_off).max() < 0.01 * np.ptp(force)


def test_pulse_of_one_sample_is_found_at_4_khz() -> None:
    force = force_of(Blow(4000.0, "half-sine", 0.3e-3), np.random.default_rng(3))
    (hit,) = find_hits(record_of(force, np.zeros((1, force.size)), 4000.0))
    assert hit.peak / 4000 == pytest.approx(0.0202, abs=5e-4)


def kyowa(path: Path) -> NDArray[np.float64]:
    """Samples (n_channels, n_samples) of a Kyowa PCD-400A text export."""
    lines = gzip.decompress(path.read_bytes()).decode("latin-1").splitlines()
    begin = next(i for i, line in enumerate(lines) if line.strip('"').startswith("Unit")) + 1
    return np.array(
        [[float(x) for x in line.split(",")[1:6]] for line in lines[begin:] if line[:1].isdigit()]
    ).T


def test_blow_of_one_sample_is_found_in_real_records_at_50_hz(test_data: Path) -> None:
    seen = []
    for path in sorted((test_data / "realdata" / "frame3_hammer").glob("*.CSV.gz")):
        samples = kyowa(path)
        hits = find_hits(record_of(samples[-1], samples[:4], 50.0, file=path.name))
        seen.append([(h.peak, round(h.peak_force)) for h in hits])
    assert [len(s) for s in seen] == [1, 1, 1]
    assert [s[0][1] for s in seen] == [-924, -1752, -139]
