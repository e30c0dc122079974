"""What may be missing, how it is called, what it promises, and what the data would have shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from imperfect_modes import GOOD, NORMAL, Hidden, chain, chain_modes
from scipy.stats import norm

from ema_pipeline.diagnose.detection_limits import _Shown, detection_limits
from ema_pipeline.diagnose.hypotheses import (
    Hypothesis,
    Name,
    _change,
    _starts_of,
    list_hypotheses,
    size_starts,
)
from ema_pipeline.diagnose.localise import localise
from ema_pipeline.diagnose.naming import in_said_names, named, sizes_of
from ema_pipeline.diagnose.probability import against_nothing, needed, null_prior, prior
from ema_pipeline.diagnose.rungs import with_gains
from ema_pipeline.diagnose.score import Score, scores
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Rung
from ema_pipeline.effects.base import EffectParameter, PlacedEffect
from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.inference import Residuals
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.observations.fitting import Fit, Model, fit_base, learned, refined
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.rigs.types import Parameter, Rig


def by_name(rig: Rig) -> dict[str, Hypothesis]:
    """Hypotheses by each of their names."""
    return {n.label: h for h in list_hypotheses(rig, shipped_effects()) for n in h.names}


@cache
def of_planetary() -> dict[str, Hypothesis]:
    return by_name(planetary())


@cache
def of_chain() -> dict[str, Hypothesis]:
    return by_name(chain())


# --- identical physics ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("own", "generic"),
    [
        ("shaft_torsion@sun", "spring@sun.u"),
        ("local_damper@sun", "damper@sun"),
        ("planet_mass_mistune@planet1", "mass@planet1"),
    ],
)
def test_a_rigs_own_effect_and_the_generic_one_of_the_same_physics_are_one_hypothesis(
    own: str, generic: str
) -> None:
    one = of_planetary()[own]
    assert one is of_planetary()[generic]
    assert one.names[0].label == own
    assert not one.generic


def test_no_physics_is_listed_twice_and_every_name_once() -> None:
    hypotheses = list_hypotheses(planetary(), shipped_effects())
    labels = [n.label for h in hypotheses for n in h.names]
    assert len(labels) == len(set(labels))
    assert len({h.label for h in hypotheses}) == len(hypotheses)


def test_a_body_of_one_direction_and_its_dof_are_one_place() -> None:
    assert of_chain()["spring@m2"] is of_chain()["spring@m2.z"]
    assert of_chain()["mass@m2"] is of_chain()["mass@m2.z"]
    assert of_chain()["spring@m2"] is not of_chain()["spring@m3"]
    assert of_chain()["spring@m2-m3"] is not of_chain()["damper@m2-m3"]


def test_a_loss_and_a_spring_of_opposite_sign_are_different_hypotheses_or_names_of_one() -> None:
    # what is said follows the sign, see the tests of names
    loss = of_planetary()["mesh_stiffness_loss@sun-planet1"]
    assert all(n.placed.effect.id != "spring" for n in loss.names)


def test_parameters_that_are_known_may_be_out_of_tolerance_and_free_ones_may_not() -> None:
    assert "out_of_tolerance@sun_bearing_stiffness" in of_planetary()
    assert "out_of_tolerance@sun_planet_mesh_stiffness" not in of_planetary()
    assert "out_of_tolerance@pressure_angle_deg" not in of_planetary()


def test_a_strut_whose_tolerance_is_not_stated_may_be_off_as_well(tmp_path: Path) -> None:
    """No generic spring lies along an oblique one."""
    file = tmp_path / "rig.toml"
    file.write_text(
        """name = "strut"
