"""Checks on single hits, after ISO 7626-5: each gives a verdict with its value, limit and topic."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from ema_pipeline.check_result import CheckResult, judged
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.channel_checks import (
    SURE_FLAT_TOP,
    check_response,
    flat_top,
    lost_samples,
    overload,
)
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.hits import align_hits, find_hits, trim_hits
from ema_pipeline.ingest.pulse import Pulse, find_pulse, find_second_impact, noise_of, step_of
from ema_pipeline.ingest.records import Hit, Record
from ema_pipeline.threads import in_order

DOUBLE_HIT = "ISO 7626-5, avoidance of double impacts"
SPECTRUM = "ISO 7626-5, frequency range of the impact force"

EXCEEDED = 2.0
"""A level that the same channel exceeds this many times in another hit is not where it clips."""

HAMMER_PEAKS_N = (0.2, 40e3)
"""Peaks that impact hammers make: the smallest (1 g, for turbine blades) tap with about 1 N, sledges end at 22 kN."""

_NO_BLOW = 10.0
"""Second impact over the first beyond which there was no first one."""

BAND_OVER_RATE = 1 / 2.56
"""Converters' anti-alias filters are flat up to the sample rate over 2.56."""


def hits_of_test(records: Sequence[Record], settings: HitSettings | None = None) -> tuple[Hit, ...]:
    """Find, align, check and if need be trim the hits of one configuration.

    Parameters
    ----------
    records : sequence of Record
        All records of the configuration; gone through up to three times, but responses are read once.
    settings : HitSettings, optional

    Returns
    -------
    tuple of Hit
        With verdicts, in the order of the records; a record in which no blow is found is one rejected hit.
    """
    settings = settings or HitSettings()
    found: list[Hit] = []
    owner: list[int] = []
    silent: dict[int, Hit] = {}
    copies: dict[int, str] = {}
    seen: dict[bytes, str] = {}
    for index, record in enumerate(records):
        original = seen.setdefault(_digest(record.force), record.file)
        if original != record.file:
            copies[index] = original
        try:
            hits = find_hits(record, settings)
        except EmaError as error:
            silent[index] = _silent_hit(record, str(error), settings)
            continue
        found += hits
        owner += [index] * len(hits)
    if not found:
        return tuple(silent.values())
    aligned = align_hits(found, record.sample_rate_hz, settings)
    checked: list[Hit] = []
    for index, record in enumerate(records):
        mine = [hit for hit, i in zip(aligned, owner, strict=True) if i == index]
        checked += [_copy_told(check_hit(record, hit, settings), copies.get(index, "")) for hit in mine]
    trimmed = trim_hits(_without_false_clipping(checked, owner, records), records, settings)
    placed = [*zip(owner, trimmed, strict=True), *silent.items()]
    return tuple(hit for _, hit in sorted(placed, key=lambda item: item[0]))


def _copy_told(hit: Hit, original: str) -> Hit:
    """The hit with a warning where its record is one that came before: no two blows are the same to the last bit."""
    if not original:
        return hit
    fault = f"{hit.file} holds the same force record as {original}, bit for bit: one is a copy; take it out"
    verdict = judged("copy", 1.0, 0.0, False, "", "warn", fault, unit="copy")
    return replace(hit, verdicts=(*hit.verdicts, verdict))


def _digest(samples: NDArray[np.float64]) -> bytes:
    """Equal for equal samples only."""
    return hashlib.sha256(samples.tobytes()).digest()


def _copied_channel(original: str, name: str) -> CheckResult:
    """No two sensors read the same to the last bit."""
    fault = (
        f"channels '{original}' and '{name}' hold the same samples: one is a copy; correct its name in test.toml or "
        "take the channel out"
    )
    return judged("copy", 1.0, 0.0, False, "", "warn", fault, channel=name, unit="copy")


def _without_false_clipping(
    hits: Sequence[Hit], owner: Sequence[int], records: Sequence[Record]
) -> list[Hit]:
    """Channels whose tops are somewhat flat at a level that they exceed by far in another record are not clipped."""
    highest: dict[str, float] = {}

    def exceeded(verdict: CheckResult, hit: Hit, record: Record) -> bool:
        if verdict.check != "clipping" or verdict.passes or verdict.value >= SURE_FLAT_TOP:
            return False
        name = verdict.channel
        if name not in highest:
            highest[name] = max((_largest(r, name) for r in records), default=0.0)
        return highest[name] > EXCEEDED * _largest(record, name, hit.start, hit.stop)

    kept = []
    for hit, index in zip(hits, owner, strict=True):
        if any(v.check == "clipping" and not v.passes for v in hit.verdicts):
            record = records[index]
            verdicts = tuple(
                replace(v, value=0.0, passes=True, message="") if exceeded(v, hit, record) else v
                for v in hit.verdicts
            )
            kept.append(replace(hit, verdicts=verdicts))
        else:
            kept.append(hit)
    return kept


def _largest(record: Record, name: str, start: int = 0, stop: int | None = None) -> float:
    """Largest excursion of a response channel from its middle; 0 where the record has no such channel."""
    rows = [k for k, channel in enumerate(record.channels) if channel.name == name]
    if not rows:
        return 0.0
    samples = np.asarray(record.responses[rows[0], start:stop])
    return float(np.max(np.abs(samples - np.median(samples))))


def _silent_hit(record: Record, reason: str, settings: HitSettings) -> Hit:
    """A record without a blow, as a hit that is left out."""
    fault, name = reason.removeprefix(f"{record.file}: "), record.force_name
    limit = settings.trigger_noise
    verdict = judged("force level", 0.0, limit, False, "", "reject_hit", fault, channel=name, unit="×")
    return Hit(record.file, 1, record.impact, 0, record.force.size, 0, 0.0, (verdict,), part=record.part)


