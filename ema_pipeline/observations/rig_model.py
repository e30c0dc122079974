"""A rig with effects of unknown size, as matrices that depend on unknowns, with exact derivatives.

Every element is a coefficient times v·vᵀ, so that the derivative of an eigenvalue by the logarithm of a coefficient
is one product. Only what an effect edits is differentiated by small differences, of the matrices, not of the modes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import EffectParameter, PlacedEffect
from ema_pipeline.inference import Unknowns, joined
from ema_pipeline.mechanics.assembly import Assembly, Row
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, solved
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.terms import DAMPING_MATRIX, STRUCTURAL, Matrices, Terms, assemble_terms
from ema_pipeline.observations.mode_pairing import OwnDamping
from ema_pipeline.observations.parts import DAMPING, DAMPING_SCATTER, Dependence, dependence, part_key
from ema_pipeline.rigs.types import Rig

LOG_STD = 1.2
"""Prior 1 σ of the logarithm of a size that has no null: within a factor of three of its start, mostly."""
_DIFFERENCE = 1e-4
"""Step of the differences by effects' sizes, in units of their prior σ."""


@dataclass(frozen=True)
class SizeMap:
    """How one size of an effect follows from its unknown: value = null + scale·x, or start·exp(1.2 x)."""

    parameter: EffectParameter
    scale: float
    logarithmic: bool

    @classmethod
    def of(cls, parameter: EffectParameter, scale: float) -> SizeMap:
        """Logarithmic where the size has no finite null within its range, or cannot be zero."""
        no_null = not np.isfinite(parameter.null) or not parameter.minimum <= parameter.null
        return cls(parameter, scale, no_null or parameter.minimum > 0)

    def value(self, x: float) -> float:
        """Size at the unknown `x`, within its range."""
        p = self.parameter
        value = p.start * self.coordinate(x) if self.logarithmic else p.null + self.scale * x
        return float(np.clip(value, p.minimum, p.maximum))

    def unknown(self, value: float) -> float:
        """The unknown at which the size is `value`."""
        p = self.parameter
        if self.logarithmic:
            return self.of_coordinate(max(value, 1e-300) / p.start)
        return (value - p.null) / self.scale

    def slope(self, x: float) -> float:
        """Derivative of the size by the unknown."""
        return self.value(x) * LOG_STD if self.logarithmic else self.scale

    def coordinate(self, x: float) -> float:
        """What a size is linear in: the unknown itself, or the size over its start."""
        return float(np.exp(LOG_STD * x)) if self.logarithmic else x

    def of_coordinate(self, z: float) -> float:
        """The unknown at a coordinate."""
        return float(np.log(z)) / LOG_STD if self.logarithmic else z

    def coordinate_slope(self, x: float) -> float:
        """Derivative of the coordinate by the unknown."""
        return LOG_STD * self.coordinate(x) if self.logarithmic else 1.0

    @property
    def bounds(self) -> tuple[float, float]:
        """Range of the unknown."""
        p = self.parameter
        low = self.unknown(p.minimum) if p.minimum > 0 or not self.logarithmic else -np.inf
        return low, self.unknown(p.maximum)


@dataclass(frozen=True)
class LinearTerms:
    """Terms whose coefficients are linear functions of the effects' coordinates (`SizeMap.coordinate`).

    Attributes
    ----------
    start : Terms
        At `begin`.
    begin : ndarray, (k,)
    slopes : ndarray, (k, t)
        Derivatives of the coefficients.
    skew_slopes : ndarray, (k, n, n)
    """

    start: Terms
    begin: NDArray[np.float64]
    slopes: NDArray[np.float64]
    skew_slopes: NDArray[np.float64]

    def at(self, coordinates: NDArray[np.float64]) -> Terms:
        """Terms at other coordinates."""
        if not len(self.begin):
            return self.start
        moved = coordinates - self.begin
        s = self.start
        skew = s.skew
        if np.any(self.skew_slopes):
            skew = skew + np.tensordot(moved, self.skew_slopes, axes=1)
        found = Terms(s.dofs, s.rows, s.coefficient + moved @ self.slopes, s.matrix, s.log, skew)
        found.__dict__["by_kind"] = s.by_kind  # the rows are the same ones
        return found


def _same_rows(a: Terms, b: Terms) -> bool:
    return (
        a.dofs == b.dofs
        and a.rows.shape == b.rows.shape
        and bool(np.array_equal(a.rows, b.rows))
        and bool(np.array_equal(a.matrix, b.matrix))
        and bool(np.array_equal(a.log, b.log))
    )


