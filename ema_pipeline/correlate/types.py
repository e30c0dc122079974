"""Which measured mode is which model mode, and where the two differ."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.rigs.types import ModelMode


def percent_off(measured: float, model: float) -> float:
    """How far a measured frequency lies above the model's, %; NaN for a model mode at 0 Hz.

    >>> round(percent_off(101.0, 100.0), 6)
    1.0
    """
    return 100 * (measured / model - 1) if model > 0 else math.nan


@dataclass(frozen=True)
class Pair:
    """A measured mode and the model mode that it is.

    Attributes
    ----------
    measured, model : int
        Indices into the measured modes and into `Pairing.model_modes`.
    measured_frequency_hz, model_frequency_hz : float
    mac : float
        Modal assurance criterion of the two shapes; inside a close group that of the measured shape
        with the subspace that the group's model shapes span.
    family : str
        Family of the model mode.
    group : int
        Number of the close group that both belong to, -1 for a mode on its own.
    """

    measured: int
    model: int
    measured_frequency_hz: float
    model_frequency_hz: float
    mac: float
    family: str
    group: int = -1


@dataclass(frozen=True)
class Unpaired:
    """A mode without a partner, and why."""

    index: int
    frequency_hz: float
    reason: str


@dataclass(frozen=True)
class Pairing:
    """Pairing of one configuration.

    Attributes
    ----------
    model_modes : tuple of ModelMode
        All modes of the model.
    pairs : tuple of Pair
        In order of measured frequency.
    unpaired_measured, unpaired_model : tuple of Unpaired
    mac : ndarray, (n_measured, n_model)
    """

    model_modes: tuple[ModelMode, ...]
    pairs: tuple[Pair, ...]
    unpaired_measured: tuple[Unpaired, ...]
    unpaired_model: tuple[Unpaired, ...]
    mac: NDArray[np.float64]


@dataclass(frozen=True)
class ModeDifference:
    """Measurement minus model for one pair, each also in units of the measurement's uncertainty (z)."""

    configuration: str
    measured: int
    family: str
    measured_frequency_hz: float
    frequency_std_hz: float
    model_frequency_hz: float
    frequency_z: float
    measured_damping_ratio: float
    damping_std: float
    model_damping_ratio: float
    damping_z: float
    mac: float
    shape_z: float


@dataclass(frozen=True)
class DofDifference:
    """Root-mean-square shape difference at one DOF over all pairs, in units of its uncertainty."""

    configuration: str
    dof: str
    z: float


@dataclass(frozen=True)
class BandDifference:
    """FRF difference of one output-input pair in one band, root-mean-square in units of its uncertainty."""

    configuration: str
    output: str
    input: str
    low_hz: float
    high_hz: float
    z: float


@dataclass(frozen=True)
class ModeAlone:
    """A measured mode that is none of the fitted model's, and takes no part in the differences.

    Attributes
    ----------
    configuration : str
    measured : int
        Its index.
    measured_frequency_hz : float
    model_frequency_hz, mac : float
        Of the model's mode of its shape; NaN where there is none.
    """

    configuration: str
    measured: int
    measured_frequency_hz: float
    model_frequency_hz: float
    mac: float


@dataclass(frozen=True)
class Comparison:
    """Where model and measurement differ.

    Attributes
    ----------
    error : float
        Root-mean-square of (measurement - model)/standard uncertainty over all that is compared
        (frequencies, dampings, shapes); about 1 where the model explains the data as well as they can tell.
    frequency_error : float
        The error function ε = Σ((ω_measured - ω_model)/ω_model)² over the pairs.
    modes, dofs, bands, alone : tuples
    """

    error: float
    frequency_error: float
    modes: tuple[ModeDifference, ...]
    dofs: tuple[DofDifference, ...]
    bands: tuple[BandDifference, ...]
    alone: tuple[ModeAlone, ...]
