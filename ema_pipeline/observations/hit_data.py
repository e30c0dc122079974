"""Modes of single hits at several force levels, and what of them can be compared.

Only differences between hits of one sheet count. A blow excites all modes at once, and their amplitudes fall while they
are observed. Modes so near to each other that their beat is slower than their decay move in step; far ones meet in all
phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ema_pipeline.correlate.measured import from_modal_model
from ema_pipeline.dof import Dof
from ema_pipeline.levels.scatter import Scatter
from ema_pipeline.levels.sizes import means_of_sheets
from ema_pipeline.levels.types import HitModes, Pulses
from ema_pipeline.mechanics.sampling import straightened
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.observations.mode_data import ModeData, prepare
from ema_pipeline.observations.reach import within_reach
from ema_pipeline.observations.ringing import Ringing
from ema_pipeline.rigs.types import Rig

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

_IN_STEP = 4.0
"""Distance of poles, in decay rates, within which modes move in step while they are observed: at this distance the
weight of one mode's force in the other's pole, 1/|1 - jΔω/2σ|², is 0.2."""

_TOLD = 0.15
"""1 σ of a change of a size that a model tells, over that change: it knows neither every hit's aim nor all modes."""
_FAR, _FAR_STD = 0.5, 0.5
"""Distance of a pole from that of the softest hits, in decay rates, at which half of the relative error is reached that
a shift read from a decay has against one of first order; and that error of far ones, 1 σ."""
_HEAVILY = 3.0
"""Damping ratio over the usual one from which friction may be what damps: by itself it hardly scatters so far."""
_UNLIKELY = 1e-3
"""Probability of hits that scatter so far about a smooth curve, below which their standard deviations are too small."""
_FEW = 0.2
"""Share of a sheet's modes in which that may be so; of more it is the structure that scatters."""
_AIMED = 0.05
"""1 σ of what is read of a mode over how its size differs in phase, by the aim of the hit."""
_CURVE = 3
"""Terms of a smooth curve in the logarithm of the amplitude; no more than there are force levels."""
_HEARD = 0.1
"""Motion of a mode over that of the largest that moves in step with it, below which a hit does not tell its pole."""
_QUIET_S = 0.01
"""Time after every blow in which what is left of its force at steps between samples rings off, s."""


_OF_HITS_AND_MODES = (
    "log_frequency", "log_frequency_std", "damping", "damping_std", "motion", "size", "size_std",
)  # fmt: skip


