"""Checks on the samples of one channel in one hit, after ISO 7626-5: overload, clipping, losses, decay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult, Consequence, judged
from ema_pipeline.ingest.clipping import flat_top_share, stands_at_top
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.lost_samples import SHORTEST, lost_stretch
from ema_pipeline.ingest.pulse import Pulse, noise_of, step_of
from ema_pipeline.ingest.records import ResponseChannel

OVERLOAD = "ISO 7626-5, overload of the measuring channels"
DECAY = "ISO 7626-5, record length and decay of the response"

FLAT_TOP_LIMIT = 0.7
"""Smooth peaks have 0.5: the time within ε of the top grows with √ε."""

SURE_FLAT_TOP = 0.85
"""Flatter tops are clipped whatever else is known; 1 in 1600 channels of weak signals lies between the two limits."""

FAR_BELOW_SCALE = 0.25
"""No input clips below this share of its full scale: a sensor's own supply ends at half the usual input range. What is
flat there all the same was clipped before the input, or the full scale is not the one stated."""

BEYOND_SCALE = 1.1
"""No input reads more than this share of its full scale, with what some leave above it: it is not the one stated."""

HUM_HZ = (50.0, 60.0)

HUM_ONLY = 0.98
"""Share of a channel's power in mains lines from which on it carries nothing else."""


def check_response(
    channel: ResponseChannel,
    samples: NDArray[np.float64],
    pulse: Pulse,
    rest: int,
    rate: float,
    settings: HitSettings,
) -> list[CheckResult]:
    """All checks of a response, the first of which is whether the channel is dead: nothing else is asked of one.

    Parameters
    ----------
    channel : ResponseChannel
    samples : ndarray, (n_samples,)
        Of the hit.
    pulse : Pulse
        The blow, in the same samples.
    rest : int
        Samples at the beginning in which the structure is at rest.
    rate : float
        Sample rate, Hz.
    settings : HitSettings
    """
    step = step_of(samples)
    dead = _dead_channel(channel.name, samples, step, pulse, rest, rate)
    if not dead.passes:
        return [dead]
    noise = noise_of(samples, step)
    return [
        dead,
        *lost_samples(samples, step, channel.name, "reject_channel", pulse.peak, rate),
        overload(samples, channel.full_scale, channel.name, "reject_channel", pulse.peak, rate, settings),
        flat_top(samples, channel.full_scale, channel.name, "reject_channel", noise),
        _decay(channel.name, samples, pulse, rest, noise, settings),
    ]


def _dead_channel(
    name: str, samples: NDArray[np.float64], step: float, pulse: Pulse, rest: int, rate: float
) -> CheckResult:
    """A channel that carries a constant, a flickering last bit, or nothing but mains hum.

    A working sensor at a node shows its own broadband noise instead, many steps of the converter high; it is
    not dead, however silent. The value is the number of converter steps that the channel spans, which
    for a dead one is at most one.
    """
    spans = float(np.ptp(samples) / step) if step > 0 else 0.0
    silent = spans > 1.5 and not _answers(samples, pulse, rest)
    hum = _hum_share(samples, rate) if silent else 0.0
    only_hum = hum > HUM_ONLY
    passes = spans > 1.5 and not only_hum
    if only_hum:
        share = f"{100 * hum:.1f} % of its power"
        fault = f"{name} carries mains hum only ({share}) and no response to the blow: open cable?"
    elif spans == 0:
        fault = f"{name} is constant at {samples[0]:.3g}: sensor or cable dead"
    else:
        fault = f"{name} flickers by one converter step only: sensor or cable dead"
    value = 0.0 if only_hum else min(spans, 1e12)
    return judged("dead channel", value, 1.5, passes, "", "reject_channel", fault, channel=name, unit="steps")


def overload(
    samples: NDArray[np.float64],
    full_scale: float,
    name: str,
    consequence: Consequence,
    peak: int,
    rate: float,
    settings: HitSettings,
) -> CheckResult:
    """Whether a channel came near its full scale, or beyond what an input can read."""
    largest = float(max(samples.max(), -samples.min()))
    share = largest / full_scale if np.isfinite(full_scale) else 0.0
    passes = share < settings.overload
    at = int(np.argmax(np.abs(samples)))
    fault = f"overload on {name}: {100 * share:.1f} % of full scale {(at - peak) / rate:+.4g} s from the blow"
    if share > BEYOND_SCALE:
        fault = f"{name} reaches {100 * share:.0f} % of its full scale, which no input can: correct it in test.toml"
    return judged("overload", share, settings.overload, passes, OVERLOAD, consequence, fault, channel=name)