[parameters]
k1 = 1e5
[[masses]]
at = "m1.x"
value = 1.0
[[masses]]
at = "m1.y"
value = 1.0
[[springs]]
name = "k1"
value = "k1"
row = { "m1.x" = 0.6, "m1.y" = 0.8 }
[[springs]]
at = "m1.x"
value = 1e5
[[springs]]
at = "m1.y"
value = 2e5
""",
        encoding="utf-8",
    )
    known = by_name(load_rig(file))
    assert known["out_of_tolerance@k1"] not in [
        known["spring@m1"],
        known["spring@m1.x"],
        known["spring@m1.y"],
    ]


def test_effects_that_the_model_has_and_those_that_depend_on_the_level_are_left_out() -> None:
    rig = rig_with_effects(planetary(), ["shaft_torsion@sun"])
    listed = list_hypotheses(rig, shipped_effects(), ["shaft_torsion@sun"])
    labels = {n.label for h in listed for n in h.names}
    assert "shaft_torsion@sun" not in labels
    assert "shaft_torsion@carrier" in labels
    assert not any(x.startswith(("bearing_cubic", "dry_friction", "cubic_spring")) for x in labels)


@pytest.mark.parametrize("name", ["planetary", "gearbox", "frame"])
def test_every_rig_has_generic_springs_masses_and_dampers_at_its_bodies(name: str) -> None:
    rig = load_rig(name)
    known = by_name(rig)
    body = rig.assembly(rig.configurations[0]).bodies[0]
    for effect in ("spring", "mass", "damper"):
        assert f"{effect}@{body}" in known


def test_starts_lie_within_the_range_of_the_size() -> None:
    for hypothesis in of_planetary().values():
        starts = hypothesis.starts()
        assert 1 <= len(starts) <= 4
        assert len({tuple(s.values()) for s in starts}) == len(starts)


# --- names ------------------------------------------------------------------------------------------------


def of_size(start: float, low: float, high: float, null: float = 0.0, unit: str = "N/m") -> EffectParameter:
    return EffectParameter("s", unit, null, start, 1.0, low, high, "")


def test_fits_begin_at_a_few_usual_sizes() -> None:
    """Within the range; of loads in time the first size, and the shape that follows it."""

    def starts(unit: str, p: EffectParameter) -> tuple[float, ...]:
        return _starts_of(unit, SizeMap.of(p, 1.0))

    both, positive, yielding = of_size(1.0, -9.0, 9.0), of_size(1.0, 0.0, 9.0), of_size(1.0, 1e-3, 9.0)
    assert starts("N/m", both) == (0.5, -0.5)
    assert starts("N/m", positive) == (0.3, 2.0)
    assert starts("N/m", yielding) == (0.5, -0.5)
    assert starts("deg", positive) == (0.0, 0.5, 1.0, -0.5)

    def begun(*parameters: EffectParameter) -> list[list[float]]:
        named = tuple(replace(p, name=f"s{k}") for k, p in enumerate(parameters))
        effect = replace(shipped_effects()["spring"], parameters=named)
        return [list(one.values()) for one in size_starts(PlacedEffect(effect, "m1"))]

    assert begun(both) == [[0.1], [0.3], [-0.3]]
    assert begun(positive) == [[0.1], [0.6]]
    assert begun(yielding) == [[-1.0], [0.4], [1.5]]
    assert begun(both, both) == [[0.3, 0.0]]
    assert begun(positive, yielding, yielding) == [[0.3, v, 0.0] for v in (-1.0, 0.4, 1.5)]
    assert begun(of_size(1.0, -0.2, 9.0)) == [[0.1], [0.3], [-0.2]]


@pytest.mark.parametrize(("bent", "told"), [(0.0, True), (1e-6, True), (1e-5, False)])
def test_only_changes_in_proportion_to_a_size_are_told_by_their_matrices(bent: float, told: bool) -> None:
    """By one prior 1 σ of it, of whatever size that is."""
    row = {"m2.z": 1.0}

    def edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
        share = values["s"] / 2e3
        return assembly.add(Spring("more", row, values["s"] * (1 + bent * share)))

    p = EffectParameter("s", "N/m", 0.0, 1e3, 2e3, -1e9, 1e9, "")
    effect = replace(shipped_effects()["spring"], parameters=(p,), edit=edit)
    assembly = chain().assembly("all")
    change = _change(Name(PlacedEffect(effect, "m2"), {}), {"all": assembly})
    assert (change is not None) is told
    if change is not None:
        assert np.count_nonzero(np.abs(change) > 1e-9) == 1
        assert np.max(change) == pytest.approx(2e3, rel=1e-5)


def fitted_on_top(hypothesis: Hypothesis, size: float, rig: Rig, observations: ModeObservations) -> Fit:
    """A fit whose only merit is that the first unknown of the hypothesis has this value."""
    model = Model().plus(hypothesis.placed, hypothesis.scales)
    problem = model.problem(observations)
    x = np.zeros(len(problem.unknowns))
    first = hypothesis.placed.effect.parameters[0]
    x[problem.unknowns.index[hypothesis.placed.parameter_name(first.name)]] = size
    return refined(observations, model, x, steps=0)


def chain_data(seed: int = 0, hidden: Hidden | None = None, lab=GOOD) -> ModeObservations:
    return ModeObservations(chain(), [prepare(m) for m in chain_modes(seed, lab, hidden).values()])


def test_a_stiffer_spring_is_a_spring_added_and_a_softer_one_a_part_out_of_tolerance() -> None:
    # a chain whose first spring has a parameter of its own: 'spring at m1' and the parameter are one physics
    parameters = dict(chain().parameters) | {"first": Parameter("first", 4e5, "N/m", 0.05)}

    def build(configuration: str, values: Mapping[str, float]):
        return (
            chain()
            .build(configuration, values)
            .edit(["spring 0"], lambda e: Spring(e.name, e.row, values["first"]))
        )

    rig = ParametricRig("chain", ("all",), parameters, build)
    known = by_name(rig)
    one = known["out_of_tolerance@first"]
    assert one is known["spring@m1"]
    observations = ModeObservations(rig, [prepare(m) for m in chain_modes(0, GOOD).values()])
    added = named(one, fitted_on_top(one, 0.5, rig, observations))
    assert added.label == "spring@m1"
    assert "out_of_tolerance@first" in added.equivalents
    taken = named(one, fitted_on_top(one, -0.3, rig, observations))
    assert taken.label == "out_of_tolerance@first"
    assert taken.sizes["relative_change"].value < 0


def test_sizes_under_several_names_are_the_same_change_of_the_model() -> None:
    rig = planetary()
    one = of_planetary()["shaft_torsion@sun"]
    observations = ModeObservations(rig, [])
    fit = fitted_on_top(one, 0.4, rig, observations)
    assemblies = []
    for name in one.names:
        sizes = {k: s.value for k, s in sizes_of(one, name, fit).items()}
        if name.placed.effect.id == "out_of_tolerance":
            continue
        edited = name.placed.effect.edit(rig.assembly("with_ring"), name.placed.place, sizes)
        assemblies.append(edited.system().stiffness)
    assert len(assemblies) >= 2
    for other in assemblies[1:]:
        np.testing.assert_allclose(other, assemblies[0], rtol=1e-9, atol=1e-3)


@pytest.mark.parametrize("said", range(2))
def test_a_fit_under_another_name_is_the_same_fit(said: int) -> None:
    one = of_chain()["spring@m1"]
    rig = chain()
    observations = ModeObservations(rig, [prepare(m) for m in chain_modes(0, GOOD).values()])
    fit = fitted_on_top(one, 0.3, rig, observations)
    fit = refined(observations, fit.model, fit.posterior.x, fit.posterior.scatters)
    name = sorted(one.names, key=lambda n: n.label)[said]
    again = in_said_names(observations, fit, [(one, name)])
    assert again.model.labels == (name.label,)
    before, after = (f.model.problem(observations) for f in (fit, again))
    modes = [p.solution("all", f.posterior.x) for p, f in ((before, fit), (after, again))]
    np.testing.assert_allclose(modes[1].frequency_hz, modes[0].frequency_hz, rtol=1e-3)
    size = next(iter(sizes_of(one, name, fit).values()))
    found = after.parameter_values(again.posterior.x)[f"{name.label}.{name.placed.effect.parameters[0].name}"]
    assert found == pytest.approx(size.value, rel=0.2)
    assert abs(again.posterior.error - fit.posterior.error) < 0.05


@pytest.mark.parametrize(
    ("unknown", "said", "other"),
    [(0.4, "shaft_torsion@sun", True), (2.5, "spring@sun.u", True), (4.0, "spring@sun.u", False)],
)
def test_a_name_is_said_where_its_prior_allows_the_size(unknown: float, said: str, other: bool) -> None:
    """The rig's own name comes first up to three, and is told beside the other up to six, of log prior density."""
    rig, one = planetary(), of_planetary()["shaft_torsion@sun"]
    own, generic = one.names
    assert one.representative is generic  # of the wider prior; its fit serves for both
    fit = fitted_on_top(one, unknown, rig, ModeObservations(rig, []))
    found = named(one, fit)
    assert found.label == said
    assert bool(found.equivalents) == other
    size = unknown * generic.scales["stiffness"]
    assert found.sizes["stiffness"].value == pytest.approx(size)
    if found.label == own.label:
        density = [norm.logpdf(size, scale=s) for s in (3e5, generic.scales["stiffness"])]
        assert found.advantage == pytest.approx(density[0] - density[1])


