"""Measured loops, and the results of identifying an isolator from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Loop:
    """One averaged steady cycle.

    Attributes
    ----------
    name : str
        Record it came from.
    frequency_hz : float
        As found in the displacement.
    amplitude_m : float
        Half the range of the displacement, X.
    phase : ndarray, (n_points,)
        Ascending, in cycles, 0…1.
    displacement, velocity, force : ndarray, (n_points,)
        At `phase`, m (from the middle of the motion), m/s, N.
    series : ndarray, (2·n_harmonics + 1,)
        Fourier coefficients of the displacement: mean, cosines, sines, m.
    force_std_n : float
        Standard deviation of each point of `force`, from the scatter between neighbouring samples.
    cycles : int
    energy_j, energy_std_j : float
        Energy per cycle ∮F dx, and its standard deviation.
    displacement_std_m : float
        Standard deviation of each of the coefficients in `series`.
    """

    name: str
    frequency_hz: float
    amplitude_m: float
    phase: NDArray[np.float64]
    series: NDArray[np.float64]
    displacement: NDArray[np.float64]
    velocity: NDArray[np.float64]
    force: NDArray[np.float64]
    force_std_n: float
    cycles: int
    energy_j: float
    energy_std_j: float
    displacement_std_m: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """A value with its standard deviation (1 σ).

    `identified` is False where the data do not determine it; `note` then says why, as it does for a value
    that cannot be.
    """

    value: float
    std: float
    unit: str
    identified: bool = True
    note: str = ""


@dataclass(frozen=True)
class EnergyLine:
    """Energy per cycle over frequency at one amplitude, E = a·ω + b, and the viscous damper that it means.

    Attributes
    ----------
    amplitude_m : float
    frequency_hz, energy_j, energy_std_j : ndarray, (n,)
    slope, intercept : float
        a, J·s, and b, J.
    damping : Estimate
        c = a/(πX²), N·s/m.
    possible : bool
        False where c is negative beyond its uncertainty.
    reason : str
        Why it cannot be, and what it points to.
    """

    amplitude_m: float
    frequency_hz: NDArray[np.float64]
    energy_j: NDArray[np.float64]
    energy_std_j: NDArray[np.float64]
    slope: float
    intercept: float
    damping: Estimate
    possible: bool
    reason: str


@dataclass(frozen=True)
class LossFactor:
    """Loss factor η = E/(2πW) of one loop."""

    name: str
    frequency_hz: float
    amplitude_m: float
    value: float
    std: float


@dataclass(frozen=True)
class LoopFit:
    """A loop beside the model's.

    Attributes
    ----------
    name : str
    force : ndarray, (n_points,)
        Model's force at the loop's points, N.
    energy_j : float
        Model's energy per cycle.
    energy_error : float
        (model - measured)/measured.
    misfit : float
        Root-mean-square difference of force over half the range of the measured force.
    """

    name: str
    force: NDArray[np.float64]
    energy_j: float
    energy_error: float
    misfit: float


@dataclass(frozen=True)
class LoopModel:
    """A model of the ladder beside the measured loops.

    Attributes
    ----------
    effects : tuple of str
        Labels ``id@isolator`` beside the linear spring.
    fits : tuple of LoopFit
        One per loop.
    scales : dict of str to float
        Force scale of each loop, by its name; empty unless loops have scales of their own.
    """

    effects: tuple[str, ...]
    fits: tuple[LoopFit, ...]
    scales: dict[str, float]


@dataclass(frozen=True)
class IsolatorResult:
    """An identified isolator.

    Attributes
    ----------
    loops : tuple of Loop
        The measurement.
    parameters : dict of str to Estimate
        From the posterior of all loops: ``stiffness`` K1, ``quadratic_stiffness`` K2, ``cubic_stiffness`` K3,
        ``viscous_damping`` c, ``hysteresis_force`` k_w, ``hysteresis_rho`` ρ, ``hysteresis_sigma`` σ, and
        ``hysteresis_stiffness`` k_w·ρ.
    names : tuple of str
        Order of rows and columns of `covariance`.
    covariance : ndarray, (n, n)
    closed_form : dict of str to float
        The source's own steps as they stand. Its backbone holds the middle line of the hysteresis too, so
        what is left may have no zero crossing: the hysteresis is then NaN.
    closed_form_hysteresis : dict of str to float
        Its steps for the hysteresis after the fitted stiffness and damping are taken off.
    energy : tuple of EnergyLine
    loss : tuple of LossFactor
    fits : tuple of LoopFit
        All loops with the one set of parameters.
    alone : tuple of LoopFit
        Every loop with parameters of its own.
    misfit_scale : float
        Root mean square of (measurement - model)/noise, 1 where the model reaches the data's own accuracy; what it
        does not reach is in the standard deviations.
    relaxation : dict of str to Estimate
        Parameters of a fit with a Maxwell branch, made where the damper came out negative; empty otherwise.
    flags : tuple of str
        Results that cannot be, with the reason.
    notes : tuple of str
        Where the model fails, in plain words.
    """

    loops: tuple[Loop, ...]
    parameters: dict[str, Estimate]
    names: tuple[str, ...]
    covariance: NDArray[np.float64]
    closed_form: dict[str, float]
    closed_form_hysteresis: dict[str, float]
    energy: tuple[EnergyLine, ...]
    loss: tuple[LossFactor, ...]
    fits: tuple[LoopFit, ...]
    alone: tuple[LoopFit, ...]
    misfit_scale: float
    relaxation: dict[str, Estimate]
    flags: tuple[str, ...]
    notes: tuple[str, ...]
