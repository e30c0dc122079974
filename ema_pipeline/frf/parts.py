"""FRFs of several parts of one test (two hammers, two sets of sensors) to one set, each in its own band."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality, merged
from ema_pipeline.frf.types import FrfSet

CLEAR = 10.0
"""|H| over its standard deviation from which a line tells how two parts' gains compare."""

FEWEST_LINES = 16
"""Fewer clear lines tell no gain."""

GAIN_SIGMAS = 4.0
"""Gains of two hammers that differ by more than this many standard uncertainties are no matter of calibration."""

LEAST_CALIBRATION = 1e-4
"""No sensitivity is known better, whatever is stated."""

PAIRS_SHARE = 0.1
"""Share of pairs that may end before the band of the whole set does."""

Gains = dict[tuple[str, str], tuple[float, float]]
"""ln of the gain of the first part over that of the second, and its standard uncertainty."""


@dataclass(frozen=True)
class Recorded:
    """How a part was recorded, as far as all parts must be recorded alike.

    Attributes
    ----------
    force_calibrated : bool
    decay_rad_s : float
        Of the exponential window, rad/s.
    quantities : mapping of str to str
        What is measured at each point.
    """

    force_calibrated: bool
    decay_rad_s: float
    quantities: Mapping[str, str]


def joined(parts: Mapping[str, FrfSet]) -> FrfSet:
    """One set of FRFs from those of several parts of a test.

    Where several parts measured a pair of output and input, their FRFs are averaged line by line with the inverse
    of their variances as weights; outside its band a part says nothing, as long as another speaks there. A part
    whose hits are too few for a variance counts with its number of hits.

    Two hammers have two calibration errors. Where the same sensor measured the same pair with both, the ratio
    of the FRFs (the median over clear lines, which a small drift of frequencies does not move) tells the ratio of their
    gains. All gains are estimated from these ratios and the stated calibrations together (least squares), and taken
    out, so that the set has one gain.

    Parameters
    ----------
    parts : mapping of str to FrfSet
        FRFs by the name of their part.

    Returns
    -------
    FrfSet
        Outputs and inputs in order of appearance. The band is that which all but a tenth of the pairs have.

    Raises
    ------
    EmaError
        If lines, windows, calibration or quantities differ; if gains differ by more than their calibration allows; if
        bands leave a gap.
    """
    if len(parts) == 1:
        return next(iter(parts.values()))
    _check_alike(parts)
    sets = _with_one_gain(parts)
    first = next(iter(sets.values()))
    outputs = _points([d for s in sets.values() for d in s.outputs])
    inputs = _points([d for s in sets.values() for d in s.inputs])
    shape = (len(outputs), len(inputs), first.frequency_hz.size)
    frf = np.full(shape, complex(np.nan, np.nan))
    coherence, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    hits, lines = np.zeros(shape[:2], dtype=np.int64), np.ones(shape[:2], dtype=np.int64)
    bands = []
    for o, output in enumerate(outputs):
        for i, point in enumerate(inputs):
            at = {name: _pair(s, output, point) for name, s in sets.items()}
            of_pair = {name: (sets[name], *pair) for name, pair in at.items() if pair is not None}
            if not of_pair:
                continue
            frf[o, i], coherence[o, i], variance[o, i] = _averaged(list(of_pair.values()))
            hits[o, i] = sum(s.hits[row, column] for s, row, column in of_pair.values())
            lines[o, i] = max(
                1 if s.variance_lines is None else s.variance_lines[row, column]
                for s, row, column in of_pair.values()
            )
            bands.append(_covered({name: s.band_hz for name, (s, _, _) in of_pair.items()}, first))
    low, high = np.array(bands).T
    channels = [_channel(sets.values(), point) for point in outputs]
    known = [c for c in channels if c is not None]
    return replace(
        first,
        frf=frf,
        coherence=coherence,
        variance=variance,
        outputs=tuple(outputs.values()),
        inputs=tuple(inputs.values()),
        quantities=tuple(
            next(s.quantities[_row(s, p)] for s in sets.values() if _has(s, p)) for p in outputs
        ),
        hits=hits,
        delay_s=np.array([_delay(sets.values(), p) for p in inputs]),
        band_hz=(
            float(np.quantile(low, 1 - PAIRS_SHARE, method="higher")),
            float(np.quantile(high, PAIRS_SHARE, method="lower")),
        ),
        sensor_mass_kg=np.array(
            [max(float(s.sensor_mass_kg[_row(s, p)]) for s in sets.values() if _has(s, p)) for p in outputs]
        ),
        channels=tuple(known) if len(known) == len(channels) else (),
        hammer=_hammer(sets.values()),
        variance_lines=lines,
        rings_on=any(s.rings_on for s in sets.values()),
    )


