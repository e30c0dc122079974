"""Checks that need several hits or several points: coherence, repeatability, driving point, reciprocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.verdict import Verdict

COHERENCE = "ISO 7626-5, coherence function"
DRIVING_POINT = "ISO 7626-5, driving-point measurement"
RECIPROCITY = "ISO 7626-5, reciprocity"
REPEATABILITY = "ISO 7626-5, repeatability"

HITS_FOR_COHERENCE = 3
"""Fewer hits fit almost any line: their coherence says little."""

PEAK_SHARE = 0.01
"""Lines with at least this share of the largest |FRF|² are judged: zeros of the force blow up the rest."""

NODE_LEVEL = 0.1
"""An FRF below this share of the strongest at its sensor is near a node: its noise says little on the test."""

NOISE_MARGIN = 2.0
"""Reciprocal FRFs may differ by their noise: this many times its power is taken off their difference."""


def check_frfs(frfs: FrfSet, settings: FrfSettings | None = None) -> tuple[Verdict, ...]:
    """Check FRFs in their band.

    Parameters
    ----------
    frfs : FrfSet
    settings : FrfSettings, optional

    Returns
    -------
    tuple of Verdict
        All with consequence "warn". Coherence and repeatability per pair of output and input with at least
        two hits (one verdict for the whole set where no pair has two); the sign of each driving point;
        reciprocity of each pair of points measured both ways. `channel` reads "output over input".
    """
    settings = settings or FrfSettings()
    inside = (frfs.frequency_hz >= frfs.band_hz[0]) & (frfs.frequency_hz <= frfs.band_hz[1])
    inside[0] = False
    return (
        *_scatter(frfs, inside, settings),
        *_driving_points(frfs, inside, settings),
        *_reciprocity(frfs, inside, settings),
    )


def _scatter(frfs: FrfSet, inside: NDArray[np.bool_], settings: FrfSettings) -> list[Verdict]:
    """Coherence and repeatability."""
    if not (frfs.hits > 1).any():
        return [
            Verdict(
                check="coherence",
                value=float("nan"),
                limit=settings.minimum_coherence,
                unit="1",
                passes=True,
                clause=COHERENCE,
                consequence="warn",
                message="one hit per point has no coherence: take three or more to know the scatter",
            )
        ]
    verdicts = []
    peak = _peak_power(frfs, inside)
    for o, i in np.argwhere(frfs.hits > 1):
        n = int(frfs.hits[o, i])
        if peak[o, i] <= NODE_LEVEL**2 * np.nanmax(peak[o]):
            continue
        power = np.abs(frfs.frf[o, i, inside]) ** 2
        power[power < PEAK_SHARE * peak[o, i]] = 0.0
        total = float(power.sum())
        coherence = float(frfs.coherence[o, i, inside] @ power / total)
        # Variance of one hit's FRF, not of the mean over n. Noise is there at all lines, scatter of the blows
        # only where the structure answers.
        variance = frfs.variance[o, i, inside]
        excess = (variance - median_filter(variance, variance.size // 16 + 1)).clip(min=0.0)
        scatter = float(np.sqrt(n * excess[power > 0].sum() / total))
        name = f"{frfs.outputs[o]} over {frfs.inputs[i]}"
        enough = n >= HITS_FOR_COHERENCE
        good = not enough or coherence >= settings.minimum_coherence
        steady = scatter <= settings.repeatability
        few = "" if enough else f"two hits are too few to judge coherence by ({coherence:.3f})"
        verdicts += [
            Verdict(
                check="coherence",
                value=coherence,
                limit=settings.minimum_coherence,
                unit="1",
                passes=good,
                clause=COHERENCE,
                consequence="warn",
                channel=name,
                message=few if good else f"coherence of {name} is {coherence:.3f} where its FRF is largest",
            ),
            Verdict(
                check="repeatability",
                value=scatter,
                limit=settings.repeatability,
                unit="1",
                passes=steady,
                clause=REPEATABILITY,
                consequence="warn",
                channel=name,
                message=""
                if steady
                else f"single hits of {name} scatter by {scatter:.0%}: strike one spot, one way",
            ),
        ]
    return verdicts


def _peak_power(frfs: FrfSet, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Largest |FRF|² in the band, (n_outputs, n_inputs); NaN where not measured.

    A high quantile: a few lines in a zero of the force may hold noise as large as a resonance.
    """
    peak = np.full(frfs.hits.shape, np.nan)
    for o, i in np.argwhere(frfs.hits > 0):
        peak[o, i] = np.quantile(np.abs(frfs.frf[o, i, inside]), 0.998) ** 2
    return peak


