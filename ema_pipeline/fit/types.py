"""Results of fitting the model's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import error_limit


@dataclass(frozen=True)
class ErrorSweep:
    """The error function ε over one stiffness (seed's Eq. 10, drawn as its Figs. 5 and 6).

    Attributes
    ----------
    parameter, configuration : str
    mode_count : int
        Number of modes used, the lowest ones first.
    values : ndarray, (n,)
        Stiffness, N/m, logarithmically spaced.
    error : ndarray, (n,)
        ε at `values`.
    minimum : float
        Stiffness at the minimum of ε.
    relative_depth : float
        (median ε - least ε)/least ε: near 0 for a flat curve that determines nothing.
    identified : bool
        False where ε is too flat, or its minimum lies on an end of the sweep.
    note : str
        Plain words on how well ε determines the stiffness.
    """

    parameter: str
    configuration: str
    mode_count: int
    values: NDArray[np.float64]
    error: NDArray[np.float64]
    minimum: float
    relative_depth: float
    identified: bool
    note: str


@dataclass(frozen=True)
class StepwiseEstimate:
    """Stiffnesses by their error functions, one configuration after the other, and their average.

    Attributes
    ----------
    values : dict of str to float
        N/m; NaN where the step could not be taken (its configuration was not measured).
    average : float
        NaN unless every step determines its stiffness.
    note : str
        Why not.
    """

    values: dict[str, float]
    average: float
    note: str


@dataclass(frozen=True)
class ParameterEstimate:
    """A fitted parameter.

    Attributes
    ----------
    value, std : float
        Estimate and its standard deviation (1 σ) from the posterior covariance.
    low, high : float
        68 % interval within the bounds, of a rig's parameter by a factor; the bounds where nothing measured depends
        on a free one.
    unit : str
    free : bool
        True for parameters without a prior.
    nominal, prior_std : float
        Nominal value and its tolerance as a standard deviation (NaN without prior).
    identified : bool
        True where the data determine the parameter; for a parameter with a prior: where the data narrow it.
    shift_z : float
        (value - nominal)/prior_std; NaN without prior.
    note : str
        Why not identified, at a bound, out of tolerance; empty otherwise.
    """

    name: str
    value: float
    std: float
    low: float
    high: float
    unit: str
    free: bool
    nominal: float
    prior_std: float
    identified: bool
    shift_z: float
    note: str


@dataclass(frozen=True)
class FitResult:
    """A weighted fit of all parameters over all configurations.

    Attributes
    ----------
    parameters : dict of str to ParameterEstimate
    names : tuple of str
        Order of rows and columns of `correlation`.
    correlation : ndarray, (n, n)
        Posterior correlation.
    error : float
        Root-mean-square of (measurement - model)/standard uncertainty over all data.
    chi2_per_dof : float
        Over all paired modes, those left out as outliers included, and the priors.
    frequency_error : float
        ε (seed's Eq. 10) over all pairs of all configurations.
    data_count : int
        Number of real data.
    stop_reason : str
        Why the optimiser stopped, in words.
    sweeps : tuple of ErrorSweep
    stepwise : StepwiseEstimate or None
    notes : tuple of str
    unknowns : dict of str to float
        Every unknown at the maximum of the posterior: logarithms of families and parts, calibrations, effects' sizes.
    scatters : dict of str to float
        What parts, channels, damping and the model scatter, as learned.
    """

    parameters: dict[str, ParameterEstimate]
    names: tuple[str, ...]
    correlation: NDArray[np.float64]
    error: float
    chi2_per_dof: float
    frequency_error: float
    data_count: int
    stop_reason: str
    sweeps: tuple[ErrorSweep, ...] = ()
    stepwise: StepwiseEstimate | None = None
    notes: tuple[str, ...] = ()
    unknowns: dict[str, float] = field(default_factory=dict)
    scatters: dict[str, float] = field(default_factory=dict)

    @property
    def error_limit(self) -> float:
        """Error up to which a model explains so many data."""
        return error_limit(self.data_count)

    def values(self) -> dict[str, float]:
        """Parameter values at the optimum, as `Rig.system` takes them."""
        return {name: p.value for name, p in self.parameters.items()}