@dataclass(frozen=True)
class HitData:
    """One configuration's modes in every single hit.

    Attributes
    ----------
    reference : ModeData
        Modes of the level that is nearest to the linear structure; the hits' modes are among them.
    modes : ndarray of int, (m,)
        Their indices.
    dofs : tuple of Dof
    shapes : complex ndarray, (m, s)
        Shapes of unit `motion`.
    names : tuple of str
    level, sheet : ndarray of int, (h,)
        Force level; only differences between hits of one sheet count.
    force_n : ndarray, (n_levels,)
    log_frequency, log_frequency_std, damping, damping_std : ndarray, (h, m)
        Infinite standard deviations where a hit tells nothing.
    motion : complex ndarray, (h, m)
        Displacement amplitude just after the hit, m.
    size, size_std : complex and real ndarray, (h, m)
        Participation in the FRFs, and the standard deviation of either part.
    window_decay : float
        Of the exponential window, 1/s.
    band_hz : ndarray, (m, 2)
        Lines from which each mode was read.
    line_hz : float
        Their distance.
    reference_level : int or None
        Force level whose hits gave `reference`; None for all.
    level_dependent : bool
        True where there is no doubt that the structure is not linear.
    pulses : Pulses or None
        What struck the structure.
    """

    reference: ModeData
    modes: Integers
    dofs: tuple[Dof, ...]
    shapes: Complex
    names: tuple[str, ...]
    level: Integers
    sheet: Integers
    force_n: Real
    log_frequency: Real
    log_frequency_std: Real
    damping: Real
    damping_std: Real
    motion: Complex
    size: Complex
    size_std: Real
    window_decay: float
    band_hz: Real
    line_hz: float
    reference_level: int | None = None
    level_dependent: bool = False
    pulses: Pulses | None = None

    @property
    def configuration(self) -> str:
        """Name of the configuration."""
        return self.reference.configuration

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Mask of hits and modes that can be compared, (h, m)."""
        known = self._known.copy()
        size = np.nan_to_num(np.abs(self.motion)) * np.max(np.abs(self.shapes), axis=1, initial=0.0)
        for group in self.groups:
            known[:, group] &= size[:, group] >= _HEARD * size[:, group].max(axis=1, keepdims=True)
        return known

    @cached_property
    def reference_weights(self) -> Real:
        """Share of every hit in each mode of `reference`, (h, m): of the hits that it comes from, by their energy."""
        of = (
            np.ones(len(self.level), bool)
            if self.reference_level is None
            else self.level == self.reference_level
        )
        energy = np.where(self.used & of[:, None], np.abs(self.motion) ** 2, 0.0)
        total = energy.sum(axis=0)
        return np.asarray(np.divide(energy, total, out=np.zeros_like(energy), where=total > 0))

    @cached_property
    def _known(self) -> NDArray[np.bool_]:
        known = np.isfinite(self.log_frequency_std) & np.isfinite(self.damping_std)
        known &= np.isfinite(self.log_frequency) & (self.damping > 0)
        return np.asarray(known & np.isfinite(self.motion))

    def only(self, keep: NDArray[np.bool_]) -> HitData:
        """Some of the hits."""
        of_hits = ("level", "sheet", *_OF_HITS_AND_MODES)
        names = tuple(n for n, k in zip(self.names, keep, strict=True) if k)
        pulses = self.pulses and self.pulses.only(keep)
        return replace(self, names=names, pulses=pulses, **{n: getattr(self, n)[keep] for n in of_hits})

    def within(self, reference: ModeData) -> HitData:
        """The modes that are among the first ones of the reference, which `reference` has."""
        kept = self.modes < len(reference)
        few = {n: getattr(self, n)[:, kept] for n in _OF_HITS_AND_MODES}
        few |= {n: getattr(self, n)[kept] for n in ("modes", "shapes", "band_hz")}
        return replace(self, reference=reference, **few)

    @cached_property
    def poles(self) -> Complex:
        """Of every mode in every hit, 1/s, (h, m); the reference's where a hit tells none that can be compared."""
        own = 2 * np.pi * np.exp(self.log_frequency) * (1j - self.damping)
        return np.asarray(np.where(self.used, own, self._reference_poles))

    @cached_property
    def _reference_poles(self) -> Complex:
        """Of the level nearest to the linear structure, 1/s, (m,)."""
        own = self.reference
        decay = np.nan_to_num(np.exp(own.log_damping[self.modes]), nan=1e-3)
        return np.asarray(2 * np.pi * np.exp(own.log_frequency[self.modes]) * (1j - decay))

    @cached_property
    def omega(self) -> Real:
        """Median of every mode over the hits, rad/s, (m,)."""
        return np.asarray(np.median(self.poles.imag, axis=0))

    @cached_property
    def decay(self) -> Real:
        """Median decay rate of every mode over the hits, 1/s, (m,)."""
        return np.asarray(np.median(-self.poles.real, axis=0))

    @cached_property
    def usual_damping(self) -> Real:
        """Median damping ratio of every mode over the hits, (m,)."""
        return np.asarray(np.median(-self.poles.real / self.poles.imag, axis=0))

    @cached_property
    def groups(self) -> tuple[Integers, ...]:
        """Modes that move in step, by their place among `modes`, from the lowest up."""
        pole = self._reference_poles
        groups: list[list[int]] = []
        for r in np.argsort(pole.imag):
            last = groups[-1][-1] if groups else None
            near = last is not None and pole[r].imag - pole[last].imag < -_IN_STEP * min(
                pole[r].real, pole[last].real
            )
            if near:
                groups[-1].append(int(r))
            else:
                groups.append([int(r)])
        return tuple(np.array(g) for g in groups)

    def reach(self, sheet: int) -> Real:
        """Largest measured change of each mode's pole between hits of a sheet, in its decay rates, (m,)."""
        on = self.sheet == sheet
        used, poles = self.used[on], self.poles[on]
        known = used.any(axis=0)
        middle = [
            np.nanmedian(np.where(used | ~known, part, np.nan), axis=0) for part in (poles.real, poles.imag)
        ]
        apart = np.where(used, np.abs(poles - (middle[0] + 1j * middle[1])), 0.0)
        return np.asarray(apart.max(axis=0, initial=0.0) / self.decay)

    @cached_property
    def _moved(self) -> Real:
        """Distance of every pole from that of the softest hits of its sheet, in decay rates, (h, m)."""
        apart = np.zeros(self.poles.shape)
        for sheet in np.unique(self.sheet):
            on = np.flatnonzero(self.sheet == sheet)
            for r in range(len(self.modes)):
                heard = on[self.used[on, r]]
                if len(heard):
                    softest = heard[self.level[heard] == self.level[heard].min()]
                    apart[heard, r] = np.abs(self.poles[heard, r] - self.poles[softest, r].mean())
        return np.asarray(apart / self.decay)

    @cached_property
    def linearised_std(self) -> Real:
        """1 σ of what a fit of one pole reads of a decay that is no small change, in decay rates, (h, m).

        The pole moves while it is read: by half a width and more, what is read is no mean of the momentary pole.
        """
        return _far_std(self._moved)

    @cached_property
    def cut_off_std(self) -> Real:
        """1 σ of what is read of modes that are damped many times as much as most, in their decay rates, (m,).

        Where friction damps a mode so, what rings is no decay that one pole describes.
        """
        times = self._times_usual / _HEAVILY
        return _far_std(np.maximum(times - 1, 0.0)) / times

    @cached_property
    def _times_usual(self) -> Real:
        """Damping ratio of every mode over the median of all, (m,)."""
        return np.asarray(self.usual_damping / np.median(self.usual_damping))

    def with_friction(self, modes: ModeData) -> ModeData:
        """The modes of `reference`, with damping ratios that say little where they are mostly friction's."""
        std = modes.log_damping_std.copy()
        of_friction = np.where(self._times_usual > _HEAVILY, np.log(self._times_usual), 0.0)
        std[self.modes] = np.hypot(std[self.modes], of_friction)
        return replace(modes, log_damping_std=std)

    @cached_property
    def moves(self) -> tuple[float, float]:
        """Mean distance of poles from those of the softest hits, in decay rates, each by its square over its variance;
        and the sum of these weights."""
        noise = np.hypot(self.log_frequency_std / self.usual_damping, self.damping_std / self.usual_damping)
        weight = np.where(self.used, (self._moved / np.where(self.used, noise, 1.0)) ** 2, 0.0)
        total = float(weight.sum())
        return float((weight * self._moved).sum() / total) if total else 0.0, total

    @cached_property
    def relative_size(self) -> Complex:
        """Size of every mode in every hit over `_reference_size`, (h, m); 1 for a linear mode, well aimed."""
        return np.asarray(np.where(self.used, self.size, self._reference_size) / self._reference_size)

    @cached_property
    def quadrature_std(self) -> Real:
        """1 σ of the imaginary part of `relative_size` from noise and from what a model has wrong of it, (h, m)."""
        noise = np.where(self.used, self.size_std, np.inf) / np.abs(self._reference_size)
        return np.asarray(np.hypot(noise, _TOLD * self.relative_size.imag))

    @cached_property
    def otherwise(self) -> Real:
        """How far `relative_size` of every mode in every hit lies from the mean of its sheet in phase, (h, m).

        Mostly by the aim of the hit: what is read then of a mode is the more a neighbour's.
        """
        mean = self._mean_over_sheet(self.size) / self._reference_size
        return np.asarray(np.where(self.used, np.abs((self.relative_size - mean).real), 0.0))

    @cached_property
    def irregularity(self) -> Real:
        """Factor on the standard deviations of what hits of a sheet tell of a mode, (h, m); 1 for most.

        What depends on the amplitude does so smoothly, but for teeth that rattle, which make many modes scatter. Where
        hits of one sheet scatter in one mode far more about a smooth curve than they say, they are known less well: aim
        alone excites it, or mixes it with a neighbour, and they differ by ten standard deviations at one force.
        Friction of 3 mN explained a few such hits.
        """
        found = np.ones(self.log_frequency.shape)
        for sheet in np.unique(self.sheet):
            factors = self._irregular(sheet)
            if len(factors) <= max(_FEW * np.sum(self.used[self.sheet == sheet].any(axis=0)), 1):
                for mode, factor in factors.items():
                    found[(self.sheet == sheet) & self.used[:, mode], mode] = factor
        return found

    def _irregular(self, sheet: int) -> dict[int, float]:
        """Modes in which hits of a sheet scatter too far about a smooth curve, and how far, in their own σ."""
        found = {}
        for mode in range(len(self.modes)):
            on = np.flatnonzero((self.sheet == sheet) & self.used[:, mode])
            terms = min(len(np.unique(self.level[on])), _CURVE)
            if len(on) > terms:
                scatter, count = self._scatter(on, mode, terms)
                if chi2.sf(scatter, count) < _UNLIKELY:
                    found[mode] = float(np.sqrt(scatter / count))
        return found

    def _scatter(self, on: Integers, mode: int, terms: int) -> tuple[float, int]:
        """Squares of damping and quadrature about smooth curves over the amplitude, in their σ, and how many count."""
        at, damping = (on, mode), self.damping[on, mode]
        log = np.log(np.abs(self.motion[at]))
        curve = tuple((log - log.mean()) ** k for k in range(1, terms))
        beside = self.linearised_std[at] ** 2 + (_AIMED * self.otherwise[at]) ** 2
        both = [
            Scatter(value, own**2 + beside, self.sheet[on], curve, shared=False)
            for value, own in (
                (np.log(damping), self.damping_std[at] / damping),
                (self.relative_size.imag[at], self.quadrature_std[at]),
            )
        ]
        return sum(s.noise_only for s in both), sum(s.dof for s in both)

    @cached_property
    def _reference_size(self) -> Complex:
        """Root mean square of the sizes in every hit's sheet, in their common phase, (h, m); 1 where no hit tells.

        Not their mean: where aim alone excites a mode, hits do so with either sign, and their mean is nearly nothing,
        of any phase.
        """
        of_squares = self._mean_over_sheet(self.size**2)
        size = np.sqrt(self._mean_over_sheet(np.abs(self.size) ** 2).real)
        phase = np.exp(0.5j * np.angle(of_squares))  # or the opposite
        sign = np.where((self._mean_over_sheet(self.size) / phase).real < 0, -1.0, 1.0)
        return np.where(size == 0, 1.0, sign * size * phase)

    def _mean_over_sheet(self, values: Complex | Real) -> Complex:
        """Mean over every hit's sheet, weighed as sizes are known, (h, m); 0 where no hit tells."""
        std = np.where(self.used, self.size_std, np.inf)
        return means_of_sheets(np.where(self.used, values, 0.0).astype(complex), std, self.sheet)

    @cached_property
    def ringing(self) -> Ringing:
        """How the modes ring on after every blow."""
        return Ringing(self)

    def blows(self, substeps: int) -> Real:
        """Forces of all hits, and for `_QUIET_S` after, at steps between which they run straight, N, (h, n_steps)."""
        if substeps not in self._blows:
            assert self.pulses is not None
            after = int(_QUIET_S * self.pulses.sample_rate_hz)
            self._blows[substeps] = straightened(np.pad(self.pulses.force_n, ((0, 0), (0, after))), substeps)
        return self._blows[substeps]

    @cached_property
    def _blows(self) -> dict[int, Real]:
        """Those that were asked for."""
        return {}


