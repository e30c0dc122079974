"""Differences of measured and model modes as rows with their uncertainties, and as whitened residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import Residuals, tails
from ema_pipeline.observations.comparison_kernel import number_blocks, whiten

FREQUENCY = "frequency_scatter"
SHAPE = "shape_scatter"
UNEVEN_DAMPING = "uneven_damping"
FREQUENCY_NOISE = "frequency_noise"
SHAPE_NOISE = "shape_noise"

_SHAPE_REACH = 0.3
_SPENT = 2.0
"""Values of a blurred shape that are spent on its factor and on how much of a hidden mode it holds."""
_NONE, _NO_SLOPE = np.zeros(0), np.zeros((0, 0))


def shape_unit(shapes: NDArray[np.float64] | NDArray[np.complex128]) -> NDArray[np.float64]:
    """What the scatter of shapes multiplies: entries below 0.3 of the largest are differences of larger motions."""
    return np.asarray(np.maximum(_SHAPE_REACH, np.abs(shapes)), dtype=np.float64)


def stacked(parts: Sequence[Residuals], n: int) -> Residuals:
    """Residuals of several parts of the data as one."""
    names = dict.fromkeys(k for p in parts for k in p.share)
    return Residuals(
        values=np.concatenate([p.values for p in parts] or [np.zeros(0)]),
        jacobian=np.concatenate([p.jacobian for p in parts] or [np.zeros((0, n))]),
        share={k: np.concatenate([p.share.get(k, np.zeros(len(p.values))) for p in parts]) for k in names},
        log_scale=sum(p.log_scale for p in parts),
        penalty=sum(p.penalty for p in parts),
        matching=tuple(p.matching for p in parts),
        unexplained=sum(p.unexplained for p in parts),
        split=sum(p.split for p in parts),
        projected=sum(p.projected for p in parts),
        block=_numbered_through([p.block for p in parts], parts),
        mixed=_masks([p.mixed for p in parts], parts),
        mode=_numbered_through([p.mode for p in parts], parts, [_modes(p) for p in parts]),
        blurred=_masks([p.blurred for p in parts], parts),
        beside=_masks([p.beside for p in parts], parts),
    )


def _numbered_through(
    numbers: Sequence[NDArray[np.int64] | None], parts: Sequence[Residuals], counts: Sequence[int] = ()
) -> NDArray[np.int64] | None:
    """Blocks or modes of all parts, numbered through; `counts` of each part, where the last ones may have no value."""
    if all(n is None for n in numbers):
        return None
    found, first = [], 0
    for k, (given, p) in enumerate(zip(numbers, parts, strict=True)):
        own = np.full(len(p.values), -1) if given is None else given
        found.append(np.where(own >= 0, own + first, -1))
        first += counts[k] if counts else int(np.max(own, initial=-1)) + 1
    return np.concatenate(found)


def _usual_of_blurred(rows: Rows, heated: bool) -> float:
    """What shapes that are blurred would cost on average where they are not: to be blurred must not pay."""
    assert rows.blur is not None
    counts = np.bincount(rows.mode[rows.blur > 0]).astype(float)
    n = counts[counts > 0]
    left = np.maximum(n - _SPENT, 0.0)
    return float(np.sum(0.5 * left if heated else tails.cost(left, n) - tails.cost(np.zeros(len(n)), n)))


def _modes(part: Residuals) -> int:
    """Number of measured modes."""
    if isinstance(part.matching, np.ndarray):
        return len(part.matching)
    return 0 if part.mode is None else int(np.max(part.mode, initial=-1)) + 1


def _masks(masks: Sequence[NDArray[np.bool_] | None], parts: Sequence[Residuals]) -> NDArray[np.bool_] | None:
    if all(m is None for m in masks):
        return None
    return np.concatenate(
        [np.zeros(len(p.values), bool) if m is None else m for m, p in zip(masks, parts, strict=True)]
    )


@dataclass(frozen=True)
class Rows:
    """Differences of one kind.

    Attributes
    ----------
    difference : ndarray, (k,)
        Measurement minus model.
    own : ndarray, (k,)
        1 σ of the test.
    unit : ndarray, (k,)
        Unit of the scatter that adds to it.
    scatter : str
        Name of that scatter.
    heat : float
        Factor on all σ while a fit is annealed.
    mode : ndarray of int, (k,)
        Measured mode that each belongs to.
    sensor : ndarray of int, (k,), optional
        Sensor that each belongs to, of shapes.
    close : ndarray of bool, (k,), optional
        True where the mode is close to another, of shapes.
    slope : ndarray, (k, n), optional
        Derivatives of the model's values by all unknowns.
    model : ndarray, (k,), optional
        The model's values, of damping: ln ζ.
    noise : str
        Name of the factor on the test's own 1 σ where that is learned too.
    least : ndarray, (k,), optional
        1 σ of the test that adds to `own`, whatever the factor on that.
    blur : ndarray, (k,), optional
        1 σ of what the measurement holds beside what it is compared with. It makes a difference count less, and what is
        left costs what it would on average: it is no evidence for a model or against it.
    wider : float
        Price of what is in `own` for the model's sake, at the default scatter.
    """

    difference: NDArray[np.float64]
    own: NDArray[np.float64]
    unit: NDArray[np.float64]
    scatter: str
    heat: float
    mode: NDArray[np.int64]
    sensor: NDArray[np.int64] | None = None
    close: NDArray[np.bool_] | None = None
    slope: NDArray[np.float64] | None = None
    model: NDArray[np.float64] | None = None
    noise: str = ""
    least: NDArray[np.float64] | None = None
    blur: NDArray[np.float64] | None = None
    wider: float = 0.0

    def __len__(self) -> int:
        return len(self.difference)

    def noise_at(self, scatters: Mapping[str, float]) -> float:
        """Factor on the test's own 1 σ."""
        return scatters.get(self.noise, 1.0)


