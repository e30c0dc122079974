"""Differences of measured and model modes as rows with their uncertainties, and as whitened residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import Residuals


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
        projected=sum(p.projected for p in parts),
        block=_blocks(parts),
        mixed=_mixed(parts),
    )


def _blocks(parts: Sequence[Residuals]) -> NDArray[np.int64] | None:
    """Blocks of all parts, numbered through."""
    if all(p.block is None for p in parts):
        return None
    numbered, count = [], 0
    for p in parts:
        block = np.full(len(p.values), -1) if p.block is None else p.block
        numbered.append(np.where(block >= 0, block + count, -1))
        count += int(np.max(block, initial=-1)) + 1
    return np.concatenate(numbered)


def _mixed(parts: Sequence[Residuals]) -> NDArray[np.bool_] | None:
    if all(p.mixed is None for p in parts):
        return None
    return np.concatenate([np.zeros(len(p.values), bool) if p.mixed is None else p.mixed for p in parts])


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
    blur : ndarray, (k,), optional
        1 σ of what the measurement holds beside what it is compared with. It makes a difference count less, and its
        size is no evidence for a model or against it.
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
    blur: NDArray[np.float64] | None = None

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
        Frequencies, damping ratios, shapes; complex ones, where there are any, apart.
    match : ndarray of int, (m,)
        Model mode of every measured one, -1 for none.
    log_scale, penalty : float
        As in `Residuals`, of modes without a partner.
    unexplained, projected : int
    """

    rows: tuple[Rows, ...]
    match: NDArray[np.int64]
    log_scale: float
    penalty: float
    unexplained: int
    projected: int

    @property
    def heated(self) -> bool:
        """True while a fit is annealed."""
        return any(r.heat != 1.0 for r in self.rows)


def _numbered(modes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Modes numbered through from 0, (k,)."""
    steps = np.diff(modes)
    if np.all(steps >= 0):  # nearly always: sorting takes ten times as long
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(steps > 0)])
    return np.unique(modes, return_inverse=True)[1]


def whitened(
    found: Compared, scatters: Mapping[str, float], defaults: Mapping[str, float], n: int
) -> Residuals:
    """Differences in units of their standard uncertainties, `n` unknowns."""
    total = sum(len(r) for r in found.rows)
    derivatives = all(r.slope is not None for r in found.rows)
    values, block, mixed = np.empty(total), np.full(total, -1), np.zeros(total, bool)
    share: dict[str, NDArray[np.float64]] = {}
    jacobian = np.zeros((total if derivatives else 0, n))
    log_scale, at, blocks = 0.0, 0, 0
    for r in found.rows:
        if not len(r):
            continue
        here = slice(at, at + len(r))
        at = here.stop
        added, own = (scatters[r.scatter] * r.unit) ** 2, (r.noise_at(scatters) * r.own) ** 2
        variance = own + added
        usual = (r.noise_at(defaults) * r.own) ** 2 + (defaults[r.scatter] * r.unit) ** 2
        log_scale += 0.5 * float(np.log(variance / usual).sum())
        if r.blur is not None:
            variance = variance + r.blur**2
        sigma = np.sqrt(variance) * r.heat
        values[here] = r.difference / sigma
        if r.sensor is not None:  # a shape may be wrong as a whole
            number = _numbered(r.mode)
            block[here] = number + blocks
            blocks += int(number.max()) + 1
        if r.close is not None:
            mixed[here] = r.close
        if derivatives and r.slope is not None:
            for name, part in ((r.scatter, added), (r.noise, own)):
                if name:
                    if name not in share:
                        share[name] = np.zeros(total)
                    share[name][here] = part / variance
            np.divide(r.slope, -sigma[:, None], out=jacobian[here])
    return Residuals(
        values=values,
        jacobian=jacobian,
        share=share,
        log_scale=log_scale + found.log_scale,
        penalty=found.penalty,
        matching=found.match,
        unexplained=found.unexplained,
        projected=found.projected,
        block=None if found.heated else block,  # far off everything is on the tail
        mixed=mixed,
    )
