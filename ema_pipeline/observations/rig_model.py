"""A rig with effects of unknown size, as matrices that depend on unknowns, with exact derivatives.

Every element is a coefficient times v·vᵀ, so that the derivative of an eigenvalue by the logarithm of a coefficient
is one product. Only what an effect edits is differentiated by small differences, of the matrices, not of the modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.inference import Unknowns, joined
from ema_pipeline.mechanics.assembly import Assembly, Row
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, solved
from ema_pipeline.mechanics.modal_losses import slopes_of_own, with_dampers_along, with_joint_losses
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.terms import (
    DAMPING_MATRIX,
    STIFFNESS,
    STRUCTURAL,
    Matrices,
    Terms,
    assemble_terms,
)
from ema_pipeline.observations.effect_terms import AddedTerms, EffectTerms, differences
from ema_pipeline.observations.parts import (
    DAMPING,
    DAMPING_POWER,
    DAMPING_SCATTER,
    JOINT_DAMPING,
    Dependence,
    dependence,
    part_key,
)
from ema_pipeline.observations.size_map import LOG_STD, SizeMap
from ema_pipeline.rigs.types import Rig

T = TypeVar("T")

_MOST_KNOWN = 2000
"""Effects of one rig, and models with them, of which terms are kept: those of some rankings."""
_POWER_STD = 0.7
"""1 σ of the power of the frequency that damping ratios follow: 1 where joints are viscous, −1 where the ground is."""
_FURTHEST = 3.0
"""Difference of ln f from the middle up to which they do: modes without stiffness have no ratio."""


class RigModel:
    """A rig, with effects on top of it, as a function of unknowns.

    The unknowns are, in this order: families, parts, the damping ratio of all modes, the power of the frequency that it
    follows, what those of single ones and the losses of single joints differ from it by (logarithms), geometric
    parameters, and the effects' sizes.

    Parameters
    ----------
    rig : Rig
    effects : sequence of PlacedEffect
        In the order in which they are applied.
    scales : dict of str to float, optional
        Prior 1 σ of effects' sizes by ``id@place.name``; the library's where left out.
    shared : Dependence, optional
        Of the rig, where it is known already.
    own_damping : dict of str to int, optional
        How many undamped modes, the lowest, have a damping ratio that is an unknown of its own, by configuration.
    middle_hz : float
        Frequency about which damping ratios follow a power of the frequency; 0 where all are the same.
    joints : bool
        True where the losses of single joints are unknowns, too; beside `own_damping`.
    """

    def __init__(
        self,
        rig: Rig,
        effects: Sequence[PlacedEffect] = (),
        scales: Mapping[str, float] | None = None,
        shared: Dependence | None = None,
        own_damping: Mapping[str, int] | None = None,
        middle_hz: float = 0.0,
        joints: bool = False,
    ) -> None:
        self.rig, self.effects, self.own_damping = rig, tuple(effects), dict(own_damping or {})
        self.middle_hz, self.joints = middle_hz, joints
        self.dependence = shared or dependence(rig)
        self._joints = self.dependence.joints if joints else self.dependence.joints[:0]
        given = scales or {}
        self.sizes = {
            one.parameter_name(p.name): SizeMap.of(p, given.get(one.parameter_name(p.name), p.scale))
            for one in self.effects
            for p in one.effect.parameters
        }
        self._terms: dict[tuple[object, ...], Terms] = {}
        self._of_effects: dict[str, EffectTerms | None] = {}
        self._nominal: dict[tuple[object, ...], Assembly] = {}
        self._fits: dict[tuple[str, int, tuple[str, ...]], bool] = {}
        self._modes: dict[str, tuple[bytes, bool, Matrices, EigenSolution | None]] = {}

    @cached_property
    def unknowns(self) -> Unknowns:
        """All unknowns of the model."""
        damping = self.rig.parameters.get(DAMPING)
        loose = damping is not None and damping.value > 0 and (damping.free or damping.tolerance > 0)
        bounds = [s.bounds for s in self.sizes.values()]
        sizes = Unknowns.plain(
            tuple(self.sizes),
            1.0,
            lower=np.array([b[0] for b in bounds]),
            upper=np.array([b[1] for b in bounds]),
        )
        return joined(
            self.dependence.unknowns,
            Unknowns.plain((DAMPING,), damping.tolerance or LOG_STD) if loose and damping else _NOTHING,
            Unknowns.plain((DAMPING_POWER,), _POWER_STD) if loose and self.middle_hz else _NOTHING,
            Unknowns.plain(
                tuple(
                    f"damping of undamped mode {k + 1} of {configuration}"
                    for configuration, count in self.own_damping.items()
                    for k in range(count)
                ),
                1.0,
                DAMPING_SCATTER,
            ),
            Unknowns.plain(
                tuple(f"damping of {self.dependence.unknowns.names[i]}" for i in self._joints),
                1.0,
                JOINT_DAMPING,
            ),
            Unknowns.plain(
                self.dependence.geometric,
                [self.rig.parameters[g].tolerance for g in self.dependence.geometric],
            ),
            replace(sizes, sizes=frozenset(sizes.names)),
        )

    @cached_property
    def _logs(self) -> int:
        """Number of families and parts."""
        return len(self.dependence.unknowns)

    @cached_property
    def shape_start(self) -> int:
        """Position of the first unknown by which matrices are differentiated as a whole."""
        return self.edit_start - len(self._joints)

    @cached_property
    def edit_start(self) -> int:
        """Position of the first unknown with which the elements change: geometry, then effects' sizes."""
        return len(self.unknowns) - len(self.dependence.geometric) - len(self.sizes)

    @property
    def has_ratio(self) -> bool:
        """True where the common damping ratio is an unknown."""
        return DAMPING in self.unknowns.index

    @property
    def common_damping(self) -> int:
        """Number of unknowns of damping that all modes share."""
        return int(self.has_ratio) + int(DAMPING_POWER in self.unknowns.index)

    def damping_power(self, x: NDArray[np.float64]) -> float:
        """Power of the frequency that modal damping ratios follow at `x`."""
        at = self.unknowns.index.get(DAMPING_POWER)
        return 0.0 if at is None else float(x[at])

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
            if undamped is not None:
                matrices = self._with_modal_damping(configuration, x, matrices, *undamped)
            if solution is None and undamped is not None:
                solution = EigenSolution.of(matrices.dense, matrices.skew, matrices.damping_ratio, undamped)
            known = self._modes[configuration] = key, derivatives, matrices, solution
        return known[2], known[3]

    def _with_modal_damping(
        self,
        configuration: str,
        x: NDArray[np.float64],
        matrices: Matrices,
        eigenvalues: NDArray[np.float64],
        shapes: NDArray[np.float64],
    ) -> Matrices:
        """The matrices with damping ratios that differ from one undamped mode to the other, where they do.

        Viscous losses of joints grow with the frequency, those to the ground fall (Rayleigh), hysteretic ones do
        neither. The derivatives take undamped modes for fixed in this.
        """
        has_own, slopes = configuration in self.own_damping, matrices.damping_log.copy()
        if DAMPING_POWER in self.unknowns.index:
            above = 0.5 * np.log(eigenvalues) - np.log(2 * np.pi * self.middle_hz)
            slopes[1] = np.clip(above, -_FURTHEST, _FURTHEST)
        elif not has_own:
            return matrices
        at = self.common_damping
        for name, count in self.own_damping.items():
            if name == configuration:
                own = slopes_of_own(eigenvalues, matrices.damping_ratio, count)
                slopes[at : at + len(own)] = own
            at += count
        matrices = replace(matrices, damping_ratio=self._ratios(x, slopes), damping_log=slopes)
        if has_own:
            rig = self._without_effects(configuration, x) if self.effects else matrices.terms
            logs, damping = x[: self._logs], x[self._logs : self.shape_start]
            matrices = with_dampers_along(matrices, rig, shapes, logs, damping, self.common_damping)
        if len(self._joints):
            lost = x[self.shape_start : self.edit_start]
            matrices = with_joint_losses(matrices, eigenvalues, shapes, self._joints, lost)
        return matrices

    def _ratios(self, x: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Damping ratios of the undamped modes by the derivatives of their logarithms, (n,)."""
        parameter = self.rig.parameters.get(DAMPING)
        nominal = 0.0 if parameter is None else parameter.value
        return nominal * np.exp(x[self._logs : self._logs + len(slopes)] @ slopes)

    def matrices(self, configuration: str, x: NDArray[np.float64], derivatives: bool = True) -> Matrices:
        """Matrices of a configuration at `x`, and their derivatives by effects and geometry."""
        logs, shape = x[: self._logs], x[self.edit_start :]
        terms = self.terms(configuration, shape)
        slopes = np.zeros((self.shape_start - self._logs, len(terms.dofs)))
        slopes[: int(self.has_ratio)] = 1.0
        coefficient = terms.scaled(logs)
        dense = terms.dense(coefficient)
        by_shape, skew = self._by_shape(configuration, terms, logs, shape if derivatives else shape[:0])
        if derivatives and len(self._joints):
            none = np.zeros((len(self._joints), *by_shape.shape[1:]))
            by_shape, skew = np.concatenate([none, by_shape]), np.concatenate([none[:, 0], skew])
        ratios = self._ratios(x, slopes)
        return Matrices(terms, coefficient, dense, terms.skew, ratios, slopes, by_shape, skew)

    def _by_shape(
        self,
        configuration: str,
        terms: Terms,
        logs: NDArray[np.float64],
        shape: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives of the matrices by effects' unknowns and geometry: exact where they are linear in the sizes."""
        n = len(terms.dofs)
        if not len(shape):
            return np.zeros((0, 4, n, n)), np.zeros((0, n, n))
        known = self._effect_terms(configuration)
        slopes = None if known is None else known.slopes_at(shape, logs)
        if slopes is None:
            slopes = differences(partial(self._assembled, configuration), shape, logs, n)
        assert slopes is not None  # whatever is assembled has terms
        return slopes

    def terms(self, configuration: str, shape: NDArray[np.float64]) -> Terms:
        """Elements of a configuration with geometry and effects' unknowns at `shape`."""
        known = self._effect_terms(configuration)
        terms = None if known is None else known.at(shape)
        return self._assembled(configuration, shape) if terms is None else terms

    def _assembled(
        self, configuration: str, shape: NDArray[np.float64], without: frozenset[int] = frozenset()
    ) -> Terms:
        key = (configuration, shape.tobytes(), without)
        if key not in self._terms:
            if len(self._terms) > 64:
                self._terms.clear()
            assembly = self.assembly(configuration, shape, without)
            self._terms[key] = assemble_terms(assembly, self.dependence.elements[configuration], part_key)
        return self._terms[key]

    def _effect_terms(self, configuration: str) -> EffectTerms | None:
        """How the terms depend on the effects' sizes; None where that is not known."""
        if configuration not in self._of_effects:
            key = (configuration, self.effects, tuple(self.sizes.values()))
            self._of_effects[configuration] = self._kept(key, lambda: self._found_effect_terms(configuration))
        return self._of_effects[configuration]

    def _found_effect_terms(self, configuration: str) -> EffectTerms | None:
        if self.dependence.geometric:
            return None
        host, elements = self._base(configuration, np.zeros(0)), self.dependence.elements[configuration]
        each = []
        for one in self.effects:
            sizes = tuple(self.sizes[one.parameter_name(p.name)] for p in one.effect.parameters)
            added = partial(AddedTerms, host, elements, one, sizes)
            each.append(self._kept((configuration, one, sizes), added))
        return EffectTerms.found(each, partial(self._assembled, configuration))

    def _kept(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        """What `make` makes, kept for all models of the rig."""
        known = self.dependence.known
        if key not in known:
            if len(known) >= _MOST_KNOWN:
                known.clear()
            known[key] = make()
        return cast(T, known[key])

    def assembly(
        self, configuration: str, shape: NDArray[np.float64], without: frozenset[int] = frozenset()
    ) -> Assembly:
        """Nominal elements with the effects applied, but those of the numbers `without`."""
        geometric = self.dependence.geometric
        assembly = self._base(configuration, shape[: len(geometric)])
        values = dict(zip(self.sizes, shape[len(geometric) :], strict=True))
        for i, one in enumerate(self.effects):
            if i in without:
                continue
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

    def strain_in_effects(
        self, configuration: str, x: NDArray[np.float64], solution: EigenSolution
    ) -> NDArray[np.float64]:
        """Share of the strain energy of every undamped mode in springs that the effects add, (n,).

        0 where they add none, and where they add coordinates.
        """
        shares = np.zeros(len(solution.eigenvalues))
        if not self.effects:
            return shares
        rig = self._without_effects(configuration, x)
        if len(rig.dofs) == len(shares):
            springs = rig.matrix == STIFFNESS
            own = rig.scaled(x[: self._logs])[springs] @ (rig.rows[springs] @ solution.shapes) ** 2
            shares = np.clip(1 - own / solution.eigenvalues, 0.0, 1.0)
        return shares

    def _without_effects(self, configuration: str, x: NDArray[np.float64]) -> Terms:
        """Elements of the rig alone, its geometry at `x`."""
        shape = x[self.edit_start :].copy()
        shape[len(self.dependence.geometric) :] = 0.0  # of no effect: the same terms at all sizes
        return self._assembled(configuration, shape, frozenset(range(len(self.effects))))

    def couples(self, configuration: str) -> tuple[bool, bool]:
        """Whether dampers or losses, and whether gyroscopic effects couple the modes, at the effects' start values."""
        m = self.matrices(configuration, self.start(), derivatives=False)
        return bool(np.any(m.dense[[DAMPING_MATRIX, STRUCTURAL]])), bool(np.any(m.skew))

    def count_below(self, configuration: str, frequency_hz: float, least: int) -> int:
        """Number of undamped modes below a frequency at the effects' start values; `least` of them, where there are."""
        dense = self.matrices(configuration, self.start(), derivatives=False).dense
        found = solved(dense)
        below = 0 if found is None else int(np.sum(found[0] < (2 * np.pi * frequency_hz) ** 2))
        return min(max(below, least), dense.shape[-1])

    def system(self, configuration: str, x: NDArray[np.float64]) -> LinearSystem:
        """The linear system of a configuration at `x`, every part with its own deviation."""
        matrices = self.matrices(configuration, x, derivatives=False)
        assembly = self.assembly(configuration, x[self.edit_start :])
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
