"""Checks that need several hits or several points: coherence, repeatability, driving point, reciprocity."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ema_pipeline.check_result import CheckResult, judged
from ema_pipeline.frf.channel_faults import (
    EXCHANGED,
    RECIPROCAL_FACTOR,
    REVERSED,
    SENSITIVITY,
    channels_words,
    factor_words,
    likely_cause,
    reciprocal_factor,
)
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet

COHERENCE = "ISO 7626-5, coherence function"
DRIVING_POINT = "ISO 7626-5, driving-point measurement"
RECIPROCITY = "ISO 7626-5, reciprocity"
REPEATABILITY = "ISO 7626-5, repeatability"

HITS_FOR_COHERENCE = 3
"""Fewer hits fit almost any line: their coherence says little."""

PEAK_SHARE = 0.01
"""Lines with at least this share of the largest |FRF|² are judged: zeros of the force blow up the rest."""

NODE_LEVEL = 0.1
"""An FRF below this share of the strongest at its sensor is near a node: its noise and its sign tell little."""

OBLIQUE_LEVEL = 0.2
"""Oblique blows and transverse sensitivity make responses of up to this share of the largest one to the same blow. Such
a response varies with the direction of every blow, and says nothing of how well the others repeat, or
of their signs."""

STRONG_LEVEL = 0.4
"""Cross FRFs above this share of their driving points are ruled by the structure, not by oblique blows, whose part may
well differ by a factor or in sign with the direction."""

WEAK_LEVEL, OBVIOUS_FACTOR = 0.15, 7.0
"""From this share on such a test makes factors of up to five by itself: only larger ones speak of a sensitivity."""

LINES_OF_ONE_HIT = 5
"""Lines averaged before the sign of a driving point is judged from one hit: where a soft tip has little force, noise is
as large as a resonance, and no second hit shows that it is noise."""

_DERIVATIVES = {"acceleration": 0, "velocity": 1, "displacement": 2}
"""From a quantity to acceleration."""

NOISE_MARGIN = 2.0
"""Reciprocal FRFs may differ by their noise: this many times its power is taken off their difference."""


def check_frfs(frfs: FrfSet, settings: FrfSettings | None = None) -> tuple[CheckResult, ...]:
    """Check FRFs in their band.

    Parameters
    ----------
    frfs : FrfSet
    settings : FrfSettings, optional

    Returns
    -------
    tuple of CheckResult
        All with consequence "warn". Coherence and repeatability per pair of output and input with at least
        two hits (one verdict for the whole set where no pair has two); the sign of each driving point;
        reciprocity of each pair of points measured both ways, or "sensitivity" where a constant factor or a sign
        explains their difference. `channel` reads "output over input".
    """
    settings = settings or FrfSettings()
    low, high = np.searchsorted(frfs.frequency_hz, frfs.band_hz)
    # A slice, not a mask: views of large sets cost nothing. Line 0 is the sensors' offset.
    inside = slice(max(int(low), 1), max(int(high), int(low) + 1) + 1)
    return (
        *_scatter(frfs, inside, settings),
        *_driving_points(frfs, inside, settings),
        *_reciprocity(frfs, inside, settings),
    )


def _scatter(frfs: FrfSet, inside: slice, settings: FrfSettings) -> list[CheckResult]:
    """Coherence and repeatability."""
    if not (frfs.hits > 1).any():
        return [
            CheckResult(
                check="coherence",
                value=float("nan"),
                limit=settings.minimum_coherence,
                unit="1",
                passes=True,
                clause=COHERENCE,
                consequence="warn",
                message=f"one {'average has' if frfs.excitation else 'hit per point has'} no coherence: take three or "
                "more to know the scatter",
            )
        ]
    verdicts = []
    peak = _peak_power(frfs, inside)
    like = {q: [o for o, other in enumerate(frfs.quantities) if other == q] for q in frfs.quantities}
    for o, i in np.argwhere(frfs.hits > 1):
        n = int(frfs.hits[o, i])
        if peak[o, i] <= NODE_LEVEL**2 * np.nanmax(peak[o]):
            continue
        power = _power(frfs, o, i, inside)
        peaks = np.flatnonzero(power >= PEAK_SHARE * peak[o, i])
        power = power[peaks]
        total = float(power.sum())
        coherence = float(frfs.coherence[o, i, inside][peaks] @ power / total)
        name = f"{frfs.outputs[o]} over {frfs.inputs[i]}"
        enough = n >= HITS_FOR_COHERENCE
        good = not enough or coherence >= settings.minimum_coherence
        low = f"coherence of {name} is {coherence:.3f} where its FRF is largest"
        least = settings.minimum_coherence
        judgement = judged("coherence", coherence, least, good, COHERENCE, "warn", low, channel=name)
        if not enough:
            few = f"two {'averages' if frfs.excitation else 'hits'} are too few to judge coherence by ({coherence:.3f})"
            judgement = replace(judgement, message=few)
        verdicts.append(judgement)
        if frfs.excitation:  # blocks and periods are no blows, whose place and direction could differ
            continue
        if peak[o, i] <= OBLIQUE_LEVEL**2 * np.nanmax(peak[like[frfs.quantities[o]], i]):
            continue
        # Variance of one hit's FRF, not of the mean over n. Noise is there at all lines, scatter of the blows
        # only where the structure answers. Lines count by their accuracy: the force fades towards the zeros of
        # its spectrum.
        variance = frfs.variance[o, i, inside]
        seen = np.maximum(variance[peaks], 1e-20 * float(power.max()))
        excess = (seen - _floor(variance, peaks)).clip(min=0.0)
        scatter = float(np.sqrt(n * np.sum(excess / seen) / np.sum(power / seen)))
        steady = scatter <= settings.repeatability
        loose = f"single hits of {name} scatter by {100 * scatter:.0f} %: strike the same spot in the same direction"
        most = settings.repeatability
        verdicts.append(
            judged("repeatability", scatter, most, steady, REPEATABILITY, "warn", loose, channel=name)
        )
    return verdicts


def _peak_power(frfs: FrfSet, inside: slice) -> NDArray[np.float64]:
    """Largest |FRF|² in the band, (n_outputs, n_inputs); NaN where not measured.

    A high quantile: a few lines in a zero of the force may hold noise as large as a resonance.
    """
    peak = np.full(frfs.hits.shape, np.nan)
    for o, i in np.argwhere(frfs.hits > 0):
        power = _power(frfs, o, i, inside)
        place = int(0.998 * (power.size - 1))
        power.partition(place)
        peak[o, i] = power[place]
    return peak


def _power(frfs: FrfSet, output: int, source: int, inside: slice) -> NDArray[np.float64]:
    """|FRF|² of one pair in the band."""
    frf = frfs.frf[output, source, inside]
    return np.asarray(frf.real**2 + frf.imag**2)


def _floor(variance: NDArray[np.float64], lines: NDArray[np.intp]) -> NDArray[np.float64]:
    """Level of a variance between its peaks, at some lines: medians of sixteenths of the band, interpolated.

    The variance has been smoothed over lines, so that every fourth one tells its median.
    """
    sparse = variance[::4]
    width = max(sparse.size // 16, 1)
    count = sparse.size // width
    medians = np.median(sparse[: count * width].reshape(count, width), axis=1)
    centres = 4 * width * (np.arange(count) + 0.5)
    return np.asarray(np.interp(lines, centres, medians))


def _driving_points(frfs: FrfSet, inside: slice, settings: FrfSettings) -> list[CheckResult]:
    """Sign of driving points: a passive structure takes power in, so that Im(accelerance) ≥ 0.

    Lines count in the quantity measured: as acceleration, what a velocity sensor reads beside resonances (its noise,
    a slow mode cut off at the end of the record) would grow with the frequency until it outweighed them.
    """
    limit = settings.negative_driving_point
    place = {d: o for o, d in enumerate(frfs.outputs)}
    own = {place[d]: i for i, d in enumerate(frfs.inputs) if d in place and frfs.hits[place[d], i] > 0}
    wrong = {o: _taken_out(frfs, o, own[o], inside) for o in sorted(own)}
    verdicts, told = [], set[int]()
    for one, other in combinations([o for o, share in wrong.items() if share > limit], 2):
        # each reads the driving point of the other: of reversed ones neither does
        crossed = max(_taken_out(frfs, other, own[one], inside), _taken_out(frfs, one, own[other], inside))
        if crossed <= limit and not told & {one, other}:
            told |= {one, other}
            verdicts.append(_exchanged(frfs, one, other, max(wrong[one], wrong[other]), limit))
    driver, keys = ("force", "'dof'") if frfs.excitation else ("hammer", "'impact', 'dof'")
    for o in sorted(set(own) - told):
        output = frfs.outputs[o]
        if wrong[o] > REVERSED:
            # displacement mistaken for acceleration, or the other way round, looks alike
            what = f"point the wrong way: sensor or {driver} reversed (put '-' before its dof), or its quantity wrong"
        else:
            what = (
                f"differ in sign; {driver} and sensor are not at one point, or its quantity is wrong: look up {keys} "
                "and 'quantity' in test.toml"
            )
        fault, name = f"driving point {output}: resonances {what}", f"{output} over {output}"
        passes = wrong[o] <= limit
        verdicts.append(
            judged("driving point", wrong[o], limit, passes, DRIVING_POINT, "warn", fault, channel=name)
        )
    return verdicts


def _taken_out(frfs: FrfSet, output: int, source: int, inside: slice) -> float:
    """Share of an FRF's lines, by their squares, that no driving point has: power is given back. 1 if not measured."""
    if frfs.hits[output, source] == 0:
        return 1.0
    loss = (frfs.frf[output, source, inside] * 1j ** _DERIVATIVES[frfs.quantities[output]]).imag
    if frfs.hits[output, source] == 1:
        loss = uniform_filter1d(loss, LINES_OF_ONE_HIT, mode="constant")
    # Squares: resonances decide, not the noise between them.
    total = float(np.sum(loss**2))
    return float(np.sum(loss[loss < 0] ** 2)) / total if total > 0 else 0.0