def test_a_mass_taken_off_is_less_usual_than_one_that_was_added() -> None:
    """A spring is as often missing as it is too much."""
    rig = chain()
    nothing = ModeObservations(rig, [])
    for label, odds in (("mass@m1", 9.0), ("spring@m1", 1.0)):
        one = of_chain()[label]
        added, off = (named(one, fitted_on_top(one, x, rig, nothing)) for x in (0.3, -0.3))
        assert added.label == off.label
        assert np.exp(added.advantage - off.advantage) == pytest.approx(odds)


def test_sizes_follow_the_ratio_of_the_priors_alone() -> None:
    rig, one = planetary(), of_planetary()["shaft_torsion@sun"]
    halved = replace(one, names=tuple(replace(n, relative=0.5 * n.relative) for n in one.names))
    fit = fitted_on_top(one, 0.4, rig, ModeObservations(rig, []))
    assert sizes_of(halved, one.names[0], fit)["stiffness"].value == pytest.approx(
        0.5 * sizes_of(one, one.names[0], fit)["stiffness"].value
    )
    assert sizes_of(halved, halved.names[0], fit) == sizes_of(one, one.names[0], fit)


# --- scores and limits against a refit in full ------------------------------------------------------------


@cache
def scored(seed: int = 1) -> tuple[ModeObservations, Fit, dict[str, Score]]:
    observations = chain_data(seed, Hidden({"spring 2": 1.15}))
    base = learned(observations, fit_base(observations, Model()))
    found = scores(observations, base, list_hypotheses(chain(), shipped_effects()))
    return observations, base, {n.label: s for s in found for n in s.hypothesis.names}