def gain_ratios(parts: Mapping[str, FrfSet]) -> Gains:
    """How the gains of any two parts compare, where the same sensors measured the same pairs in both.

    Parameters
    ----------
    parts : mapping of str to FrfSet
    """
    found = {}
    for one, other in combinations(parts, 2):
        a, b = parts[one], parts[other]
        logs = [
            _log_ratio(a, pair_a, b, pair_b)
            for output in _points(a.outputs)
            for point in _points(a.inputs)
            if (pair_a := _pair(a, output, point)) is not None
            and (pair_b := _pair(b, output, point)) is not None
            and _channel([a], output) == _channel([b], output)
        ]
        values = np.concatenate([np.empty(0), *logs])
        if values.size >= FEWEST_LINES:
            spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
            # 1.25: what the median costs against the mean of normal values
            found[one, other] = float(np.median(values)), 1.25 * spread / float(np.sqrt(values.size))
    return found


def _log_ratio(a: FrfSet, pair_a: tuple[int, int], b: FrfSet, pair_b: tuple[int, int]) -> NDArray[np.float64]:
    """ln |H_a|/|H_b| at the lines of both bands at which both are clear.

    Raises
    ------
    EmaError
        If the two have opposite signs.
    """
    inside = _inside(a) & _inside(b)
    x, y = a.frf[pair_a][inside], b.frf[pair_b][inside]
    clear = (np.abs(x) ** 2 > CLEAR**2 * a.variance[pair_a][inside]) & (
        np.abs(y) ** 2 > CLEAR**2 * b.variance[pair_b][inside]
    )
    x, y = x[clear], y[clear]
    if x.size >= FEWEST_LINES and np.median(np.cos(np.angle(x * np.conj(y)))) < -0.5:
        pair = f"{a.outputs[pair_a[0]].point} over {a.inputs[pair_a[1]].point}"
        raise EmaError(
            f"the parts' FRFs of {pair} have opposite signs: a sensor or the hammer is reversed in one; correct "
            "its dof or impact ('-' in front)"
        )
    return np.asarray(np.log(np.abs(x) / np.abs(y)))


def _with_one_gain(parts: Mapping[str, FrfSet]) -> dict[str, FrfSet]:
    """The parts with the differences of their hammers' gains taken out."""
    names, ratios = list(parts), gain_ratios(parts)
    calibration = [_calibration(parts[name]) for name in names]
    rows = [np.eye(len(names))[k] / calibration[k] for k in range(len(names))]
    right = [0.0] * len(names)
    for (one, other), (value, std) in ratios.items():
        a, b = names.index(one), names.index(other)
        allowed = GAIN_SIGMAS * float(np.hypot(np.hypot(calibration[a], calibration[b]), std))
        if abs(value) > allowed:
            raise EmaError(
                f"parts '{one}' and '{other}': FRFs of the same pairs differ by a factor of {np.exp(abs(value)):.3g}, "
                f"calibration allows {np.exp(allowed):.3g}; correct sensitivity_mv of the hammer in one"
            )
        std = max(std, LEAST_CALIBRATION)
        rows.append((np.eye(len(names))[a] - np.eye(len(names))[b]) / std)
        right.append(value / std)
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    return {
        name: replace(s, frf=s.frf / gain, variance=s.variance / gain**2)
        for (name, s), gain in zip(parts.items(), gains, strict=True)
    }


def _calibration(frfs: FrfSet) -> float:
    if not frfs.force_calibrated:
        return 1.0
    return max(frfs.hammer.calibration_std if frfs.hammer else 0.0, LEAST_CALIBRATION)


def _averaged(
    sets: Sequence[tuple[FrfSet, int, int]],
) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64]]:
    """FRF, coherence and variance of one pair from all parts that measured it."""
    frf = np.array([s.frf[o, i] for s, o, i in sets])
    coherence = np.array([s.coherence[o, i] for s, o, i in sets])
    variance = np.array([s.variance[o, i] for s, o, i in sets])
    if len(sets) == 1:
        return frf[0], coherence[0], variance[0]
    known = bool(np.isfinite(variance).all())
    weight = (
        1 / np.maximum(variance, np.finfo(float).tiny)
        if known
        else np.array([np.full(frf.shape[1], float(s.hits[o, i])) for s, o, i in sets])
    )
    inside = np.array([_inside(s) for s, _, _ in sets])
    weight = np.where(inside | ~inside.any(axis=0), weight, 0.0)
    weight = weight / weight.sum(axis=0)
    return (
        np.sum(weight * frf, axis=0),
        np.sum(np.where(weight > 0, weight * coherence, 0.0), axis=0),
        np.sum(np.where(weight > 0, weight**2 * variance, 0.0), axis=0),
    )


