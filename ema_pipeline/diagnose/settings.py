"""Settings of the diagnosis."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.inference import ERROR_LIMIT
from ema_pipeline.settings import Settings

MOST_UNEXPLAINED = 1
"""Measured modes without a partner in a model that explains the data: one may be invented, or of the floor."""


class DiagnoseSettings(Settings):
    """How missing physics is looked for."""

    null_prior: float = Field(
        default=0.3, gt=0, lt=1, description="Prior probability that nothing is missing."
    )
    further_null_prior: float = Field(
        default=0.6,
        gt=0,
        lt=1,
        description="The same once an effect was found: a model seldom misses two effects. Once n were "
        "found it is 1 - (1 - p)ⁿ.",
    )
    doubt: float = Field(
        default=0.2,
        gt=0,
        lt=1,
        description="Largest probability that nothing is missing at which an effect is still claimed; the more "
        "hypotheses there are, the more evidence one of them needs.",
    )
    further_doubt: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="The same of a further effect beside those that are claimed: a wrong name beside a right one "
        "spoils both.",
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
        description="Smallest gain in log evidence at which an effect is claimed: a Bayes factor of 33, strong "
        "evidence after Kass and Raftery (1995).",
    )
    linearised: float = Field(
        default=0.25,
        ge=0,
        lt=1,
        description="Once amplitude-dependent effects are claimed, a further effect must gain this share of their log "
        "evidence in addition, and `linearised_claim`: the residual error of equivalent linearisation can look like a "
        "second effect.",
    )
    linearised_claim: float = Field(
        default=17.0,
        ge=0,
        description="Log evidence that an effect that depends on the amplitude must gain in addition to `claim`, in "
        "tests at several force levels: wrong ones gained up to 17 from what equivalent linearisation leaves out, "
        "true ones clearly above their limits mostly more than 100. Of generic effects twice as much is asked.",
    )
    sigmas: float = Field(
        default=2.0,
        gt=0,
        description="Smallest distance of a claimed size from zero, in its standard deviations.",
    )
    linearised_sigmas: float = Field(
        default=3.0,
        gt=0,
        description="The same for an effect that depends on the amplitude, in tests at several force "
        "levels. True effects reach four or more, since equivalent linearisation gives sizes to "
        "within a fifth or a quarter; motion that it does not describe gains evidence with sizes of "
        "about two.",
    )
    alike: float = Field(
        default=3.0,
        gt=0,
        description="Difference of log evidence within which two effects explain the data equally well (a factor of "
        "20).",
    )
    error_limit: float = Field(
        default=ERROR_LIMIT,
        gt=1,
        description="Error up to which a model counts as one that explains the data, where these are few (up to "
        "20); of 60 and more 0.87 times as much.",
    )
    folds: int = Field(default=4, ge=2, le=20, description="Number of cross-validation folds.")
    most_effects: int = Field(
        default=3, ge=1, le=6, description="Largest number of effects that are added automatically."
    )
    further_finalists: int = Field(
        default=0,
        ge=0,
        le=10,
        description="Extra finalists, chosen by expected gain at the learned scatters, whatever they promise; up to "
        "three that promise a gain are added in any case. Two tests of one rig, which repeat far better than is "
        "stated, have 2 at least, continuous records 3.",
    )
    candidates: int = Field(default=5, ge=1, description="Number of candidates that are reported.")
    processes: int | None = Field(
        default=None,
        ge=1,
        le=64,
        description="Processes that share the hypotheses; 1 for none but this one; left out: one per processor.",
    )