def refit(label: str) -> tuple[Score, Fit, Fit]:
    observations, base, found = scored()
    score = found[label]
    model = Model().plus(score.hypothesis.placed, score.hypothesis.scales)
    problem = model.problem(observations)
    x = np.zeros(len(problem.unknowns))
    for i, name in enumerate(problem.unknowns.names):
        if name in base.posterior.unknowns.index:
            x[i] = base.posterior.value(name)
    return score, base, refined(observations, model, x, base.posterior.scatters, steps=40)


def test_a_score_promises_as_much_from_beside_the_maximum_of_the_base_model() -> None:
    """A fit of repeated modes may end a little off; what that leaves is not the effect's to gain."""
    observations, base, found = scored()
    problem = base.model.problem(observations)
    x = base.posterior.x + 0.1 * base.posterior.prior_std * np.random.default_rng(4).standard_normal(
        len(base.posterior.x)
    )
    moved = problem.residuals(x, base.posterior.scatters, matching=base.posterior.residuals.matching)
    beside = replace(base, posterior=replace(base.posterior, x=x, residuals=moved))
    assert beside.posterior.cost > base.posterior.cost + 10.0
    there = scores(observations, beside, list_hypotheses(chain(), shipped_effects()))
    for score in there:
        before = found[score.hypothesis.label]
        assert score.gain == pytest.approx(before.gain, rel=0.15, abs=0.6), score.hypothesis.label


@pytest.mark.parametrize("label", ["spring@m2-m3", "spring@m4", "mass@m2", "spring@m1-m5"])
def test_a_score_is_what_a_refit_in_full_finds_where_the_effect_is_small(label: str) -> None:
    score, base, fit = refit(label)
    placed = score.hypothesis.placed
    i = fit.posterior.unknowns.index[placed.parameter_name(placed.effect.parameters[0].name)]
    scale = fit.posterior.std[i]
    bounded = score.size[0] <= fit.posterior.unknowns.lower[i]
    if not bounded:
        assert score.size[0] == pytest.approx(fit.posterior.x[i], abs=0.6 * scale)
    assert 1 / np.sqrt(1 + score.std**-2) == pytest.approx(scale, rel=0.25)
    before = base.log_evidence + base.posterior.scatter_cost  # the refit keeps the scatters
    assert score.gain == pytest.approx(fit.log_evidence - before, abs=1.2)


