"""Measured modes in the form that residuals need: real shapes, logarithms of frequencies and damping ratios."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.settings import AssumedSettings
from ema_pipeline.dof import Dof
from ema_pipeline.modal.assurance import mac
from ema_pipeline.observations.mode_rows import shape_unit

if TYPE_CHECKING:
    from ema_pipeline.observations.known_shapes import KnownShapes
    from ema_pipeline.observations.without_partner import Alone

_MIXED_STD = 0.1
"""1 σ, in the largest entry, of shapes that identification may have mixed."""
_BROAD, _BROAD_STD = 0.05, 0.5
"""Damping ratio from which a resonance is broad, and 1 σ of its shape, in the largest entry, over the square of that,
which repeated hits do not show: a fit gives some of a broad flank to the neighbours that stand on it. Modes of 7 to 8 %
were off by 0.1 to 0.2 %."""
_USUAL_RATIO = 0.01
"""Damping ratio of a mode whose own was not measured."""
_PHASE_STD = 2e-3
"""1 σ of imaginary parts, per entry, by what all hits have in common: channels whose phases agree within 0.1°."""
_BEYOND = 1.5
"""Frequency of what stands for all modes above the band, over its upper end."""
_WHIRLS = 0.05
"""Share of its imaginary part in the sum of squares of a shape, from which it is compared as a complex one: MPC 0.8."""
_DOUBLE = 0.9
"""Share of a shape's squares that shapes of near modes explain, from which it is no mode of its own."""
_BETTER_KNOWN = 2.0
"""Factor by which a near mode's frequency is known better, from which one that it may share is no mode of its own."""
_LEAST_SENSORS = 2
"""Sensors that tell whether shapes are alike: on one alone all are."""
_ORTHOGONAL = 0.2
"""Modal assurance criterion up to which two modes are orthogonal, as far as sensors without masses tell."""
_NEAR = 4.0
"""Half-widths within which modes are near: one that drifts from hit to hit has twins a little farther off than one."""
_CLOSE = 3.0
"""Half-power bandwidths within which modes are close: further apart, one is below a sixth of its peak at another's."""
_UNEVEN = 10.0
"""Relative difference of the damping of parts that is seldom less, 0.1, over the usual share that identification mixes.
"""
_OVERLAP = 6.0
"""Half-widths within which one mode's shape may hold some of another's."""
_LEAST_TURN = 0.003
"""Turn of a shape towards another's, 1 σ, that is looked at: what is less lies within the scatter of shapes."""
_NEARLY_ONE, _MORE = 0.35, 15.0
"""Distance of two poles, in half-widths, within which identification hardly tells their shapes apart, and by how much
more it mixes them there: in 14 simulated rigs 0.0009 (root mean square) at one half-width, and up to 0.0085 at 0.3."""

_CHAIN = 0.03
"""Difference of ln f up to which neighbours are of one group."""
_MOST = 4
"""Most modes of a group; a longer chain is cut at its widest gaps."""
_SENSORS = 2
"""Sensors per mode of a group that tell its shapes apart."""


