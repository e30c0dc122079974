"""Damping that differs from mode to mode at random, as a modal damping matrix of the true system."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import Assembly, Damper
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig
from ema_pipeline.simulate.altered import altered
from ema_pipeline.simulate.imperfections import deviations, generator


def draw_damping(rig: Rig, scatter: float, seed: int) -> dict[str, tuple[float, ...]]:
    """Factor of the damping ratio of every mode, in order of frequency, by configuration."""
    drawn = {}
    for i, configuration in enumerate(rig.configurations):
        count = len(rig.assembly(configuration).dofs)
        z = deviations(generator(seed, "damping", i), count)
        drawn[configuration] = tuple(float(f) for f in np.exp(scatter * np.array(z)))
    return drawn


def damped_rig(rig: Rig, base: Rig, factors: Mapping[str, tuple[float, ...]]) -> ParametricRig:
    """The rig whose modes have their own damping.

    Parameters
    ----------
    rig : Rig
        With effects.
    base : Rig
        Without effects: only the damping that it has itself is changed, not what an effect adds.
    factors : dict of str to tuple of float
        Configuration to factors of the damping ratios, as `draw_damping` gives them.
    """
    own = {
        c: frozenset(e.name for e in base.assembly(c).elements if isinstance(e, Damper))
        for c in base.configurations
    }
    return altered(rig, partial(_of_configuration, own, dict(factors)))


def _of_configuration(
    own: Mapping[str, Collection[str]],
    factors: Mapping[str, tuple[float, ...]],
    configuration: str,
    assembly: Assembly,
) -> Assembly:
    return with_modal_factors(assembly, own[configuration], np.array(factors[configuration]))


def with_modal_factors(
    assembly: Assembly, dampers: Collection[str], factors: NDArray[np.float64]
) -> Assembly:
    """An assembly in which mode r has `factors[r]` times its damping ratio.

    Parameters
    ----------
    assembly : Assembly
    dampers : collection of str
        Dampers that count as the rig's own damping beside the modal damping ratio.
    factors : ndarray, (n_modes,)
        In order of frequency.

    Returns
    -------
    Assembly
        Its modal damping ratio is replaced by one damper per mode along Mφ_r, whose coefficients make up
        C = Σ c_r·Mφ_r·φ_rᵀM. The own dampers stay: c_r holds only what is to be added to, or taken off, their
        share of the damping ratio.
    """
    system = assembly.system()
    values, shapes = eigen_solution(system)
    omega = np.sqrt(values)
    by_dampers = _coefficients(assembly, dampers, shapes)
    wanted = factors * (2 * omega * assembly.modal_damping_ratio + by_dampers) - by_dampers
    rows = system.mass @ shapes
    elements = [
        Damper(
            f"damping of mode {r + 1}", dict(zip(system.dofs, map(float, rows[:, r]), strict=True)), float(c)
        )
        for r, c in enumerate(wanted)
        if omega[r] > 0 and c != 0.0
    ]
    return dataclasses.replace(assembly.add(*elements), modal_damping_ratio=0.0)


def _coefficients(
    assembly: Assembly, dampers: Collection[str], shapes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """φᵀCφ of the named dampers, (n_modes,), 1/s."""
    total = np.zeros(shapes.shape[1])
    index = {dof: i for i, dof in enumerate(assembly.dofs)}
    for e in assembly.elements:
        if isinstance(e, Damper) and e.name in dampers:
            stretch = sum((v * shapes[index[dof]] for dof, v in e.row.items()), np.zeros(len(total)))
            total += e.coefficient * stretch**2
    return total