def test_the_best_score_is_that_of_the_spring_that_was_made_stiffer() -> None:
    _, _, found = scored()
    best = max(found.values(), key=lambda s: s.gain)
    assert "spring@m2-m3" in {n.label for n in best.hypothesis.names}
    places = localise(found.values())
    assert places[0].place.replace(".z", "") == "m2-m3"
    assert places[0].acts_like == "stiffness"
    assert places[0].size == pytest.approx(0.15 * 4e5, rel=0.5)


@pytest.mark.parametrize("label", ["spring@m2-m3", "mass@m3", "damper@m3"])
def test_an_effect_of_twice_its_limit_is_seen_and_one_far_below_it_is_not(label: str) -> None:
    settings = DiagnoseSettings()
    healthy = chain_data(3, lab=NORMAL)
    base = learned(healthy, fit_base(healthy, Model()))
    hypotheses = list_hypotheses(chain(), shipped_effects())
    h = of_chain()[label]
    limit = {d.label: d for d in detection_limits(healthy, base, hypotheses, settings)}[label]
    assert 0 < limit.size < np.inf
    effect, _, place = label.partition("@")
    rows = {"m2-m3": {"m2.z": -1.0, "m3.z": 1.0}, "m3": {"m3.z": 1.0}, "m2": {"m2.z": 1.0}}
    make = {"spring": Spring, "mass": Mass, "damper": Damper}[effect]

    def seen(size: float, seed: int) -> bool:
        hidden = Hidden(added=(make("added", rows[place], size),))
        observations = chain_data(seed, hidden, NORMAL)
        start = learned(observations, fit_base(observations, Model()))
        with_it = learned(observations, fit_base(observations, Model().plus(h.placed, h.scales)))
        return with_it.log_evidence - start.log_evidence >= needed(h, hypotheses, settings, 0)

    at = np.mean([seen(2.0 * limit.size, 20 + i) for i in range(4)])
    below = np.mean([seen(0.1 * limit.size, 40 + i) for i in range(3)])
    assert at >= 0.75
    assert below == 0


@pytest.mark.parametrize(
    ("power", "linear"), [(0.35, True), (1.0, True), (2.0, True), (3.0, True), (4.0, False)]
)
@pytest.mark.parametrize("off", [0.2, 5.0])
def test_the_search_for_a_limit_ends_at_the_size_that_gains_enough(
    power: float, linear: bool, off: float
) -> None:
    """Whatever power of the size the gain grows with, and wherever first order would have begun."""
    wanted, sigma = 8.0 + 0.5 * np.log1p(0.1**-2.0), 0.1
    true = off * sigma * (np.sqrt(2 * wanted) + 1.2816)

    class Power(_Shown):
        def _above(self, unknown: float, gain: float, sigmas: float) -> tuple[float, bool]:
            asked = self._wanted(gain, sigmas, 1 / sigma)
            return float(np.log(wanted / asked * (unknown / true) ** power)), True

    def least(most: float, gain: float = 8.0, sigmas: float = 2.0) -> float:
        problem = SimpleNamespace(unknowns=SimpleNamespace(upper=np.array([most])))
        nothing = Residuals(np.zeros(0), np.zeros((0, 1)))
        slope = np.zeros(0)
        return Power(problem, np.zeros(1), 0, {}, nothing, slope, None, sigma, linear).least(gain, sigmas)  # type: ignore[arg-type]

    assert least(np.inf) == pytest.approx(true, rel=0.12 / power)
    assert least(0.5 * true) == (np.inf if 0.5**power < 0.9 else 0.5 * true)
    # a claim needs its sigmas, too, however little evidence it needs
    assert least(np.inf, gain=-4.0, sigmas=6.0) == pytest.approx(
        true * (18.0 / wanted) ** (1 / power), rel=0.12 / power
    )


def test_the_same_nonlinear_element_under_two_names_is_one_hypothesis() -> None:
    """At a body of one direction and at its only DOF; in a plane a body has two."""
    of_line = list_hypotheses(chain(), shipped_effects(), linear=False)
    names = [[n.label for n in h.names] for h in of_line if not h.placed.effect.linear]
    for effect in ("dry_friction", "cubic_spring"):
        assert [f"{effect}@m2", f"{effect}@m2.z"] in names
    of_plane = list_hypotheses(planetary(), shipped_effects(), linear=False)
    friction = [h for h in of_plane if h.placed.effect.id == "dry_friction"]
    assert friction
    assert all(len(h.names) == 1 for h in friction)
    # teeth take the place of a spring of their name, each of its own
    teeth = [h.label for h in of_plane if h.placed.effect.id == "mesh_backlash"]
    assert teeth == [f"mesh_backlash@{body}-planet{k}" for body in ("sun", "ring") for k in (1, 2)]


