"""Sensitivities that the data contradict: every FRF held against the model's, channel by channel.

Between resonances an accelerance is set by masses and stiffnesses that a rig states within some per cent, whatever
effect is missing at one place. A channel whose FRFs are all larger or smaller than the model's by one large factor
has a wrong sensitivity; one whose FRFs all have the wrong sign is reversed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.fit.comparison import windowed_accelerance
from ema_pipeline.frf.channel_faults import (
    SAME_FACTOR,
    SENSITIVITY,
    SUSPECT_FACTOR,
    channels_words,
    factor_words,
    likely_cause,
)
from ema_pipeline.frf.channels import SEVERAL
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.defaults import TRANSVERSE
from ema_pipeline.mechanics.system import LinearSystem

Real = NDArray[np.float64]

LINES = 400
"""Lines that are compared, spaced logarithmically so that each mode's neighbourhood counts alike."""

AGREEMENT = 0.5
"""Mean cosine of the phase between measured and modelled FRF from which on the model describes the FRF at all: below,
the FRF is ruled by what the model leaves out (transverse sensitivity, oblique blows) or its modes lie elsewhere."""

ONE_SIZE = 3.0
"""An FRF that differs from the model's, or where none is right from its channel's others, by a larger factor is ruled
by what the model leaves out: oblique blows where it answers blows along one direction hardly at all."""

CLEAR = 0.7
"""At least one FRF of a channel must agree as well as this before the channel is called reversed."""

ROUNDS = 10
"""Rounds in which the signs of outputs and inputs are settled; two or three suffice."""

SMALLEST_LEVEL = 0.02
"""An FRF below this share of the largest at its output and at its input (geometric mean) is nearly a symmetry zero of
the model: what parts that scatter, oblique blows and transverse sensitivity put there is as large."""

LARGEST_TRANSVERSE = 3.0
"""Transverse sensitivity that a sensor may have, over the 1 σ that is stated of it."""


@dataclass(frozen=True)
class _Suspicion:
    """One finding: a factor other than 1, or a sign of −1, of some DOFs of one channel, of blows, or of all."""

    what: str
    factor: float
    cause: str = ""


def suspected_sensitivities(
    frfs: Mapping[str, FrfSet], systems: Mapping[str, Sequence[LinearSystem]]
) -> tuple[CheckResult, ...]:
    """Check the scale and the sign of every channel against the model.

    Parameters
    ----------
    frfs : mapping of configuration to FrfSet
    systems : mapping of configuration to sequence of LinearSystem
        Models of the configuration, e.g. nominal and fitted; the one that agrees best in phase is taken.

    Returns
    -------
    tuple of CheckResult
        One per suspicion, ``passes`` False: `value` is the factor by which the channel reads too high (below 1: too
        low; −1 where it is reversed), `channel` its name, `message` what to look up. Empty where nothing is suspected.
    """
    found: dict[tuple[str, float], list[tuple[str, _Suspicion]]] = {}
    for configuration, measured in frfs.items():
        log_ratio, cosine = _against_model(measured, systems[configuration])
        faults = *_factors(measured, log_ratio, cosine), *_reversed(measured, _of_one_size(log_ratio, cosine))
        for s in faults:
            found.setdefault(
                (s.what, round(4 * math.log(s.factor)) if s.factor > 0 else s.factor), []
            ).append((configuration, s))
    verdicts = []
    for alike in found.values():
        where = "" if len(alike) == len(frfs) else f"{', '.join(c for c, _ in alike)}: "
        verdicts.append(_verdict(where, alike[0][1]))
    return tuple(verdicts)


def _verdict(where: str, s: _Suspicion) -> CheckResult:
    if s.factor < 0:
        fault = f"{where}{s.what} has the opposite sign to the model: change the sign of its dof in test.toml"
        return CheckResult(SENSITIVITY, -1.0, 0.0, "1", False, "", "warn", s.what, fault)
    fault = (
        f"{where}{s.what} reads {factor_words(s.factor)} against the model's masses and stiffnesses: "
        f"look up sensitivity_mv and unit{s.cause}"
    )
    return CheckResult(SENSITIVITY, s.factor, SUSPECT_FACTOR, "1", False, "", "warn", s.what, fault)


