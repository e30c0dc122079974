"""What the diagnosis hands on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from ema_pipeline.inference import ERROR_LIMIT

VerdictWord = Literal["adequate", "effect", "ambiguous", "unknown_effect", "not_enough_data"]

OUT_OF_TOLERANCE = "out_of_tolerance"
"""Stands where an effect's id stands for a parameter that the data put outside its tolerance."""
EXTRA_COORDINATE = "a degree of freedom of its own"
"""What a misfit acts like where a test shows more modes than the model has."""


NOT_DETERMINED = "not determined by these data"

NOTHING = "nothing"
UNKNOWN = "an effect that is not in the library"
"""Beside the hypotheses, what else may be so."""
DOUBTFUL = 0.5
"""Probability that nothing is missing, however small, below which an adequate model has a candidate worth a word."""

_UNDETERMINED = 100.0
"""Above this ratio of standard deviation to value a size counts as not determined."""


@dataclass(frozen=True)
class EffectSize:
    """A fitted size; `std` is 1 σ. `learned` is False where the data leave its prior as it was."""

    value: float
    std: float
    unit: str
    learned: bool = True

    @property
    def determined(self) -> bool:
        """False where the data say nothing of it: a free gap that never closes stays where its fit began."""
        return self.learned and (self.value == 0.0 or not self.std > _UNDETERMINED * abs(self.value))


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing.

    Attributes
    ----------
    effect, at : str
        Id and place; ``out_of_tolerance`` and the parameter's name for a parameter.
    title : str
        What it is, in a few words.
    probability : float
        Over all hypotheses and "nothing is missing" it adds up to 1.
    parameters : dict of str to EffectSize
    error_before, error_after : float
        Root-mean-square of (measurement - model)/standard uncertainty without and with it.
    heldout_error_before, heldout_error_after : float
        The same on data that the fit has not seen; NaN where it was not computed.
    log_evidence : float
        Log evidence gained (natural logarithm of a Bayes factor) over the model without it: the model as it stood, with
        the effects that were added before this one.
    threshold : float
        Log evidence that a claim needed: the setting `claim`, more in tests at several force levels for an effect that
        depends on the amplitude, and for a further effect beside one.
    claimed : bool
        True where probability, gain and held-out data all support it.
    why : str
        Two plain sentences.
    equivalents : tuple of str
        Other names of the same physics.
    """

    effect: str
    at: str
    title: str
    probability: float
    parameters: dict[str, EffectSize]
    error_before: float
    error_after: float
    heldout_error_before: float
    heldout_error_after: float
    log_evidence: float
    threshold: float
    claimed: bool
    why: str
    equivalents: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """``id@place``."""
        return f"{self.effect}@{self.at}"

    def would_explain(self, error_limit: float) -> bool:
        """True where it is not claimed, yet gains evidence and brings the error within a limit."""
        return not self.claimed and self.log_evidence > 0 and self.error_after <= error_limit


@dataclass(frozen=True)
class Rung:
    """One model of the ladder.

    Attributes
    ----------
    effects : tuple of str
        Labels ``id@place``; empty for the base model.
    error, heldout_error : float
    chi2 : float
        Sum of squares of everything compared, priors included.
    parameters : dict of str to EffectSize
        All fitted parameters, those of the effects named ``id@place.name``.
    log_evidence : float
        Against the base model.
    unexplained : int
        Measured modes that the model does not explain.
    unknowns : dict of str to float
        Everything uncertain as this model was fitted, by name: where a later fit of it begins.
    """

    effects: tuple[str, ...]
    error: float
    heldout_error: float
    chi2: float
    parameters: dict[str, EffectSize]
    log_evidence: float
    unexplained: int
    unknowns: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class LearnedScatter:
    """A standard deviation (1 σ) of everything that is not exactly as stated.

    Attributes
    ----------
    name, title : str
    stated : float
        What was stated, or the default.
    learned : float
        What the data say of it.
    """

    name: str
    title: str
    stated: float
    learned: float


@dataclass(frozen=True)
class Ladder:
    """Rungs from the base model upwards, all at one noise level.

    Attributes
    ----------
    rungs : tuple of Rung
    frequency_noise, damping_noise, shape_noise : float
        Standard uncertainties added to the test's own scatter (relative; shape in units of the largest
        entry).
    note : str
        Why no further effect was added.
    scatters : tuple of LearnedScatter
        What σ includes in addition to the test's own scatter.
    """

    rungs: tuple[Rung, ...]
    frequency_noise: float
    damping_noise: float
    shape_noise: float
    note: str
    scatters: tuple[LearnedScatter, ...] = ()


@dataclass(frozen=True)
class Localisation:
    """Where a misfit acts and how.

    Attributes
    ----------
    place : str
        DOF, or two DOFs joined by ``-``.
    acts_like : str
        ``"stiffness"``, ``"mass"``, ``"viscous damping"``, ``"hysteretic damping"`` or ``"a degree of freedom of its
        own"``.
    size : float
        Of the element that would correct it best, N/m, kg, N·s/m; of a degree of freedom its frequency, Hz.
    score : float
        Reduction of the sum of squares that is expected to first order.
    """

    place: str
    acts_like: str
    size: float
    score: float


@dataclass(frozen=True)
class DetectionLimit:
    """The least size of an effect that these data would show nine times in ten, or the largest.

    Attributes
    ----------
    label : str
        ``id@place``.
    parameter : str
    size : float
        Distance from null; infinite where no allowed size would be seen. Relative to the nominal value for a
        parameter out of tolerance.
    unit : str
    largest : bool
        True for an effect that shows the more the smaller its size is (the preload of teeth): `size` is the largest
        one that would be seen, 0 where none would.
    """

    label: str
    parameter: str
    size: float
    unit: str
    largest: bool = False

    @property
    def seen(self) -> bool:
        """True where some allowed size would be seen."""
        return self.size > 0 if self.largest else math.isfinite(self.size)


@dataclass(frozen=True)
class Diagnosis:
    """The answer to: which physics is the model missing?

    Attributes
    ----------
    verdict : str
        ``"adequate"``, ``"effect"``, ``"ambiguous"``, ``"unknown_effect"`` or ``"not_enough_data"``.
    summary : str
        The verdict in one or two plain sentences.
    null_probability : float
        Probability that nothing is missing, however small.
    candidates : tuple of Candidate
        The most probable first.
    indistinguishable : tuple of tuple of str
        Groups of labels that these data cannot tell apart.
    next_measurement : str
        What would tell them apart, or raise the certainty, with its expected effect; empty where nothing
        is needed.
    localisation : tuple of Localisation
        Best first; empty unless the model fails and nothing in the library corrects it.
    probabilities : dict of str to float
        Of every hypothesis, ``"nothing"`` among them; adds up to 1.
    error, heldout_error : float
        Of the base model.
    ladder : Ladder
    notes : tuple of str
        What the data's screening found.
    detection_limits : tuple of DetectionLimit
        What these data would show; empty where even the best model fails.
    nothing_visible : float
        Probability that nothing is missing that is larger than its detection limit; NaN where that was not calculated.
    error_limit : float
        Error up to which a model explains so many data.
    """

    verdict: VerdictWord
    summary: str
    null_probability: float
    candidates: tuple[Candidate, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    next_measurement: str
    localisation: tuple[Localisation, ...]
    probabilities: dict[str, float]
    error: float
    heldout_error: float
    ladder: Ladder
    notes: tuple[str, ...] = ()
    detection_limits: tuple[DetectionLimit, ...] = ()
    nothing_visible: float = math.nan
    error_limit: float = ERROR_LIMIT

    @property
    def suspected(self) -> Candidate | None:
        """Best candidate of an adequate model that some small effect is more probable to be missing from than none."""
        doubtful = self.verdict == "adequate" and self.null_probability < DOUBTFUL
        return self.candidates[0] if doubtful and self.candidates else None

    @property
    def adequate_probability(self) -> float:
        """Probability of the verdict ``"adequate"``: nothing is missing that these data would show."""
        return self.null_probability if math.isnan(self.nothing_visible) else self.nothing_visible
