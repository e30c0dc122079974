"""A rig under measured forces as a function of unknowns: what the compiled loop marches, with its derivatives.

The unknowns are, in this order: those of the rig and the effects (see `rig_model`), the deviations of the modes'
damping from the common one, the offsets of the forces, and the calibration of all channels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.errors import EmaError
from ema_pipeline.inference import Unknowns, joined
from ema_pipeline.mechanics.assembly import Damper
from ema_pipeline.mechanics.driven_slopes import ModalDamping, driven_derivatives, matrix_derivatives
from ema_pipeline.mechanics.driven_system import (
    WITH_MEMORY,
    CodedElements,
    DrivenSystem,
    Slopes,
    coded_law,
)
from ema_pipeline.mechanics.modes import modal_damping
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.terms import Matrices
from ema_pipeline.observations.parts import (
    DAMPING,
    MASS_SCATTER,
    MASS_STD,
    STIFFNESS_STD,
    Dependence,
    dependence,
)
from ema_pipeline.observations.record_data import DISCREPANCY
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.rigs.types import Parameter, Rig

LINEAR_STD = 0.35
"""Prior 1 σ of the logarithm of a value that no tolerance is stated for, about that of the FRFs: a strongly nonlinear
rig answers with up to twice or half of its stiffness at rest."""
_OFFSET_STD = 0.3
"""Prior 1 σ of a force channel's offset, as a share of the force's root mean square."""
_MODE_STD = 0.3
"""1 σ of the logarithm of a mode's damping about the common ratio, the default of `modal_damping_scatter`."""
_START_RATIO = 0.01
"""Damping ratio of a rig that states no damping at all."""
_STEP = 1e-4
"""Step of the differences of the laws' numbers, in units of the unknowns."""
_MOST_KNOWN = 32
_BARELY = 1e-6
"""Size, in units of the prior 1 σ, that stands for an effect of size nought: its elements are there to be changed."""


