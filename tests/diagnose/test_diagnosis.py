"""The diagnosis by modes: what is named on imperfect rigs, what stays silent, and every verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from frequencies import from_frequencies
from imperfect_modes import GOOD, NORMAL, Hidden, Lab, chain, chain_modes, planetary_modes

from ema_pipeline import codec
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.claims import judge, left_of_close_modes
from ema_pipeline.diagnose.diagnosis import diagnose
from ema_pipeline.diagnose.explained import at_usual_scatters, explanation, outlying_damping
from ema_pipeline.diagnose.heldout import HeldOut, held_out
from ema_pipeline.diagnose.hypotheses import list_hypotheses
from ema_pipeline.diagnose.ranked import BEATEN
from ema_pipeline.diagnose.ranking import rank
from ema_pipeline.diagnose.rungs import make_ladder
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, UNKNOWN, DetectionLimit, Diagnosis, EffectSize
from ema_pipeline.effects.base import Effect
from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.inference import Posterior, Residuals, Unknowns
from ema_pipeline.inference.posterior import error_limit
from ema_pipeline.mechanics.assembly import Damper, Element, Mass, Spring
from ema_pipeline.number_text import format_value
from ema_pipeline.observations.fitting import Fit, Model, at_scatters, fit_base, learned
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.rigs.types import Rig

diagnosis: Any = import_module("ema_pipeline.diagnose.diagnosis")
claims: Any = import_module("ema_pipeline.diagnose.claims")
SETTINGS = DiagnoseSettings(processes=1)
GENERIC = {k: v for k, v in shipped_effects().items() if k in ("spring", "mass", "damper")}
MESHES = {k: shipped_effects()[k] for k in ("mesh_stiffness_loss", "planet_bearing_mistune", "shaft_torsion")}


def observed(rig: Rig, measured: Mapping[str, MeasuredModes]) -> ModeObservations:
    return ModeObservations(rig, [prepare(m) for m in measured.values()])


def of_chain(
    seed: int,
    hidden: Hidden | None = None,
    lab: Lab = NORMAL,
    library: Mapping[str, Effect] | None = None,
    settings: DiagnoseSettings = SETTINGS,
) -> Diagnosis:
    rig = chain()
    return diagnose(observed(rig, chain_modes(seed, lab, hidden)), rig, library or GENERIC, None, settings)


def added(element: type, size: float, row: dict[str, float]) -> Hidden:
    made: Element = element("hidden", row, size)
    return Hidden(added=(made,))


def names_of(found: Diagnosis) -> set[str]:
    """What is said to be missing, under all its names."""
    claimed = [c for c in found.candidates if c.claimed]
    return {label for c in claimed for label in (c.label, *c.equivalents)}


# --- a chain as laboratories have it ------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [11, 12])
def test_a_healthy_chain_whose_parts_and_sensors_scatter_is_adequate(seed: int) -> None:
    found = of_chain(seed)
    assert found.verdict == "adequate"
    assert not names_of(found)
    assert 0.6 < found.error < 1.4
    assert found.probabilities[NOTHING] == max(found.probabilities.values())
    assert found.ladder.rungs[0].effects == ()
    assert len(found.ladder.rungs) == 1


@pytest.mark.parametrize(
    ("hidden", "label", "truth", "seed"),
    [
        (added(Spring, 2e5, {"m2.z": 1.0}), "spring@m2", 2e5, 1),
        pytest.param(
            added(Spring, 2.5e5, {"m1.z": -1.0, "m3.z": 1.0}),
            "spring@m1-m3",
            2.5e5,
            2,
            marks=pytest.mark.slow,
        ),
        pytest.param(added(Mass, 0.8, {"m4.z": 1.0}), "mass@m4", 0.8, 3, marks=pytest.mark.slow),
        pytest.param(added(Damper, 120.0, {"m3.z": 1.0}), "damper@m3", 120.0, 4, marks=pytest.mark.slow),
    ],
)
def test_what_is_hidden_in_a_chain_is_named_with_its_size(
    hidden: Hidden, label: str, truth: float, seed: int
) -> None:
    found = of_chain(seed, hidden)
    assert found.verdict in ("effect", "ambiguous")
    first = found.candidates[0]
    assert label in (first.label, *first.equivalents)
    assert first.claimed
    (size,) = first.parameters.values()
    assert abs(size.value - truth) < 3 * size.std
    assert size.std < 0.5 * truth
    assert found.ladder.rungs[-1].error < 1.5
    limit, healthy = (
        {d.label: d.size for d in f.detection_limits}[first.label] for f in (found, of_chain(seed))
    )
    assert limit == pytest.approx(healthy, rel=0.4)  # that of the rig without it
    assert size.std < limit
    assert first.log_evidence > SETTINGS.claim
    assert first.heldout_error_after < first.heldout_error_before


@pytest.mark.parametrize(
    ("wrong", "close", "doubted"), [((1,), (1, 2), True), ((1,), (2, 3), False), ((1, 2), (1, 2), False)]
)
def test_no_effect_is_claimed_for_the_shape_of_one_close_mode_alone(
    wrong: tuple[int, ...], close: tuple[int, ...], doubted: bool
) -> None:
    block = np.repeat(np.arange(4), 6)

    def fit(off: tuple[int, ...]) -> Fit:
        values = np.where(np.isin(block, off), 20.0, 0.5)
        unknowns = Unknowns.plain(("a",), 1.0)
        residuals = Residuals(values, np.zeros((24, 1)), block=block, mixed=np.isin(block, close))
        return Fit(Model(), Posterior(unknowns, np.zeros(1), {}, residuals))

    left = left_of_close_modes(fit(wrong), fit(()))
    assert (left < SETTINGS.claim) is doubted


def test_evidence_that_rests_on_modes_that_tests_split_or_merge_does_not_count() -> None:
    """Of measured modes 3 and 7 without a partner, and of shapes that an added mode is said to hide in."""

    def fit(
        modes: tuple[int, ...], off: tuple[int, ...], hides: tuple[int, ...] = (), doubles: int = 0
    ) -> Fit:
        mode = np.repeat(modes, 6)
        values = np.where(np.isin(mode, off), 20.0, 0.5)
        residuals = Residuals(
            values,
            np.zeros((len(mode), 1)),
            block=np.repeat(np.arange(len(modes)), 6),
            mode=mode,
            blurred=np.isin(mode, hides),
            split=12.0 * doubles,
            penalty=12.0 * doubles,
        )
        return Fit(Model(), Posterior(Unknowns.plain(("a",), 1.0), np.zeros(1), {}, residuals))

    def gained(base: Fit, mended: Fit) -> float:
        return base.posterior.residuals.cost - mended.posterior.residuals.cost

    base = fit((1, 2, 5), off=(5,))
    honest, hiding = fit((1, 2, 5), ()), fit((1, 2, 5), (), hides=(5,))
    assert left_of_close_modes(base, honest) == pytest.approx(gained(base, honest))
    left = left_of_close_modes(base, hiding)
    usual = Residuals(np.ones(6), np.zeros((6, 1)), block=np.zeros(6, int)).cost
    assert left == pytest.approx(usual - fit((5,), ()).posterior.residuals.cost)
    assert left < 3 < gained(base, hiding)
    hidden_before = fit((1, 2, 5), off=(5,), hides=(5,))
    assert left_of_close_modes(hidden_before, hiding) == pytest.approx(gained(hidden_before, hiding))
    other = fit((1, 2, 5, 7), ())  # a mode that had no partner moves the blocks of none
    assert left_of_close_modes(base, other) == pytest.approx(gained(base, other))
    split = fit((1, 2, 5), off=(5,), doubles=1)
    assert left_of_close_modes(split, other) == pytest.approx(gained(split, other) - 12.0)


@pytest.mark.slow
def test_two_hidden_effects_are_found_one_after_the_other() -> None:
    hidden = Hidden(added=(Spring("a", {"m2.z": 1.0}, 4e5), Mass("b", {"m5.z": 1.0}, 1.0)))
    found = of_chain(5, hidden, GOOD)
    assert {"spring@m2", "mass@m5"} <= names_of(found)
    assert found.verdict in ("effect", "ambiguous")
    assert [len(r.effects) for r in found.ladder.rungs] == [0, 1, 2]
    errors = [r.error for r in found.ladder.rungs]
    assert errors == sorted(errors, reverse=True)


def test_an_effect_far_below_its_limit_is_not_claimed() -> None:
    found = of_chain(6, added(Spring, 2e3, {"m2.z": 1.0}))
    assert found.verdict == "adequate"
    limits = {d.label: d.size for d in found.detection_limits}
    assert limits["spring@m2"] > 4e3


def test_an_effect_that_the_library_lacks_is_unknown_and_its_place_is_told() -> None:
    only = {k: v for k, v in GENERIC.items() if k == "damper"}
    found = of_chain(7, added(Spring, 1.6e6, {"m3.z": 1.0}), GOOD, only)
    assert found.verdict == "unknown_effect"
    assert found.detection_limits == ()
    assert "force levels" in found.next_measurement


@pytest.mark.slow
def test_a_mass_that_only_one_part_far_off_can_follow_is_unknown_to_a_library_without_masses() -> None:
    only = {k: v for k, v in GENERIC.items() if k == "damper"}
    found = of_chain(3, added(Mass, 0.5, {"m4.z": 1.0}), library=only)
    assert found.verdict == "unknown_effect"
    assert found.error > SETTINGS.error_limit
    assert "mass 4 +" in found.summary
    assert found.notes == ()
    assert found.null_probability == found.probabilities[NOTHING] == 0.0
    assert found.probabilities[UNKNOWN] > 0.5
    assert sum(found.probabilities.values()) == pytest.approx(1)
    for c in found.candidates:  # what does not mend the model is not probable, whatever evidence it gains
        assert c.probability <= 0.5
        assert c.probability == pytest.approx(found.probabilities[c.label])


def test_a_damper_is_not_taken_for_scatter_of_damping_by_a_library_without_dampers() -> None:
    only = {k: v for k, v in GENERIC.items() if k != "damper"}
    found = of_chain(22, added(Damper, 400.0, {"m3.z": 1.0}), library=only)
    assert found.verdict == "unknown_effect"
    assert found.error < found.error_limit  # the scatter of damping, which is learned, hides it
    assert "The damping ratios scatter by 1" in found.summary
    assert "more than the 50 %" in found.summary
    assert of_chain(22, library=only).verdict == "adequate"


@pytest.mark.parametrize(("scatter", "outlying"), [(0.4, False), (1.6, True)])
def test_damping_that_scatters_too_much_is_told_whether_it_is_what_is_left_or_an_unknown(
    scatter: float, outlying: bool
) -> None:
    rig = chain()
    observations = observed(rig, chain_modes(4, replace(NORMAL, damping=scatter)))
    model = Model((parse_effect("damper@m3", rig, library=GENERIC),))
    suited = observations.suited(model.effects)
    assert suited.own_damping
    assert not observations.own_damping
    fits = [learned(o, fit_base(o, Model())) for o in (observations, suited)]
    told = [outlying_damping(o, fit) for o, fit in zip((observations, suited), fits, strict=True)]
    assert [one is not None for one in told] == [outlying, outlying]
    if outlying:
        # some of it may be that of joints, of which there are more
        assert 1.0 < told[1].scatter < told[0].scatter


def test_a_model_that_only_a_larger_scatter_than_usual_explains_fails() -> None:
    only = {k: v for k, v in GENERIC.items() if k == "damper"}
    found = of_chain(1, added(Spring, 3e4, {"m1.z": 1.0, "m4.z": -1.0}), GOOD, only)
    assert found.verdict == "unknown_effect"
    assert found.error < found.error_limit
    assert "with the usual one the error is 1.4" in found.summary
    observations = observed(chain(), chain_modes(1, GOOD))
    right = learned(observations, fit_base(observations, Model()))
    assert at_usual_scatters(observations, right) is right


# --- the planetary rig ------------------------------------------------------------------------------------------


@cache
def cracked() -> Diagnosis:
    rig = planetary()
    measured = planetary_modes(rig, 1, GOOD, Hidden({"sun-planet1 mesh": 0.65}), ("no_ring",))
    return diagnose(observed(rig, measured), rig, MESHES, None, SETTINGS)


def test_a_cracked_mesh_is_named_with_its_size() -> None:
    found = cracked()
    assert found.verdict == "effect"
    first = found.candidates[0]
    assert first.label == "mesh_stiffness_loss@sun-planet1"
    size = first.parameters["fraction"]
    assert abs(size.value - 0.35) < 3 * size.std
    assert 0.002 < size.std < 0.1


def test_the_error_of_one_model_is_one_number() -> None:
    found = cracked()
    first = found.candidates[0]
    bottom, top = found.ladder.rungs
    assert found.error == bottom.error
    assert found.heldout_error == bottom.heldout_error
    assert first.error_before == pytest.approx(bottom.error, rel=0.02)
    assert first.error_after == pytest.approx(top.error, rel=0.02)


def test_probabilities_of_all_hypotheses_and_of_nothing_add_up_to_one() -> None:
    found = cracked()
    assert sum(found.probabilities.values()) == pytest.approx(1)
    assert found.probabilities[NOTHING] == found.null_probability < 1e-3


def test_the_limit_of_a_claimed_effect_is_that_of_the_symmetric_rig_without_it() -> None:
    """Meshes scatter by more than a per cent, so that no loss far below that can show in one of them."""
    found = cracked()
    limits = {d.label: d.size for d in found.detection_limits}
    size = found.candidates[0].parameters["fraction"]
    assert 2 * size.std < limits["mesh_stiffness_loss@sun-planet1"] < size.value


def test_a_diagnosis_survives_the_store(tmp_path: Path) -> None:
    found = cracked()
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "d", found)
        back = codec.read(file, "d", Diagnosis)
    assert repr(back.candidates) == repr(found.candidates)
    assert [r.error for r in back.ladder.rungs] == [r.error for r in found.ladder.rungs]
    assert back.ladder.scatters == found.ladder.scatters
    assert back.probabilities == found.probabilities
    assert back.detection_limits == found.detection_limits


def test_a_healthy_planetary_rig_with_parts_that_differ_is_adequate() -> None:
    rig = planetary()
    measured = planetary_modes(rig, 3, NORMAL, configurations=("no_ring",))
    found = diagnose(observed(rig, measured), rig, MESHES, None, SETTINGS)
    assert found.verdict == "adequate"
    assert 0.6 < found.error < 1.4


def test_a_support_far_out_of_its_tolerance_is_named_by_its_parameter() -> None:
    rig = planetary()
    hidden = Hidden({"sun bearing x": 1.8, "sun bearing y": 1.8})
    measured = planetary_modes(rig, 3, GOOD, hidden, ("no_ring",))
    found = diagnose(observed(rig, measured), rig, MESHES, None, SETTINGS)
    first = found.candidates[0]
    assert first.label == "out_of_tolerance@sun_bearing_stiffness"
    size = first.parameters["relative_change"]
    assert size.value == pytest.approx(0.8, abs=max(0.1, 3 * size.std))


def test_frequencies_that_scatter_more_than_usual_speak_against_a_model_that_follows_all_other_data() -> None:
    """Three hundred entries of shapes hide it in the error of all data."""
    rig = planetary()
    aslant = added(Spring, 7.0e6, {"sun.x": 1.0, "sun.y": 1.0})  # no part of the rig couples x and y
    observations = observed(rig, planetary_modes(rig, 5, GOOD, aslant, ("no_ring", "with_ring")))
    told = explanation(observations, learned(observations, fit_base(observations, Model())), SETTINGS)
    error, count = told.telling
    assert told.fails
    assert told.by_scatter == error < error_limit(count, SETTINGS.error_limit)


def test_what_is_known_already_is_not_looked_for_again() -> None:
    rig = planetary()
    measured = planetary_modes(rig, 1, GOOD, Hidden({"sun-planet1 mesh": 0.65}), ("no_ring",))
    label = "mesh_stiffness_loss@sun-planet1"
    known = Model().plus(parse_effect(label, rig), {})
    found = diagnose(observed(rig, measured), rig, MESHES, known, SETTINGS)
    assert found.verdict == "adequate"
    assert label not in found.probabilities
    assert found.ladder.rungs[0].effects == (label,)


# --- verdicts, groups and held-out data ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_a_spring_to_ground_of_a_free_rig_is_named_though_the_mode_that_it_holds_has_little_damping(
    seed: int,
) -> None:
    """What lifts a mode from 0 Hz may lose nothing; and where it is, that mode is in the band."""
    (modes,) = chain_modes(seed, hidden=added(Spring, 8e4, {"m1.z": 1.0}), held=False).values()
    assert modes.frequency_hz[0] < 16 < 30 < modes.frequency_hz[1]
    damping = modes.damping_ratio.copy()
    damping[0] *= 0.06
    modes = replace(modes, damping_ratio=damping, damping_std=0.02 * damping)
    rig = chain(held=False)
    found = diagnose(observed(rig, {"all": modes}), rig, GENERIC, None, SETTINGS)
    assert found.verdict == "effect"
    assert found.ladder.rungs[-1].error < 1.3
    (first,) = (c for c in found.candidates if c.claimed)
    assert "spring@m1" in (first.label, *first.equivalents)
    assert abs(first.parameters["stiffness"].value - 8e4) < 3 * first.parameters["stiffness"].std
    (limit,) = (one.size for one in found.detection_limits if one.label == "spring@m1")
    assert limit < 8e4


def test_effects_that_explain_the_data_alike_are_a_group_with_a_measurement_that_parts_them() -> None:
    # no shapes: a symmetric chain tells nothing of left or right
    measured = chain_modes(8, GOOD, added(Spring, 4e5, {"m2.z": 1.0}))["all"]
    plain = from_frequencies("all", measured.frequency_hz)
    rig = chain()
    found = diagnose(observed(rig, {"all": plain}), rig, {"spring": GENERIC["spring"]}, None, SETTINGS)
    assert found.verdict == "ambiguous"
    group = set(found.indistinguishable[0])
    assert {"spring@m2", "spring@m4"} <= group
    listed = {c.label for c in found.candidates}
    assert group <= listed
    assert found.next_measurement


def test_three_frequencies_do_not_name_an_effect() -> None:
    rig = planetary()
    one = {"with_ring": from_frequencies("with_ring", [47.0, 98.0, 519.0])}
    found = diagnose(observed(rig, one), rig, MESHES, None, SETTINGS)
    assert found.verdict == "not_enough_data"
    assert not names_of(found)


def test_modes_far_from_a_rig_with_values_in_a_wrong_unit_are_not_too_few() -> None:
    """Masses in grams: no measured mode has a partner, so that nothing is compared."""
    right = chain(3)
    rig = replace(
        right, build=lambda name, values: right.assembly(name, {**values, "mass": 1000 * values["mass"]})
    )
    found = diagnose(
        observed(rig, chain_modes(3, GOOD, masses=3)), rig, {"mass": GENERIC["mass"]}, None, SETTINGS
    )
    assert found.verdict == "unknown_effect"
    assert found.next_measurement.startswith("Check values and units in the rig file")


def test_the_right_effect_predicts_what_was_held_out_and_a_wrong_one_does_not() -> None:
    rig = chain()
    observations = observed(rig, chain_modes(9, GOOD, added(Mass, 1.0, {"m4.z": 1.0})))
    right = learned(observations, _with(observations, "mass@m4"))
    scatters = right.posterior.scatters
    fits = {"nothing": fit_base(observations, Model()), "damper@m1": _with(observations, "damper@m1")}
    density = {k: held_out(observations, at_scatters(observations, f, scatters)) for k, f in fits.items()}
    best = held_out(observations, right)
    assert best.log_density > max(d.log_density for d in density.values()) + 3
    assert best.error < 1.5 < density["nothing"].error


def _with(observations: ModeObservations, label: str) -> Fit:
    return fit_base(observations, Model().plus(parse_effect(label, observations.rig), {}))


def test_an_effect_is_claimed_only_where_everything_supports_it() -> None:
    rig = chain()
    observations = observed(rig, chain_modes(10, NORMAL))
    base = fit_base(observations, Model())
    ranking = rank(observations, base, list_hypotheses(rig, GENERIC), 1)
    judged = [judge(observations, ranking, r, SETTINGS) for r in ranking.ranked if r.final]
    assert judged
    assert not any(j.claimed for j in judged)
    assert all(j.doubt for j in judged)
    dearer = SETTINGS.model_copy(update={"claim": 50.0})  # as for a further effect
    again = judge(observations, ranking, judged[0].ranked, dearer)
    assert (judged[0].needed, again.needed) == (SETTINGS.claim, 50.0)
    assert again.doubt.endswith("is below 50")


def test_nothing_is_held_out_for_what_is_far_behind_a_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def held_out_of_each(observations: object, fits: Sequence[Fit], processes: object) -> list[HeldOut]:
        asked.append(fits)
        return [HeldOut(1.0, 0.0)] * len(fits)

    monkeypatch.setattr(claims, "held_out_of_each", held_out_of_each)
    rig = chain()
    observations = observed(rig, chain_modes(11, NORMAL, added(Mass, 2.0, {"m3.z": 1.0})))
    ranking = rank(observations, fit_base(observations, Model()), list_hypotheses(rig, GENERIC), 1)
    first = judge(observations, ranking, ranking.ranked[0], SETTINGS)
    second = replace(ranking.ranked[1], gain=first.gain - BEATEN - 0.1)
    assert first.claimed
    assert len(asked) == 1
    for doubt, beaten in (("", True), ("doubted", False)):
        judged = judge(observations, ranking, second, SETTINGS, better=[replace(first, doubt=doubt)])
        assert (judged.doubt == claims.FAR_BEHIND) is beaten
    near = replace(second, gain=first.gain - BEATEN + 0.1)
    assert judge(observations, ranking, near, SETTINGS, better=[first]).doubt != claims.FAR_BEHIND


def test_learned_scatters_are_those_of_the_laboratory() -> None:
    found = of_chain(15, lab=NORMAL)
    told = {s.name: s for s in found.ladder.scatters}
    assert {"part_scatter", "calibration", "damping_scatter", "frequency_scatter", "shape_scatter"} <= set(
        told
    )
    assert told["part_scatter"].stated == 0.02
    assert 0.008 < told["part_scatter"].learned < 0.06
    assert 0.01 < told["calibration"].learned < 0.1


@pytest.mark.slow
def test_the_number_of_processes_does_not_change_a_digit() -> None:
    hidden, library = added(Spring, 2e5, {"m2.z": 1.0}), {"mass": GENERIC["mass"]}
    settings = [SETTINGS.model_copy(update={"processes": n, "most_effects": 1}) for n in (1, 2)]
    one, two = (of_chain(1, hidden, library=library, settings=s) for s in settings)
    assert one.probabilities == two.probabilities
    assert repr(one.ladder) == repr(two.ladder)


@pytest.mark.slow
def test_effects_that_cannot_be_pickled_are_fitted_in_other_processes_too() -> None:
    own = replace(GENERIC["spring"], id="my_spring", find_places=lambda a: a.bodies, generic=False)
    found = of_chain(
        1,
        added(Spring, 2e5, {"m2.z": 1.0}),
        library={"my_spring": own},
        settings=SETTINGS.model_copy(update={"processes": 2, "most_effects": 1}),
    )
    assert found.candidates[0].label == "my_spring@m2"


def test_a_ladder_of_given_effects_is_measured_at_one_yardstick() -> None:
    rig = planetary()
    measured = planetary_modes(rig, 1, GOOD, Hidden({"sun-planet1 mesh": 0.65}), ("no_ring",))
    model = Model().plus(parse_effect("mesh_stiffness_loss@sun-planet1", rig), {})
    up = make_ladder(observed(rig, measured), [Model(), model])
    assert [r.effects for r in up.rungs] == [(), ("mesh_stiffness_loss@sun-planet1",)]
    assert up.rungs[1].error < 1.3 < up.rungs[0].error
    assert up.rungs[1].heldout_error < up.rungs[0].heldout_error
    assert up.rungs[1].error == pytest.approx(cracked().ladder.rungs[1].error, rel=0.05)


# --- data that are hard to work with ----------------------------------------------------------------------------


@pytest.mark.slow
def test_hopeless_data_give_a_verdict_and_no_error() -> None:
    rig = chain()
    measured = chain_modes(16)["all"]
    assert measured.shapes is not None
    cases = {
        "one mode": from_frequencies("all", [18.0]),
        "all alike": from_frequencies("all", [40.0, 40.0, 40.0]),
        "far off": replace(measured, frequency_hz=measured.frequency_hz * [4.0, 0.3, 1.0, 3.0, 0.5]),
        "no shapes": replace(measured, shapes=np.full(measured.shapes.shape, np.nan)),
        "no damping": replace(measured, damping_ratio=np.full(5, np.nan), damping_std=np.full(5, np.nan)),
    }
    for name, modes in cases.items():
        found = diagnose(observed(rig, {"all": modes}), rig, {"mass": GENERIC["mass"]}, None, SETTINGS)
        assert found.verdict in ("adequate", "effect", "ambiguous", "unknown_effect", "not_enough_data"), name
        assert sum(found.probabilities.values()) == pytest.approx(1), name
        assert np.isfinite(found.error), name


def test_no_modes_at_all_are_refused_or_called_too_few() -> None:
    rig = chain()
    found = diagnose(observed(rig, {"all": from_frequencies("all", [])}), rig, GENERIC, None, SETTINGS)
    assert found.verdict == "not_enough_data"
    assert not names_of(found)


@pytest.mark.parametrize(
    ("size", "limit", "largest", "linear", "two_sizes", "alone", "dropped"),
    [(0.9, 3.0, False, True, False, 0, True), (-0.9, 3.0, False, True, False, 0, True),
     (1.1, 3.0, False, True, False, 0, False), (0.9, 3.0, True, True, False, 0, False),
     (0.9, np.inf, False, True, False, 0, False), (0.9, 3.0, False, True, True, 0, True),
     (0.9, 3.0, False, False, False, 0, True), (0.9, 3.0, False, False, True, 0, False),
     (0.9, 3.0, False, True, False, 1, False)],
)  # fmt: skip
def test_what_is_far_too_small_to_be_seen_is_not_claimed(
    monkeypatch: pytest.MonkeyPatch,
    size: float,
    limit: float,
    largest: bool,
    linear: bool,
    two_sizes: bool,
    alone: int,
    dropped: bool,
) -> None:
    """The selection is made once more without it, and the reader is told.

    Of two sizes of an effect that depends on the amplitude, the limit of one says nothing at another value of the
    other. What gives a measured mode its partner shows by that.
    """
    placed = SimpleNamespace(effect=SimpleNamespace(linear=linear))
    one, other = (SimpleNamespace(label=f"spring@{place}", placed=placed) for place in ("m1", "m2"))
    sizes = {"stiffness": EffectSize(size, 0.1, "N/m")}
    sizes |= {"rate": EffectSize(1.0, 0.1, "m/s")} if two_sizes else {}
    named = SimpleNamespace(label=one.label, sizes=sizes)
    asked: list[list[str]] = []

    def leaving(unexplained: int) -> Any:
        return SimpleNamespace(posterior=SimpleNamespace(residuals=SimpleNamespace(unexplained=unexplained)))

    def select(observations: Any, known: Any, hypotheses: Any, settings: Any, progress: Any) -> Any:
        asked.append([h.label for h in hypotheses])
        claim = SimpleNamespace(hypothesis=one, named=named, base=leaving(alone), after=leaving(0))
        claimed = [claim] if one in hypotheses else []
        return SimpleNamespace(claimed=claimed, rounds=[], observations=observations, final=None)

    limits = [DetectionLimit(one.label, "stiffness", limit, "N/m", largest=largest)]
    monkeypatch.setattr(diagnosis, "select", select)
    monkeypatch.setattr(diagnosis, "detection_limits", lambda *given: limits)
    nothing: Any = None
    found, told = diagnosis._selected(nothing, nothing, [one, other], nothing, nothing)
    assert asked == [["spring@m1", "spring@m2"], *([["spring@m2"]] if dropped else [])]
    assert bool(found.claimed) is not dropped
    rate = ", rate 1.00 ± 0.10 m/s" if two_sizes else ""
    text = f"Not claimed: spring at m1, stiffness {format_value(size, 0.1, 'N/m')}{rate}. "
    assert told == ([f"{text}Of such a size these data would show nothing."] if dropped else [])
