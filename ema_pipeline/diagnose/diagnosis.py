"""From observations to the diagnosis: what is missing, how sure that is, and what these data could have shown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import softmax

from ema_pipeline.diagnose import sentences
from ema_pipeline.diagnose.claims import Judged, linearised
from ema_pipeline.diagnose.detection_limits import detection_limits
from ema_pipeline.diagnose.explained import explanation, stands_still
from ema_pipeline.diagnose.hypotheses import Hypothesis, list_hypotheses
from ema_pipeline.diagnose.localise import localise
from ema_pipeline.diagnose.naming import averaged_size, in_said_names, sizes_of
from ema_pipeline.diagnose.next_test import next_measurement
from ema_pipeline.diagnose.probability import CLOSEST, against_nothing, complete, shared
from ema_pipeline.diagnose.rungs import as_calculated, learned_scatters, noise, rungs_of
from ema_pipeline.diagnose.score import scores
from ema_pipeline.diagnose.selection import Earlier, Progress, Selection, select
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import (
    DOUBTFUL,
    NOTHING,
    Candidate,
    DetectionLimit,
    Diagnosis,
    EffectSize,
    Ladder,
    VerdictWord,
)
from ema_pipeline.diagnose.verdict import alike, verdict_of
from ema_pipeline.diagnose.visible import nothing_visible
from ema_pipeline.effects.base import Effect
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.in_full import fit_in_full, friction_in_full
from ema_pipeline.processes import aside
from ema_pipeline.rigs.types import Rig

_FAINT = 0.33
"""Size over the least that would be claimed in nine tests of ten, below which a claim is none: of 211 right claims in
simulated tests none was below 0.38; two of eight wrong ones were at 0.11 and 0.29."""
_ALTERNATIVES = 1e-6
"""Probability of all that is not claimed, below which what is claimed is weighed against nothing alone."""
_MOST_AGAIN = 3
"""Selections without what is so small, one after the other."""


def diagnose(
    observations: Observations,
    rig: Rig,
    library: Mapping[str, Effect],
    known: Model | None = None,
    settings: DiagnoseSettings | None = None,
    progress: Progress = lambda share, text: None,
    notes: Sequence[str] = (),
    linear: bool = True,
    hypotheses: Sequence[Hypothesis] | None = None,
) -> Diagnosis:
    """Which physics is the model missing?

    Parameters
    ----------
    observations : Observations
        What was measured.
    rig : Rig
        The model, with the effects that it has already.
    library : dict of str to Effect
    known : Model, optional
        The effects that it has already; none where left out.
    settings : DiagnoseSettings, optional
    progress : callable, optional
    notes : sequence of str
        Remarks on the data that a reader should see beside the verdict.
    linear : bool
        True for effects whose response is proportional to the force only.
    hypotheses : sequence of Hypothesis, optional
        What may be missing; every effect at every place of the rig where left out.

    Returns
    -------
    Diagnosis
        Deterministic, whatever the number of processes.

    References
    ----------
    D. J. C. MacKay, Neural Computation 4 (1992) 415-447 (evidence); I. Behmanesh et al., Mech. Syst. Signal Process.
    64-65 (2015) 360-376 (hierarchical model updating); R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90 (1995)
    773-795 (Bayes factors).
    """
    settings, known = settings or DiagnoseSettings(), known or Model()
    if hypotheses is None:
        hypotheses = list_hypotheses(rig, library, known.labels, linear)
    first, faint = _selected(observations, known, hypotheses, settings, progress)
    first = _with_friction_in_full(first, known, hypotheses, settings, progress)
    # what else there may be is told to first order, as it was looked for
    observations, final = fit_in_full(first.observations, first.final, settings.processes)
    found = replace(first, final=final, observations=observations)
    reached = explanation(found.observations, found.final, settings)
    explained = reached.explained
    verdict = verdict_of(found, settings, explained)
    limits: tuple[DetectionLimit, ...] = ()
    with aside(lambda: _ladder(found, settings), settings.processes) as ladder_aside:
        if explained:
            already = len(first.claimed)
            limits = detection_limits(first.observations, first.final, hypotheses, settings, found=already)
        ladder = ladder_aside()
    errors = (ladder.rungs[0].error, ladder.rungs[-1].error)
    group = alike(found)
    share = complete(*reached.telling) if explained else CLOSEST
    candidates = tuple(
        replace(c, probability=share * c.probability)
        for c in _candidates(found, settings, group, hypotheses, ladder.rungs[-1].parameters)
    )
    start = found.rounds[0].ranking.base
    begun = reached if start is found.final else explanation(first.observations, start, settings)
    probabilities = shared(_first_probabilities(found), share, share if begun.explained else 0.0)
    nothing, limit = probabilities[NOTHING], found.final.posterior.error_limit(settings.error_limit)
    visible = math.nan
    if verdict == "adequate":
        visible = share * nothing_visible(first.rounds[0].ranking, found.rounds[0].probabilities, limits)
    told, beside = _told(candidates, group, verdict)
    best = _worth_a_word(candidates, explained, nothing, limit)
    bent = sentences.standing_out(reached.parts)
    in_model = set(found.final.model.labels)
    further = [h for h in hypotheses if h.label not in in_model]
    return Diagnosis(
        verdict=verdict,
        summary=sentences.summary(
            verdict, told, errors, visible, best, sentences.reasons(reached, errors[1]), beside
        ),
        null_probability=nothing,
        candidates=candidates,
        indistinguishable=_groups(found, group),
        next_measurement=next_measurement(first.observations, first, group, verdict),
        localisation=()
        if explained
        else localise(scores(first.observations, first.final, further, processes=settings.processes)),
        probabilities=probabilities,
        error=errors[0],
        heldout_error=ladder.rungs[0].heldout_error,
        ladder=ladder,
        notes=(*((bent,) if bent and verdict != "unknown_effect" else ()), *faint, *notes),
        detection_limits=limits,
        nothing_visible=visible,
        error_limit=limit,
    )


def _first_probabilities(found: Selection) -> dict[str, float]:
    """Of the first round; what was dropped once more was known leaves its share to the first claim."""
    told = dict(found.rounds[0].probabilities)
    best = found.rounds[0].best
    if best is not None and found.claimed and best.named.label not in {j.named.label for j in found.claimed}:
        first = found.claimed[0].named.label
        told[first] = told.get(first, 0.0) + told.pop(best.named.label, 0.0)
    return told


def _ladder(found: Selection, settings: DiagnoseSettings) -> Ladder:
    """The model without and with what is claimed, one effect after the other."""
    fits = [found.rounds[0].ranking.base, *(j.ranked.fit for j in found.claimed)]
    if found.claimed:
        fits[-1] = found.final
    said = [(j.hypothesis, j.named.name) for j in found.claimed]
    named = [in_said_names(found.observations, f, said) for f in fits]
    rungs = rungs_of(found.observations, named, settings.processes)
    scatters = learned_scatters(found.observations, found.final)
    return Ladder(rungs, *noise(found.final), note=_ended(found, settings), scatters=scatters)


Said = list[tuple[str, str]]
"""Labels of effects and their sizes in words."""


def _told(
    candidates: Sequence[Candidate], group: Sequence[Judged], verdict: VerdictWord
) -> tuple[Said, Said]:
    """What is claimed, or what explains the data equally well and what is claimed beside it."""

    def said(some: Iterable[Candidate]) -> Said:
        return [(c.label, sentences.size_text(c.parameters)) for c in some]

    if verdict != "ambiguous":
        return said(c for c in candidates if c.claimed), []
    names = {j.named.label for j in group}
    beside = (c for c in candidates if c.claimed and c.label not in names)
    return said(c for c in candidates if c.label in names), said(beside)


def _worth_a_word(
    candidates: Sequence[Candidate], explained: bool, nothing: float, limit: float
) -> tuple[str, str]:
    """What gains most, and why it is not claimed, where it may well be right or would explain the data alone."""
    claimed = [c for c in candidates if c.claimed]
    for c in claimed[:1] or sorted(candidates, key=lambda c: -c.log_evidence)[:1]:
        if (explained and not c.claimed and nothing < DOUBTFUL) or c.would_explain(limit):
            return c.label, c.why
    return "", ""


def _selected(
    observations: Observations,
    known: Model,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    progress: Progress,
) -> tuple[Selection, list[str]]:
    """What is claimed, once more without what is too small to be; and what that is, in sentences.

    An effect far below the least size that these data would show gains little. What gains more at such a size takes up
    something else.
    """
    told: list[str] = []
    found = select(observations, known, hypotheses, settings, progress)
    for _ in range(_MOST_AGAIN):
        claimed = _faint(found, found.claimed, hypotheses, settings)
        if not claimed:
            break
        told += [
            f"Not claimed: {sentences.label_text(j.named.label)}, {sentences.size_text(j.named.sizes)}. Of such a size "
            "these data would show nothing."
            for j in claimed
        ]
        tried = {j.hypothesis.label: j for of in found.rounds for j in of.judged}
        tried |= {j.hypothesis.label: j for j in claimed}
        dropped = {j.hypothesis.label for j in _faint(found, [*tried.values()], hypotheses, settings)}
        hypotheses = [h for h in hypotheses if h.label not in dropped]
        found = select(observations, known, hypotheses, settings, progress)
    return found, told


def _with_friction_in_full(
    first: Selection,
    known: Model,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    progress: Progress,
) -> Selection:
    """The selection from data for which friction is calculated in full, where that alone finds what moves the modes.

    Marched beside every rival it takes minutes: nothing is asked about beside it but what promised most.
    """
    if not stands_still(first.observations, first.final):
        return first
    progress(0.0, "friction in full")
    ranked = [r for of in first.rounds for r in of.ranking.ranked]
    effects = [(r.hypothesis.placed, r.hypothesis.scales) for r in ranked]
    found = friction_in_full(first.observations, first.rounds[0].ranking.base, effects, settings.processes)
    if found is None:
        return first
    full, label, friction = found
    asked = {r.hypothesis.label: r.hypothesis for r in ranked if r.final or r.hypothesis.label == label}
    earlier = Earlier((asked.pop(label), *asked.values()), settings.most_effects + 1, {label: friction}, True)
    again = select(full, known, hypotheses, settings, progress, earlier)
    return first if stands_still(again.observations, again.final) else again


def _faint(
    found: Selection, judged: Sequence[Judged], hypotheses: Sequence[Hypothesis], settings: DiagnoseSettings
) -> list[Judged]:
    """Those that are far smaller than the least size that these data would show.

    That is stated with other sizes as usual: friction shows half the force at half the rate as well.
    """
    judged = [j for j in judged if j.hypothesis.placed.effect.linear or len(j.named.sizes) == 1]
    # measured modes that have no partner without it show it, whatever else its size changes
    pairs = [[fit.posterior.residuals.unexplained for fit in (j.base, j.after)] for j in judged]
    judged = [j for j, (without, beside) in zip(judged, pairs, strict=True) if without <= beside]
    asked = [j.hypothesis for j in judged]
    already = len(found.claimed)
    limits = detection_limits(found.observations, found.final, hypotheses, settings, asked, already)
    least = {(limit.label, limit.parameter): limit.size for limit in limits if not limit.largest}
    return [
        j
        for j in judged
        if any(
            abs(size.value) < _FAINT * least.get((j.named.label, name), 0.0) < np.inf
            for name, size in j.named.sizes.items()
        )
    ]


def _candidates(
    found: Selection,
    settings: DiagnoseSettings,
    group: Sequence[Judged],
    hypotheses: Sequence[Hypothesis],
    final: Mapping[str, EffectSize],
) -> tuple[Candidate, ...]:
    """What is claimed, as it was added, with sizes of the final model; then the best others, most probable first.

    Beside several effects that explain the data as well, a size is averaged over these.
    """
    last = found.rounds[min(len(found.claimed), len(found.rounds)) - 1] if found.claimed else found.rounds[0]
    fits = [found.final if any(j is c for c in found.claimed) else j.ranked.fit for j in group]
    weights = [float(w) for w in softmax([fit.log_evidence for fit in fits])] if group else []
    shares = {j.named.label: w for j, w in zip(group, weights, strict=True)}
    # some of them judged anew, beside what was claimed after them
    anew = any(all(j is not one for of in found.rounds for one in of.judged) for j in group)
    mine, probabilities = [], dict(last.probabilities)
    for k, j in enumerate(found.claimed):
        of = found.rounds[k]
        # what else is claimed is no alternative to it
        alternatives = 1 - math.fsum(
            of.probabilities.get(one.named.label, 0.0) for one in found.claimed if one is not j
        )
        if alternatives > _ALTERNATIVES and any(j is one for one in of.judged):
            told = of.probabilities.get(j.named.label, 0.0) / alternatives
        else:  # there are none, or it took the place of an earlier claim once others were known
            told = against_nothing(j.hypothesis, j.gain, hypotheses, settings, k)
        sizes = {n: final.get(f"{j.named.label}.{n}", s) for n, s in j.named.sizes.items()}
        if group and j.named.label not in shares:
            named = partial(sizes_of, j.hypothesis, j.named.name)
            beside = [sizes if fit is found.final else named(fit) for fit in fits]
            sizes = {n: averaged_size([s[n] for s in beside], weights) for n in sizes}
        elif anew:
            probabilities |= {label: told * share for label, share in shares.items()}
            told = probabilities[j.named.label]
        mine.append(_candidate(j, sizes, told, True))
    taken = {c.label for c in mine}
    others = {j.named.label: j for j in (*last.judged, *group) if j.named.label not in taken}
    rest = sorted(others.values(), key=lambda j: (j.named.label not in shares, -j.gain))
    shown = rest[: max(settings.candidates, len(mine) + len(group)) - len(mine)]
    told_of = [_candidate(j, _stated(found, j), probabilities.get(j.named.label, 0.0), False) for j in shown]
    return (*mine, *sorted(told_of, key=lambda c: -c.probability))


def _stated(found: Selection, j: Judged) -> dict[str, EffectSize]:
    """Sizes of what is not in the model, as they would be stated if it were."""
    by_motion = linearised(found.observations, j.hypothesis)
    return {n: as_calculated(s) if by_motion else s for n, s in j.named.sizes.items()}


def _candidate(j: Judged, sizes: dict[str, EffectSize], probability: float, claimed: bool) -> Candidate:
    effect = j.named.name.placed.effect
    why = f"Its signs: {effect.signs}." if claimed or j.claimed else f"Not claimed: {j.doubt}."
    return Candidate(
        effect=effect.id,
        at=j.named.name.placed.place,
        title=effect.title,
        probability=probability,
        parameters=sizes,
        error_before=j.base.posterior.error,
        error_after=j.after.posterior.error,
        heldout_error_before=j.held_before.error,
        heldout_error_after=j.held_after.error,
        log_evidence=j.gain,
        threshold=j.needed,
        claimed=claimed,
        why=why,
        equivalents=j.named.equivalents,
    )


def _groups(found: Selection, group: Sequence[Judged]) -> tuple[tuple[str, ...], ...]:
    """What cannot be told apart: several effects, several names of one, and generic ones beside the rig's own."""
    groups = [tuple(j.named.label for j in group)] if len(group) > 1 else []
    for j, alike_it in zip(found.claimed, found.alike, strict=True):
        near = [n.named.label for n in alike_it if n is not j]
        names = (j.named.label, *j.named.equivalents, *(n for n in near if not any(n in g for g in groups)))
        if len(names) > 1:
            groups.append(names)
    return tuple(groups)


def _ended(found: Selection, settings: DiagnoseSettings) -> str:
    """Why no further effect was added."""
    best = found.rounds[-1].judged[0] if found.rounds[-1].judged else None
    if best is None:
        return "no further effect to try"
    if best.claimed:
        return f"the limit of {settings.most_effects} automatically added effects is reached (`most_effects`)"
    return f"the best further effect is {sentences.label_text(best.named.label)}, and {best.doubt}"