def _covered(bands: Mapping[str, tuple[float, float]], frfs: FrfSet) -> tuple[float, float]:
    """The band that the parts cover together.

    Raises
    ------
    EmaError
        If there is a gap between them.
    """
    step = float(frfs.frequency_hz[1])
    (name, (low, high)), *rest = sorted(bands.items(), key=lambda item: item[1])
    for other, (start, end) in rest:
        if start > high + step:
            raise EmaError(
                f"no part covers {high:.4g} to {start:.4g} Hz: '{name}' ends below, '{other}' begins above; widen "
                "band_hz of one, or strike with a tip in between"
            )
        if end > high:
            name, high = other, end
    return low, high


def check_recorded_alike(parts: Mapping[str, Recorded]) -> None:
    """Refuse parts whose FRFs could not stand in one set.

    Raises
    ------
    EmaError
        If calibration or windows differ, or if a point is measured in two quantities.
    """
    (first, a), *rest = parts.items()
    for name, b in rest:
        if a.force_calibrated != b.force_calibrated:
            raise EmaError(
                f"the hammer is calibrated in only one of the parts '{first}' and '{name}'; state its sensitivity"
            )
        if a.decay_rad_s != b.decay_rad_s:
            raise EmaError(
                f"parts '{first}' and '{name}' were recorded with different exponential windows "
                f"({a.decay_rad_s:g} and {b.decay_rad_s:g} rad/s); record them alike"
            )
    known: dict[str, tuple[str, str]] = {}
    for name, part in parts.items():
        for point, quantity in part.quantities.items():
            other, before = known.setdefault(point, (name, quantity))
            if before != quantity:
                raise EmaError(
                    f"{point} is measured as {before} in part '{other}', as {quantity} in part '{name}'; use one "
                    "kind of sensor there"
                )


def _check_alike(parts: Mapping[str, FrfSet]) -> None:
    """Parts must share lines and what `check_recorded_alike` asks for; everything else can only be compared then."""
    (first, a), *rest = parts.items()
    for name, b in rest:
        if a.frequency_hz.shape != b.frequency_hz.shape or not np.allclose(a.frequency_hz, b.frequency_hz):
            raise EmaError(
                f"parts '{first}' and '{name}' differ in sample rate or length of their hits; record them alike"
            )
    check_recorded_alike({name: _recorded(s) for name, s in parts.items()})


def _recorded(frfs: FrfSet) -> Recorded:
    quantities = {d.point: quantity for d, quantity in zip(frfs.outputs, frfs.quantities, strict=True)}
    return Recorded(frfs.force_calibrated, frfs.response_decay_rad_s, quantities)


def _points(dofs: Sequence[Dof]) -> dict[str, Dof]:
    return {d.point: d for d in dofs}


def _pair(frfs: FrfSet, output: str, point: str) -> tuple[int, int] | None:
    """Row and column of a pair; None where it was not measured."""
    rows = [k for k, d in enumerate(frfs.outputs) if d.point == output]
    columns = [k for k, d in enumerate(frfs.inputs) if d.point == point]
    if not rows or not columns or not frfs.hits[rows[0], columns[0]]:
        return None
    return rows[0], columns[0]


def _inside(frfs: FrfSet) -> NDArray[np.bool_]:
    low, high = frfs.band_hz
    return np.asarray((frfs.frequency_hz >= low) & (frfs.frequency_hz <= high))


def _has(frfs: FrfSet, point: str) -> bool:
    return any(d.point == point for d in frfs.outputs)


def _row(frfs: FrfSet, point: str) -> int:
    return next(k for k, d in enumerate(frfs.outputs) if d.point == point)


def _channel(sets: Collection[FrfSet], point: str) -> ChannelQuality | None:
    """What is known of the sensors that measured a point."""
    found: ChannelQuality | None = None
    for s in sets:
        if s.channels and _has(s, point):
            found = merged(found, s.channels[_row(s, point)])
    return found


def _hammer(sets: Collection[FrfSet]) -> ChannelQuality | None:
    found: ChannelQuality | None = None
    for s in sets:
        if s.hammer is not None:
            found = merged(found, s.hammer)
    return found


def _delay(sets: Collection[FrfSet], point: str) -> float:
    """Mean delay of the hits on a point, s."""
    delays, hits = [], []
    for s in sets:
        for k, d in enumerate(s.inputs):
            if d.point == point:
                delays.append(s.delay_s[k])
                hits.append(float(s.hits[:, k].max()))
    return float(np.average(delays, weights=hits))
