"""Results of the study of force levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel

_FAR, _FAR_IN_WIDTHS, _FAR_IN_STDS = 0.01, 1.0, 5.0
"""Change of a frequency from the softest to the hardest level, relative, in the peak's width at half its power and in
standard deviations, that is no drift. So far a frequency also moves within each decay, and single hits scatter."""

_NO_DOUBT = 1e-5
"""Of ten simulated linear structures with oblique hits and drift the least p value is 0.005; parting teeth and sticking
friction have 1e-9 and less."""


@dataclass(frozen=True)
class ForceLevel:
    """Hits of about the same peak force.

    Attributes
    ----------
    force_n : float
        Median of the peak forces.
    hits : tuple of str
        ``file#number`` of every accepted hit of this level.
    own_frfs : FrfSet or None
        Averaged over the hits of this level alone; None for the only level, whose FRFs are the configuration's.
    modal : ModalModel or None
        Identified from `frfs` alone, without circle fits; None where all hits are of one level. The softest
        level's is the closest to the linear structure.
    unit : str
        Of the force: V where the hammer is not calibrated.
    """

    force_n: float
    hits: tuple[str, ...]
    own_frfs: FrfSet | None = None
    modal: ModalModel | None = None
    unit: str = "N"

    @property
    def label(self) -> str:
        """The force with its unit."""
        return f"{self.force_n:.3g} {self.unit}"

    @property
    def frfs(self) -> FrfSet:
        """FRFs of one level of several."""
        if self.own_frfs is None:
            raise ValueError("the only level has no FRFs of its own: take those of the configuration")
        return self.own_frfs


@dataclass(frozen=True)
class ModeLevels:
    """One mode at every force level.

    Attributes
    ----------
    mode : int
        Index into the modes of the configuration's `ModalModel`, see `LevelStudy.linear_level`.
    frequency_hz, frequency_std_hz, damping_ratio, damping_std : ndarray, (n_levels,)
        NaN where the mode could not be followed to a level.
    amplitude_m : ndarray, (n_levels, n_impacts)
        Largest displacement amplitude of this mode at any sensor just after the hit, per impact point of
        `LevelStudy.inputs`.
    frequency_p, damping_p : float
        Probability of a trend as clear as this where nothing depends on the level, from single hits (from
        decays where there is one level); NaN where unknown, or damping changes by too little.
    depends : bool
        True where frequency, damping or size moves with the level beyond what scatter explains, all modes' tests
        taken into account.
    trend : str
        ``"hardening"``, ``"softening"``, ``"damping falls"``, ``"damping rises"``, ``"size rises"``, ``"size
        falls"``, joined by ``", "``; empty where nothing moves.
    level_modes : ndarray of int, (n_levels,), or None
        Index into the modes of each level's own `ModalModel`; -1 where the mode was not found there.
    frequency_shift_hz, frequency_shift_std_hz, damping_shift, damping_shift_std : ndarray, (n_levels,), or None
        Difference from the softest level in single hits, each compared with hits on its own point alone; of the
        levels' own FRFs where a frequency moves by more than half a half-width.
    size, size_std : ndarray, (n_levels,), or None
        Participation in the FRFs of each level over that in all hits, see `sizes`; 1 for a linear mode. NaN where
        no hit tells.
    size_p : float
        As `frequency_p`; NaN also for a change too small to tell of the structure, see `sizes.PLAIN_SIZE`.
    """

    mode: int
    frequency_hz: NDArray[np.float64]
    frequency_std_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damping_std: NDArray[np.float64]
    amplitude_m: NDArray[np.float64]
    frequency_p: float
    damping_p: float
    depends: bool
    trend: str
    level_modes: NDArray[np.int64] | None = None
    frequency_shift_hz: NDArray[np.float64] | None = None
    frequency_shift_std_hz: NDArray[np.float64] | None = None
    damping_shift: NDArray[np.float64] | None = None
    damping_shift_std: NDArray[np.float64] | None = None
    size: NDArray[np.float64] | None = None
    size_std: NDArray[np.float64] | None = None
    size_p: float = float("nan")

    @property
    def sized_levels(self) -> tuple[int, int] | None:
        """The softest and the hardest level whose hits tell the size; None where fewer than two do."""
        known = [] if self.size is None else np.flatnonzero(np.isfinite(self.size)).tolist()
        return (known[0], known[-1]) if len(known) > 1 else None

    @property
    def moved_far(self) -> bool:
        """True where the frequency rises or falls from level to level by more than any drift."""
        known = np.isfinite(self.frequency_hz)
        if np.count_nonzero(known) < 2:
            return False
        frequency, std = self.frequency_hz[known], self.frequency_std_hz[known]
        steps = np.diff(frequency)
        width = 2 * float(np.mean(self.damping_ratio[known])) * frequency[0]
        spread = _FAR_IN_STDS * float(np.hypot(std[0], std[-1]))
        least = max(_FAR * frequency[0], _FAR_IN_WIDTHS * width, spread)
        one_way = np.all(steps > 0) or np.all(steps < 0)
        return bool(one_way and abs(frequency[-1] - frequency[0]) > least)


@dataclass(frozen=True)
class DecayCurve:
    """Instantaneous frequency and damping of one mode over its amplitude, from the free decay after one hit.

    Attributes
    ----------
    mode : int
    hit : str
        ``file#number``.
    output : Dof
        The sensor where the mode shows best.
    amplitude_m : ndarray, (n,)
        Displacement amplitude, falling.
    frequency_hz, frequency_std_hz, damping_ratio, damping_std : ndarray, (n,)
    """

    mode: int
    hit: str
    output: Dof
    amplitude_m: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    frequency_std_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damping_std: NDArray[np.float64]


@dataclass(frozen=True)
class Pulses:
    """What struck the structure, hit by hit.

    Attributes
    ----------
    struck : tuple of Dof
        Where and which way the force is positive.
    force_n : ndarray, (n_hits, n_samples)
        0 outside the blow.
    peak : int
        Sample at which every hit's force is largest.
    sample_rate_hz : float
    """

    struck: tuple[Dof, ...]
    force_n: NDArray[np.float64]
    peak: int
    sample_rate_hz: float

    def only(self, keep: NDArray[np.bool_]) -> Pulses:
        """Of some of the hits."""
        struck = tuple(d for d, k in zip(self.struck, keep, strict=True) if k)
        return Pulses(struck, self.force_n[keep], self.peak, self.sample_rate_hz)


@dataclass(frozen=True)
class HitModes:
    """Modes of a configuration in every single hit at several force levels.

    Attributes
    ----------
    modes : ndarray of int, (n_modes,)
        Indices into the modes of the configuration's `ModalModel`, see `LevelStudy.linear_level`.
    outputs : tuple of Dof
    shapes : complex ndarray, (n_modes, n_outputs)
        Those with which the hits were read.
    names : tuple of str
        ``file#number`` of every hit.
    level, sheet : ndarray of int, (n_hits,)
        Force level; hits of one sheet share impact point and sensors, and only their differences mean something.
    log_frequency, log_frequency_std, damping_ratio, damping_std : ndarray, (n_hits, n_modes)
        Standard deviations from noise alone; ``inf`` where a hit tells nothing of the mode.
    motion_m : complex ndarray, (n_hits, n_modes)
        Displacement amplitude just after the hit where the shape is 1; NaN for an uncalibrated hammer.
    size, size_std : complex and real ndarray, (n_hits, n_modes)
        Participation in the FRFs: alike in all hits of a sheet where the structure is linear and they are aimed alike.
        Standard deviation of either part.
    window_decay_rad_s : float
        Of the exponential window on the responses.
    band_hz : ndarray, (n_modes, 2)
        Lines from which each mode was read.
    line_hz : float
        Their distance.
    pulses : Pulses or None
        None for an uncalibrated hammer, and where hits were sampled at different rates.
    """

    modes: NDArray[np.int64]
    outputs: tuple[Dof, ...]
    shapes: NDArray[np.complex128]
    names: tuple[str, ...]
    level: NDArray[np.int64]
    sheet: NDArray[np.int64]
    log_frequency: NDArray[np.float64]
    log_frequency_std: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damping_std: NDArray[np.float64]
    motion_m: NDArray[np.complex128]
    size: NDArray[np.complex128]
    size_std: NDArray[np.float64]
    window_decay_rad_s: float
    band_hz: NDArray[np.float64]
    line_hz: float
    pulses: Pulses | None = None


@dataclass(frozen=True)
class LevelStudy:
    """What moves with the force level in one configuration.

    Attributes
    ----------
    levels : tuple of ForceLevel
        From the softest hits up; one entry where all are of one level.
    inputs : tuple of Dof
        Impact points.
    modes : tuple of ModeLevels
    decays : tuple of DecayCurve
    verdicts : tuple of CheckResult
        Homogeneity of the FRFs, coherence dips at resonances, distortion of Nyquist circles.
    level_dependent : bool
        The answer of all tests together, at the false-alarm rate of the settings.
    p_value : float
        Probability of data as level-dependent as these from a linear structure; NaN where it cannot be known.
    summary : str
        One or two plain sentences; with one level only, what cannot be known.
    linear_level : int or None
        Level nearest to the linear structure, where the answer depends on the level: its modes are those of the
        configuration, and `modes` counts them. None: the modes of all hits together.
    products : tuple of str
        Poles that the nonlinearity makes at multiples and sums of frequencies, left out of all levels' modes.
    hit_modes : HitModes or None
        Modes in single hits; None where all hits are of one level.
    """

    levels: tuple[ForceLevel, ...]
    inputs: tuple[Dof, ...]
    modes: tuple[ModeLevels, ...]
    decays: tuple[DecayCurve, ...]
    verdicts: tuple[CheckResult, ...]
    level_dependent: bool
    p_value: float
    summary: str
    linear_level: int | None = None
    products: tuple[str, ...] = ()
    hit_modes: HitModes | None = None

    @property
    def clearly_level_dependent(self) -> bool:
        """True where there is no doubt of it: scatter that differs from level to level passes the other tests."""
        return self.level_dependent and (self.p_value < _NO_DOUBT or any(m.moved_far for m in self.modes))