@dataclass(frozen=True)
class ModeData:
    """One configuration's measured modes, prepared: real shapes with their largest entry 1.

    Attributes
    ----------
    configuration : str
    log_frequency, log_frequency_std : ndarray, (m,)
    log_damping, log_damping_std : ndarray, (m,)
        NaN where not measured.
    shapes, shape_std : ndarray, (m, s)
        NaN where not measured; s may be 0.
    dofs : tuple of Dof
    band_hz : tuple of float
    complete : bool
        False where modes of the band were taken out on purpose: what the model has besides is then no contradiction.
    imaginary : ndarray, (m, s), optional
        Imaginary parts of the shapes, turned so that the sum of their squares is real; 0 where not measured.
    always : ndarray of bool, (m,), optional
        Modes that are never held out.
    whole : ModeData, optional
        What the modes were taken out of: what they are to each other does not change when one of them is held out.
    kept : ndarray of bool, optional
        Mask of them there.
    product : ndarray of bool, optional
        True for what a structure that is not linear may have made of other modes; none where left out.
    """

    configuration: str
    log_frequency: NDArray[np.float64]
    log_frequency_std: NDArray[np.float64]
    log_damping: NDArray[np.float64]
    log_damping_std: NDArray[np.float64]
    shapes: NDArray[np.float64]
    shape_std: NDArray[np.float64]
    dofs: tuple[Dof, ...]
    band_hz: tuple[float, float]
    complete: bool = True
    imaginary: NDArray[np.float64] | None = None
    always: NDArray[np.bool_] | None = None
    whole: ModeData | None = None
    kept: NDArray[np.bool_] | None = None
    product: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.log_frequency)

    @property
    def places(self) -> NDArray[np.int64]:
        """Place of every mode in the whole that these are of, (m,)."""
        return np.arange(len(self)) if self.kept is None else np.flatnonzero(self.kept)

    @cached_property
    def doubtful(self) -> NDArray[np.bool_]:
        """Mask of modes that may be none of the structure: `double` ones and products, (m,)."""
        return self.double if self.product is None else self.double | self.product

    @cached_property
    def known_shapes(self) -> NDArray[np.float64]:
        """Shapes with 0 where not measured, (m, s)."""
        return np.nan_to_num(self.shapes)

    @cached_property
    def seen(self) -> NDArray[np.float64]:
        """1 where a shape was measured, 0 elsewhere, (m, s)."""
        return np.isfinite(self.shapes).astype(float)

    @cached_property
    def whirling(self) -> NDArray[np.bool_]:
        """Mask of modes whose shapes are complex far beyond what a test does to real ones, (m,).

        Gyroscopic coupling makes bodies whirl, and strong dampers let parts of a structure lag behind. Shapes of
        `double` modes are complex because identification mixes them.
        """
        if self.imaginary is None:
            return np.zeros(len(self), bool)
        across = np.sum(self.imaginary**2, axis=1)
        return np.asarray((across > _WHIRLS * (across + np.sum(self.known_shapes**2, axis=1))) & ~self.double)

    @cached_property
    def lagging(self) -> NDArray[np.bool_]:
        """Mask of modes whose real shapes are compared, and their imaginary parts apart from them, (m,).

        Dampers at single places let parts of a structure lag behind a little. Close modes lag by what identification
        mixes of them.
        """
        if self.whole is not None:
            return np.asarray(self.whole.lagging[self.kept])
        if self.imaginary is None:
            return np.zeros(len(self), bool)
        told = np.any(self.imaginary, axis=1) & (np.sum(self.seen, axis=1) >= _LEAST_SENSORS)
        return np.asarray(told & ~self.whirling & ~self.doubtful & ~self.close & (self.group < 0))

    @cached_property
    def complex_shapes(self) -> NDArray[np.complex128]:
        """Shapes with the imaginary parts of `whirling` and `lagging` modes, 0 where not measured, (m, s)."""
        if self.imaginary is None:
            return self.known_shapes.astype(complex)
        compared = (self.whirling | self.lagging)[:, None]
        return np.asarray(self.known_shapes + 1j * np.where(compared, self.imaginary, 0.0), complex)

    @cached_property
    def compared_shapes(self) -> NDArray[np.complex128]:
        """Shapes that are compared up to one factor, (m, s): complex ones of `whirling` modes, real ones of others."""
        return np.where(self.whirling[:, None], self.complex_shapes, self.known_shapes)

    @cached_property
    def costs_alone(self) -> dict[tuple[object, ...], Alone]:
        """Costs of modes without a partner that were calculated last, see `Alone.of`."""
        return {}

    @cached_property
    def shapes_compared(self) -> dict[tuple[object, ...], KnownShapes]:
        """Shapes of modes with a partner as they were compared last, see `KnownShapes.of`."""
        return {}

    @cached_property
    def squares(self) -> NDArray[np.float64]:
        """Sum of squares of every shape, (m,)."""
        return np.asarray(np.sum(np.abs(self.compared_shapes) ** 2, axis=1))

    @cached_property
    def double(self) -> NDArray[np.bool_]:
        """Mask of modes whose shape is a mix of those of near modes, or whose frequency is not told from one's, (m,).

        Drift and hits off their mark split close modes into more than there are. What a structure adds has a shape that
        the others have not.
        """
        if self.whole is not None:
            return np.asarray(self.whole.double[self.kept])
        found = np.zeros(len(self), bool)
        width = np.nan_to_num(np.exp(self.log_damping))
        for i in range(len(self)):
            near = np.abs(self.log_frequency - self.log_frequency[i]) < _NEAR * np.maximum(width, width[i])
            near[i] = False
            on = (self.seen[i] > 0) & np.all(self.seen[near] > 0, axis=0)
            if not np.any(near) or np.sum(on) < _LEAST_SENSORS:
                continue
            found[i] = np.any(near & self._within_uncertainty(i))
            if np.sum(on) < np.sum(near) + 2:
                continue  # any shape is a mix of so many
            others, own = self.shapes[near][:, on].T, self.shapes[i, on]
            left = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
            found[i] |= left @ left < (1 - _DOUBLE) * (own @ own)
        return found

    def _within_uncertainty(self, i: int) -> NDArray[np.bool_]:
        """Mask of modes at a frequency that mode `i` may have as well, known much better and somewhat alike, (m,).

        True modes at one frequency are orthogonal.
        """
        std = self.log_frequency_std
        apart = np.abs(self.log_frequency - self.log_frequency[i])
        alike = mac(self.shapes[i], self.shapes)[0] > _ORTHOGONAL
        return (apart < std[i]) & (_BETTER_KNOWN * std < std[i]) & alike

    @cached_property
    def close(self) -> NDArray[np.bool_]:
        """Mask of modes close to another, whose shapes drift, noise and hits off their mark mix, (m,)."""
        if self.whole is not None:
            return np.asarray(self.whole.close[self.kept])
        bandwidth = 2 * np.nan_to_num(np.exp(self.log_damping))
        apart = np.abs(self.log_frequency[:, None] - self.log_frequency)
        near = apart < _CLOSE * np.maximum(bandwidth[:, None], bandwidth)
        return np.asarray(np.sum(near, axis=1) > 1)

    @cached_property
    def may_hide_another(self) -> NDArray[np.bool_]:
        """Mask of modes near which no further one was measured, (m,): another of the model may hide in them.

        A list of modes of no stated band does not say that there are no others.
        """
        if self.whole is None:
            return np.full(len(self), self.complete)
        left_out = ~np.asarray(self.kept)
        width = np.nan_to_num(np.exp(self.whole.log_damping))
        apart = np.abs(self.log_frequency[:, None] - self.whole.log_frequency[left_out])
        near = apart < _NEAR * np.maximum(width[self.kept][:, None], width[left_out])
        return np.asarray(self.whole.may_hide_another[self.kept] & ~np.any(near, axis=1))

    @cached_property
    def sensors_for_another(self) -> NDArray[np.int64]:
        """Sensors that tell whether another mode hides in one, (m,): 0 where none may."""
        return np.asarray(np.count_nonzero(self.seen, axis=1) * self.may_hide_another, np.int64)

    @cached_property
    def mixes(self) -> tuple[tuple[int, int, float], ...]:
        """Modes whose shape identification may have mixed with that of another: mode, other one, and how much.

        What a fit mistakes of one resonance (drift, hits off their mark) goes to those that it overlaps: it falls with
        their distance over the half-width, and is far more where the poles nearly coincide. Parts that damp unevenly
        mix true shapes by √(ζᵣ ζₛ) |ζᵣ − ζₛ| / (ln²(ωᵣ/ωₛ) + (ζᵣ − ζₛ)²), times their relative difference.
        """
        pairs = []
        width = np.nan_to_num(np.exp(self.log_damping))
        shaped = np.flatnonzero(np.any(self.seen, axis=1) & ~self.whirling)
        for a in shaped:
            for b in shaped:
                half = max(width[a], width[b])
                apart = abs(self.log_frequency[a] - self.log_frequency[b]) / max(half, 1e-300)
                if a != b and apart < _OVERLAP:
                    less = min(width[a], width[b]) / max(half, 1e-300)
                    uneven = np.sqrt(less) * (1 - less) / (max(apart, 1.0) ** 2 + (1 - less) ** 2)
                    more = _MORE if np.hypot(apart, 1 - less) < _NEARLY_ONE else 1.0
                    share = np.hypot(more / np.hypot(1.0, apart), _UNEVEN * uneven)
                    pairs.append((int(a), int(b), float(share)))
        return tuple(pairs)

    @cached_property
    def turns(self) -> tuple[tuple[int, int, float], ...]:
        """Modes whose true shape drift turns towards that of another: mode, other one, and 1 σ of how far.

        Parts that drift apart from each other move the frequencies of two modes apart, by δ ln(ωᵣ/ωₛ), and turn their
        shapes by about δ / ln(ωᵣ/ωₛ). What all frequencies may share is drift of all parts, which turns none.
        """
        shaped = np.flatnonzero(np.any(self.seen, axis=1) & ~self.whirling)
        variance = self.log_frequency_std[shaped] ** 2
        own = variance - np.min(variance, initial=np.inf)
        moved = np.sqrt(own[:, None] + own)
        apart = np.hypot(moved, self.log_frequency[shaped, None] - self.log_frequency[shaped])
        share = np.divide(moved, apart, out=np.zeros_like(apart), where=apart > 0)
        np.fill_diagonal(share, 0.0)
        return tuple(
            (int(shaped[a]), int(shaped[b]), float(share[a, b])) for a, b in np.argwhere(share > _LEAST_TURN)
        )

    @cached_property
    def holds(self) -> NDArray[np.int64]:
        """Pairs of modes, (q, 2): what the shape of one holds of that of the other; all of `mixes`, then of `turns`."""
        return np.array([pair[:2] for pair in (*self.mixes, *self.turns)], np.int64).reshape(-1, 2)

    @cached_property
    def group(self) -> NDArray[np.int64]:
        """Number of the group of neighbours that every mode is compared in, -1 for one that is alone, (m,).

        Modes without a real shape of their own are alone: `double` ones and those that whirl.
        """
        group = np.full(len(self), -1)
        usable = np.flatnonzero(~self.double & ~self.whirling & np.any(self.seen > 0, axis=1))
        order = usable[np.argsort(self.log_frequency[usable])]
        for number, members in enumerate(_chains(order, self.log_frequency)):
            if len(members) > 1 and np.all(np.sum(self.seen[members], axis=1) >= _SENSORS * len(members)):
                group[members] = number
        return group

    @cached_property
    def unit(self) -> NDArray[np.int64]:
        """Number of what is held out together: a mode that is alone, or all of a group, (m,)."""
        first = {g: r for r, g in reversed(list(enumerate(self.group.tolist()))) if g >= 0}
        begins = [first.get(g, r) for r, g in enumerate(self.group.tolist())]
        return np.asarray(np.unique(begins, return_inverse=True)[1], np.int64)

    def shape_rows(self, modes: NDArray[np.int64]) -> int:
        """Number of values that the shapes of some modes are compared by: two per sensor of one that is complex."""
        return int(np.sum(self.seen[modes] * (1 + (self.whirling | self.lagging)[modes, None])))

    @cached_property
    def compared_std(self) -> NDArray[np.float64]:
        """1 σ of shapes as they are compared, (m, s): identification mixes those of `double` and `whirling` modes."""
        return np.hypot(self.shape_std, _MIXED_STD * (self.double | self.whirling)[:, None])

    @cached_property
    def broad_std(self) -> NDArray[np.float64]:
        """1 σ of shapes of broad resonances that adds to that of hits, (m,); 0 of others."""
        ratio = np.nan_to_num(np.exp(self.log_damping))
        return np.where(ratio > _BROAD, _BROAD_STD * ratio**2, 0.0)

    @cached_property
    def lag_std(self) -> NDArray[np.float64]:
        """1 σ of imaginary parts of shapes that adds to that of hits, (m, s)."""
        return np.hypot(self.broad_std[:, None], _PHASE_STD * shape_unit(self.known_shapes))

    @cached_property
    def lag_unit(self) -> NDArray[np.float64]:
        """Imaginary parts of shapes where parts damp unevenly, per relative difference of their damping, (m, s).

        Damping forces from mode to mode are then of the size of those of the modes themselves, times that difference,
        and make mode r hold 2 √(ζᵣ ζₛ ωₛ/ωᵣ) / ((ωₛ/ωᵣ)² − 1) of mode s, 90° late (first order: Rayleigh, The Theory of
        Sound, 1877, §102), or √(ωₛ/ωᵣ) times that where losses are hysteretic: the larger one is taken. All modes are
        taken to be equally large at the sensors; one stands for those above the band.
        """
        if self.whole is not None:
            return np.asarray(self.whole.lag_unit[self.kept])
        ratio = np.where(np.isfinite(self.log_damping), np.exp(self.log_damping), _USUAL_RATIO)[:, None]

        def held(above: NDArray[np.float64], of: NDArray[np.float64]) -> NDArray[np.float64]:
            apart = np.where(above == 1, np.inf, above**2 - 1)
            return np.asarray(4 * ratio * of * above * np.maximum(above, 1.0) / apart**2)

        size = np.sqrt(np.sum(self.known_shapes**2, axis=1, keepdims=True))
        others = held(np.exp(self.log_frequency - self.log_frequency[:, None]), ratio.T)
        beyond = held(_BEYOND * self.band_hz[1] / np.exp(self.log_frequency)[:, None], ratio)
        of_others = others @ (self.known_shapes / np.maximum(size, 1e-300)) ** 2 * size**2
        return np.asarray(np.sqrt(of_others + beyond * shape_unit(self.known_shapes) ** 2))

    def without_lag(self) -> ModeData:
        """The same with imaginary parts of `whirling` modes alone."""
        if self.imaginary is None:
            return self
        return dataclasses.replace(self, imaginary=np.where(self.whirling[:, None], self.imaginary, 0.0))

    def only(self, keep: NDArray[np.bool_]) -> ModeData:
        """The modes of a mask, (m,)."""
        names = [
            "log_frequency",
            "log_frequency_std",
            "log_damping",
            "log_damping_std",
            "shapes",
            "shape_std",
        ]
        names += [n for n in ("imaginary", "product") if getattr(self, n) is not None]
        kept = {n: getattr(self, n)[keep] for n in names}
        return dataclasses.replace(self, complete=False, always=None, whole=self, kept=keep, **kept)


