"""Which physical effect is the model missing? The whole diagnosis, from measured modes to a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.advice import next_measurement
from ema_pipeline.diagnose.climbing import Climb, at_bound, climb, group, rivals
from ema_pipeline.diagnose.detection import detection_limits
from ema_pipeline.diagnose.explain import why
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.heldout import held_out
from ema_pipeline.diagnose.hypotheses import NOTHING, describe, same_physics
from ema_pipeline.diagnose.ladder import Yardstick, assemble_ladder, with_frfs, yardstick
from ema_pipeline.diagnose.localise import extra_coordinates, localise
from ema_pipeline.diagnose.predict import predict_left_out
from ema_pipeline.diagnose.progress import Progress, part
from ema_pipeline.diagnose.ranking import Ranking
from ema_pipeline.diagnose.screening import Screening, screen
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.thresholds import threshold
from ema_pipeline.diagnose.types import (
    Candidate,
    Diagnosis,
    Ladder,
    Localisation,
    VerdictWord,
)
from ema_pipeline.diagnose.verdict import judge_data, mending, misfit, sizes, unexplained_notes
from ema_pipeline.diagnose.witness import Witness, better_share, frf_lines
from ema_pipeline.effects.library import Library
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.types import Rig
from ema_pipeline.threads import single_blas_thread

_AS_GOOD = 0.9


def diagnose(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: DiagnoseSettings | None = None,
    library: Library | None = None,
    progress: Progress | None = None,
    warnings: Sequence[str] = (),
    thresholds: Mapping[str, float] | None = None,
    frfs: Mapping[str, FrfSet] | None = None,
    first_only: bool = False,
) -> Diagnosis:
    """Find the physics that a rig's model is missing.

    Parameters
    ----------
    rig : Rig
        The base model.
    measured : mapping of configuration to MeasuredModes
    settings : DiagnoseSettings, optional
    library : mapping of id to Effect, optional
        The shipped effects where left out; see `effects.library.effect_library` for the user's own.
    progress : callable, optional
        Called with the share done (0…1) and a word on what is being done.
    warnings : sequence of str
        Remarks of earlier stages that the reader of a diagnosis should see (checks that failed).
    thresholds : mapping of family to gain, optional
        Calibrated thresholds in place of the shipped ones, see `diagnose.thresholds` and `diagnose.bootstrap`.
    frfs : mapping of configuration to FrfSet, optional
        The FRFs that the modes were read from: a second witness, see `diagnose.witness`.
    first_only : bool
        Whether to stop at the first effect, where other data tell what else is missing.

    Returns
    -------
    Diagnosis
        Deterministic: the same data and settings give the same answer.

    Raises
    ------
    EmaError
        If there are no measured modes, or the rig has nothing to fit.

    Notes
    -----
    Every hypothesis (an effect at a place, or a parameter out of its tolerance) is fitted with all parameters of
    the rig; the base model is fitted again from each hypothesis' parameters. Then the noise level is taken from
    the best hypothesis and all is fitted again. Evidence is Laplace's, with the priors that the tolerances and
    the effects' scales state.
    """
    settings = settings or DiagnoseSettings()
    tell = progress or (lambda share, text: None)
    screening = screen(rig, measured)
    case = Case(rig, screening.measured, settings, library)
    witness = Witness(case, frf_lines(frfs or {}, screening.measured))
    with single_blas_thread():
        found = _diagnose(case, screening, witness, thresholds, tell, first_only)
    return replace(found, notes=(*found.notes, *warnings))


def _diagnose(
    case: Case,
    screening: Screening,
    witness: Witness,
    thresholds: Mapping[str, float] | None,
    tell: Progress,
    first_only: bool,
) -> Diagnosis:
    climbed = climb(case, witness, thresholds, part(tell, 0.0, 0.85), first_only)
    first, top = climbed.rankings[0], climbed.top
    fit = climbed.level.applied(case.settings.fit)
    ladder = assemble_ladder(
        case, climbed.models, climbed.level, climbed.note, part(tell, 0.85, 0.93), climbed.explaining
    )
    ladder = with_frfs(ladder, climbed.models, witness)
    stick = yardstick(case, fit, climbed.explaining)
    rung, members = _alike(case, climbed, ladder, stick, witness)
    tell(0.93, "predicting held-out data")
    candidates = _candidates(case, climbed, rung, members, ladder, stick, witness, thresholds)
    verdict, summary = judge_data(case, screening, climbed, rung, members, ladder)
    groups = _groups(case, climbed, members, verdict)
    localised: tuple[Localisation, ...] = ()
    if verdict == "unknown_effect":
        localised = (*extra_coordinates(case, top), *localise(case, top.hypothesis, fit, top.values))
        summary += _where(localised)
    tell(0.97, "next measurement")
    adequate = not misfit(case, top, ladder.rungs[-1].error)
    found = Diagnosis(
        verdict=verdict,
        summary=summary,
        null_probability=first.probabilities[NOTHING],
        candidates=candidates,
        indistinguishable=groups,
        next_measurement=next_measurement(case, verdict, climbed.rankings[rung], members, fit),
        localisation=localised,
        probabilities=first.probabilities,
        error=ladder.rungs[0].error,
        heldout_error=ladder.rungs[0].heldout_error,
        ladder=ladder,
        notes=(*screening.notes, *unexplained_notes(case, top)),
        detection_limits=detection_limits(case, climbed.rankings[-1], thresholds) if adequate else (),
        heldout_modes=predict_left_out(case, top, fit),
        thresholds_from="" if thresholds is None else "simulated from this test's own fitted null",
    )
    tell(1.0, "done")
    return found


def _groups(
    case: Case, climbed: Climb, members: Sequence[Fitted], verdict: VerdictWord
) -> tuple[tuple[str, ...], ...]:
    """What the data cannot tell apart: rivals, and names for the same change of the matrices."""
    if verdict == "ambiguous":
        labels = [x for f in members for x in (f.hypothesis.labels[-1], *_same(case, f))]
        return (tuple(labels if len(labels) > 1 else [*labels, NOTHING]),)
    claimed = [(m.hypothesis.labels[-1], *_same(case, m)) for m in climbed.models[1:]]
    return tuple(labels for labels in claimed if len(labels) > 1)


def _same(case: Case, f: Fitted) -> tuple[str, ...]:
    found = list(sizes(case, f).values())
    size = found[0].value if found else 0.0
    return same_physics(case.rig, list(case.measured), case.library, f.hypothesis, size)


def _alike(
    case: Case, climbed: Climb, ladder: Ladder, stick: Yardstick, witness: Witness
) -> tuple[int, list[Fitted]]:
    """What explains the data alike and on which rung, from 0: rivals of a claim; where nothing is claimed, what would
    mend a model that fails."""
    if len(climbed.models) > 1:
        return rivals(case, climbed, witness)
    if misfit(case, climbed.top, ladder.rungs[-1].error):
        found = mending(case, climbed.rankings[0], stick)
        base = witness.error(climbed.top)
        return 0, [f for f in found if not witness.rejects(base, f, True)]
    return 0, group(case, climbed.rankings[0], witness)[:1]


def _candidates(
    case: Case,
    climbed: Climb,
    undecided: int,
    members: Sequence[Fitted],
    ladder: Ladder,
    stick: Yardstick,
    witness: Witness,
    thresholds: Mapping[str, float] | None,
) -> tuple[Candidate, ...]:
    """The claimed effects, each with what it brought on its rung, and what else was most probable alone."""
    added = climbed.top.hypothesis.labels
    first = climbed.rankings[0]
    alike = {f.hypothesis.label for f in members} if undecided == 0 else set()
    listed = [f for f in first.ordered() if f.hypothesis.label not in added]
    kept = [f for f in listed if f.hypothesis.label in alike or (sizes(case, f) and not at_bound(case, f))]
    shown = kept[: max(case.settings.candidates - len(added), 1)]
    shown += [f for f in listed if f not in shown and f.hypothesis.label in alike]
    result: list[Candidate] = []
    chance = 1.0
    for rung, (below, model) in enumerate(zip(climbed.rankings, climbed.models[1:], strict=False), start=1):
        chance *= below.probabilities[model.hypothesis.label]
        before, after = ladder.rungs[rung - 1], ladder.rungs[rung]
        made = _candidate(case, below, model, stick, witness, thresholds)
        result.append(
            replace(
                made,
                probability=chance,
                # of the final model: what is added later bends what was fitted before
                parameters=sizes(case, climbed.top, model.hypothesis.labels[-1]),
                heldout_before=before.heldout_error,
                heldout_error_after=after.heldout_error,
                claimed=True,
            )
        )
        if undecided == rung - 1 > 0:
            others = [f for f in members if f.hypothesis.label != model.hypothesis.label]
            share = chance / below.probabilities[model.hypothesis.label]
            for f in others:
                rival = _candidate(case, below, f, stick, witness, thresholds)
                result.append(replace(rival, probability=share * rival.probability))
    told = {c.label for c in result}
    for f in [f for f in shown if f.hypothesis.label not in told]:
        made = _candidate(case, first, f, stick, witness, thresholds)
        heldout = float("nan")
        if f.hypothesis.label in alike:
            heldout = stick.heldout_error(f, held_out(case, f, stick.fit, case.settings.folds))
        result.append(
            replace(made, heldout_before=ladder.rungs[0].heldout_error, heldout_error_after=heldout)
        )
    return tuple(sorted(result, key=lambda c: -c.probability))


def _candidate(
    case: Case,
    ranking: Ranking,
    f: Fitted,
    stick: Yardstick,
    witness: Witness,
    thresholds: Mapping[str, float] | None,
) -> Candidate:
    """A hypothesis beside the base model of its ranking; held-out data are left open."""
    title, signs = describe(f.hypothesis, case.library)
    family, _, place = f.hypothesis.labels[-1].partition("@")
    before, after = witness.error(ranking.base), witness.error(f)
    better, impacts = better_share(before, after)
    return Candidate(
        effect=family,
        at=place,
        title=title,
        probability=ranking.probabilities[f.hypothesis.label],
        parameters=sizes(case, f),
        error_before=stick.error(ranking.base),
        error_after=stick.error(f),
        heldout_before=float("nan"),
        heldout_error_after=float("nan"),
        gain=ranking.gain(f),
        threshold=threshold(f.hypothesis.family, case.settings.gain_least, thresholds),
        log_evidence=ranking.log_evidence(f),
        claimed=False,
        why=why(ranking.base, f, case.measured, signs),
        frf_error_before=before.error,
        frf_error_after=after.error,
        frf_impacts_better=better,
        frf_impacts=impacts,
    )


def _where(localised: Sequence[Localisation]) -> str:
    """Where the misfit sits, and what the data do not tell from it."""
    if not localised:
        return ""
    first, *rest = localised
    also = [
        x.place if x.acts_like == first.acts_like else f"{x.place} as {x.acts_like}"
        for x in rest
        if x.score > _AS_GOOD * first.score
    ]
    or_at = f" (or at {', or at '.join(also)}: these data hardly tell)" if also else ""
    return f" The misfit sits at {first.place} and acts like {first.acts_like}{or_at}."