def _driving_points(frfs: FrfSet, inside: NDArray[np.bool_], settings: FrfSettings) -> list[Verdict]:
    """Sign of driving points: a passive structure takes power in, so that Im(accelerance) ≥ 0."""
    verdicts = []
    for o, output in enumerate(frfs.outputs):
        if output not in frfs.inputs or frfs.hits[o, frfs.inputs.index(output)] == 0:
            continue
        loss = _accelerance(frfs, o, frfs.inputs.index(output), inside).imag
        # Squares: resonances decide, not the noise between them.
        total = float(np.sum(loss**2))
        wrong = float(np.sum(loss[loss < 0] ** 2)) / total if total > 0 else 0.0
        passes = wrong <= settings.negative_driving_point
        reversed_sign = wrong > 0.5
        verdicts.append(
            Verdict(
                check="driving point",
                value=wrong,
                limit=settings.negative_driving_point,
                unit="1",
                passes=passes,
                clause=DRIVING_POINT,
                consequence="warn",
                channel=f"{output} over {output}",
                message=""
                if passes
                else f"driving point {output}: resonances "
                + (
                    "point the wrong way; sensor or hammer is reversed, put '-' before its dof"
                    if reversed_sign
                    else "differ in sign; hammer and sensor are not at one point"
                ),
            )
        )
    return verdicts


def _reciprocity(frfs: FrfSet, inside: NDArray[np.bool_], settings: FrfSettings) -> list[Verdict]:
    """H_ij against H_ji, in accelerance."""
    verdicts = []
    peak = _peak_power(frfs, inside)
    place = {d: o for o, d in enumerate(frfs.outputs)}
    both = [(place[d], i) for i, d in enumerate(frfs.inputs) if d in place]
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
            size = 0.5 * (np.linalg.norm(one) + np.linalg.norm(other))
            noise = np.nan_to_num(frfs.variance[o1, i2, inside] + frfs.variance[o2, i1, inside])[seen]
            beyond = max(float(np.sum(np.abs(one - other) ** 2) - NOISE_MARGIN * np.sum(noise)), 0.0)
            difference = float(np.sqrt(beyond) / size) if size > 0 else 0.0
            passes = difference <= settings.reciprocity
            name = f"{frfs.outputs[o1]} and {frfs.outputs[o2]}"
            verdicts.append(
                Verdict(
                    check="reciprocity",
                    value=difference,
                    limit=settings.reciprocity,
                    unit="1",
                    passes=passes,
                    clause=RECIPROCITY,
                    consequence="warn",
                    channel=name,
                    message=""
                    if passes
                    else f"FRFs between {name} differ by {difference:.0%} with the direction: sign, "
                    "calibration, position or a nonlinearity",
                )
            )
    return verdicts


def _accelerance(frfs: FrfSet, output: int, source: int, inside: NDArray[np.bool_]) -> NDArray[np.complex128]:
    """One FRF in the band as acceleration over force; the whole set at once would double the memory."""
    power = {"acceleration": 0, "velocity": 1, "displacement": 2}[frfs.quantities[output]]
    return np.asarray(frfs.frf[output, source, inside] * (2j * np.pi * frfs.frequency_hz[inside]) ** power)
