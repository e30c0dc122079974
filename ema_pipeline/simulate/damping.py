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
        C = Σ c_r·Mφ_r·φ_rᵀM. The own dampers stay: what is to be added to, or taken off, multiplies row and column r of
        their matrix between the modes by the root of `factors[r]`, so that no motion gains energy.
    """
    system = assembly.system()
    values, shapes = eigen_solution(system)
    omega = np.sqrt(values)
    by_dampers = _between_modes(assembly, dampers, shapes)
    root = np.sqrt(factors)
    changes, along = np.linalg.eigh(root[:, None] * by_dampers * root - by_dampers)
    modal = 2 * omega * assembly.modal_damping_ratio * factors
    rows = system.mass @ shapes

    def elements(name: str, coefficients: NDArray[np.float64], rows: NDArray[np.float64]) -> list[Damper]:
        return [
            Damper(f"{name} {r + 1}", dict(zip(system.dofs, map(float, row), strict=True)), float(c))
            for r, (c, row) in enumerate(zip(coefficients, rows.T, strict=True))
            if c != 0.0
        ]

    modes = elements("damping of mode", np.where(omega > 0, modal, 0.0), rows)
    others = elements("change of dampers", changes, rows @ along)
    return dataclasses.replace(assembly.add(*modes, *others), modal_damping_ratio=0.0)


def _between_modes(
    assembly: Assembly, dampers: Collection[str], shapes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """ΦᵀCΦ of the named dampers, (n_modes, n_modes), 1/s."""
    total = np.zeros((shapes.shape[1], shapes.shape[1]))
    index = {dof: i for i, dof in enumerate(assembly.dofs)}
    for e in assembly.elements:
        if isinstance(e, Damper) and e.name in dampers:
            stretch = sum((v * shapes[index[dof]] for dof, v in e.row.items()), np.zeros(len(total)))
            total += e.coefficient * np.outer(stretch, stretch)
    return total