def _against_model(frfs: FrfSet, systems: Sequence[LinearSystem]) -> tuple[Real, Real]:
    """Median log ratio of sizes and mean cosine of the phase difference, each (n_outputs, n_inputs).

    Both are NaN where nothing was measured or where the model has a symmetry zero.
    """
    picked = _picked(frfs)
    measured = picked.accelerance()
    best: tuple[float, Real, Real] | None = None
    for system in systems:
        model = windowed_accelerance(system, picked)
        size = np.abs(model)
        level = np.median(size, axis=2)
        largest = np.sqrt(level.max(axis=0, keepdims=True) * level.max(axis=1, keepdims=True))
        known = np.isfinite(measured).all(axis=2) & (level > SMALLEST_LEVEL * largest)
        known &= level > _across(picked, level)
        tiny = np.finfo(float).tiny
        ratio = np.median(np.log(np.maximum(np.abs(measured), tiny)) - np.log(np.maximum(size, tiny)), axis=2)
        product = measured * model.conj()
        cosine = np.mean(product.real / np.maximum(np.abs(product), tiny), axis=2)
        ratio, cosine = np.where(known, ratio, np.nan), np.where(known, cosine, np.nan)
        agreement = float(np.nansum(np.abs(cosine)))
        if best is None or agreement > best[0]:
            best = agreement, ratio, cosine
    assert best is not None
    return best[1], best[2]


def _across(frfs: FrfSet, level: Real) -> Real:
    """What outputs may read of other directions at their body, (n_outputs, n_inputs).

    A stiff shaft hardly turns: a sensor of its rotation reads its bending by transverse sensitivity.
    """
    bodies = np.array([d.body for d in frfs.outputs])
    stated = [c.transverse for c in frfs.channels] or [TRANSVERSE] * len(bodies)
    beside = (bodies[:, None] == bodies) & ~np.eye(len(bodies), dtype=bool)
    strongest = np.max(np.where(beside[..., None], level, 0.0), axis=1)
    return np.asarray(LARGEST_TRANSVERSE * np.array(stated)[:, None] * strongest)


def _picked(frfs: FrfSet) -> FrfSet:
    """The FRFs at some lines of their band."""
    f = frfs.frequency_hz
    low, high = frfs.band_hz
    inside = np.flatnonzero((f >= max(low, f[1])) & (f <= high))
    lines = np.unique(np.geomspace(inside[0], inside[-1], LINES).round().astype(int))
    return replace(
        frfs,
        frequency_hz=f[lines],
        frf=frfs.frf[..., lines],
        coherence=frfs.coherence[..., lines],
        variance=frfs.variance[..., lines],
    )


def _signs(cosine: Real) -> tuple[Real, Real]:
    """Signs of outputs and inputs, +1 or −1, whose product agrees best with the signs of the FRFs.

    Outputs are turned first: the fewest explanations win, and a hammer is rarely turned between blows.
    """
    vote = np.where(np.abs(cosine) >= AGREEMENT, cosine * np.abs(cosine), 0.0)
    rows, columns = np.ones(vote.shape[0]), np.ones(vote.shape[1])
    for _ in range(ROUNDS):
        rows = np.where(vote @ columns < 0, -1.0, 1.0)
        columns = np.where(rows @ vote < 0, -1.0, 1.0)
    both = np.sum(rows < 0) + np.sum(columns < 0)
    if both > (rows.size + columns.size) / 2:  # the same product with all signs turned
        rows, columns = -rows, -columns
    return rows, columns


