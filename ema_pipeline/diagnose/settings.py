"""Settings of the diagnosis."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.settings import Settings


class DiagnoseSettings(Settings):
    """How missing physics is looked for."""

    null_prior: float = Field(
        default=0.3, gt=0, lt=1, description="Prior probability that nothing is missing."
    )
    further_null_prior: float = Field(
        default=0.6,
        gt=0,
        lt=1,
        description="The same once an effect was found: a rig seldom misses two.",
    )
    doubt: float = Field(
        default=0.2,
        gt=0,
        lt=1,
        description="Probability of nothing up to which an effect is claimed; the more hypotheses there are, the more "
        "evidence one of them needs.",
    )
    generic_prior: float = Field(
        default=0.3,
        gt=0,
        le=1,
        description="Prior weight of a generic effect (a spring somewhere) against one of the rig's own.",
    )
    claim: float = Field(
        default=3.5,
        gt=0,
        description="Log evidence gained from which an effect is claimed: a Bayes factor of 33, strong evidence after "
        "Kass and Raftery (1995).",
    )
    linearised: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="Share of the log evidence gained by effects that depend on the amplitude which a further effect "
        "must gain besides: what equivalent linearisation leaves out of the first looks like a second one.",
    )
    sigmas: float = Field(
        default=2.0, gt=0, description="Distance of a claimed size from nothing, in its standard deviations."
    )
    linearised_sigmas: float = Field(
        default=3.0,
        gt=0,
        description="The same for an effect that depends on the amplitude, in tests at several force levels. Those of "
        "true effects are four or more: equivalent linearisation gives sizes to a fifth or a quarter. Motion that it "
        "does not describe gains evidence with about two.",
    )
    alike: float = Field(
        default=3.0,
        gt=0,
        description="Difference of log evidence within which two effects explain the data alike (a factor of 20).",
    )
    error_limit: float = Field(
        default=1.5, gt=1, description="Error up to which a model counts as one that explains the data."
    )
    folds: int = Field(default=4, ge=2, le=20, description="Parts that the modes are held out in, in turn.")
    most_effects: int = Field(default=3, ge=1, le=6, description="Most effects that are added in turn.")
    further_finalists: int = Field(
        default=0,
        ge=0,
        le=10,
        description="Finalists, beside the best by evidence, that promise most beside learned scatters; two tests of "
        "one rig, which repeat far better than is stated, have 2 in any case, continuous records 3.",
    )
    candidates: int = Field(default=5, ge=1, description="Number of candidates that are reported.")
    processes: int | None = Field(
        default=None,
        ge=1,
        le=64,
        description="Processes that share the hypotheses; 1 for none but this one; left out: one per processor.",
    )
