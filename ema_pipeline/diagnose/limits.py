"""What these data would have shown: the least size of every effect that would be claimed in nine tests of ten."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.probability import needed
from ema_pipeline.diagnose.score import Score
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import DetectionLimit
from ema_pipeline.observations.rig_model import SizeMap

_NINE_OF_TEN = 1.2816
"""Quantile of the normal distribution: in nine tests of ten the estimate is no further than this below the truth."""


def detection_limits(
    found: Iterable[Score], hypotheses: Sequence[Hypothesis], settings: DiagnoseSettings
) -> tuple[DetectionLimit, ...]:
    """Limit of every effect, from the information that the data hold of its size beside everything uncertain.

    An effect of size z·σ gains z²/2 in log evidence, less what its freedom costs, ½ ln(1 + (prior σ/σ)²). It has to
    gain as much as a claim needs among so many hypotheses.
    """
    limits = []
    for score in found:
        parameter = score.hypothesis.placed.effect.parameters[0]
        name = score.hypothesis.placed.parameter_name(parameter.name)
        size = SizeMap.of(parameter, score.hypothesis.scales.get(name, parameter.scale))
        gain = needed(score.hypothesis, hypotheses, settings, found=0)
        sigmas = max(settings.sigmas, float(np.sqrt(2 * gain + np.log1p(score.std**-2.0))))
        unknown = score.std * (sigmas + _NINE_OF_TEN)
        least = abs(size.slope(0.0)) * unknown
        if least > parameter.maximum - parameter.null:
            least = float("inf")
        for name_of in score.hypothesis.names:
            own = name_of.placed.effect.parameters[0]
            own_size = SizeMap.of(own, name_of.scales.get(own.name, own.scale))
            ratio = score.hypothesis.representative.relative / name_of.relative
            limits.append(
                DetectionLimit(
                    name_of.label,
                    own.name,
                    least
                    if name_of.label == score.hypothesis.label
                    else abs(own_size.slope(0.0)) * unknown * ratio,
                    own.unit,
                )
            )
    return tuple(limits)