def _exchanged(frfs: FrfSet, one: int, other: int, wrong: float, limit: float) -> CheckResult:
    points = f"{frfs.outputs[one]} and {frfs.outputs[other]}"
    sensors = channels_words([_sensor(frfs, one), _sensor(frfs, other)])
    # exchanged sensors and exchanged points of impact give the same FRFs at these points
    blows, key = ("forces", "dof") if frfs.excitation else ("hits", "impact")
    fault = (
        f"{sensors} or the {blows} on {points} are exchanged: each sensor shows the driving point of the other; "
        f"exchange the dof of these channels or the {key} of these {blows}, whichever is wrong"
    )
    return judged(EXCHANGED, wrong, limit, False, DRIVING_POINT, "warn", fault, channel=points)


def _reciprocity(frfs: FrfSet, inside: slice, settings: FrfSettings) -> list[CheckResult]:
    """H_ij against H_ji, in accelerance."""
    verdicts: list[CheckResult] = []
    place = {d: o for o, d in enumerate(frfs.outputs)}
    both = [(place[d], i) for i, d in enumerate(frfs.inputs) if d in place]
    if len(both) < 2:
        return verdicts
    peak = _peak_power(frfs, inside)
    for first, (o1, i1) in enumerate(both):
        for o2, i2 in both[first + 1 :]:
            if frfs.hits[o1, i2] == 0 or frfs.hits[o2, i1] == 0:
                continue
            if peak[o1, i2] * peak[o2, i1] <= NODE_LEVEL**4 * peak[o1, i1] * peak[o2, i2]:
                continue
            one, other = _accelerance(frfs, o1, i2, inside), _accelerance(frfs, o2, i1, inside)
            power = np.maximum(np.abs(one), np.abs(other)) ** 2
            seen = power >= PEAK_SHARE * power.max()
            one, other = one[seen], other[seen]
            level = (peak[o1, i2] * peak[o2, i1] / (peak[o1, i1] * peak[o2, i2])) ** 0.25
            apart = _sensor(frfs, o1) != _sensor(frfs, o2)
            least = RECIPROCAL_FACTOR ** (1 / min(max(level, STRONG_LEVEL), 1.0))
            factor = reciprocal_factor(one, other, least) if apart and level > WEAK_LEVEL else 1.0
            if level <= STRONG_LEVEL and factor < OBVIOUS_FACTOR and 1 / factor < OBVIOUS_FACTOR:
                factor = 1.0
            if factor != 1.0:
                verdicts.append(_contradiction(frfs, o1, o2, factor, least))
                continue
            size = 0.5 * (np.linalg.norm(one) + np.linalg.norm(other))
            noise = np.nan_to_num(_noise(frfs, o1, i2, inside) + _noise(frfs, o2, i1, inside))[seen]
            beyond = max(float(np.sum(np.abs(one - other) ** 2) - NOISE_MARGIN * np.sum(noise)), 0.0)
            difference = float(np.sqrt(beyond) / size) if size > 0 else 0.0
            passes = difference <= settings.reciprocity
            name = f"{frfs.outputs[o1]} and {frfs.outputs[o2]}"
            fault = (
                f"FRFs between {name} differ by {100 * difference:.0f} % with the direction: hits off their direction "
                "or place, frequencies that drift, or a nonlinearity"
            )
            limit = settings.reciprocity
            verdicts.append(
                judged("reciprocity", difference, limit, passes, RECIPROCITY, "warn", fault, channel=name)
            )
    return verdicts