def test_limits_of_several_names_are_the_same_change() -> None:
    observations, base, _ = scored()
    hypotheses = list_hypotheses(chain(), shipped_effects())
    limits = {d.label: d.size for d in detection_limits(observations, base, hypotheses, DiagnoseSettings())}
    assert limits["spring@m2"] == pytest.approx(limits["spring@m2.z"])
    assert all(v > 0 for v in limits.values())


def test_an_effect_at_a_body_is_not_taken_for_one_at_its_coordinate() -> None:
    """The unknown of spring@m1 is not that of spring@m1.z, whose name begins alike."""
    hypotheses = {n.label: h for h in of_chain().values() for n in h.names}
    at_dof = parse_effect("spring@m2.z", chain())
    observations = ModeObservations(chain(), [prepare(chain_modes(5, NORMAL)["all"])])
    model = Model().plus(at_dof, {at_dof.parameter_name("stiffness"): 1e5})
    base = learned(observations, fit_base(observations, model))
    body = replace(hypotheses["spring@m2"], names=(hypotheses["spring@m2"].names[0],))
    assert body.label == "spring@m2"
    (found,) = scores(observations, base, [body])
    assert len(found.size) == 1


@pytest.mark.parametrize(("found", "nothing"), [(0, 0.3), (1, 0.6), (2, 0.84)])
def test_prior_probabilities_add_up_to_one_and_generic_effects_weigh_less(found: int, nothing: float) -> None:
    hypotheses, settings = list_hypotheses(planetary(), shipped_effects()), DiagnoseSettings()
    each = np.array([prior(h, hypotheses, settings, found) for h in hypotheses])
    assert null_prior(settings, found) == pytest.approx(nothing)
    assert each.sum() + nothing == pytest.approx(1.0)
    generic = np.array([h.generic for h in hypotheses])
    assert 0 < generic.sum() < len(generic)
    assert np.ptp(each[generic]) == np.ptp(each[~generic]) == 0.0
    assert each[generic][0] / each[~generic][0] == pytest.approx(0.3)


def test_gains_of_a_ladder_count_from_its_first_rung() -> None:
    rungs = [Rung((), 1.0, 1.0, 1.0, {}, log_evidence=e, unexplained=0) for e in (-40.0, -25.0, -26.5)]
    assert [r.log_evidence for r in with_gains(rungs)] == [0.0, 15.0, 13.5]


@pytest.mark.parametrize("found", [0, 1])
def test_what_a_claim_needs_leaves_nothing_its_doubt(found: int) -> None:
    """Where that is more than the least that a claim needs."""
    hypotheses, settings = list(of_chain().values()), DiagnoseSettings(claim=0.01)
    for h in hypotheses:
        gain = needed(h, hypotheses, settings, found)
        doubt = settings.further_doubt if found else settings.doubt
        assert against_nothing(h, gain, hypotheses, settings, found) == pytest.approx(1 - doubt)
        assert against_nothing(h, -1e4, hypotheses, settings, found) == 0.0


def test_a_sensor_less_lets_less_be_seen() -> None:
    limits = []
    for sensors in (5, 2):
        measured = chain_modes(5, NORMAL)["all"]
        assert measured.shapes is not None
        assert measured.shape_std is not None
        fewer = replace(
            measured,
            dofs=measured.dofs[:sensors],
            shapes=measured.shapes[:, :sensors],
            shape_std=measured.shape_std[:, :sensors],
        )
        observations = ModeObservations(chain(), [prepare(fewer)])
        base = fit_base(observations, Model())
        limits.append(
            detection_limits(observations, base, [of_chain()["spring@m4"]], DiagnoseSettings())[0].size
        )
    assert limits[1] > limits[0]


def test_effects_of_the_library_can_all_be_placed() -> None:
    rig = planetary()
    for label in of_planetary():
        if not label.startswith("out_of_tolerance"):
            assert parse_effect(label, rig).label == label
