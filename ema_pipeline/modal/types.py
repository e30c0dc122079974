"""Results of the modal stage: modes with uncertainties, and the chart that they were selected from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof


@dataclass(frozen=True)
class CircleFit:
    """Nyquist circle of one mode in one FRF (mobility plane).

    The circles of the next mode below and above are taken off its points where that makes them rounder, unless the
    settings say otherwise; what farther modes add shifts the circle as a whole.

    Attributes
    ----------
    output, input : Dof
    frequency_hz : ndarray, (n_points,)
        Lines used.
    points : complex ndarray, (n_points,)
        The FRF at these lines, mobility, (m/s)/N, neighbours taken off.
    centre : complex
        Centre of the fitted circle.
    radius : float
    natural_frequency_hz, natural_frequency_std_hz : float
        Frequency of maximum sweep rate.
    damping_ratio, damping_std : float
        Mean over half-power pairs and its standard deviation.
    pair_damping : ndarray, (n_pairs,)
        Damping ratio from each pair of points on either side of resonance.
    residual : float
        Root-mean-square distance of the points from the circle over its radius.
    diameter : complex
        From the point opposite to resonance to the resonance point.
    damping_in_frf : float
        Damping ratio by which the points sweep the circle: an exponential window's share is still in it.
    """

    output: Dof
    input: Dof
    frequency_hz: NDArray[np.float64]
    points: NDArray[np.complex128]
    centre: complex
    radius: float
    natural_frequency_hz: float
    natural_frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    pair_damping: NDArray[np.float64]
    residual: float
    diameter: complex
    damping_in_frf: float


@dataclass(frozen=True)
class Mode:
    """One identified mode.

    Attributes
    ----------
    frequency_hz : float
        Undamped natural frequency |s|/2π.
    frequency_std_hz : float
    damping_ratio : float
        -Re(s)/|s|, with the exponential window's share already taken off.
    damping_std : float
    pole : complex
        s, rad/s, window share taken off.
    shape : complex ndarray, (n_dofs,)
        At `ModalModel.dofs`; NaN where not measured. Where `ModalModel.scaled`, mass-normalised:
        the receptance is Σ A/(jω - s) + conj. with A = shape·shapeᵀ/(2jω_d), ω_d = Im s. Otherwise the
        largest entry is 1.
    shape_std : ndarray, (n_dofs,)
        Standard deviation of the modulus of each entry's error, per real or imaginary part.
    shape_own_std : ndarray, (n_dofs,)
        The same without what all entries have in common, which changes the scale and not the form; empty where not
        known.
    mpc : float
        Modal phase collinearity, 0…1.
    method : str
        ``"plscf"``, ``"lscf"``, ``"sdypy"`` or ``"circle"``.
    stability : float
        Share of model orders that voted for the mode, 0…1.
    flags : tuple of str
        Plain-word remarks, e.g. ``"circle fit differs: close neighbour"``.
    circles : tuple of CircleFit
        Best FRFs first.
    """

    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    pole: complex
    shape: NDArray[np.complex128]
    shape_std: NDArray[np.float64]
    mpc: float
    method: str
    stability: float = 1.0
    flags: tuple[str, ...] = ()
    circles: tuple[CircleFit, ...] = ()
    shape_own_std: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class StabilisationChart:
    """Poles of all model orders.

    Attributes
    ----------
    order : ndarray of int, (n_poles,)
    frequency_hz, damping_ratio : ndarray, (n_poles,)
    stable : ndarray of bool, (n_poles,)
        Pole found again at the next lower order in frequency, damping and shape.
    selected : ndarray of int, (n_poles,)
        Index of the mode that the pole voted for, or -1.
    """

    order: NDArray[np.int64]
    frequency_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    stable: NDArray[np.bool_]
    selected: NDArray[np.int64]


@dataclass(frozen=True)
class LeftOut:
    """What looks like a mode and is none of the list.

    Attributes
    ----------
    frequency_hz, damping_ratio : float
    evidence : str
        What speaks for it, e.g. ``"peak"``.
    reason : str
        Why it is left out.
    """

    frequency_hz: float
    damping_ratio: float
    evidence: str
    reason: str


GROWS = "its damping is negative once the exponential window is taken off"
"""Reason for which a mode is left out: the window that test.toml states decays faster than the mode."""

NO_SYNTHESIS = np.zeros((0, 0, 0), dtype=np.complex64)
"""In place of a synthesis that was not loaded: it is as large as the FRFs."""


@dataclass(frozen=True)
class ModalModel:
    """Everything identified from one configuration's FRFs.

    Attributes
    ----------
    dofs : tuple of Dof
        DOFs at which shapes are given (outputs; inputs too where reciprocity allows), all with sign +1.
    modes : tuple of Mode
        In order of frequency.
    band_hz : tuple of float
        Band analysed.
    scaled : bool
        True where shapes are mass-normalised (a driving point was measured with a calibrated hammer).
    scaling_note : str
        Why the shapes are unscaled; empty where they are scaled.
    references : tuple of Dof
        Inputs (or outputs, for a roving hammer) that served as references.
    frequency_hz : ndarray, (n_lines,)
        Lines of the band analysed.
    synthesis : complex ndarray, (n_outputs, n_inputs, n_lines)
        Accelerance that the modes and residuals give at these lines, in single precision: it is there to be looked at.
    outputs, inputs : tuple of Dof
        DOFs of `synthesis`.
    chart : StabilisationChart
    notes : tuple of str
        Plain sentences, e.g. that a single reference cannot show a multiplicity.
    sensor_notes : tuple of str
        The same on sensors that the modes show to be at fault.
    left_out : tuple of LeftOut
        Peaks and columns of stable poles without a mode.
    """

    dofs: tuple[Dof, ...]
    modes: tuple[Mode, ...]
    band_hz: tuple[float, float]
    scaled: bool
    scaling_note: str
    references: tuple[Dof, ...]
    frequency_hz: NDArray[np.float64]
    synthesis: NDArray[np.complex64]
    outputs: tuple[Dof, ...]
    inputs: tuple[Dof, ...]
    chart: StabilisationChart
    notes: tuple[str, ...] = ()
    sensor_notes: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
