"""Residuals of one configuration's hits at one point of the unknowns: how modes move from hit to hit.

Only differences between hits on one impact point with the same sensors count. What the nonlinear elements make of the
modes at the measured amplitudes comes from `observations.hit_modes`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.inference import Residuals, Scatter
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import Nonlinear, Spring
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.observations.hit_aim import as_aimed
from ema_pipeline.observations.hit_data import HitData
from ema_pipeline.observations.hit_march import Driven, marched_modes, rubs
from ema_pipeline.observations.hit_modes import Linear, changed_modes
from ema_pipeline.observations.hit_rows import (
    HIT_AIM,
    HIT_DAMPING,
    HIT_FREQUENCY,
    HIT_QUADRATURE,
    HitRows,
)
from ema_pipeline.observations.larger_motions import as_larger_motions
from ema_pipeline.observations.mode_problem import Paired
from ema_pipeline.observations.mode_rows import FREQUENCY, FREQUENCY_NOISE
from ema_pipeline.observations.parts import DAMPING_SCATTER, part_key

if TYPE_CHECKING:
    from ema_pipeline.observations.amplitude import AmplitudeProblem

DRIFT = "drift"
LINEARISATION = "linearisation"
AMPLITUDE = "amplitude of all modes"
"""Unknown by whose exponential all amplitudes are multiplied."""
_FINE_STEP = 1e-6
"""Step of the differences of elements' numbers by sizes, in units of their prior σ."""
_REMEMBERED = 16
"""Last points at which the shifts are kept: a step is tried without derivatives, then taken with them."""


def hit_scatters() -> dict[str, Scatter]:
    """The hyper-parameters that single hits add to those of measured modes."""
    known = (
        Scatter(DRIFT, "ln f of all modes from hit to hit", 1e-4, 1.0, 1e-3, 20.0),
        Scatter(HIT_FREQUENCY, "ln f of one mode from hit to hit", 3e-5, 1.0, 3e-5, 5.0),
        Scatter(HIT_DAMPING, "ln ζ of one mode from hit to hit", 5e-3, 1.0, 5e-3, 15.0),
        Scatter(HIT_QUADRATURE, "imaginary part of one mode's size from hit to hit", 3e-3, 1.0, 1e-2, 15.0),
        Scatter(HIT_AIM, "what is read of a mode over how its size differs", 0.1, 1.0, 0.2, 5.0),
        Scatter(LINEARISATION, "equivalent linearisation", 0.15, 0.3, 0.15, 2.0),
    )
    return {s.name: s for s in known}


