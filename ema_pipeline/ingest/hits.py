"""Hits in records: a trigger that adapts to noise and hammer, and cuts of one length for a whole test."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.ndimage import uniform_filter1d, white_tophat

from ema_pipeline.check_result import judged
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.pulse import find_pulse, noise_of
from ema_pipeline.ingest.records import Hit, Record

LONGEST_PULSE_S = 0.03
"""What lasts longer is drift, not a blow."""

QUIET_LEAD = 16
"""Samples kept before what is seen of the pulse: the ringing ahead of it goes on under the noise."""

SMALLEST_PULSE = 1e-12
"""N, or V of an uncalibrated hammer; far below the resolution of every converter, so that less is nothing."""

MINIMUM_GUARD = 8
"""Samples kept before a peak at least, so that slowly sampled pulses are whole."""


def find_hits(record: Record, settings: HitSettings | None = None) -> tuple[Hit, ...]:
    """Find the hits of a record.

    The threshold is the larger of `trigger_level` of the largest blow and `trigger_noise` times the
    noise, both taken from the record itself, so that offset, unit and polarity of the hammer channel do not
    matter. Blows that follow each other within `minimum_spacing_s`, or within a quarter of the median
    spacing, are one hit (`check_hit` then finds the second impact).

    Parameters
    ----------
    record : Record
    settings : HitSettings, optional

    Returns
    -------
    tuple of Hit
        Without verdicts. A single hit spans the whole record; several are cut from shortly before their
        peak to shortly before the next; `align_hits` gives them one length.

    Raises
    ------
    EmaError
        Where no blow stands out of the noise.
    """
    settings = settings or HitSettings()
    rate, force = record.sample_rate_hz, record.force
    deviation = force - np.median(force)
    # Drift of the amplifier can exceed the threshold without any blow: only what is short counts.
    longest = max(int(LONGEST_PULSE_S * rate), 9)
    quick = force - uniform_filter1d(force, 10 * longest, mode="nearest")
    sign = 1.0 if quick[np.argmax(np.abs(quick))] >= 0 else -1.0
    short = white_tophat(sign * deviation, size=(longest,))
    height = float(short.max())
    # The median sees hum, which is no broadband noise, and yet no blow either.
    noise = max(noise_of(force), float(np.median(short)))
    threshold = max(settings.trigger_level * height, settings.trigger_noise * noise)
    if height < max(threshold, SMALLEST_PULSE):
        raise EmaError(
            f"{record.file}: no hit found on hammer channel '{record.force_name}': its largest pulse is "
            f"{height:.3g}, its noise {noise:.3g}; "
            "check the hammer's cable and sensitivity, or leave the file out"
        )
    spacing = max(int(settings.minimum_spacing_s * rate), 10)
    peaks = _group(_blows(short, threshold), short, spacing)
    if len(peaks) > 2:
        peaks = _group(peaks, short, max(spacing, int(0.25 * float(np.median(np.diff(peaks))))))
    guard = _guard(rate, settings)
    if len(peaks) == 1:
        bounds = [(0, force.size)]
    else:
        starts = [max(0, p - guard) for p in peaks]
        bounds = list(zip(starts, [*starts[1:], force.size], strict=True))
    return tuple(
        Hit(
            file=record.file,
            number=number,
            impact=record.impact,
            start=start,
            stop=stop,
            peak=peak,
            peak_force=float(deviation[peak]),
            force_unit="N" if record.force_calibrated else "V",
            part=record.part,
        )
        for number, (peak, (start, stop)) in enumerate(zip(peaks, bounds, strict=True), start=1)
    )


def align_hits(
    hits: Sequence[Hit], sample_rate_hz: float, settings: HitSettings | None = None
) -> tuple[Hit, ...]:
    """Give all hits of a test one length, so that their FRFs share a frequency axis.

    Hits that are equally long already stay as they are. Otherwise the common length is the one that keeps
    most time in all, number of hits × length, while every impact point of every part of the test keeps a
    hit; it is rounded down to a length that is fast to transform. A hit with less room than that is rejected,
    with a verdict. Check hits (`check_hit`) after this, since a cut may leave responses that have not decayed.

    Parameters
    ----------
    hits : sequence of Hit
        All hits of one configuration, as `find_hits` returned them.
    sample_rate_hz : float
        Of the records that they were found in.
    settings : HitSettings, optional

    Returns
    -------
    tuple of Hit
        In the same order.
    """
    settings = settings or HitSettings()
    if len({h.stop - h.start for h in hits}) <= 1:
        return tuple(hits)
    guard = _guard(sample_rate_hz, settings)
    starts = [max(h.start, h.peak - guard) for h in hits]
    room = np.array([h.stop - start for h, start in zip(hits, starts, strict=True)])
    length = _common_length(hits, room)
    return tuple(
        _with_length(hit, start, int(space), length, sample_rate_hz)
        for hit, start, space in zip(hits, starts, room, strict=True)
    )


def trim_hits(
    hits: Sequence[Hit], records: Sequence[Record], settings: HitSettings | None = None
) -> tuple[Hit, ...]:
    """Let the hits of a test start at their force pulse where responses have not decayed at the end.

    A response that is cut while it still rings is a sum of truncated exponentials. From the blow to the end
    of the record, of length T, the discrete Fourier transform of each at the FFT lines is that of the whole
    exponential times (1 - exp(sT)): the FRF stays rational with the true poles, only residues change. With
    a delay before the blow that no longer holds, and the modal fit suffers; more so with delays that differ from
    hit to hit, as what is cut off then differs too. So all hits start equally long before their peak, and have
    one length. Decayed tests lose nothing by keeping their records whole, and then equal a plain computation;
    so only tests with an accepted hit that fails the decay check are trimmed. The length is found as in `align_hits`,
    and a hit with less room is rejected: one at the end of its record spoils no test.

    Parameters
    ----------
    hits : sequence of Hit
        All hits of one configuration, checked.
    records : sequence of Record
        Their records.
    settings : HitSettings, optional

    Returns
    -------
    tuple of Hit
        Unchanged where `trim` is "none" or where all responses have decayed.
    """
    settings = settings or HitSettings()
    if settings.trim == "none" or not any(h.rings_on for h in hits if h.accepted):
        return tuple(hits)
    lead = max(
        hit.peak - hit.start - _onset(record.force[hit.start : hit.stop], hit.peak - hit.start)
        for record in records
        for hit in hits
        if hit.file == record.file and hit.accepted
    )
    starts = [max(h.start, h.peak - lead) for h in hits]
    room = np.array([h.stop - s for h, s in zip(hits, starts, strict=True)])
    accepted = [h.accepted for h in hits]
    length = _common_length([h for h in hits if h.accepted], room[accepted])
    return tuple(
        _with_length(hit, start, int(space), length, records[0].sample_rate_hz)
        if hit.accepted
        else replace(hit, start=start, stop=min(start + length, hit.stop))
        for hit, start, space in zip(hits, starts, room, strict=True)
    )


def _common_length(hits: Sequence[Hit], room: NDArray[np.int64]) -> int:
    """Length that keeps most time in all, while every impact point of every part of the test keeps a hit."""
    longest: dict[tuple[str, str], int] = defaultdict(int)
    for hit, length in zip(hits, room, strict=True):
        key = hit.impact.point, hit.part
        longest[key] = max(longest[key], int(length))
    allowed = np.unique(room[room <= min(longest.values())])
    best = max(allowed, key=lambda length: int(length) * int(np.sum(room >= length)))
    return _fast_length_below(int(best))


def _onset(force: NDArray[np.float64], peak: int) -> int:
    """First sample of the pulse, with the anti-alias filter's ringing that runs ahead of it.

    Force that is cut off here is missing in the FRF at all lines: of an undecayed mode, half a percent of the
    pulse costs several percent of its damping.
    """
    pulse = find_pulse(force, peak)
    start = pulse.start
    loud = np.abs(force - pulse.baseline) > max(0.001 * pulse.height, 4 * noise_of(force))
    while start > 0 and loud[max(0, start - 8) : start].any():
        start -= 1
    return max(start - QUIET_LEAD, 0)


def _guard(rate: float, settings: HitSettings) -> int:
    return max(int(settings.pre_trigger_s * rate), MINIMUM_GUARD)


def _blows(force: NDArray[np.float64], threshold: float) -> list[int]:
    """Peak of every stretch above the threshold."""
    above = np.concatenate(([False], force > threshold, [False]))
    edges = np.flatnonzero(np.diff(above.astype(np.int8)))
    return [int(a + np.argmax(force[a:b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _group(peaks: list[int], force: NDArray[np.float64], spacing: int) -> list[int]:
    """Join peaks closer than `spacing` to the one before; the largest of a group stands for it."""
    groups: list[list[int]] = []
    for peak in peaks:
        if groups and peak - groups[-1][-1] < spacing:
            groups[-1].append(peak)
        else:
            groups.append([peak])
    return [max(group, key=lambda p: float(force[p])) for group in groups]


def _fast_length_below(length: int) -> int:
    """Largest even length up to `length` that is fast to transform."""
    for candidate in range(length // 2 * 2, 2, -2):
        if next_fast_len(candidate, real=True) == candidate:
            return candidate
    return length


def _with_length(hit: Hit, start: int, room: int, length: int, rate: float) -> Hit:
    if room >= length:
        return replace(hit, start=start, stop=start + length)
    fault = f"only {room / rate:.3g} s to the next hit or the end, the test uses {length / rate:.3g} s"
    verdict = judged("hit length", room / rate, length / rate, False, "", "reject_hit", fault, unit="s")
    return replace(hit, start=start, verdicts=(*hit.verdicts, verdict))
