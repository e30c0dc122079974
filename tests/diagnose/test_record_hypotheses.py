"""What may be missing in records of two bodies, and which claims whole records take back."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from two_bodies import BEGIN, LIBRARY, STIFFNESS, decaying, rig, steady

from ema_pipeline.diagnose import records
from ema_pipeline.diagnose.records import (
    _OUT_OF_PHASE,
    _linear_change,
    _loose_columns,
    _nothing_claimed,
    _spanned,
    _unconfirmed,
    _with_sizes,
    _withdrawn,
    begun_at,
    record_hypotheses,
    whole_ladder,
)
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, UNKNOWN, Candidate, Diagnosis, EffectSize, Ladder, Rung
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.inference import Unknowns
from ema_pipeline.observations.records import RecordObservations
from ema_pipeline.rigs.types import Rig

__all__ = ["rig"]  # a fixture
NO_HELD_OUT: Any = SimpleNamespace(held_out=())
SETTINGS = DiagnoseSettings(claim=3.5, error_limit=1.5)


@pytest.fixture(scope="module")
def both(rig: Rig) -> RecordObservations:
    return RecordObservations(rig, rig.configurations[0], [steady(), decaying(BEGIN)])


def test_what_a_loose_value_of_the_rig_does_is_no_hypothesis(both: RecordObservations) -> None:
    """Springs and dampers at the first body and between both, and both masses, are values of the rig."""
    found = record_hypotheses(both, LIBRARY)
    labels = {h.label for h in found}
    nonlinear = {
        f"{e}@{p}"
        for e in ("cubic_spring", "quadratic_spring", "dry_friction", "hysteresis", "quadratic_damping")
        for p in ("a.x", "b.x", "a-b")
    }
    assert nonlinear <= labels
    assert labels - nonlinear == {"spring@b.x", "damper@b.x", "mass@a-b"}
    assert not {"spring@b.x", "cubic_spring@a.x"} & {
        h.label for h in record_hypotheses(both, LIBRARY, ["spring@b.x", "cubic_spring@a.x"])
    }
    one = next(h for h in found if h.label == "spring@b.x")
    assert one.names[0].label == "spring@b.x"
    assert len(one.begun) == 3


def test_of_identified_modes_only_what_is_not_linear_is_sought_at_the_sensors(
    both: RecordObservations,
) -> None:
    modal = RecordObservations(both.rig, both.configuration, both.data, modal=True, basis=both.basis)
    found = record_hypotheses(modal, LIBRARY)
    assert {h.placed.place for h in found} == {"a.x", "b.x"}
    assert not any(h.placed.effect.linear for h in found)


def test_changes_of_the_matrices_are_counted_in_the_rigs_own(both: RecordObservations) -> None:
    columns = _loose_columns(both)
    assert columns.shape == (12, 6)
    named = dict(zip(both.basis.loose, columns.T, strict=True))
    mass = next(v for n, v in named.items() if n.endswith("(mass)"))
    np.testing.assert_allclose(mass, [1.0, *np.zeros(11)], atol=1e-6)
    spring = next(v for n, v in named.items() if n.endswith("(spring)"))
    np.testing.assert_allclose(spring, [*np.zeros(8), 5e4 / 7e4, 0.0, 0.0, 0.0], atol=1e-6)
    damper = next(v for n, v in named.items() if n.endswith("(damper)"))
    np.testing.assert_allclose(damper, [*np.zeros(4), 40.0 / np.sqrt(7e4 * 2.0), *np.zeros(7)], atol=1e-6)
    placed = parse_effect("spring@b.x", both.rig)
    change = _linear_change(both, placed)
    assert change is not None
    scale = placed.effect.parameters[0].scale
    np.testing.assert_allclose(change, [*np.zeros(11), scale / np.max(STIFFNESS)])
    assert _linear_change(both, parse_effect("cubic_spring@b.x", both.rig)) is None
    assert not _spanned(change, columns)
    assert _spanned(columns @ np.arange(1.0, 7.0), columns)
    assert _spanned(np.zeros(12), columns)
    along = columns @ np.arange(1.0, 7.0)
    across = change - columns @ np.linalg.lstsq(columns, change, rcond=None)[0]
    apart = across / np.linalg.norm(across) * np.linalg.norm(along)
    assert _spanned(along + 0.9e-5 * apart, columns)
    assert not _spanned(along + 1.1e-5 * apart, columns)


# --- claims against whole records ----------------------------------------------------------------------------------


def rung(log_evidence: float, effects: tuple[str, ...] = (), error: float = 1.0, **sizes: float) -> Rung:
    parameters = {
        n.replace("_at_", "@").replace("__", "."): EffectSize(v, 0.1, "N") for n, v in sizes.items()
    }
    return Rung(effects, error, 2.0, 1.0, parameters, log_evidence, 0, unknowns={"a": 1.0, "b": 2.0})


def ladder(*rungs: Rung, note: str = "") -> Ladder:
    return Ladder(rungs, 0.0, 0.0, 0.0, note)


def candidate(label: str, gain: float, claimed: bool = True) -> Candidate:
    effect, _, place = label.partition("@")
    sizes = {"size": EffectSize(1.0, 0.1, "N")}
    return Candidate(effect, place, "", 0.5, sizes, 9.0, 1.0, 9.0, 1.0, gain, 3.5, claimed, "Its signs.")


def diagnosis(
    *candidates: Candidate, verdict: Any = "effect", groups: tuple[tuple[str, ...], ...] = ()
) -> Diagnosis:
    odds = {c.label: 0.4 for c in candidates} | {NOTHING: 0.2}
    return Diagnosis(verdict, "", 0.2, candidates, groups, "", (), odds, 9.0, 9.0, ladder(rung(0.0)))


def test_a_claim_stands_where_whole_records_gain_enough_by_it() -> None:
    found = diagnosis(candidate("a@x", 100.0), candidate("w@x", 50.0, claimed=False), candidate("b@x", 9.0))
    up = (rung(0.0), rung(100.0))
    assert _unconfirmed(NO_HELD_OUT, found, ladder(*up, rung(103.5)), SETTINGS) == ""
    doubt = _unconfirmed(NO_HELD_OUT, found, ladder(*up, rung(103.4)), SETTINGS)
    assert doubt == "its gain in log evidence over whole records, 3.4, is below 3.5"
    assert (
        _unconfirmed(NO_HELD_OUT, found, ladder(*up, rung(103.4), note=f"so far; {_OUT_OF_PHASE}"), SETTINGS)
        == ""
    )
    assert _unconfirmed(NO_HELD_OUT, found, ladder(rung(0.0)), SETTINGS) == ""
    strong = diagnosis(candidate("a@x", 300.0), candidate("c@x", 200.0), candidate("b@x", 9.9))
    doubt = _unconfirmed(NO_HELD_OUT, strong, ladder(*up, rung(120.0)), SETTINGS)
    assert doubt.startswith("its gain in log evidence, 9.9, is below 2 % of that of the other effects")
    enough = diagnosis(candidate("a@x", 300.0), candidate("c@x", 200.0), candidate("b@x", 10.0))
    assert _unconfirmed(NO_HELD_OUT, enough, ladder(*up, rung(120.0)), SETTINGS) == ""


def test_a_claim_that_is_withdrawn_takes_its_group_and_its_rung_with_it() -> None:
    found = diagnosis(
        candidate("a@x", 9.0),
        candidate("b@x", 9.0),
        verdict="ambiguous",
        groups=(("b@x", "c@x"), ("a@x", "d@x")),
    )
    searched = ladder(rung(0.0), rung(5.0, ("a@x",)), rung(9.0, ("a@x", "b@x")))
    kept, left = _withdrawn(found, searched, "of doubt", 5.0)
    assert [(c.label, c.claimed, c.why) for c in kept.candidates] == [
        ("a@x", True, "Its signs."), ("b@x", False, "Not claimed: of doubt.")
    ]  # fmt: skip
    assert (kept.verdict, kept.indistinguishable) == ("effect", (("a@x", "d@x"),))
    assert left.rungs == searched.rungs[:2]
    assert left.note == "the best further effect is b at x, and of doubt"
    assert kept.probabilities == found.probabilities
    other = replace(found, indistinguishable=(("a@x", "d@x"), ("b@x", "c@x")))
    assert _withdrawn(other, searched, "of doubt", 5.0)[0].verdict == "ambiguous"


@pytest.mark.parametrize(
    ("error", "verdict", "named", "nothing"),
    [(1.3, "adequate", 0.25, 0.5), (1.31, "unknown_effect", 0.125, 0.0)],
)
def test_without_the_only_claim_nothing_is_as_probable_as_the_evidence_lost_makes_it(
    error: float, verdict: str, named: float, nothing: float
) -> None:
    found = replace(diagnosis(candidate("a@x", 9.0), candidate("b@x", 1.0, claimed=False)), error_limit=1.3)
    kept = _nothing_claimed(found, error, np.log(4.0))
    assert kept.verdict == verdict
    unknown = {} if nothing else {UNKNOWN: 0.75}
    assert kept.probabilities == pytest.approx({"a@x": named, "b@x": named, NOTHING: nothing} | unknown)
    assert kept.null_probability == pytest.approx(nothing)
    assert [c.probability for c in kept.candidates] == pytest.approx([named, named])
    searched = ladder(rung(0.0, error=error), rung(5.0, ("a@x",)))
    assert _withdrawn(found, searched, "of doubt", np.log(4.0))[0].verdict == verdict


def test_sizes_of_a_candidate_are_those_of_the_last_rung_where_it_has_it() -> None:
    last = replace(rung(0.0, ("a@x",)), parameters={"a@x.size": EffectSize(5.0, 0.2, "N")})
    assert _with_sizes(candidate("a@x", 1.0), last).parameters["size"].value == 5.0
    assert _with_sizes(candidate("b@x", 1.0), last).parameters["size"].value == 1.0


def test_a_fit_begins_at_what_a_rung_knows() -> None:
    problem: Any = SimpleNamespace(
        unknowns=Unknowns.plain(("c", "b"), 1.0), start=lambda: np.array([0.5, 0.7])
    )
    np.testing.assert_array_equal(begun_at(problem, rung(0.0)), [0.5, 2.0])


@pytest.mark.parametrize(
    ("searched", "whole", "kept"), [(0.5, 2.9, True), (0.5, 3.0, False), (2.0, 5.9, True), (2.0, 6.0, False)]
)
def test_where_the_model_loses_step_in_whole_records_windows_stay(
    monkeypatch: pytest.MonkeyPatch, searched: float, whole: float, kept: bool
) -> None:
    def refitted(data: Any, library: Any, searched: Ladder, processes: int) -> Ladder:
        if data == 4 * records.SEARCHED:  # in windows of so many samples
            return replace(searched, rungs=(rung(8.0, error=0.7),))
        return ladder(rung(7.0, error=whole), note="whole")

    monkeypatch.setattr(records, "_refitted", refitted)
    data: Any = SimpleNamespace(in_windows=lambda samples: samples)
    for note, told in (
        ("", _OUT_OF_PHASE),
        ("so far", f"so far; {_OUT_OF_PHASE}"),
        (_OUT_OF_PHASE, _OUT_OF_PHASE),
    ):
        found = whole_ladder(data, {}, ladder(rung(0.0, error=searched), note=note))
        assert found.note == ("whole" if kept else told)
        assert found.rungs[0].error == (whole if kept else 0.7)


def test_what_whole_records_do_not_gain_of_the_only_claim_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    told = replace(diagnosis(candidate("a@x", 9.0)), ladder=ladder(rung(0.0), rung(9.0, ("a@x",))))
    shares: list[float] = []
    whole = {2: ladder(rung(0.0, error=1.2), rung(2.0, ("a@x",))), 1: ladder(rung(0.0, error=1.2))}

    def search(*given: Any, **named: Any) -> Diagnosis:
        progress = given[5]
        progress(0.5, "half")
        return told

    monkeypatch.setattr(records, "in_windows", lambda data: None)
    monkeypatch.setattr(records, "record_hypotheses", lambda *given: ())
    monkeypatch.setattr(records, "record_model", lambda *given: None)
    monkeypatch.setattr(records, "diagnose", search)
    monkeypatch.setattr(
        records, "whole_ladder", lambda data, library, searched, processes: whole[len(searched.rungs)]
    )
    data: Any = SimpleNamespace(rig=None, held_out=())
    found = records.diagnose_records(data, {}, (), SETTINGS, lambda share, text: shares.append(share))
    assert found.verdict == "adequate"
    odds = 0.4 * np.exp(-(9.0 - 2.0))
    assert found.null_probability == pytest.approx(0.2 / (0.2 + odds))
    assert shares == [0.425, 0.85]
    monkeypatch.setitem(whole, 2, ladder(rung(0.0, error=1.2), rung(30.0, ("a@x",))))
    assert records.diagnose_records(data, {}, (), SETTINGS).verdict == "effect"


def test_the_diagnosis_tells_errors_and_sizes_of_whole_records() -> None:
    found = diagnosis(candidate("a@x", 9.0), candidate("b@x", 1.0, claimed=False))
    last = replace(rung(9.0, ("a@x",), error=1.1), parameters={"a@x.size": EffectSize(5.0, 0.2, "N")})
    whole = ladder(rung(0.0, error=8.0), rung(5.0, error=4.0), last)
    told = records._with_whole(found, whole)
    assert (told.error, told.heldout_error, told.ladder) == (8.0, 2.0, whole)
    assert told.candidates[0].parameters["size"].value == 5.0
    assert told.summary.startswith("Missing from the model: a at x")
    assert "8" in told.summary
    assert "1.1" in told.summary
    assert " b " not in told.summary
    ambiguous = replace(found, verdict="ambiguous", summary="as it was")
    assert records._with_whole(ambiguous, whole).summary == "as it was"


def test_a_ladder_of_effects_is_searched_where_no_known_one_has_just_these(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(records, "record_model", lambda data, library, labels: tuple(labels))
    monkeypatch.setattr(records, "in_windows", lambda data: "windows")
    monkeypatch.setattr(records, "make_ladder", lambda data, models: (data, models))
    monkeypatch.setattr(records, "whole_ladder", lambda data, library, known, processes: known)
    data: Any = None
    effects = ["a@x", "b@x"]
    searched = ("windows", [(), ("a@x",), ("a@x", "b@x")])
    known = ladder(rung(0.0), rung(1.0, ("a@x",)), rung(2.0, ("a@x", "b@x")))
    for other in (None, ladder(), ladder(rung(0.0), rung(1.0, ("a@x",)))):
        assert records.records_ladder(data, {}, effects, other) == searched
    assert records.records_ladder(data, {}, effects, known) is known