class HitResiduals:
    """Residuals of one configuration's hits at one point of the unknowns."""

    def __init__(
        self,
        problem: AmplitudeProblem,
        data: HitData,
        paired: Paired,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        heat: float,
    ) -> None:
        self.problem, self.data, self.paired, self.x = problem, data, paired, x
        self.scatters, self.heat = scatters, heat
        self.scale = problem.unknowns.index[AMPLITUDE]
        self.drift, self.left = problem.positions(data)

    def residuals(self, rows: HitRows, derivatives: bool, by_sizes: bool = True) -> Residuals:
        """All `rows` of the data, each without its mean over a sheet's hits."""
        x, predicted, hit, mode = self.x, self.predicted, rows.hit, rows.mode
        told, slope = np.arctan(predicted[2]), np.ones_like(predicted)
        slope[2] = 1 / (1 + predicted[2] ** 2)
        values = rows.measured - np.stack([*predicted[:2], told])[:, hit, mode]
        values[0] -= x[self.drift][hit]
        at_unit = rows.whitening(self.scatters, self.heat)
        jacobian = np.zeros((3 * len(hit) if derivatives else 0, len(x)))
        if derivatives:
            for i, change in self.changes.items() if by_sizes else ():
                jacobian[:, i] = -(slope * change)[:, hit, mode].ravel()
            row = np.arange(3 * len(hit))
            jacobian[row[: len(hit)], self.drift[hit]] = -1.0
            jacobian[row, np.tile(self.left[hit, mode], 3)] = -(slope * predicted)[:, hit, mode].ravel()
            jacobian = at_unit.whitened(jacobian)
        return Residuals(
            at_unit.whitened(values.ravel()),
            jacobian,
            at_unit.share,
            at_unit.log_scale,
            matching=self.paired.match,
            projected=rows.groups,
        )

    @cached_property
    def predicted(self) -> NDArray[np.float64]:
        """Changes of ln f, of ln ζ and of the size in quadrature of every hit and mode, (3, h, m)."""
        return self._read(np.exp(self.x[self.left]) * self.moved(self.x))

    @cached_property
    def changes(self) -> dict[int, NDArray[np.float64]]:
        """Derivatives of `predicted` by sizes and by the scale of amplitudes, by their position."""
        sizes = self.problem.nonlinear_sizes
        found = {i: self._change(i) for i in sizes}
        if np.any(self.predicted):
            alike = self._as_larger_motions(sizes)
            by_scale = (
                self._change(self.scale) if alike is None else np.tensordot(alike, [*found.values()], 1)
            )
            found[self.scale] = by_scale
        return found

    def _as_larger_motions(self, sizes: Sequence[int]) -> NDArray[np.float64] | None:
        """See `larger_motions.as_larger_motions`."""
        points = [self.x, *(self._ahead(i, _FINE_STEP) for i in sizes)]
        elements, *changed = (self._assembly(x).nonlinear for x in points)
        steps = [(x - self.x)[i] for x, i in zip(points[1:], sizes, strict=True)]
        return as_larger_motions(elements, changed, steps)

    def _change(self, i: int) -> NDArray[np.float64]:
        """Derivative of `predicted` by the unknown at position `i`."""
        ahead = self._ahead(i, self.problem.step(i, self.x))
        change = (self.moved(ahead) - self.moved(self.x)) / (ahead - self.x)[i]
        return self._read(np.exp(self.x[self.left]) * change)

    def _ahead(self, i: int, step: float) -> NDArray[np.float64]:
        """The unknowns a step on in one of them, or back where it would leave its range."""
        ahead = self.x.copy()
        ahead[i] += step if ahead[i] + step <= self.problem.unknowns.upper[i] else -step
        return ahead

    def shift_reference(self, modes: Residuals, derivatives: bool) -> None:
        """Move the model's values behind the residuals of the level's modes to where its hits find them.

        Even the hits nearest to the linear structure lock friction, or part teeth.
        """
        if not np.any(self.predicted):
            return
        weight = self.data.reference_weights
        for kind, (row, mode, sigma) in enumerate(self._rows_of_reference(modes)):
            modes.values[row] -= np.sum(weight * self.predicted[kind], axis=0)[mode] / sigma
            if not derivatives:
                continue
            for i, change in self.changes.items():
                modes.jacobian[row, i] -= np.sum(weight * change[kind], axis=0)[mode] / sigma
            for h in range(len(weight)):
                share = (weight[h] * self.predicted[kind, h])[mode] / sigma
                modes.jacobian[row, self.left[h, mode]] -= share

    def _rows_of_reference(
        self, modes: Residuals
    ) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Rows of frequencies and of damping ratios of the hits' modes, their place among these, and 1 σ."""
        at, scatters = 0, self.scatters
        assert isinstance(modes.matching, tuple)
        for data, match in zip(self.problem.modes.observations.data, modes.matching, strict=True):
            on = np.flatnonzero(match >= 0)
            damped = on[np.isfinite(data.log_damping[on])]
            whole = data if data.whole is None else data.whole
            if data.configuration == self.data.configuration and len(whole) == len(self.data.reference):
                of_hits = {int(r): k for k, r in enumerate(self.data.modes)}
                mine = {r: of_hits[int(p)] for r, p in enumerate(data.places) if int(p) in of_hits}
                found = []
                for rows, start, own, scatter, heat in (
                    (on, at, scatters[FREQUENCY_NOISE] * data.log_frequency_std, FREQUENCY, self.heat),
                    (damped, at + len(on), data.log_damping_std, DAMPING_SCATTER, 1.0),
                ):
                    kept = [(start + i, mine[int(r)], int(r)) for i, r in enumerate(rows) if int(r) in mine]
                    row, mode, measured = np.array(kept, int).reshape(-1, 3).T
                    found.append((row, mode, np.hypot(own[measured], scatters[scatter]) * heat))
                return found
            at += len(on) + len(damped) + data.shape_rows(on)
        return []

    def _read(self, moved: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Changes of ln f, of ln ζ and of the size in quadrature that changes of poles and ln sizes make, (3, h, m)."""
        usual, omega = self.data.usual_damping, self.data.omega
        pole, size = moved
        frequency = pole.imag / omega
        damping = -pole.real / omega - usual * frequency
        return np.stack([frequency, damping / usual, (size * self.data.relative_size).imag])

    def moved(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Change of every mode's pole, 1/s, and of ln of its size in every hit, (2, h, m)."""
        own = x[: self.problem.modes.offset]
        key = (self.data.configuration, own.tobytes(), float(x[self.scale]), self.paired.match.tobytes())
        known = self.problem.moved
        if key not in known:
            if len(known) >= _REMEMBERED:
                known.clear()
            known[key] = self._found_moved(x)
        return known[key]

    def _found_moved(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        lattice, on_lattice = self.problem.observations.lattice, self.problem.on_lattice
        if lattice is None or not any(map(on_lattice, self._assembly(x).nonlinear)):
            return self.calculated(x, lambda element: True)
        others = self.calculated(x, lambda element: not on_lattice(element))
        return others + lattice.changes(self.data, self.problem, x)

    def calculated(
        self, x: NDArray[np.float64], wanted: Callable[[Nonlinear], bool]
    ) -> NDArray[np.complex128]:
        """What some elements change, as `moved` has it, with the structure that these unknowns make."""
        data = self.data
        assembly = self._assembly(x)
        elements = [e for e in assembly.nonlinear if wanted(e)]
        total = np.zeros((2, *data.log_frequency.shape), complex)
        match = self.paired.match[data.modes]
        on = np.flatnonzero(match >= 0)
        if not elements or not len(on):
            return total
        rows = element_rows(assembly, elements)
        solution = self.paired.solution
        stretch = rows @ solution.shapes[: rows.shape[1]]
        displacement = self._displacement(x, match, on)
        scaled = [self._scaled(e, x) for e in elements]
        of_marched = np.array([self.problem.is_marched(e) for e in scaled])
        if of_marched.any():
            through_time = list(compress(scaled, of_marched))
            marched = self._marched(x, through_time, stretch[of_marched], match, displacement)
            if marched is not None:
                scaled, stretch = list(compress(scaled, ~of_marched)), stretch[~of_marched]
                total += marched
        if not scaled:
            return total
        linear = Linear.of(data, stretch, match, solution.eigenvalues, displacement)
        return total + changed_modes(data, scaled, linear)

    def _marched(
        self,
        x: NDArray[np.float64],
        elements: Sequence[Nonlinear],
        stretch: NDArray[np.float64],
        match: NDArray[np.int64],
        displacement: NDArray[np.complex128],
    ) -> NDArray[np.complex128] | None:
        """What these elements change, by marching the hits; None where their motion has no bound."""
        data = self.data
        assert data.pulses is not None
        scale = float(np.exp(x[self.scale]))
        stated = self._motion_of(data.pulses.struck)
        struck: NDArray[np.float64] | NDArray[np.complex128] = stated
        if any(map(rubs, elements)):
            across = [self._motion_of(self._across(d)) for d in data.pulses.struck]
            struck = as_aimed(data, stated, across, displacement, match, scale)
        driven = Driven.of(data, stretch, struck, match, self.paired.solution.eigenvalues, scale)
        return marched_modes(data, elements, driven, displacement)

    def _across(self, struck: Dof) -> list[Dof]:
        """Directions in which a blow that is off its own moves the body, too."""
        modes = self.problem.modes
        others = [Dof(struck.body, one) for one in modes.directions_across(struck.point)]
        return [d for d in others if modes.observations.has(self.data.configuration, d)]

    def _motion_of(self, dofs: Sequence[Dof]) -> NDArray[np.float64]:
        """Motion along some DOFs in each shape of the model, (k, n)."""
        rows = self.problem.model.sensor_rows(self.data.configuration, dofs)
        return np.asarray(rows @ self.paired.solution.shapes[: rows.shape[1]])

    def _assembly(self, x: NDArray[np.float64]) -> Assembly:
        model = self.problem.model
        return model.assembly(self.data.configuration, x[model.edit_start : self.problem.modes.offset])

    def _displacement(
        self, x: NDArray[np.float64], match: NDArray[np.int64], on: NDArray[np.int64]
    ) -> NDArray[np.complex128]:
        """Amplitude of each modal coordinate just after each blow, as the sensors saw it, (h, m)."""
        data = self.data
        seen = self._motion_of(data.dofs)[:, match[on]]
        factor = np.einsum("om,mo->m", seen, data.shapes[on]) / np.maximum(np.sum(seen**2, axis=0), 1e-300)
        result = np.zeros(data.motion.shape, complex)
        result[:, on] = np.nan_to_num(data.motion[:, on]) * factor * np.exp(x[self.scale])
        return result

    def _scaled(self, element: Nonlinear, x: NDArray[np.float64]) -> Nonlinear:
        """An element that replaces a spring, with the stiffness that the spring has at these unknowns."""
        model = self.problem.model
        row = model.dependence.elements[self.data.configuration].get(part_key(element))
        if row is None or not isinstance(element, Spring):
            return element
        factor = float(np.exp(row @ x[: len(row)]))
        return dataclasses.replace(element, stiffness=element.stiffness * factor)