def _chains(order: NDArray[np.int64], log_frequency: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Modes in the order of their frequencies, cut where neighbours are far apart."""
    gaps = np.diff(log_frequency[order])
    widest = int(np.argmax(gaps)) if len(gaps) else 0
    if len(gaps) and (gaps[widest] > _CHAIN or len(order) > _MOST):
        yield from _chains(order[: widest + 1], log_frequency)
        yield from _chains(order[widest + 1 :], log_frequency)
    else:
        yield order


def _known_or(std: NDArray[np.float64], assumed: float) -> NDArray[np.float64]:
    """Standard deviations, the assumed one where none is known."""
    return np.where(np.isfinite(std) & (std > 0), std, assumed)


def prepare(measured: MeasuredModes, settings: AssumedSettings | None = None) -> ModeData:
    """Measured modes in the form that residuals need; where no scatter is known, `settings` say what is assumed."""
    settings = settings or AssumedSettings()
    m, f = len(measured), measured.frequency_hz
    shapes, imaginary = np.zeros((m, 0)), np.zeros((m, 0))
    std = np.zeros((m, 0))
    dofs: tuple[Dof, ...] = ()
    if measured.shapes is not None and measured.dofs:
        dofs = measured.dofs
        shapes, imaginary, std = (np.zeros((m, len(dofs))) for _ in range(3))
        for r in range(m):
            y = measured.shapes[r] * np.exp(-0.5j * np.angle(np.nansum(measured.shapes[r] ** 2)))
            size = float(np.nanmax(np.abs(y.real), initial=0.0)) or 1.0
            shapes[r] = y.real / size
            imaginary[r] = np.nan_to_num(y.imag / size)
            # shapes are compared up to a factor: what all entries have in common is none of their difference
            stds = measured.shape_std if measured.shape_own_std is None else measured.shape_own_std
            given = np.full(len(dofs), np.nan) if stds is None else stds[r]
            std[r] = _known_or(given / size, settings.shape_std_assumed)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = _known_or(measured.frequency_std_hz / f, settings.frequency_std_assumed)
        damping = np.where(measured.damping_ratio > 0, measured.damping_ratio, np.nan)
        damping_std = _known_or(measured.damping_std / damping, settings.damping_std_assumed)
    band = measured.band_hz or (0.9 * float(np.min(f, initial=1.0)), 1.1 * float(np.max(f, initial=1.0)))
    return ModeData(
        measured.configuration, np.log(f), relative, np.log(damping), damping_std, shapes, std, dofs, band,
        complete=measured.band_hz is not None,  # a list of frequencies does not say that there are no others
        imaginary=imaginary,
    )  # fmt: skip