def _far_std(distance: Real) -> Real:
    """1 σ of what one pole reads of a decay that is so many decay rates off, in these."""
    return np.asarray(_FAR_STD * distance**2 / (distance + _FAR))


def prepare_hits(
    configuration: str,
    hits: HitModes,
    modal: ModalModel,
    force_n: Sequence[float],
    reference_level: int | None = None,
    level_dependent: bool = False,
    rig: Rig | None = None,
) -> HitData | None:
    """What single hits tell, prepared; None where no sheet was struck at several levels.

    Parameters
    ----------
    configuration : str
    hits : HitModes
    modal : ModalModel
        Of the level that is nearest to the linear structure.
    force_n : sequence of float
        Of each level.
    reference_level : int, optional
        Level that `modal` is of; all hits where left out.
    level_dependent : bool, optional
        What the study of the levels leaves no doubt of.
    rig : Rig, optional
        Modes above the reach of its model are left out.
    """
    data = HitData(
        prepare(from_modal_model(modal, configuration)),
        hits.modes,
        hits.outputs,
        np.nan_to_num(hits.shapes),
        hits.names,
        hits.level,
        hits.sheet,
        np.asarray(force_n, float),
        hits.log_frequency,
        hits.log_frequency_std,
        hits.damping_ratio,
        hits.damping_std,
        hits.motion_m,
        hits.size,
        hits.size_std,
        hits.window_decay_rad_s,
        hits.band_hz,
        hits.line_hz,
        reference_level,
        level_dependent,
        hits.pulses,
    )
    if rig is not None:  # those above are the last ones
        data = data.within(within_reach(data.reference, rig))
    return data if comparable(data) else None


def comparable(data: HitData) -> bool:
    """True where hits of several levels share a sheet and tell of a mode."""
    return any(
        len(set(data.level[data.used[:, r] & (data.sheet == s)].tolist())) > 1
        for r in range(len(data.modes))
        for s in np.unique(data.sheet)
    )