def check_hit(record: Record, hit: Hit, settings: HitSettings | None = None) -> Hit:
    """Check a hit: double hit, overload, dead channels, decay of the responses, force spectrum.

    Parameters
    ----------
    record : Record
        The record that the hit was found in.
    hit : Hit
    settings : HitSettings, optional

    Returns
    -------
    Hit
        The same hit with its verdicts.
    """
    settings = settings or HitSettings()
    force = record.force[hit.start : hit.stop]
    pulse = find_pulse(force, hit.peak - hit.start)
    rate, name, noise = record.sample_rate_hz, record.force_name, noise_of(force)
    verdicts = [
        *hit.verdicts,
        _double_hit(force, pulse, rate, settings),
        overload(force, record.force_full_scale, name, "reject_hit", pulse.peak, rate, settings),
        flat_top(force, record.force_full_scale, name, "reject_hit", noise),
        _force_level(pulse, noise, name, settings),
        _force_spectrum(force, pulse, rate, name, settings),
    ]
    if record.force_calibrated:
        verdicts.append(_force_peak(hit.peak_force, name))
    verdicts += lost_samples(force, step_of(force), name, "reject_hit", pulse.peak, rate)
    # Before the first hit of a record the structure is at rest: what is there is noise and hum.
    rest = pulse.start if hit.start == 0 and hit.number == 1 else 0

    def check(row: int) -> tuple[list[CheckResult], bytes]:
        samples = record.responses[row, hit.start : hit.stop]
        found = check_response(record.channels[row], samples, pulse, rest, rate, settings)
        return found, _digest(samples)

    seen: dict[bytes, str] = {}
    for channel, (found, digest) in zip(
        record.channels, in_order(check, range(len(record.channels))), strict=True
    ):
        verdicts += found
        original = seen.setdefault(digest, channel.name)
        if original != channel.name and found[0].passes:
            verdicts.append(_copied_channel(original, channel.name))
    return replace(hit, verdicts=tuple(verdicts))


def usable_band_hz(
    force: NDArray[np.float64], pulse: Pulse, sample_rate_hz: float, drop_db: float
) -> tuple[float, float]:
    """Frequency up to which the spectrum of the pulse stays within `drop_db` of its largest, and its level.

    Only the pulse itself is transformed, so that noise after it does not fill the dips.

    Returns
    -------
    band_hz : float
        At most the Nyquist frequency.
    top_db : float
        Level at the sample rate over 2.56, relative to the largest, dB.
    """
    margin = int(2 * pulse.width) + 4
    cut = force[max(0, pulse.start - margin) : pulse.stop + margin] - pulse.baseline
    n = next_fast_len(max(8 * cut.size, 4096), real=True)
    level = np.abs(np.asarray(rfft(cut, n)))
    frequency = np.fft.rfftfreq(n, 1 / sample_rate_hz)
    top = int(np.argmax(level))
    relative = 20 * np.log10(np.maximum(level / max(float(level[top]), 1e-300), 1e-15))
    low = np.flatnonzero(relative[top:] < -drop_db)
    band = float(frequency[top + low[0] - 1]) if low.size else float(frequency[-1])
    return band, float(np.interp(sample_rate_hz * BAND_OVER_RATE, frequency, relative))


def _double_hit(force: NDArray[np.float64], pulse: Pulse, rate: float, settings: HitSettings) -> CheckResult:
    second = find_second_impact(force, pulse, rate, settings.double_hit)
    passes = second.ratio < settings.double_hit
    when = "after" if second.delay_s > 0 else "before"
    apart = abs(second.delay_s)
    span = f"{apart * 1e3:.1f} ms" if apart < 1 else f"{apart:.3g} s"
    fault = f"second impact of {100 * second.ratio:.0f} %, {span} {when} the peak"
    if second.ratio > _NO_BLOW:
        fault = (
            "the force has no pulse where its peak should be: does the record begin or end within the blow?"
        )
    return judged("double hit", second.ratio, settings.double_hit, passes, DOUBLE_HIT, "reject_hit", fault)


def _force_level(pulse: Pulse, noise: float, name: str, settings: HitSettings) -> CheckResult:
    ratio = min(pulse.height / noise, 1e12) if noise > 0 else 1e12
    passes = ratio >= settings.trigger_noise
    fault = f"{name} does not stand out of its noise: {ratio:.1f} times"
    limit = settings.trigger_noise
    return judged("force level", ratio, limit, passes, "", "reject_hit", fault, channel=name, unit="×")


def _force_peak(peak: float, name: str) -> CheckResult:
    """Whether an impact hammer can have made this peak; its unit or sensitivity is wrong if not."""
    size, (low, high) = abs(peak), HAMMER_PEAKS_N
    limit = low if size < low else high
    fault = (
        f"channel '{name}' peaks at {size:.3g} N, which no impact hammer makes ({low:g} to {high:g} N): look up "
        "sensitivity_mv and unit; leave sensitivity_mv out where the file holds newtons"
    )
    passes = low <= size <= high
    return judged("force peak", size, limit, passes, "", "warn", fault, channel=name, unit="N")


def _force_spectrum(
    force: NDArray[np.float64], pulse: Pulse, rate: float, name: str, settings: HitSettings
) -> CheckResult:
    band, top_db = usable_band_hz(force, pulse, rate, settings.force_drop_db)
    wanted = rate * BAND_OVER_RATE
    drop = f"{settings.force_drop_db:.0f} dB up to {band:.4g} Hz"
    fault = f"force within {drop}; {top_db:.0f} dB at {wanted:.4g} Hz"
    passes = band >= wanted
    return judged("force spectrum", band, wanted, passes, SPECTRUM, "warn", fault, channel=name, unit="Hz")