@dataclass(frozen=True)
class Compared:
    """All differences of one configuration, and the cost of what has no partner.

    Attributes
    ----------
    rows : tuple of Rows
        Frequencies, damping ratios, shapes; apart, where there are any, complex ones and imaginary parts of others.
    match : ndarray of int, (m,)
        Model mode of every measured one, -1 for none.
    log_scale, penalty, split : float
        As in `Residuals`, of modes without a partner.
    unexplained, projected : int
    """

    rows: tuple[Rows, ...]
    match: NDArray[np.int64]
    log_scale: float
    penalty: float
    split: float
    unexplained: int
    projected: int

    @property
    def heated(self) -> bool:
        """True while a fit is annealed."""
        return any(r.heat != 1.0 for r in self.rows)


def whitened(
    found: Sequence[Compared], scatters: Mapping[str, float], defaults: Mapping[str, float], n: int
) -> Residuals:
    """Differences of all configurations in units of their standard uncertainties, `n` unknowns."""
    rows, modes = list[tuple[Rows, Compared, int]](), 0
    for c in found:
        rows += [(r, c, modes) for r in c.rows if len(r)]
        modes += len(c.match)
    total = sum(len(r) for r, _, _ in rows)
    derivatives = all(r.slope is not None for r, _, _ in rows)
    values, block, mode = np.empty(total), np.full(total, -1), np.full(total, -1)
    mixed, blurred, beside = (np.zeros(total, bool) for _ in range(3))
    share: dict[str, NDArray[np.float64]] = {}
    jacobian = np.empty((total if derivatives else 0, n))
    log_scale, at, blocks = sum(c.log_scale for c in found), 0, 0
    for r, c, first in rows:
        here = slice(at, at + len(r))
        at = here.stop
        mode[here], beside[here] = r.mode + first, r.scatter == UNEVEN_DAMPING
        least = _NONE if r.least is None else r.least
        blur = _NONE
        log_scale += r.wider
        if r.blur is not None:
            blurred[here], blur = r.blur > 0, r.blur
            log_scale += _usual_of_blurred(r, c.heated)
        slope = r.slope if derivatives and r.slope is not None else _NO_SLOPE
        of_noise, of_scatter = np.empty((2, len(slope)))
        log_scale += whiten(
            r.difference, r.own, r.unit, least, blur, slope, (r.noise_at(scatters), r.noise_at(defaults)),
            (scatters[r.scatter], defaults[r.scatter]), r.heat, values[here], jacobian[here], of_noise, of_scatter,
        )  # fmt: skip
        if r.sensor is not None:  # a shape may be wrong as a whole
            blocks += number_blocks(r.mode, blocks, block[here])
        if r.close is not None:
            mixed[here] = r.close
        if derivatives:
            for name, part in ((r.scatter, of_scatter), (r.noise, of_noise)):
                if name:
                    if name not in share:
                        share[name] = np.zeros(total)
                    share[name][here] = part
    return Residuals(
        values=values,
        jacobian=jacobian,
        share=share,
        log_scale=log_scale,
        penalty=sum(c.penalty for c in found),
        matching=tuple(c.match for c in found),
        unexplained=sum(c.unexplained for c in found),
        split=sum(c.split for c in found),
        projected=sum(c.projected for c in found),
        block=None if any(c.heated for c in found) else block,  # far off everything is on the tail
        mixed=mixed,
        mode=mode,
        blurred=blurred,
        beside=beside,
    )
