"""Loops to be explained together, and the weights of their points.

The displacement is measured too: a wrong amplitude or phase of a loop changes its force like a little stiffness
or damping. These errors, and the unknown offset of each force, are taken out of data and model alike by a
whitening matrix, so that what is left over counts in standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.effects import Structure
from ema_pipeline.loops.model import (
    CUBIC,
    DAMPING,
    FORCE,
    GAP,
    GAPS,
    QUADRATIC,
    RELAXATION,
    RHO,
    SPRING_GAP,
    STIFFNESS,
    TIME,
    Motion,
)
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.fourier import fourier

_CERTAIN = 1e8


class LoopSet:
    """Loops to be explained together.

    Parameters
    ----------
    loops : sequence of Loop
    own_scale : bool
        Whether every loop has a factor of its own on the model's force: for tests of one device at several
        settings, e.g. tensions.
    misfit : float
        By how much the models' misfit exceeds the noise of the force: errors of the displacement then matter
        that much less.
    """

    def __init__(self, loops: Sequence[Loop], own_scale: bool = False, misfit: float = 1.0) -> None:
        self.loops = tuple(loops)
        self.own_scale = own_scale
        self.misfit = misfit
        self.motion = Motion(loops)
        self.parts = self.motion.parts
        self._std = np.concatenate([np.full(len(loop.force), loop.force_std_n) for loop in loops])
        self._whiten = [_whitening(loop, misfit) for loop in loops]
        self.amplitude_m = max(loop.amplitude_m for loop in loops)
        self.omega = 2 * np.pi * float(np.mean([loop.frequency_hz for loop in loops]))
        self.least_span_m = float(self.motion.span.min())
        self.reference = int(np.argmax([loop.amplitude_m for loop in loops]))

    @cached_property
    def data(self) -> NDArray[np.float64]:
        """Whitened forces, (n_points,)."""
        return self.whitened(np.concatenate([loop.force for loop in self.loops])[:, None])[:, 0]

    def subset(self, indices: Sequence[int]) -> LoopSet:
        """Some of the loops, weighted alike."""
        return LoopSet([self.loops[i] for i in indices], self.own_scale, self.misfit)

    def with_loop(self, loop: Loop) -> LoopSet:
        """One loop more."""
        return LoopSet((*self.loops, loop), self.own_scale, self.misfit)

    @property
    def freedom(self) -> int:
        """Points less the offsets."""
        return len(self.data) - len(self.loops)

    @cached_property
    def units(self) -> dict[str, float]:
        """Sizes of the linear parameters that would make a force as large as the measured one."""
        stiffness = float(np.median([_secant(loop) for loop in self.loops]))
        x, omega = self.amplitude_m, self.omega
        force = stiffness * x
        return {
            STIFFNESS: stiffness,
            "quadratic_stiffness": force / x**2,
            "cubic_stiffness": force / x**3,
            "viscous_damping": force / (x * omega),
            FORCE: force,
            RELAXATION: stiffness,
        }

    def shape_unit(self, name: str) -> float:
        """Unit in which `fitting.RANGES` counts a parameter."""
        if name in GAPS:
            return self.least_span_m
        return {RHO: 1 / self.amplitude_m, TIME: 1 / self.omega}.get(name, 1.0)

    def whitened(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Forces in standard deviations and freed of offsets, (n_points, m)."""
        found = columns / self._std[:, None]
        for part, (q, shrink) in zip(self.parts, self._whiten, strict=True):
            found[part] -= q @ (shrink[:, None] * (q.T @ found[part]))
        return found

    def evaluate(
        self, structure: Structure, values: Mapping[str, float], scales: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Whitened force, (n_points,), its slopes by the linear parameters, and by the scales."""
        terms = structure.terms
        if GAP in values:
            columns = self.whitened(self.motion.force(values, terms)[1])
        else:
            columns = np.empty((len(self._std), len(terms)))
            for j, term in enumerate(terms):
                columns[:, j] = self._column(term, values)
        plain = columns @ np.array([values[t] for t in terms])
        if not self.own_scale:
            return plain, columns, np.zeros((len(plain), 0))
        each = np.zeros((len(plain), len(self.loops)))
        for k, part in enumerate(self.parts):
            each[part, k] = plain[part]
            columns[part] *= scales[k]
        return each @ scales, columns, each

    def _column(self, term: str, values: Mapping[str, float]) -> NDArray[np.float64]:
        if term in self._known and not (SPRING_GAP in values and term != DAMPING):
            return self._known[term]
        return self.whitened(self.motion.column(term, values)[:, None])[:, 0]

    @cached_property
    def _known(self) -> dict[str, NDArray[np.float64]]:
        """Whitened columns that do not depend on any parameter."""
        terms = (STIFFNESS, QUADRATIC, CUBIC, DAMPING)
        columns = self.whitened(np.stack([self.motion.column(t, {}) for t in terms], axis=1))
        return dict(zip(terms, columns.T, strict=True))


def _secant(loop: Loop) -> float:
    """Size of the force over that of the displacement, both at the first harmonic, N/m."""
    basis = fourier(loop.phase, 1)
    return float(np.hypot(*_first(basis, loop.force)) / np.hypot(*_first(basis, loop.displacement)))


def _first(basis: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.lstsq(basis, y, rcond=None)[0][1:3])


def _whitening(loop: Loop, misfit: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of a loop's force that errors of its displacement and its offset reach, and by how much each
    is shrunk to have unit variance again."""
    basis = fourier(loop.phase, len(loop.series) // 2)
    size = np.full(basis.shape[1], _secant(loop) * loop.displacement_std_m / (misfit * loop.force_std_n))
    size[0] = _CERTAIN
    q, s, _ = np.linalg.svd(basis * size, full_matrices=False)
    return q, 1.0 - 1.0 / np.sqrt(1.0 + s**2)
