"""Settings of the fit."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.correlate.settings import PairingSettings, UncertaintySettings


class FitSettings(UncertaintySettings):
    """How the model's parameters are fitted to measured modes."""

    pairing: PairingSettings = Field(
        default=PairingSettings(), description="When a measured mode and a model mode may be one."
    )
    starts_per_decade: int = Field(
        default=2,
        ge=1,
        le=10,
        description="Starting values per decade for every free parameter that may span decades.",
    )
    starts_refined: int = Field(
        default=3,
        ge=1,
        description="Number of starts that are followed to the end; the rest only compete.",
    )
    annealing_start: float = Field(
        default=0.3,
        gt=0,
        description="Relative error of eigenvalues that the first rung of the annealing allows; the default "
        "covers a nominal model whose stiffnesses are off by 30 %.",
    )
    annealing_rungs: int = Field(
        default=7, ge=2, description="Rungs from the start down to the data's own accuracy."
    )
    screening_error: float = Field(
        default=0.03,
        gt=0,
        description="Relative error of eigenvalues at which the starts of the grid compete: tight enough to"
        " tell "
        "their basins apart, loose enough that few modes are lost as outliers.",
    )
    outlier_prior: float = Field(
        default=0.05,
        gt=0,
        lt=0.5,
        description="Prior probability that a measured mode is no mode of the rig (spurious, or of the "
        "foundation).",
    )
    outlier_limit: float = Field(
        default=0.35,
        gt=0,
        le=1,
        description="Share of outliers above which not the modes but the model is taken to be wrong: all "
        "uncertainties are then widened together until at most this share is left out.",
    )
    damping: bool = Field(default=True, description="Use measured damping ratios.")
    iterations: int = Field(
        default=60, ge=1, description="Largest number of Gauss-Newton steps of one refinement."
    )
    convergence: float = Field(
        default=1e-7,
        gt=0,
        lt=1e-2,
        description="A refinement ends when a step gains less than this share of the objective (plus one).",
    )
    profile_points: int = Field(
        default=5,
        ge=2,
        description="Points of the profile likelihood on each side, within three standard deviations.",
    )
    profile_rise: float = Field(
        default=4.0,
        gt=0,
        description="Rise of -2 log posterior on both sides, inside the bounds, by which a free parameter "
        "counts as "
        "identified: 4 is the 95 % interval of one parameter.",
    )
    relative_std_limit: float = Field(
        default=0.5,
        gt=0,
        description="Relative standard deviation above which a free parameter does not count as identified: "
        "beyond 50 % not even its factor of two is known.",
    )
    narrowed: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="A parameter with a tolerance counts as identified where its posterior is narrower than"
        " this "
        "share of the tolerance.",
    )
    sweep_points: int = Field(default=601, ge=50, description="Stiffnesses in a sweep of the error function.")
    flat_depth: float = Field(
        default=0.05,
        gt=0,
        description="Depth (median - least)/least below which the error function counts as flat.",
    )