def _factors(frfs: FrfSet, log_ratio: Real, cosine: Real) -> list[_Suspicion]:
    """Channels that read too high or too low; the hammer where most channels share one factor."""
    weight = np.where(np.abs(cosine) >= AGREEMENT, cosine**2, 0.0)
    known = np.flatnonzero(weight.any(axis=1))
    if not known.size:
        return []
    logs = np.array([_weighted_median(log_ratio[o], weight[o]) for o in known])
    middle = float(np.median(logs))  # common where more than half of the channels share it
    common = middle if np.mean(np.abs(logs - middle) < 2 * math.log(SAME_FACTOR)) > 0.5 else 0.0
    found = []
    if frfs.force_calibrated and abs(common) > math.log(SUSPECT_FACTOR):
        hammer = channels_words([frfs.hammer.name]) if frfs.hammer else "the force channel"
        factor = math.exp(-common)  # an FRF too large is a force too small
        cause = likely_cause(1 / factor, frfs.quantities[0]) or likely_cause(factor, "force")
        what = f"{hammer} (or every response the other way)"
        found.append(_Suspicion(what, factor, cause))
    elif frfs.force_calibrated:
        common = 0.0
    for o, log in zip(known, logs - common, strict=True):
        if abs(log) > math.log(SUSPECT_FACTOR) and not _right_where_struck(
            frfs, int(o), log_ratio - common, cosine
        ):
            cause = likely_cause(math.exp(log), frfs.quantities[o])
            found.append(_Suspicion(_channel_words(frfs, int(o)), math.exp(log), cause))
    return found


def _right_where_struck(frfs: FrfSet, output: int, log_ratio: Real, cosine: Real) -> bool:
    """True where the channel's driving point has the right size: a gain is one for all FRFs of a channel."""
    struck = [i for i, d in enumerate(frfs.inputs) if d.point == frfs.outputs[output].point]
    return any(
        abs(log_ratio[output, i]) <= math.log(SUSPECT_FACTOR) and cosine[output, i] >= CLEAR for i in struck
    )


def _of_one_size(log_ratio: Real, cosine: Real) -> Real:
    """Cosines of FRFs of the right size, or of their channel's where none is right; NaN elsewhere.

    A sign turns no size.
    """
    kept = cosine.copy()
    for logs, own in zip(log_ratio, kept, strict=True):
        weight = np.nan_to_num(own**2)
        if np.any(weight) and not np.any(np.abs(logs) < math.log(ONE_SIZE)):
            logs = logs - _weighted_median(logs, weight)
        own[np.abs(logs) >= math.log(ONE_SIZE)] = np.nan
    return kept


def _reversed(frfs: FrfSet, cosine: Real) -> list[_Suspicion]:
    """Channels and blows of the wrong sign."""
    clear = np.abs(cosine) >= CLEAR
    rows, columns = _signs(cosine)
    if np.all(rows[clear.any(axis=1)] < 0) or np.all(columns[clear.any(axis=0)] < 0):
        hammer = channels_words([frfs.hammer.name]) if frfs.hammer else "the force channel"
        return [_Suspicion(f"{hammer} (or every response)", -1.0)] if clear.any() else []
    found = [
        _Suspicion(_channel_words(frfs, int(o)), -1.0) for o in np.flatnonzero((rows < 0) & clear.any(axis=1))
    ]
    turned = np.flatnonzero((columns < 0) & clear.any(axis=0))
    return found + [_Suspicion(f"the blow on {frfs.inputs[i].point}", -1.0) for i in turned]


def _channel_words(frfs: FrfSet, output: int) -> str:
    """``channel 'a_m2' at m2.x``; the DOF alone where the channel is not known."""
    point = frfs.outputs[output].point
    name = frfs.channels[output].name if output < len(frfs.channels) else ""
    return f"{channels_words(name.split(SEVERAL))} at {point}" if name else point


def _weighted_median(values: Real, weights: Real) -> float:
    kept = np.isfinite(values) & (weights > 0)
    order = np.argsort(values[kept])
    total = np.cumsum(weights[kept][order])
    return float(values[kept][order][np.searchsorted(total, 0.5 * total[-1])])
