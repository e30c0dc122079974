"""Two tests mode by mode: changes of frequency, damping and shape with intervals and p-values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from ema_pipeline.correlate.matching import common_shapes, mac_between, match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.significance import holm

LEVEL = 0.01
"""Chance of any false change among all that are compared."""
_ALIKE = 0.2
"""Share of the common shift by which the change of a single mode may differ from it, beside its own noise: temperature
moves modes of unlike parts by nearly the same share, a mass or a spring by shares from nothing to its full effect."""
_DRAWS = 2000
"""Random shapes of which the MAC of one and the same shape is known."""


@dataclass(frozen=True)
class ModeChange:
    """One mode in two tests.

    Attributes
    ----------
    configuration : str
    mode_a, mode_b : int
        Numbers from 1.
    frequency_a, frequency_a_std, frequency_b, frequency_b_std : float
        Hz.
    damping_a, damping_a_std, damping_b, damping_b_std : float
        Ratios.
    mac : float
        NaN where fewer than two DOFs were measured in both tests.
    mac_usual : float
        MAC that one and the same shape would fall below by the tests' noise once in a hundred times.
    frequency_p, damping_p, mac_p : float
        p-values of no change, adjusted for all that is compared (Holm); NaN where it cannot be told.
    """

    configuration: str
    mode_a: int
    mode_b: int
    frequency_a: float
    frequency_a_std: float
    frequency_b: float
    frequency_b_std: float
    damping_a: float
    damping_a_std: float
    damping_b: float
    damping_b_std: float
    mac: float
    mac_usual: float
    frequency_p: float
    damping_p: float
    mac_p: float

    @property
    def frequency_change(self) -> tuple[float, float]:
        """Relative change of frequency and its 1 σ."""
        a, b = self.frequency_a_std / self.frequency_a, self.frequency_b_std / self.frequency_b
        return self.frequency_b / self.frequency_a - 1, float(np.hypot(a, b))

    @property
    def damping_change(self) -> tuple[float, float]:
        """Relative change of the damping ratio and its 1 σ."""
        a, b = self.damping_a_std / self.damping_a, self.damping_b_std / self.damping_b
        ratio = self.damping_b / self.damping_a
        return ratio - 1, ratio * float(np.hypot(a, b))

    @property
    def changed(self) -> tuple[str, ...]:
        """What changed beyond its interval."""
        told = (("frequency", self.frequency_p), ("damping", self.damping_p), ("shape", self.mac_p))
        return tuple(name for name, p in told if p < LEVEL)


@dataclass(frozen=True)
class CommonShift:
    """Relative change of all frequencies of a configuration.

    Attributes
    ----------
    relative, std : float
        Weighted mean and its 1 σ, which includes how much the modes differ in it.
    alike : bool
        True where every mode changed by that share, within its noise and a fifth of the share; only then it is a
        shift common to all.
    """

    relative: float
    std: float
    alike: bool


@dataclass(frozen=True)
class ModeChanges:
    """All modes of two tests.

    Attributes
    ----------
    modes : tuple of ModeChange
    only_a, only_b : tuple of (str, int, float)
        Modes without a partner: configuration, number, frequency in Hz.
    common_shift : dict of str to CommonShift
        By configuration; none with fewer than two modes of known uncertainty.
    """

    modes: tuple[ModeChange, ...]
    only_a: tuple[tuple[str, int, float], ...]
    only_b: tuple[tuple[str, int, float], ...]
    common_shift: dict[str, CommonShift]

    @property
    def changed(self) -> bool:
        """True where anything changed beyond its interval."""
        return any(m.changed for m in self.modes)


def mode_changes(a: Mapping[str, MeasuredModes], b: Mapping[str, MeasuredModes]) -> ModeChanges:
    """Match the modes of two tests and compare them.

    Intervals include each test's own scatter. They do not include what changes from one set-up to the next
    without being a change of the structure: temperature, mounting, suspension.
    """
    modes: list[ModeChange] = []
    only_a, only_b, shifts = [], [], dict[str, CommonShift]()
    for c in (c for c in a if c in b):
        first, second = a[c], b[c]
        match = match_modes(first, second)
        found = _of_configuration(c, first, second, match)
        modes += found
        shift = _common_shift(found)
        if shift is not None:
            shifts[c] = shift
        only_a += [(c, int(k) + 1, float(first.frequency_hz[k])) for k in np.flatnonzero(match < 0)]
        left = np.setdiff1d(np.arange(len(second)), match)
        only_b += [(c, int(k) + 1, float(second.frequency_hz[k])) for k in left]
    return ModeChanges(tuple(_adjusted(modes)), tuple(only_a), tuple(only_b), shifts)


def _of_configuration(
    configuration: str, a: MeasuredModes, b: MeasuredModes, match: NDArray[np.int64]
) -> list[ModeChange]:
    alike, shapes = mac_between(a, b), common_shapes(a, b)
    out = []
    for i, j in enumerate(match):
        if j < 0:
            continue
        usual = p = float("nan")
        value = float("nan") if alike is None else float(alike[i, j])
        if shapes is not None:
            noise = _noise(a, b, i, int(j))
            if noise is not None:
                usual, p = _of_one_shape(shapes[0][i], shapes[1][j], noise, value)
        fa, fa_std = float(a.frequency_hz[i]), float(a.frequency_std_hz[i])
        fb, fb_std = float(b.frequency_hz[j]), float(b.frequency_std_hz[j])
        za, za_std = float(a.damping_ratio[i]), float(a.damping_std[i])
        zb, zb_std = float(b.damping_ratio[j]), float(b.damping_std[j])
        out.append(
            ModeChange(
                configuration, i + 1, int(j) + 1, fa, fa_std, fb, fb_std, za, za_std, zb, zb_std, value, usual,
                _p(fa, fa_std, fb, fb_std), _p(za, za_std, zb, zb_std), p,
            )
        )  # fmt: skip
    return out


def _p(a: float, a_std: float, b: float, b_std: float) -> float:
    """Two-sided p-value of no change of a positive value; NaN where a value or an uncertainty is unknown."""
    if not (a > 0 and b > 0):
        return float("nan")
    std = float(np.hypot(a_std / a, b_std / b))
    return float(2 * scipy.stats.norm.sf(abs(np.log(b / a)) / std)) if std > 0 else float("nan")


def _noise(
    a: MeasuredModes, b: MeasuredModes, i: int, j: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """1 σ of both shapes at the common DOFs."""
    if a.shape_std is None or b.shape_std is None:
        return None
    of_b = {d.point: k for k, d in enumerate(b.dofs)}
    at = [(k, of_b[d.point]) for k, d in enumerate(a.dofs) if d.point in of_b]
    std_a, std_b = a.shape_std[i, [k for k, _ in at]], b.shape_std[j, [k for _, k in at]]
    if not (np.all(np.isfinite(std_a)) and np.all(np.isfinite(std_b))):
        return None
    return std_a, std_b


def _of_one_shape(
    a: NDArray[np.complex128],
    b: NDArray[np.complex128],
    noise: tuple[NDArray[np.float64], NDArray[np.float64]],
    value: float,
) -> tuple[float, float]:
    """MAC that one shape seldom falls below under this noise, and the p-value of the MAC that was found.

    The one shape is the mean of both; noise is drawn about it, with the same random numbers in every call.
    """
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    if len(a) < 2 or not np.vdot(b, b).real > 0:
        return float("nan"), float("nan")
    factor = np.vdot(b, a) / np.vdot(b, b)
    mean = 0.5 * (a + factor * b)
    random = np.random.default_rng(0)

    def drawn(std: NDArray[np.float64]) -> NDArray[np.complex128]:
        parts = random.standard_normal((2, _DRAWS, len(mean)))
        return np.asarray(mean + std * (parts[0] + 1j * parts[1]))

    x, y = drawn(noise[0][known]), drawn(abs(factor) * noise[1][known])
    cross = np.abs(np.sum(np.conj(x) * y, axis=1)) ** 2
    found = cross / (np.sum(np.abs(x) ** 2, axis=1) * np.sum(np.abs(y) ** 2, axis=1))
    return float(np.quantile(found, LEVEL)), float((1 + np.sum(found <= value)) / (_DRAWS + 1))


def _common_shift(modes: list[ModeChange]) -> CommonShift | None:
    """Weighted mean of the relative changes, its 1 σ by how much they differ or by their own σ, whichever is larger."""
    values = np.array([m.frequency_change for m in modes]).reshape(-1, 2)
    known = np.isfinite(values[:, 1]) & (values[:, 1] > 0)
    if np.sum(known) < 2:
        return None
    change, std = values[known].T
    weight = std**-2.0
    mean = float(np.sum(weight * change) / np.sum(weight))
    chi2 = float(np.sum(weight * (change - mean) ** 2)) / (len(change) - 1)
    noise = scipy.stats.norm.isf(0.5 * LEVEL / len(change)) * std
    alike = bool(np.all(np.abs(change - mean) <= _ALIKE * abs(mean) + noise))
    return CommonShift(mean, float(np.sqrt(max(chi2, 1.0) / np.sum(weight))), alike)


def _adjusted(modes: list[ModeChange]) -> list[ModeChange]:
    """p-values adjusted over all that was compared."""
    adjusted = holm([p for m in modes for p in (m.frequency_p, m.damping_p, m.mac_p)]).reshape(-1, 3)
    return [
        replace(m, frequency_p=float(f), damping_p=float(d), mac_p=float(s))
        for m, (f, d, s) in zip(modes, adjusted, strict=True)
    ]