class RigModel:
    """A rig, with effects on top of it, as a function of unknowns.

    The unknowns are, in this order: families, parts, the damping ratio of all modes and what those of single ones
    differ from it by (logarithms), geometric parameters, and the effects' sizes.

    Parameters
    ----------
    rig : Rig
    effects : sequence of PlacedEffect
        In the order in which they are applied.
    scales : dict of str to float, optional
        Prior 1 σ of effects' sizes by ``id@place.name``; the library's where left out.
    shared : Dependence, optional
        Of the rig, where it is known already.
    own_damping : dict of str to OwnDamping, optional
        Undamped modes whose damping ratios are unknowns of their own, by configuration.
    """

    def __init__(
        self,
        rig: Rig,
        effects: Sequence[PlacedEffect] = (),
        scales: Mapping[str, float] | None = None,
        shared: Dependence | None = None,
        own_damping: Mapping[str, OwnDamping] | None = None,
    ) -> None:
        self.rig, self.effects, self.own_damping = rig, tuple(effects), dict(own_damping or {})
        self.dependence = shared or dependence(rig)
        given = scales or {}
        self.sizes = {
            one.parameter_name(p.name): SizeMap.of(p, given.get(one.parameter_name(p.name), p.scale))
            for one in self.effects
            for p in one.effect.parameters
        }
        self._terms: dict[tuple[object, ...], Terms] = {}
        self._linear: dict[str, LinearTerms | None] = {}
        self._nominal: dict[tuple[object, ...], Assembly] = {}
        self._fits: dict[tuple[str, int, tuple[str, ...]], bool] = {}
        self._modes: dict[str, tuple[bytes, bool, Matrices, EigenSolution | None]] = {}

    @cached_property
    def unknowns(self) -> Unknowns:
        """All unknowns of the model."""
        damping = self.rig.parameters.get(DAMPING)
        loose = damping is not None and damping.value > 0 and (damping.free or damping.tolerance > 0)
        bounds = [s.bounds for s in self.sizes.values()]
        return joined(
            self.dependence.unknowns,
            Unknowns.plain((DAMPING,), damping.tolerance or LOG_STD) if loose and damping else _NOTHING,
            Unknowns.plain(
                tuple(name for own in self.own_damping.values() for name in own.names),
                1.0,
                DAMPING_SCATTER,
            ),
            Unknowns.plain(
                self.dependence.geometric,
                [self.rig.parameters[g].tolerance for g in self.dependence.geometric],
            ),
            Unknowns.plain(
                tuple(self.sizes),
                1.0,
                lower=np.array([b[0] for b in bounds]),
                upper=np.array([b[1] for b in bounds]),
            ),
        )

    @cached_property
    def _logs(self) -> int:
        """Number of families and parts."""
        return len(self.dependence.unknowns)

    @cached_property
    def shape_start(self) -> int:
        """Position of the first unknown by which matrices are differentiated as a whole."""
        return len(self.unknowns) - len(self.dependence.geometric) - len(self.sizes)

    @property
    def has_ratio(self) -> bool:
        """True where the common damping ratio is an unknown."""
        return DAMPING in self.unknowns.index

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """Nominal values and the effects at `sizes` (their start values where left out), (n,)."""
        x = np.zeros(len(self.unknowns))
        for name, size in self.sizes.items():
            value = (sizes or {}).get(name, size.parameter.start)
            x[self.unknowns.index[name]] = size.unknown(value)
        return self.unknowns.clipped(x)

    def size_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Sizes of the effects at `x` by ``id@place.name``."""
        return {name: size.value(float(x[self.unknowns.index[name]])) for name, size in self.sizes.items()}

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Values of the rig's parameters and of the effects' at `x`, of the part itself where a family has one only."""
        values, index = {name: p.value for name, p in self.rig.parameters.items()}, self.unknowns.index
        for name in (*self.dependence.families, *self.dependence.geometric, DAMPING):
            if name in index:
                values[name] *= float(np.exp(x[index[name]]))
        for name, (part, power) in self.dependence.sole_parts.items():
            values[name] *= float(np.exp(power * x[index[part]]))
        return values | self.size_values(x)

    def modes(
        self, configuration: str, x: NDArray[np.float64], derivatives: bool = True
    ) -> tuple[Matrices, EigenSolution | None]:
        """Matrices and modes of a configuration at `x`; no modes where a mass or a stiffness is not admissible.

        Derivatives are mostly wanted where a trial step was found to lead, so the last modes are cached.
        """
        key, known = x.tobytes(), self._modes.get(configuration)
        if known is None or known[0] != key or (derivatives and not known[1]):
            matrices = self.matrices(configuration, x, derivatives)
            solution = known[3] if known is not None and known[0] == key else None
            undamped = solved(matrices.dense) if solution is None else (solution.eigenvalues, solution.shapes)
            if undamped is not None and configuration in self.own_damping:
                matrices = self._with_own_damping(configuration, x, matrices, *undamped)
            if solution is None and undamped is not None:
                solution = EigenSolution.of(matrices.dense, matrices.skew, matrices.damping_ratio, undamped)
            known = self._modes[configuration] = key, derivatives, matrices, solution
        return known[2], known[3]

    def _with_own_damping(
        self,
        configuration: str,
        x: NDArray[np.float64],
        matrices: Matrices,
        eigenvalues: NDArray[np.float64],
        shapes: NDArray[np.float64],
    ) -> Matrices:
        """The matrices with the damping ratios of the undamped modes that have one of their own."""
        at, slopes = int(self.has_ratio), matrices.damping_log.copy()
        for name, own in self.own_damping.items():
            if name == configuration:
                slopes[at : at + len(own.names)] = own.slopes(eigenvalues, shapes)
            at += len(own.names)
        return replace(matrices, damping_ratio=self._ratios(x, slopes), damping_log=slopes)

    def _ratios(self, x: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Damping ratios of the undamped modes by the derivatives of their logarithms, (n,)."""
        parameter = self.rig.parameters.get(DAMPING)
        nominal = 0.0 if parameter is None else parameter.value
        return nominal * np.exp(x[self._logs : self._logs + len(slopes)] @ slopes)

    def matrices(self, configuration: str, x: NDArray[np.float64], derivatives: bool = True) -> Matrices:
        """Matrices of a configuration at `x`, and their derivatives by effects and geometry."""
        logs, shape = x[: self._logs], x[self.shape_start :]
        terms = self.terms(configuration, shape)
        slopes = np.zeros((self.shape_start - self._logs, len(terms.dofs)))
        slopes[: int(self.has_ratio)] = 1.0
        factor = np.exp(terms.log @ logs)
        coefficient = terms.coefficient * factor
        dense = terms.dense(coefficient)
        by_shape, skew = self._by_shape(
            configuration, terms, factor, logs, shape if derivatives else shape[:0]
        )
        ratios = self._ratios(x, slopes)
        return Matrices(terms, coefficient, dense, terms.skew, ratios, slopes, by_shape, skew)

    def _by_shape(
        self,
        configuration: str,
        terms: Terms,
        factor: NDArray[np.float64],
        logs: NDArray[np.float64],
        shape: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives of the matrices by effects' unknowns and geometry: exact where they are linear in the sizes."""
        n = len(terms.dofs)
        by_shape, skew = np.zeros((len(shape), 4, n, n)), np.zeros((len(shape), n, n))
        if not len(shape):
            return by_shape, skew
        linear = self._linear_terms(configuration)
        if linear is not None:
            for i, (size, x) in enumerate(zip(self.sizes.values(), shape, strict=True)):
                slope = size.coordinate_slope(float(x))
                by_shape[i] = slope * terms.dense(linear.slopes[i] * factor)
                skew[i] = slope * linear.skew_slopes[i]
            return by_shape, skew
        for i in range(len(shape)):
            ends = []
            for h in (-_DIFFERENCE, _DIFFERENCE):
                moved = shape.copy()
                moved[i] += h
                other = self.terms(configuration, moved)
                ends.append((other.dense(other.scaled(logs)), other.skew))
            if ends[0][0].shape == by_shape[i].shape == ends[1][0].shape:
                by_shape[i] = (ends[1][0] - ends[0][0]) / (2 * _DIFFERENCE)
                skew[i] = (ends[1][1] - ends[0][1]) / (2 * _DIFFERENCE)
        return by_shape, skew

    def terms(self, configuration: str, shape: NDArray[np.float64]) -> Terms:
        """Elements of a configuration with geometry and effects' unknowns at `shape`."""
        linear = self._linear_terms(configuration)
        return (
            self._assembled(configuration, shape) if linear is None else linear.at(self._coordinates(shape))
        )

    def _coordinates(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of the sizes in which terms may be linear, (k,)."""
        return np.array([s.coordinate(float(x)) for s, x in zip(self.sizes.values(), shape, strict=True)])

    def _assembled(self, configuration: str, shape: NDArray[np.float64]) -> Terms:
        key = (configuration, shape.tobytes())
        if key not in self._terms:
            if len(self._terms) > 64:
                self._terms.clear()
            self._terms[key] = assemble_terms(
                self.assembly(configuration, shape), self.dependence.elements[configuration], part_key
            )
        return self._terms[key]

    def _linear_terms(self, configuration: str) -> LinearTerms | None:
        """The terms as linear functions of the effects' coordinates; None where they are not."""
        if configuration not in self._linear:
            self._linear[configuration] = None if self.dependence.geometric else self._tried(configuration)
        return self._linear[configuration]

    def _tried(self, configuration: str) -> LinearTerms | None:
        """Find the linear function from a few points, and try it at others."""
        sizes, unknowns = tuple(self.sizes.values()), self.unknowns
        low, high = unknowns.lower[self.shape_start :], unknowns.upper[self.shape_start :]
        begin = np.where([s.logarithmic for s in sizes], 1.0, np.clip(0.2, 0.5 * low, 0.5 * high))

        def at(coordinates: NDArray[np.float64]) -> Terms:
            x = [s.of_coordinate(float(z)) for s, z in zip(sizes, coordinates, strict=True)]
            return self._assembled(configuration, np.array(x))

        start = at(begin)
        slopes, skews = [], []
        for i in range(len(begin)):
            other = at(begin * np.where(np.arange(len(begin)) == i, 1.5, 1.0))
            if not _same_rows(start, other):
                return None
            slopes.append((other.coefficient - start.coefficient) / (0.5 * begin[i]))
            skews.append((other.skew - start.skew) / (0.5 * begin[i]))
        n = len(start.dofs)
        linear = LinearTerms(
            start,
            begin,
            np.array(slopes).reshape(len(begin), len(start.coefficient)),
            np.array(skews).reshape(len(begin), n, n),
        )
        for share in (0.6, 1.3) if len(begin) else ():
            trial, told = at(share * begin), linear.at(share * begin)
            if not _same_rows(start, trial) or not np.allclose(
                told.coefficient, trial.coefficient, rtol=1e-9
            ):
                return None
        return linear

    def assembly(self, configuration: str, shape: NDArray[np.float64]) -> Assembly:
        """Nominal elements with the effects applied."""
        geometric = self.dependence.geometric
        assembly = self._base(configuration, shape[: len(geometric)])
        values = dict(zip(self.sizes, shape[len(geometric) :], strict=True))
        for i, one in enumerate(self.effects):
            key = (configuration, i, assembly.dofs)  # whatever the sizes, but for one that adds a coordinate
            if key not in self._fits:
                self._fits[key] = one.effect.fits(assembly, one.place)
            if self._fits[key]:
                names = {p.name: one.parameter_name(p.name) for p in one.effect.parameters}
                own = {short: self.sizes[full].value(float(values[full])) for short, full in names.items()}
                assembly = one.effect.edit(assembly, one.place, own)
        return assembly

    def _base(self, configuration: str, geometry: NDArray[np.float64]) -> Assembly:
        key = (configuration, geometry.tobytes())
        if key not in self._nominal:
            values = {
                name: self.rig.parameters[name].value * float(np.exp(g))
                for name, g in zip(self.dependence.geometric, geometry, strict=True)
            }
            self._nominal[key] = self.rig.assembly(configuration, values)
        return self._nominal[key]

    def couples(self, configuration: str) -> bool:
        """True where dampers, losses or gyroscopic effects couple the modes, with the effects at their start values."""
        m = self.matrices(configuration, self.start(), derivatives=False)
        return bool(np.any(m.dense[[DAMPING_MATRIX, STRUCTURAL]]) or np.any(m.skew))

    def system(self, configuration: str, x: NDArray[np.float64]) -> LinearSystem:
        """The linear system of a configuration at `x`, every part with its own deviation."""
        matrices = self.matrices(configuration, x, derivatives=False)
        assembly = self.assembly(configuration, x[self.shape_start :])
        mass, damping, stiffness, structural = matrices.dense
        return LinearSystem(
            dofs=matrices.terms.dofs,
            mass=mass,
            stiffness=stiffness,
            damping=damping + matrices.skew,
            structural=structural,
            modal_damping_ratio=self.parameter_values(x).get(DAMPING, 0.0),
            sensors={name: _row(row, matrices.terms.dofs) for name, row in assembly.sensors.items()},
        )

    def named(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Unknowns by name as an array; zero where left out, (n,)."""
        return np.array([values.get(name, 0.0) for name in self.unknowns.names])

    def sensor_rows(self, configuration: str, dofs: Sequence[Dof]) -> NDArray[np.float64]:
        """What sensors at `dofs` read of the rig's own coordinates, (n_dofs, n)."""
        assembly = self._base(configuration, np.zeros(len(self.dependence.geometric)))
        return np.array([d.sign * _row(assembly.row(d.point), assembly.dofs) for d in dofs]).reshape(
            len(dofs), len(assembly.dofs)
        )


_NOTHING = Unknowns.plain((), 1.0)


def _row(row: Row, dofs: tuple[str, ...]) -> NDArray[np.float64]:
    return np.array([row.get(d, 0.0) for d in dofs])