def _contradiction(frfs: FrfSet, one: int, other: int, factor: float, least: float) -> CheckResult:
    """Two channels whose reciprocal FRFs differ by one constant: a sensitivity or a sign is wrong."""
    sensors = channels_words([_sensor(frfs, one), _sensor(frfs, other)])
    what = ["their signs"] if factor < 0 else []
    size = abs(factor)
    if size != 1.0:
        sides = f"the first reads {factor_words(size)}, or the second {factor_words(1 / size)}"
        what.append(f"sensitivity_mv and unit: {sides}{likely_cause(size, frfs.quantities[one])}")
    fault = f"{sensors} contradict each other (reciprocity of their FRFs): look up {', and '.join(what)}"
    channel = f"{frfs.outputs[one]} and {frfs.outputs[other]}"
    return CheckResult(SENSITIVITY, factor, least, "1", False, RECIPROCITY, "warn", channel, fault)


def _sensor(frfs: FrfSet, output: int) -> str:
    """Name of the channel at an output; its DOF where no channel is known."""
    name = frfs.channels[output].name if output < len(frfs.channels) else ""
    return name or str(frfs.outputs[output])


def _accelerance(frfs: FrfSet, output: int, source: int, inside: slice) -> NDArray[np.complex128]:
    """One FRF in the band as acceleration over force; the whole set at once would double the memory."""
    return np.asarray(frfs.frf[output, source, inside] * _to_acceleration(frfs, output, inside))


def _noise(frfs: FrfSet, output: int, source: int, inside: slice) -> NDArray[np.float64]:
    """Variance of one accelerance."""
    return np.asarray(
        frfs.variance[output, source, inside] * np.abs(_to_acceleration(frfs, output, inside)) ** 2
    )


def _to_acceleration(frfs: FrfSet, output: int, inside: slice) -> NDArray[np.complex128]:
    return np.asarray((2j * np.pi * frfs.frequency_hz[inside]) ** _DERIVATIVES[frfs.quantities[output]])
