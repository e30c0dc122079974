"""What to measure next, in a sentence with the effect that is to be expected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.explain import label_text
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.hypotheses import NOTHING
from ema_pipeline.diagnose.ranking import Ranking
from ema_pipeline.diagnose.separate import Option, best_measurement
from ema_pipeline.diagnose.types import VerdictWord
from ema_pipeline.fit.settings import FitSettings

_LEAST = 1.0
_WORTH = 2.0
_CERTAIN = 100.0


def next_measurement(
    case: Case, verdict: VerdictWord, ranking: Ranking, members: Sequence[Fitted], fit: FitSettings
) -> str:
    """The measurement that would help most; empty where nothing is needed.

    Parameters
    ----------
    case : Case
    verdict : str
    ranking : Ranking
        On top of the base model.
    members : sequence of Fitted
        What explains the data alike.
    fit : FitSettings
        At the noise level.
    """
    if verdict == "ambiguous" and members:
        second = members[1] if len(members) > 1 else ranking.base
        names = (_name(members[0]), _name(second))
        option = best_measurement(case, members[0], second, fit)
        if option is None or option.separation < _LEAST:
            return f"No single further measurement that was tried would tell {names[0]} from {names[1]}."
        return f"{_capital(option.text)} would tell {names[0]} from {names[1]}: {_expected(option, *names)}."
    if verdict == "unknown_effect":
        return (
            "Hit at three force levels: if a natural frequency moves, the missing effect depends on amplitude; "
            "if not, put further sensors around the place named."
        )
    if verdict == "not_enough_data":
        return _what_lacks(case)
    if verdict == "adequate" and ranking.probabilities[NOTHING] < case.settings.probability_least:
        ordered = ranking.ordered()
        option = best_measurement(case, ordered[0], ranking.base, fit) if ordered else None
        if option is not None and option.separation > _WORTH:
            name = _name(ordered[0])
            expected = _expected(option, "it", "nothing missing")
            return f"{_capital(option.text)} would show whether {name} is there: {expected}."
    return ""


def _what_lacks(case: Case) -> str:
    """What a test would have to hold beside what it holds."""
    lacking = []
    for c, m in case.measured.items():
        if m.shapes is None or not m.dofs:
            lacking.append(f"measure mode shapes at every body ({c})")
        elif bare := _bare_bodies(case, c, m):
            lacking.append(f"put sensors on {', '.join(bare)} ({c})")
        if not np.any(np.isfinite(m.frequency_std_hz)):
            lacking.append(f"state the standard deviations of the frequencies ({c})")
        if not np.any(np.isfinite(m.damping_ratio)):
            lacking.append(f"measure damping ratios ({c})")
    others = [c for c in case.rig.configurations if c not in case.measured]
    lacking += [f"test in configuration {c}" for c in others]
    return (
        f"{_capital('; '.join(lacking))}."
        if lacking
        else "State the rig's parameters with narrower tolerances."
    )


def _bare_bodies(case: Case, configuration: str, m: MeasuredModes) -> list[str]:
    """Bodies without a sensor."""
    bodies = dict.fromkeys(d.rpartition(".")[0] for d in case.rig.system(configuration).dofs)
    covered = {d.point.rpartition(".")[0] for d in m.dofs}
    return [b for b in bodies if b not in covered]


def _expected(option: Option, first: str, second: str) -> str:
    effect = option.effect.format(first=first, second=second)
    size = f"more than {_CERTAIN:g}" if option.separation > _CERTAIN else f"{option.separation:.1f}"
    return f"{effect}, a difference of {size} σ" if effect else f"a difference of {size} σ"


def _name(f: Fitted) -> str:
    return label_text(f.hypothesis.labels[-1]) if f.hypothesis.labels else "the model as it is"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