@dataclass(frozen=True)
class Basis:
    """What all models of the same records share.

    Attributes
    ----------
    rig : Rig
        With loose damping.
    configuration : str
    shared : Dependence
        Values without a stated tolerance are loose.
    loose : tuple of str
    inputs, outputs : tuple of Dof
        Driven and measured.
    quantities : tuple of str
        Of the outputs.
    calibration : tuple of (str, float)
        Name of each force, then of each response channel, and the relative 1 σ of its sensitivity.
    force_rms : ndarray, (n_inputs,)
        N.
    zero_std : ndarray, (n_outputs,)
        Prior 1 σ of the mean that a response channel reads at rest, in units of what its signal is uncertain by.
    centre : dict of str to float
        Values of loose unknowns that stand for 0: where fits begin.
    """

    rig: Rig
    configuration: str
    shared: Dependence
    loose: tuple[str, ...]
    inputs: tuple[Dof, ...]
    outputs: tuple[Dof, ...]
    quantities: tuple[str, ...]
    calibration: tuple[tuple[str, float], ...]
    force_rms: NDArray[np.float64]
    zero_std: NDArray[np.float64]
    centre: Mapping[str, float]

    def calibrated(self) -> Basis:
        """With the first force and the first response exactly calibrated, where no value of the rig is known.

        Loose values take such errors up without a trace, so that they only slow a search down.
        """
        if set(self.shared.unknowns.names) != set(self.loose):
            return self
        pinned = tuple(
            (n, 0.0 if k in (0, len(self.inputs)) else s) for k, (n, s) in enumerate(self.calibration)
        )
        return dataclasses.replace(self, calibration=pinned)

    @cached_property
    def rows(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rows of the inputs and of the outputs over the rig's coordinates."""
        model = RigModel(self.rig, (), {}, self.shared)
        return (
            model.sensor_rows(self.configuration, self.inputs),
            model.sensor_rows(self.configuration, self.outputs),
        )


def loosened(rig: Rig, configuration: str) -> tuple[Rig, Dependence, tuple[str, ...]]:
    """The rig with damping that records determine, its dependence, and the unknowns that nothing is stated for.

    A number in a rig file without a tolerance is where the search begins. Only a parameter with a tolerance is known.
    """
    if not dataclasses.is_dataclass(rig) or isinstance(rig, type):
        raise EmaError(f"rig '{rig.name}' cannot be fitted to records; give a rig file of masses and springs")
    damping = rig.parameters.get(DAMPING)
    if damping is not None and not any(isinstance(e, Damper) for e in rig.assembly(configuration).elements):
        value = damping.value or _START_RATIO
        free = dataclasses.replace(damping, value=value, tolerance=LINEAR_STD, free=False)
        rig = dataclasses.replace(rig, parameters={**rig.parameters, DAMPING: free})
    whole = dependence(rig)
    rows = whole.elements[configuration]
    names, stds, kept, loose = [], [], [], []
    for i, name in enumerate(whole.unknowns.names):
        used = [row for row in rows.values() if row[i]]
        if not used:
            continue
        family = name in whole.families
        alone = not family and all(not np.any(row[: len(whole.families)]) for row in used)
        std = float(whole.unknowns.std[i])
        if family:
            free = rig.parameters[name].free
            std = LINEAR_STD if free else std
        elif alone:
            std = LINEAR_STD
        elif _only_part(whole, configuration, i):
            continue  # it deviates from no other part
        else:
            std *= MASS_STD if whole.unknowns.scatter[i] == MASS_SCATTER else STIFFNESS_STD
        if (family and rig.parameters[name].free) or alone:
            loose.append(name)
        names.append(name)
        stds.append(std)
        kept.append(i)
    shared = Dependence(
        Unknowns.plain(names, np.array(stds)),
        {configuration: {k: r[kept] for k, r in rows.items() if np.any(r[kept])}},
        tuple(f for f in whole.families if f in names),
        whole.geometric,
    )
    return rig, shared, tuple(loose)


def _only_part(whole: Dependence, configuration: str, part: int) -> bool:
    """True for the only part of its families."""
    rows = whole.elements[configuration]
    own = next(row for row in rows.values() if row[part])
    families = np.flatnonzero(own[: len(whole.families)])
    return all(sum(bool(row[f]) for row in rows.values()) == 1 for f in families)


def _calibration(channels: Sequence[tuple[str, float]]) -> Unknowns:
    std = np.array([max(s, 1e-9) for _, s in channels])
    return Unknowns.plain([f"calibration of {n}" for n, _ in channels], std)


class RecordModel:
    """A rig with effects under measured forces.

    Parameters
    ----------
    basis : Basis
    effects : sequence of PlacedEffect
    scales : dict of str to float
        Prior 1 σ of sizes by ``id@place.name``; the effects' own where left out.
    """

    def __init__(self, basis: Basis, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> None:
        self.basis = basis
        self.rig_model = RigModel(basis.rig, effects, scales, basis.shared)
        self.offset = len(self.rig_model.unknowns)
        self._known: dict[bytes, CodedElements] = {}
        self.modes = len(basis.rows[0][0]) if len(basis.rows[0][0]) > 1 and self.rig_model.has_ratio else 0

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """How the effects' sizes follow from their unknowns."""
        return self.rig_model.sizes

    @cached_property
    def unknowns(self) -> Unknowns:
        """All but the states at the start of the records."""
        b = self.basis
        forces = [n for n, _ in b.calibration[: len(b.inputs)]]
        return joined(
            self.rig_model.unknowns,
            Unknowns.plain([f"damping of mode {k + 1}" for k in range(self.modes)], _MODE_STD),
            Unknowns.plain([f"offset of {n}" for n in forces], _OFFSET_STD),
            _calibration(b.calibration[: len(b.inputs)]),
            Unknowns.plain([f"zero of {n}" for n, _ in b.calibration[len(b.inputs) :]], b.zero_std),
            _calibration(b.calibration[len(b.inputs) :]),
        )

    @cached_property
    def _parts(self) -> tuple[slice, slice, slice, slice, slice]:
        """Positions of the modes' damping, the offsets and gains of the forces, those of the responses."""
        n_in, n_out = len(self.basis.inputs), len(self.basis.outputs)
        at = np.cumsum([self.offset, self.modes, n_in, n_in, n_out, n_out]).tolist()
        damping, forces, gains, zeros, read = (slice(a, b) for a, b in pairwise(at))
        return damping, forces, gains, zeros, read

    @property
    def marched(self) -> int:
        """Number of unknowns, the first ones, that the motion depends on: the responses' zeros and gains come after."""
        return self._parts[3].start

    def gains(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """What every response channel reads over what is, (n_outputs,)."""
        return np.asarray(np.exp(x[self._parts[4]]))

    def response_offsets(self, x: NDArray[np.float64], rms: NDArray[np.float64]) -> NDArray[np.float64]:
        """What every response channel reads at rest, (n_outputs,), `rms` being the size of its signal."""
        return np.asarray(DISCREPANCY * rms * x[self._parts[3]])

    @property
    def offset_columns(self) -> slice:
        """Unknowns of the response channels' zeros, in units of what their signals are uncertain by."""
        return self._parts[3]

    @property
    def gain_columns(self) -> slice:
        """Unknowns of the response channels' calibration."""
        return self._parts[4]

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """The effects at `sizes`, or at their start values, all else at its centre, (n,)."""
        return np.concatenate([self.rig_model.start(sizes), np.zeros(len(self.unknowns) - self.offset)])

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Values of the rig's parameters, of the elements that have none, and of the effects' sizes."""
        inner = self._inner(x)
        values = self.rig_model.parameter_values(inner)
        index = self.rig_model.unknowns.index
        for name, (value, _) in self.stated.items():
            values[name] = value * float(np.exp(inner[index[name]]))
        return values

    @cached_property
    def stated(self) -> dict[str, tuple[float, str]]:
        """Stated value and unit of every element that has an unknown of its own and follows no parameter."""
        found = {}
        families = self.basis.shared.families
        assembly = self.basis.rig.assembly(self.basis.configuration)
        for e in assembly.elements:
            for attribute, unit in (("value", "kg"), ("stiffness", "N/m"), ("coefficient", "N·s/m")):
                name = f"{getattr(e, 'part', '') or e.name} ({type(e).__name__.lower()})"
                if name in self.basis.loose and name not in families and hasattr(e, attribute):
                    found[name] = (float(getattr(e, attribute)), unit)
        return found

    def parameters(self, x: NDArray[np.float64]) -> dict[str, Parameter]:
        """Parameters of the rig at `x`, for their units."""
        return dict(self.basis.rig.parameters)

    def _inner(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unknowns of the rig's model: counted from the rig's own values, and no effect quite nought."""
        inner = x[: self.offset].copy()
        index = self.rig_model.unknowns.index
        for name, value in self.basis.centre.items():
            inner[index[name]] += value
        for name, size in self.sizes.items():
            i = index[name]
            if not size.logarithmic and size.value(float(inner[i])) == 0.0:
                sign = -1.0 if size.parameter.start < 0 else 1.0
                inner[i] += sign * _BARELY
        return inner

    def linear(self, x: NDArray[np.float64]) -> LinearSystem:
        """Matrices at `x`, the tangents of the elements included, the modes' damping among the dampers."""
        matrices = self.rig_model.matrices(self.basis.configuration, self._inner(x), derivatives=False)
        system, ratios = self._system(matrices), self._ratios(x, matrices.damping_ratio)
        if not np.any(ratios):
            return system
        if len(ratios) == 1:  # the mode of one coordinate needs no eigenvalues
            critical = 2 * np.sqrt(np.maximum(system.mass * system.stiffness, 0.0))
            return dataclasses.replace(system, damping=system.damping + ratios * critical)
        return dataclasses.replace(system, damping=system.damping + modal_damping(system, ratios))

    def _system(self, matrices: Matrices) -> LinearSystem:
        """The matrices without the modes' damping."""
        mass, damping, stiffness, structural = matrices.dense
        return LinearSystem(
            dofs=matrices.terms.dofs,
            mass=mass,
            stiffness=stiffness,
            damping=damping + matrices.skew,
            structural=structural,
        )

    def _ratios(self, x: NDArray[np.float64], common: NDArray[np.float64]) -> NDArray[np.float64]:
        """Damping ratio of every mode beside the dampers, (n,)."""
        n = len(self.basis.rows[0][0])
        return np.asarray(common * (np.exp(x[self._parts[0]]) if self.modes else np.ones(n)))

    @cached_property
    def memories(self) -> tuple[tuple[str, int], ...]:
        """Name and number of every element that has a memory, among the nonlinear ones."""
        assembly = self.rig_model.assembly(
            self.basis.configuration, self._inner(self.start())[self.rig_model.edit_start :]
        )
        return tuple((e.name, j) for j, e in enumerate(assembly.nonlinear) if coded_law(e)[0] in WITH_MEMORY)

    def driven(self, x: NDArray[np.float64]) -> DrivenSystem:
        """What is marched at `x`: the forces' columns, then one of their offsets."""
        b = self.basis
        at_start = np.exp(-x[self._parts[2]])
        rows = b.rows[0] * at_start[:, None]
        offset = -(x[self._parts[1]] * b.force_rms) @ rows
        return self._coded(x).driven(self.linear(x), np.vstack([rows, offset]))

    def _coded(self, x: NDArray[np.float64]) -> CodedElements:
        """The nonlinear elements, which only some unknowns change; those of the last points are cached."""
        shape = self._inner(x)[self.rig_model.edit_start :]
        key = shape.tobytes()
        if key not in self._known:
            if len(self._known) > _MOST_KNOWN:
                self._known.clear()
            self._known[key] = CodedElements.of(self.rig_model.assembly(self.basis.configuration, shape))
        return self._known[key]

    def slopes(self, x: NDArray[np.float64], here: DrivenSystem, more: int) -> Slopes:
        """Derivatives of what is marched by all unknowns, and room for `more`."""
        found = Slopes.none(here, self.marched + more)
        rig, inner = self.rig_model, self._inner(x)
        matrices = rig.matrices(self.basis.configuration, inner)
        change = matrix_derivatives(matrices)
        tangents = np.zeros((len(change), len(here.kinds)))
        logs = len(change) - (self.offset - rig.edit_start)
        columns = np.r_[0:logs, rig.edit_start : self.offset]
        for k, i in enumerate(range(rig.edit_start, self.offset), start=logs):
            low, high, step = self._ends(x, i)
            found.numbers[..., i] = (high.numbers - low.numbers) / step
            tangents[k] = (high.tangent - low.tangent) / step
        system, ratios = self._system(matrices), self._ratios(x, matrices.damping_ratio)
        modal = ModalDamping.of(system, ratios) if np.any(ratios) else None
        parts = driven_derivatives(system, here, self._coded(x).tangent, change, tangents, modal)
        for mine, part in zip(found.arrays, parts, strict=False):
            mine[..., columns] = np.moveaxis(part, 0, -1)
        damping, offsets, gains, _, _ = self._parts
        if modal is not None:
            if rig.has_ratio:
                found.damping[..., rig.unknowns.index[DAMPING]] = modal.matrix
            for mode in range(self.modes):
                found.damping[..., damping.start + mode] = modal.by_ratio(mode)
        n_in = len(self.basis.inputs)
        for q in range(n_in):
            own, size = here.inputs[:, q], self.basis.force_rms[q]
            found.inputs[:, q, gains.start + q] = -own
            found.inputs[:, n_in, gains.start + q] = own * size * x[offsets.start + q]
            found.inputs[:, n_in, offsets.start + q] = -own * size
        return found

    def _ends(self, x: NDArray[np.float64], i: int) -> tuple[CodedElements, CodedElements, float]:
        """Elements at both ends of a small step of one unknown, within its bounds."""
        lower, upper = self.unknowns.lower[i], self.unknowns.upper[i]
        low, high = x.copy(), x.copy()
        low[i] = max(x[i] - _STEP, lower)
        high[i] = min(x[i] + _STEP, upper)
        return self._coded(low), self._coded(high), float(high[i] - low[i])
