"""Measured modes as the comparison with a model needs them, from an identification or from a plain table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.modal.assurance import mpc
from ema_pipeline.modal.types import NO_SYNTHESIS, ModalModel, Mode, StabilisationChart


@dataclass(frozen=True)
class MeasuredModes:
    """The measured modes of one configuration.

    Attributes
    ----------
    configuration : str
    frequency_hz, frequency_std_hz : ndarray, (n_modes,)
        In ascending order; the standard deviation is NaN where unknown.
    damping_ratio, damping_std : ndarray, (n_modes,)
        NaN where not measured.
    shapes : complex ndarray, (n_modes, n_dofs), or None
        NaN where not measured; None where only frequencies are known.
    shape_std : ndarray, (n_modes, n_dofs), or None
        Standard deviation of each entry, per real or imaginary part.
    shape_own_std : ndarray, (n_modes, n_dofs), or None
        The same without what all entries of a mode have in common.
    dofs : tuple of Dof
    scaled : bool
        True where shapes are mass-normalised.
    band_hz : tuple of float, or None
        Band in which modes were looked for; None where unknown.
    references : tuple of Dof
        Points at which the rig was struck; empty where unknown.
    notes : tuple of str
        What a reader should know of these numbers, one plain sentence each.
    """

    configuration: str
    frequency_hz: NDArray[np.float64]
    frequency_std_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damping_std: NDArray[np.float64]
    shapes: NDArray[np.complex128] | None = None
    shape_std: NDArray[np.float64] | None = None
    dofs: tuple[Dof, ...] = ()
    scaled: bool = False
    band_hz: tuple[float, float] | None = None
    references: tuple[Dof, ...] = ()
    notes: tuple[str, ...] = ()
    shape_own_std: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return int(self.frequency_hz.size)


def to_modal_model(measured: MeasuredModes) -> ModalModel:
    """A table of modes in the form that an identification has, so that both are reported alike."""
    empty = np.zeros(0)
    count = len(measured.dofs) if measured.shapes is not None else 0
    modes = []
    for r in range(len(measured)):
        shape = np.zeros(0, complex) if measured.shapes is None else measured.shapes[r]
        std = np.full(count, np.nan) if measured.shape_std is None else measured.shape_std[r]
        f, zeta = float(measured.frequency_hz[r]), float(measured.damping_ratio[r])
        pole = 2 * np.pi * f * complex(-np.nan_to_num(zeta), np.sqrt(1 - np.nan_to_num(zeta) ** 2))
        modes.append(
            Mode(
                frequency_hz=f,
                frequency_std_hz=float(measured.frequency_std_hz[r]),
                damping_ratio=zeta,
                damping_std=float(measured.damping_std[r]),
                pole=pole,
                shape=shape,
                shape_std=std,
                mpc=mpc(shape) if count else float("nan"),
                method="table",
            )
        )
    nothing = StabilisationChart(
        empty.astype(np.int64), empty, empty, empty.astype(np.bool_), empty.astype(np.int64)
    )
    return ModalModel(
        dofs=measured.dofs if count else (),
        modes=tuple(modes),
        band_hz=measured.band_hz or (float("nan"), float("nan")),
        scaled=measured.scaled,
        scaling_note="" if measured.scaled else "the table of modes does not say that its shapes are scaled",
        references=measured.references,
        frequency_hz=empty,
        synthesis=NO_SYNTHESIS,
        outputs=(),
        inputs=(),
        chart=nothing,
        notes=measured.notes,
    )


def from_modal_model(model: ModalModel, configuration: str) -> MeasuredModes:
    """Collect an identified modal model into arrays."""
    modes = model.modes
    n_dofs = len(model.dofs)
    return MeasuredModes(
        configuration=configuration,
        frequency_hz=np.array([m.frequency_hz for m in modes], dtype=float),
        frequency_std_hz=np.array([m.frequency_std_hz for m in modes], dtype=float),
        damping_ratio=np.array([m.damping_ratio for m in modes], dtype=float),
        damping_std=np.array([m.damping_std for m in modes], dtype=float),
        shapes=np.array([m.shape for m in modes], dtype=complex).reshape(-1, n_dofs) if n_dofs else None,
        shape_std=np.array([m.shape_std for m in modes], dtype=float).reshape(-1, n_dofs) if n_dofs else None,
        dofs=model.dofs,
        scaled=model.scaled,
        band_hz=None if np.isnan(model.band_hz[0]) else model.band_hz,
        references=model.references,
        shape_own_std=np.array([m.shape_own_std for m in modes], dtype=float).reshape(-1, n_dofs)
        if n_dofs and all(len(m.shape_own_std) for m in modes)
        else None,
    )