def flat_top(
    samples: NDArray[np.float64], full_scale: float, name: str, consequence: Consequence, noise: float
) -> CheckResult:
    """Whether the tops of a channel are flat, at its full scale or far below it."""
    share = flat_top_share(samples, noise)
    used = float(max(samples.max(), -samples.min())) / full_scale
    far_below = 0 < used < FAR_BELOW_SCALE
    if far_below and FLAT_TOP_LIMIT <= share < SURE_FLAT_TOP:
        share = 0.0  # undecided: nothing clips there
    passes = share < FLAT_TOP_LIMIT
    fault = f"{name} is clipped: its tops are flat; use a lower gain or hit softer"
    if far_below:
        fault = (
            f"{name} is clipped at {100 * used:.2f} % of its full scale: its tops are flat; look for a saturated "
            "amplifier, or correct the full scale in test.toml"
        )
        consequence = consequence if stands_at_top(samples) else "warn"
    return judged("clipping", share, FLAT_TOP_LIMIT, passes, OVERLOAD, consequence, fault, channel=name)


def lost_samples(
    samples: NDArray[np.float64], step: float, name: str, consequence: Consequence, peak: int, rate: float
) -> list[CheckResult]:
    """A verdict only where samples were lost."""
    start, stop = lost_stretch(samples, step)
    if start == stop:
        return []
    fault = (
        f"{name} stands at {samples[start]:.4g} for {stop - start} samples, {(start - peak) / rate:+.4g} to "
        f"{(stop - peak) / rate:+.4g} s from the blow, amid a signal: samples were lost; export or record again"
    )
    verdict = judged(
        "lost samples", stop - start, SHORTEST, False, "", consequence, fault, channel=name, unit="samples"
    )
    return [verdict]


def _hum_share(samples: NDArray[np.float64], rate: float) -> float:
    """Share of the power, offset taken off, in 50 or 60 Hz and harmonics: a least-squares fit of sines.

    A fit does not leak, whatever the record's length; the mains' own drift of ±0.1 Hz is searched.
    """
    centred = samples - samples.mean()
    total = float(centred @ centred)
    if total <= 0:
        return 0.0
    # The first second shows it as well as all of it and bears the mains' drift better.
    n = min(centred.size, int(rate))
    part, time = centred[:n], np.arange(n) / rate
    power = float(part @ part)
    best = 0.0
    for mains in HUM_HZ:
        # Fewer than two periods, or no room below Nyquist: not to be told from vibration.
        if n < 2 * rate / mains or mains > 0.45 * rate or power <= 0:
            continue
        for frequency in mains + np.array([-0.1, 0.0, 0.1]):
            harmonics = frequency * np.arange(1, 8)
            phase = 2 * np.pi * np.outer(time, harmonics[harmonics < 0.45 * rate])
            basis = np.hstack([np.ones((n, 1)), np.cos(phase), np.sin(phase)])
            weights, *_ = np.linalg.lstsq(basis, part, rcond=None)
            rest = part - basis @ weights
            best = max(best, 1 - float(rest @ rest) / power)
            if best < 0.5:
                break
    return best


def _answers(samples: NDArray[np.float64], pulse: Pulse, rest: int) -> bool:
    """True where the channel swings more after the blow than before it, or than late in the record."""
    span = min(max(int(16 * pulse.width), 64), samples.size // 4)
    after = samples[pulse.start : pulse.start + span]
    quiet = samples[:rest] if rest >= span else samples[-span:]
    return bool(np.std(after) > 1.5 * np.std(quiet))


def _decay(
    name: str, samples: NDArray[np.float64], pulse: Pulse, rest: int, noise: float, settings: HitSettings
) -> CheckResult:
    """Response at the end of the record over its largest, noise and hum taken off.

    Both are rms over a twentieth of the record. What the channel shows before the blow (or, in the middle
    of a recording, its broadband noise) is no response. A channel that shows nothing but noise has decayed.
    """
    length = max(samples.size // 20, 8)
    quiet = float(np.std(samples[:rest])) if rest >= 32 else noise
    blocks = samples[samples.size % length :].reshape(-1, length)
    blocks = blocks[max(0, (pulse.start - samples.size % length) // length) :]
    # Offset from the end: an AC-coupled or drifting channel is centred where it matters.
    rms = np.sqrt(np.mean((blocks - np.mean(blocks[-1])) ** 2, axis=1))
    largest = float(rms.max())
    left = float(np.sqrt(max(rms[-1] ** 2 - quiet**2, 0.0)))
    # Scatter of an rms over n samples is rms/√(2n): less than three times that is no response.
    silent = left < quiet * np.sqrt(3 / np.sqrt(2 * length)) * 1.5 or largest < 3 * quiet
    ratio = 0.0 if silent or largest == 0 else left / largest
    limit = settings.residual_response
    fault = f"{name} still at {100 * ratio:.1f} % of its largest at the end: record longer"
    return judged("response decay", ratio, limit, ratio <= limit, DECAY, "warn", fault, channel=name)
