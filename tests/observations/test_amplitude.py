"""Hits at several force levels against describing functions, on top of the modes of the linear level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from simulate_amplitude import COORDINATES, LEVELS, RIG, STRUCK, observed, simulated_hits, true_assembly

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose import claims, rounds
from ema_pipeline.diagnose.detection_limits import detection_limits
from ema_pipeline.diagnose.diagnosis import diagnose
from ema_pipeline.diagnose.explained import explanation, outlying_damping
from ema_pipeline.diagnose.heldout import HeldOut
from ema_pipeline.diagnose.hypotheses import Hypothesis, Name
from ema_pipeline.diagnose.ranking import rank
from ema_pipeline.diagnose.sentences import STANDING_STILL
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.inference import Posterior
from ema_pipeline.levels.differences import smooth_terms
from ema_pipeline.mechanics.laws import DryFriction, Nonlinear, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.observations import amplitude
from ema_pipeline.observations.amplitude import AmplitudeObservations, AmplitudeProblem
from ema_pipeline.observations.amplitude_starts import _followed, _grid, _while_hopeful
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    best_refined,
    fit_base,
    learned,
    refined,
    transferred,
    wide,
)
from ema_pipeline.observations.hit_data import HitData, comparable
from ema_pipeline.observations.hit_modes import Linear, changed_modes
from ema_pipeline.observations.hit_reading import momentary_weights
from ema_pipeline.observations.hit_residuals import AMPLITUDE, LINEARISATION
from ema_pipeline.observations.hit_rows import HIT_AIM, HitRows
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.parts import DAMPING_SCATTER
from ema_pipeline.observations.size_map import LOG_STD, SizeMap
from ema_pipeline.rigs.isolator import isolator

SETTINGS = DiagnoseSettings(processes=1)
RATIO, LINE_HZ, HITS = 0.01, 0.5, 2
IMPULSE_S = 1e-3
"""Impulse of a blow over its peak force."""


def synthetic(
    elements: Sequence[Nonlinear] = (), seed: int = 0, drift: float = 1e-4
) -> AmplitudeObservations:
    """Modes of the true rig, and of hits whose poles move as describing functions say, with noise and drift."""
    random = np.random.default_rng(seed)
    assembly = true_assembly()
    values, shapes = eigen_solution(assembly.system())
    omega, dofs = np.sqrt(values), tuple(Dof.parse(c) for c in COORDINATES)
    m = len(omega)
    measured = MeasuredModes(
        "test", omega / (2 * np.pi), 1e-5 * omega, np.full(m, RATIO), np.full(m, 1e-4),
        shapes.T.astype(complex), np.full((m, m), 1e-3), dofs, band_hz=(50.0, 200.0),
    )  # fmt: skip
    sheet, level, motion = [], [], []
    for i, struck in enumerate(STRUCK):
        for k, force in enumerate(LEVELS):
            for _ in range(HITS):
                peak = force * np.exp(0.05 * random.standard_normal())
                sheet.append(i)
                level.append(k)
                motion.append(shapes[COORDINATES.index(struck)] * peak * IMPULSE_S / omega)
    count = len(sheet)
    std = np.full((count, m), 1e-5)
    clean = HitData(
        prepare(measured), np.arange(m), dofs, shapes.T.astype(complex), tuple(f"h{i}" for i in range(count)),
        np.array(level), np.array(sheet), np.array(LEVELS), np.tile(np.log(omega / (2 * np.pi)), (count, 1)), std,
        np.full((count, m), RATIO), 1e-5 * np.ones((count, m)), np.array(motion, complex),
        np.ones((count, m), complex), np.full((count, m), 1e-3), 0.0,
        np.stack([omega / (2 * np.pi) - 8.0, omega / (2 * np.pi) + 8.0], axis=1), LINE_HZ,
        reference_level=0,
    )  # fmt: skip
    stretch = element_rows(assembly, list(elements)) @ shapes
    linear = Linear.of(clean, stretch, np.arange(m), values, clean.motion)
    moved, grown = changed_modes(clean, elements, linear)
    frequency = clean.log_frequency + moved.imag / omega + 1e-5 * random.standard_normal((count, m))
    frequency += drift * random.standard_normal((count, 1))
    damping = RATIO - moved.real / omega + 1e-5 * random.standard_normal((count, m))
    size = np.exp(grown) + 1e-3 * (
        random.standard_normal((count, m)) + 1j * random.standard_normal((count, m))
    )
    weight = clean.reference_weights  # the softest hits, too, move a little
    reference = replace(
        clean.reference,
        log_frequency=clean.reference.log_frequency + np.sum(weight * moved.imag / omega, axis=0),
        log_damping=clean.reference.log_damping + np.sum(weight * -moved.real / omega / RATIO, axis=0),
    )
    hits = replace(clean, reference=reference, log_frequency=frequency, damping=damping, size=size)
    return AmplitudeObservations(ModeObservations(RIG, [hits.reference]), [hits])


def base_fit(observations: AmplitudeObservations) -> Fit:
    modes = fit_base(observations.modes, Model())
    unknowns = observations.problem((), {}).unknowns
    start = transferred(modes.posterior, unknowns, np.zeros(len(unknowns)))
    return learned(observations, refined(observations, Model(), start))


def fitted(observations: AmplitudeObservations, base: Fit, label: str) -> tuple[AmplitudeProblem, Posterior]:
    model = base.model.plus(parse_effect(label, RIG), {})
    problem = observations.problem(model.effects, model.scales)
    x = transferred(base.posterior, problem.unknowns, np.zeros(len(problem.unknowns)))
    scatters = base.posterior.scatters
    fit = best_refined(observations, model, problem.begun(x, scatters), scatters)
    return problem, learned(observations, fit).posterior


CASES = {
    "bearing_cubic@hub": ([PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=8e9) for a in "xy"], "stiffness", 8e9),
    "bearing_quadratic@rim": (
        [PolynomialSpring(f"q{a}", {f"rim.{a}": 1.0}, quadratic=-1.2e7) for a in "xy"], "stiffness", 1.2e7,
    ),
    "dry_friction@hub": ([DryFriction(f"f{a}", {f"hub.{a}": 1.0}, 0.02) for a in "xy"], "force", 0.02),
    "mesh_backlash@hub-rim": (
        [PartingSpring("hub-rim mesh", {"hub.x": 1.0, "rim.x": -1.0}, 2.1e5, preload=3e-4, gap=1e-2)], "preload", 3e-4,
    ),
}  # fmt: skip


def test_sizes_that_are_tried_count_once_all_else_has_followed() -> None:
    observations = synthetic(CASES["mesh_backlash@hub-rim"][0])
    base = base_fit(observations)
    model = base.model.plus(parse_effect("mesh_backlash@hub-rim", RIG), {})
    problem = observations.problem(model.effects, model.scales)
    x = transferred(base.posterior, problem.unknowns, problem.start())
    scatters = base.posterior.scatters
    held = [problem.unknowns.index[name] for name in problem.sizes]
    found = problem.residuals(x, scatters, by_sizes=False)
    std = problem.unknowns.prior_std(scatters)
    rows = np.vstack([found.jacobian, np.diag(1 / std)])
    right = np.concatenate([found.values, x / std])
    step = np.linalg.lstsq(np.delete(rows, held, axis=1), -right)[0]
    left = right + np.delete(rows, held, axis=1) @ step
    assert _followed(problem, found, x, scatters, held) == pytest.approx(float(left @ left))
    assert np.max(np.abs(step)) > 1e-3


@pytest.mark.parametrize("label", list(CASES))
def test_each_effect_is_told_at_its_place_with_its_size(label: str) -> None:
    elements, parameter, size = CASES[label]
    observations = synthetic(elements)
    base = base_fit(observations)
    gains, values = {}, {}
    for other in CASES:
        problem, found = fitted(observations, base, other)
        gains[other] = found.log_evidence - base.log_evidence
        values[other] = problem.parameter_values(found.x)
    assert max(gains, key=lambda k: gains[k]) == label, gains
    assert gains[label] > 5
    assert abs(values[label][f"{label}.{parameter}"]) == pytest.approx(size, rel=0.5)


@pytest.mark.parametrize(
    ("label", "law"), [("bearing_cubic@hub", "cubic"), ("bearing_quadratic@rim", "quadratic")]
)
def test_effects_twice_their_limit_are_claimed_and_those_of_half_of_it_are_not(label: str, law: str) -> None:
    def element(size: float) -> list[Nonlinear]:
        place = label.partition("@")[2]
        return [PolynomialSpring(f"p{a}", {f"{place}.{a}": 1.0}, **{law: size}) for a in "xy"]

    healthy = synthetic()
    hypothesis = Hypothesis((Name(parse_effect(label, RIG), {}),))
    settings = DiagnoseSettings(processes=1)
    (limit,) = detection_limits(healthy, base_fit(healthy), [hypothesis], settings)
    assert limit.label == label
    for factor, claimed in ((2.0, True), (0.5, False)):
        gains = []
        for seed in range(3):
            observations = synthetic(element(factor * limit.size), seed)
            base = base_fit(observations)
            gains.append(fitted(observations, base, label)[1].log_evidence - base.log_evidence)
        assert all((g > settings.claim + settings.linearised_claim) is claimed for g in gains), gains


def test_hits_add_nothing_to_what_modes_without_a_partner_cost() -> None:
    observations = synthetic()
    problem = Model().problem(observations)
    x = problem.unknowns.clipped(40.0 * np.random.default_rng(1).standard_normal(len(problem.unknowns)))
    for at in (problem.start(), x):
        told = problem.residuals(at, wide(observations), heat=30.0, derivatives=False).penalty
        assert problem.unpaired(at, wide(observations), 30.0) == told


def test_nothing_is_claimed_where_only_drift_moves_the_modes() -> None:
    observations = synthetic(drift=5e-4)
    base = base_fit(observations)
    assert base.posterior.scatters["drift"] == pytest.approx(5e-4, rel=0.5)
    for label in CASES:
        _, found = fitted(observations, base, label)
        assert found.log_evidence - base.log_evidence < 5


def test_modes_that_the_model_misses_are_not_hidden_by_hits_that_fit() -> None:
    settings, quiet = DiagnoseSettings(processes=1), synthetic()
    (hits,) = quiet.hits
    off = np.zeros(len(hits.reference))
    off[1] = 0.06
    reference = replace(hits.reference, log_frequency=hits.reference.log_frequency + off)
    moved = replace(hits, reference=reference, log_frequency=hits.log_frequency + off)
    observations = AmplitudeObservations(ModeObservations(RIG, [reference]), [moved])
    found = base_fit(observations).posterior
    assert found.error < found.error_limit() < found.error_apart
    told = diagnose(observations, RIG, {}, settings=settings, hypotheses=())
    assert told.verdict == "unknown_effect"
    assert "The error of the modes alone is" in told.summary


def test_modes_that_move_with_the_force_are_not_explained_by_a_model_that_moves_none() -> None:
    settings = DiagnoseSettings(processes=1)
    quiet = synthetic()  # far below the error limit: what moves is not seen in it
    moving = AmplitudeObservations(quiet.modes, [replace(h, level_dependent=True) for h in quiet.hits])
    assert not quiet.level_dependent
    assert moving.level_dependent
    assert explanation(quiet, base_fit(quiet), settings).explained
    base = base_fit(moving)
    assert not explanation(moving, base, settings).explained

    def with_effect(label: str) -> Fit:
        model = base.model.plus(parse_effect(label, RIG), {})
        problem = moving.problem(model.effects, model.scales)
        start = transferred(base.posterior, problem.unknowns, np.zeros(len(problem.unknowns)))
        return refined(moving, model, start, base.posterior.scatters)

    assert not explanation(moving, with_effect("local_damper@hub"), settings).explained
    assert explanation(moving, with_effect("bearing_cubic@hub"), settings).explained
    told = diagnose(moving, RIG, {}, settings=settings, hypotheses=())
    assert told.verdict == "unknown_effect"
    assert STANDING_STILL in told.summary
    assert told.null_probability == 0.0
    assert told.detection_limits == ()
    assert diagnose(quiet, RIG, {}, settings=settings, hypotheses=()).verdict == "adequate"


@pytest.mark.parametrize(
    ("linearised", "share"), [(True, claims.LINEARISED_SHARE), (False, claims.HELD_OUT_SHARE)]
)
def test_data_held_out_may_speak_against_an_effect_by_a_share_of_its_gain(
    monkeypatch: pytest.MonkeyPatch, linearised: bool, share: float
) -> None:
    observations = synthetic(CASES["bearing_cubic@hub"][0])
    hypothesis = Hypothesis((Name(parse_effect("bearing_cubic@hub", RIG), {}),))
    settings = SETTINGS
    ranking = rank(observations, base_fit(observations), [hypothesis], 1)
    (found,) = ranking.ranked
    monkeypatch.setattr(claims, "left_of_close_modes", lambda base, mended: 0.8 * found.gain)
    most = claims.HELD_OUT_TIE + share * 0.8 * found.gain
    monkeypatch.setattr(observations, "linearised", linearised)
    for further, doubt in ((-0.1, ""), (0.1, claims.PREDICTED_WORSE)):
        densities = [HeldOut(1.0, 0.0), HeldOut(1.0, -most - further)]
        monkeypatch.setattr(
            claims, "held_out_of_each", lambda observations, fits, processes, found=densities: found
        )
        judged = claims.judge(observations, ranking, found, settings)
        assert judged.doubt == doubt
        assert judged.contradicted is bool(doubt)


@pytest.mark.parametrize(("linearised", "more"), [(True, SETTINGS.linearised_claim), (False, 0.0)])
def test_what_linearisation_leaves_out_may_gain_evidence_that_does_not_count(
    monkeypatch: pytest.MonkeyPatch, linearised: bool, more: float
) -> None:
    observations = synthetic(CASES["bearing_cubic@hub"][0])
    hypothesis = Hypothesis((Name(parse_effect("bearing_cubic@hub", RIG), {}),))
    ranking = rank(observations, base_fit(observations), [hypothesis], 1)
    (found,) = ranking.ranked
    monkeypatch.setattr(observations, "linearised", linearised)
    needed = SETTINGS.claim + more
    assert found.gain > needed
    assert ranking.linearised
    unjudged = rounds._without_linearisation(replace(ranking, linearised=linearised), SETTINGS)
    assert unjudged == ({"bearing_cubic@hub": pytest.approx(found.gain - more)} if linearised else {})
    for gain, claimed in ((needed + 0.1, True), (needed - 0.1, False)):
        judged = claims.judge(observations, ranking, replace(found, gain=gain), SETTINGS)
        assert (judged.claimed, judged.needed) == (claimed, needed)
        assert judged.believed == pytest.approx(gain - more)
        assert claimed or judged.doubt == f"its gain in log evidence, {gain:.1f}, is below {needed:g}"


def test_a_generic_effect_is_asked_twice_the_evidence_that_linearisation_may_leave() -> None:
    observations = synthetic()
    own, generic = (
        Hypothesis((Name(parse_effect(label, RIG), {}),))
        for label in ("bearing_cubic@hub", "cubic_spring@hub.x")
    )
    linear = Hypothesis((Name(parse_effect("spring@hub.x", RIG), {}),))
    for hypothesis, asked in ((own, 1.0), (generic, 2.0), (linear, 0.0)):
        beyond = claims.evidence_beyond(observations, hypothesis, SETTINGS)
        assert beyond == asked * SETTINGS.linearised_claim
    # hits in x alone do not tell the two apart, whatever is asked of them
    for hypothesis in (own, generic):
        assert claims.doubtful_evidence(observations, hypothesis, SETTINGS) == SETTINGS.linearised_claim


def test_rows_of_hits_are_compared_without_what_a_sheet_shares() -> None:
    """Against least squares with a free mean for every mode, kind and sheet; kept at each set of scatters."""
    observations = synthetic()
    (rows,), random = observations.rows, np.random.default_rng(5)
    scatters = {name: s.start for name, s in observations.scatters.items()}
    one = rows.whitening(scatters, 2.0)
    assert rows.whitening(dict(scatters), 2.0) is one
    assert rows.whitening(scatters, 1.0) is not one
    assert rows.whitening(scatters | {HIT_AIM: 0.3}, 2.0) is not one
    np.testing.assert_allclose(one.sigma, 2.0 * rows.whitening(scatters, 1.0).sigma)
    assert rows.groups == 3 * len(STRUCK) * len(COORDINATES) == len(one.norm)
    values = random.standard_normal(len(one.sigma)) * one.sigma
    design = np.eye(rows.groups)[one.group] / one.sigma[:, None]
    left = values / one.sigma - design @ np.linalg.lstsq(design, values / one.sigma, rcond=None)[0]
    np.testing.assert_allclose(one.whitened(values), left, atol=1e-9)
    both = np.stack([values, values + random.standard_normal(rows.groups)[one.group]], axis=1)
    np.testing.assert_allclose(
        one.whitened(both), np.stack([left, left], axis=1), atol=1e-6 * np.max(1 / one.sigma)
    )
    assert np.all(sum(one.share.values()) < 1)


def test_a_scale_of_amplitudes_that_is_hardly_known_does_not_take_a_size_to_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The size is then known to within a factor only, and is not the nearer to zero for it."""
    monkeypatch.setattr(amplitude, "AMPLITUDE_STD", 0.4)
    observations = synthetic(CASES["bearing_cubic@hub"][0])
    hypothesis = Hypothesis((Name(parse_effect("bearing_cubic@hub", RIG), {}),))
    settings = DiagnoseSettings(processes=1)
    (found,) = rank(observations, base_fit(observations), [hypothesis], 1).ranked
    posterior = found.fit.posterior
    i = posterior.unknowns.index["bearing_cubic@hub.stiffness"]
    assert abs(posterior.x[i]) < 1.5 * np.sqrt(posterior.covariance[i, i])
    assert claims._weak(observations, found, found.gain, settings.claim, settings, 0.0) == ""
    assert abs(posterior.x[i]) > 5.0 * claims._std_of_first(found)


@pytest.mark.parametrize(
    ("label", "sizes", "near", "rounding"),
    [
        ("bearing_cubic@hub", {"stiffness": 1e11}, 0.01, 1e-9),
        ("dry_friction@hub", {"force": 0.3, "velocity": 0.02}, 0.01, 1e-9),
        pytest.param(
            "hysteresis@hub",
            {"stiffness": 4e4, "force": 2.0, "shape": 0.3, "exponent": 1.5},
            0.1,
            1e-5,  # by interpolation in a table
            marks=pytest.mark.slow,
        ),
    ],
)
def test_derivatives_by_sizes_are_those_of_small_differences(
    label: str, sizes: dict[str, float], near: float, rounding: float
) -> None:
    """Those of the level's modes as well, which an effect this strong moves in the softest hits."""
    observations = synthetic([PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=1e11) for a in "xy"])
    problem = observations.problem((parse_effect(label, RIG),), {})
    scatters = {n: s.start for n, s in observations.scatters.items()}
    x = problem.start({f"{label}.{name}": size for name, size in sizes.items()})
    left = [i for i, n in enumerate(problem.unknowns.names) if n.startswith("linearisation")]
    x[left] = 0.2 * np.random.default_rng(0).standard_normal(len(left))
    here = problem.residuals(x, scatters)
    count = len(problem.modes.residuals(problem.modes.start(), scatters).values)
    drift = next(i for i, n in enumerate(problem.unknowns.names) if n.startswith("drift"))
    for i in (*problem.nonlinear_sizes, problem.unknowns.index[AMPLITUDE], drift, *left):
        ahead, behind = x.copy(), x.copy()
        ahead[i], behind[i] = x[i] + 1e-5, x[i] - 1e-5
        values = [
            problem.residuals(p, scatters, matching=here.matching, derivatives=False).values
            for p in (ahead, behind)
        ]
        slope = (values[0] - values[1]) / 2e-5
        for rows in (slice(count), slice(count, None)):
            close = near * np.abs(slope[rows]).max() + rounding
            np.testing.assert_allclose(here.jacobian[rows, i], slope[rows], atol=close)


def test_what_the_hits_of_a_second_configuration_move_is_moved_there() -> None:
    """Rows of the level's modes are found between those of other configurations, whose modes stay as they are."""
    one = synthetic([PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=1e11) for a in "xy"])
    rig = replace(RIG, configurations=("first", "test", "last"))
    first, last = (replace(one.modes.data[0], configuration=name) for name in ("first", "last"))
    three = AmplitudeObservations(ModeObservations(rig, [first, *one.modes.data, last]), one.hits)
    effects = [parse_effect("bearing_cubic@hub", RIG)]
    moved = {}
    for name, data in (("one", one), ("three", three)):
        problem = data.problem(effects, {})
        scatters = {n: s.default for n, s in data.scatters.items()}
        values = [
            problem.residuals(
                problem.start({"bearing_cubic@hub.stiffness": size}), scatters, derivatives=False
            ).values
            for size in (0.0, 1e11)
        ]
        count = len(problem.modes.residuals(problem.modes.start(), scatters).values)
        moved[name] = (values[1] - values[0])[:count]
    before, mine, after = moved["three"].reshape(3, -1)
    assert not np.any(before)
    assert not np.any(after)
    assert np.max(np.abs(moved["one"])) > 1e-3
    np.testing.assert_allclose(mine, moved["one"], atol=1e-9)


def test_a_spring_that_parts_is_as_stiff_as_the_spring_that_it_replaces() -> None:
    label, stiffer = "mesh_backlash@hub-rim", 0.3
    observations = synthetic(CASES[label][0])
    parameters = {**RIG.parameters, "link": replace(RIG.parameters["link"], value=2e5 * np.exp(stiffer))}
    rigs = RIG, replace(RIG, parameters=parameters)
    scatters = {n: s.default for n, s in observations.scatters.items()}
    found = []
    for rig in rigs:
        data = AmplitudeObservations(ModeObservations(rig, observations.modes.data), observations.hits)
        problem = data.problem([parse_effect(label, rig)], {})
        x = problem.start({f"{label}.preload": 3e-4})
        x[problem.unknowns.index["link"]] = stiffer if rig is RIG else 0.0
        found.append(problem.residuals(x, scatters, derivatives=False).values)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-6)


def test_a_hit_read_with_nine_times_the_damping_leaves_no_motion_to_divide_by() -> None:
    """Beside a mode that moves in step and rings on: friction of 1 N moved its pole by 1e23 decay rates."""
    (hits,) = synthetic(drift=0.0).hits
    assembly = true_assembly()
    values, shapes = eigen_solution(assembly.system())
    heavy = np.where(np.arange(len(hits.modes)) == 0, 12.0, 1.0)
    hits = replace(hits, motion=np.full(hits.motion.shape, 1e-5 + 0j))
    reference = replace(hits.reference, log_damping=hits.reference.log_damping + np.log(heavy))
    usual = replace(hits, reference=reference, damping=hits.damping * heavy)
    assert any(0 in g and len(g) > 1 for g in usual.groups)
    wild = replace(
        usual, damping=usual.damping * np.where(np.arange(len(usual.names))[:, None] == 0, 9.0, 1.0)
    )
    friction = DryFriction("fx", {"hub.x": 1.0}, 0.02)
    moved = []
    for data in (usual, wild):
        linear = Linear.of(
            data, element_rows(assembly, [friction]) @ shapes, np.arange(len(values)), values, data.motion
        )
        moved.append(abs(changed_modes(data, [friction], linear)[0, 0, 0]))
    assert moved[1] < 20 * moved[0]


def test_the_scale_of_amplitudes_is_known_less_well_the_further_poles_move() -> None:
    observations = synthetic(drift=0.0)
    still = AmplitudeObservations(observations.modes, [])
    assert still.problem([], {})._amplitude_std == 0.02
    (hits,) = observations.hits
    hard = (hits.level == hits.level.max())[:, None]
    far = replace(hits, log_frequency=hits.log_frequency + np.where(hard, 0.7 * RATIO, 0.0))
    problem = AmplitudeObservations(observations.modes, [far, replace(far)]).problem([], {})
    apart = far.moves[0]
    assert apart == pytest.approx(0.7, rel=0.05)
    assert problem._amplitude_std == pytest.approx(np.hypot(0.02, 0.35 * apart / (apart + 0.3)))


def test_sizes_are_tried_over_six_decades_of_both_signs_where_there_are_two() -> None:
    effect = parse_effect("bearing_quadratic@rim", RIG).effect
    (p,) = effect.parameters
    grid = _grid(SizeMap.of(p, p.scale), 4)
    one = np.array([1e-5, 1e-3, 0.1, 10.0])
    np.testing.assert_allclose(grid, one if p.minimum == 0.0 else [*one, *-one])
    times = SizeMap.of(parse_effect("relaxation@isolator", isolator()).effect.parameters[1], 0.1)
    reach = 3.0 * np.log(10) / LOG_STD
    low, high = times.bounds
    expected = np.linspace(-reach, reach, 5)
    np.testing.assert_allclose(_grid(times, 5), expected[(expected >= low) & (expected <= high)])
    assert _grid(times, 1).tolist() == [0.0]


@pytest.mark.parametrize(("std", "learned"), [(1.0, False), (0.9, True)])
def test_the_data_tell_nothing_of_a_size_without_a_null_whose_prior_they_leave(
    std: float, learned: bool
) -> None:
    posterior = cast(Posterior, SimpleNamespace(std=np.array([std]), prior_std=np.ones(1)))
    gap = parse_effect("relaxation@isolator", isolator()).effect.parameters[1]
    assert SizeMap.of(gap, 0.1).learned(posterior, 0) is learned
    (spring,) = parse_effect("bearing_quadratic@rim", RIG).effect.parameters
    assert SizeMap.of(spring, spring.scale).learned(posterior, 0)  # it may be zero, and is told to be


def test_preloads_are_tried_from_the_largest_down_to_where_nothing_leads_anywhere() -> None:
    asked = []

    def tried(values: Sequence[float]) -> tuple[float, np.ndarray]:
        (size,) = values
        asked.append(size)
        return costs[int(size)], np.array(values)

    places = [(float(k),) for k in range(10)]
    costs = [0.0, 9e3, 9e3, 9e3, 9e3, 500.0, 9e3, 9e3, 300.0, 310.0]  # two in a row are no end
    found = _while_hopeful(tried, places)
    assert asked == [9, 8, 7, 6, 5, 4, 3, 2]
    assert [float(x[0]) for _, x in found] == [2, 3, 4, 5, 6, 7, 8, 9]
    costs = list(np.linspace(0.0, 900.0, 10))
    assert len(_while_hopeful(tried, places)) == 10


def test_modes_within_four_decay_rates_move_in_step() -> None:
    """Of the faster one. Each joins the one below it: a row of them is one group."""
    hits = synthetic().hits[0]
    width = 50.0 * RATIO  # decay rate over 2π, Hz
    hertz = np.array([50.0, 50.0 + 3.5 * width, 50.0 + 7.0 * width, 60.0])
    names = np.arange(4)
    for frequency, groups in (
        (hertz, [[0, 1, 2], [3]]),
        (hertz[::-1], [[3, 2, 1], [0]]),
        (np.array([50.0, 60.0, 60.0 + 3.5 * width, 80.0]), [[0], [1, 2], [3]]),
        (np.array([50.0, 60.0, 80.0, 83.4]), [[0], [1], [2], [3]]),
        (np.array([50.0, 60.0, 80.0, 83.28]), [[0], [1], [2, 3]]),
    ):
        reference = replace(
            hits.reference,
            log_frequency=np.log(frequency),
            log_damping=np.full(len(frequency), np.log(RATIO)),
        )
        given = replace(hits, reference=reference, modes=names[: len(frequency)])
        assert [g.tolist() for g in given.groups] == groups


def test_what_other_modes_give_is_their_flexibility_at_the_frequency_of_the_group() -> None:
    (hits,) = synthetic().hits
    omega = hits.omega
    slow = (0.4 * omega.min()) ** 2
    values = np.array([slow, *omega**2, (3 * omega.max()) ** 2])
    stretch = np.random.default_rng(2).standard_normal((2, len(values)))
    match = np.arange(1, len(omega) + 1)
    match[2] = -1
    found = Linear.of(hits, stretch, match, values, hits.motion)
    np.testing.assert_allclose(found.along, stretch[:, match] * (match >= 0))
    fast = values > slow
    np.testing.assert_allclose(found.flexibility, (stretch[:, fast] / values[fast]) @ stretch[:, fast].T)
    assert [len(g) for g in hits.groups] == [1] * len(omega)
    for c, (mode,) in enumerate(hits.groups):
        square = float(np.mean(hits.poles.imag[:, mode])) ** 2
        apart = values - square
        each = stretch**2 * apart / (apart**2 + (0.05 * square) ** 2)
        others = [k for k in range(len(values)) if match[mode] < 0 or k != match[mode]]
        np.testing.assert_allclose(found.elsewhere[:, c], each[:, others].sum(axis=1))


def test_every_mode_and_every_level_is_held_out_once() -> None:
    observations = synthetic()
    folds = observations.folds()
    of_levels = folds[-len(LEVELS) :]
    for k, (kept, out) in enumerate(of_levels):
        assert k not in kept.hits[0].level
        assert set(out.hits[0].level) == {k, 1 if k == 0 else 0}
        assert not out.modes.data
    held = []
    for kept, out in folds[: -len(LEVELS)]:
        assert kept.hits == out.hits == observations.hits
        assert len(kept.modes.data[0]) + len(out.modes.data[0]) == len(observations.modes.data[0])
        problem = out.problem((), {})
        scatters = {n: s.default for n, s in out.scatters.items()}
        found = problem.residuals(problem.start(), scatters)
        alone = out.modes.problem((), {})
        assert len(found.values) == len(alone.residuals(alone.start(), scatters).values)  # none of the hits
        held += list(out.modes.data[0].log_frequency)
    assert sorted(held) == pytest.approx(sorted(observations.modes.data[0].log_frequency))


def test_modes_held_out_lie_where_the_hits_of_their_level_find_them() -> None:
    """A part of the modes is shifted as they are among all."""
    observations = synthetic([PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=1e11) for a in "xy"])
    scatters = {n: s.default for n, s in observations.scatters.items()}
    effects = [parse_effect("bearing_cubic@hub", RIG)]

    def shifts(of: AmplitudeObservations) -> dict[float, float]:
        """How far the hits shift the row of every mode, by the mode's frequency."""
        problem = of.problem(effects, {})
        x = problem.start({"bearing_cubic@hub.stiffness": 1e11})
        found, alone = (
            p.residuals(x[: len(p.unknowns)], scatters, derivatives=False) for p in (problem, problem.modes)
        )
        (match,) = alone.matching  # type: ignore[misc]
        on = np.flatnonzero(match >= 0)
        moved = found.values[: len(on)] - alone.values[: len(on)]
        return dict(zip(of.modes.data[0].log_frequency[on], moved, strict=True))

    among_all = shifts(observations)
    assert min(map(abs, among_all.values())) > 0.02
    count = 0
    for _, out in observations.folds()[: -len(LEVELS)]:
        for frequency, shift in shifts(out).items():
            assert shift == pytest.approx(among_all[frequency], rel=1e-9, abs=1e-12)
            count += 1
    assert count == len(among_all)


def test_a_mode_that_moves_is_not_spared_by_leaving_it_without_a_partner() -> None:
    """A model that pairs no mode would otherwise explain that all of them move."""
    observations = synthetic([PolynomialSpring("cubic", {"hub.x": 1.0}, cubic=1e11)])
    problem = AmplitudeProblem(observations, [], {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    x = problem.start()
    paired = problem.residuals(x, scatters, derivatives=False)
    nobody = np.full(len(observations.hits[0].reference), -1)
    modes, hits = paired.matching  # type: ignore[misc]
    alone = problem.residuals(x, scatters, matching=(modes, tuple(nobody for _ in hits)), derivatives=False)
    assert alone.cost == pytest.approx(paired.cost, rel=1e-9)


def test_the_modes_of_the_softest_hits_are_those_that_the_effect_makes_of_them() -> None:
    """A spring that is stiffer in the softest hits already makes another structure, which no part has to explain."""
    elements = [PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=1e11) for a in "xy"]
    observations = synthetic(elements)
    scatters = {n: s.default for n, s in observations.scatters.items()}
    true = base_fit(synthetic())
    m, worst = len(observations.hits[0].reference), []
    for effects in ([], [parse_effect("bearing_cubic@hub", RIG)]):
        problem = observations.problem(effects, {})
        begin = problem.start({"bearing_cubic@hub.stiffness": 1e11})
        x = transferred(true.posterior, problem.unknowns, begin)
        found = problem.residuals(x, scatters, derivatives=False)
        worst.append(np.max(np.abs(found.values[:m] - true.posterior.residuals.values[:m])))
    assert worst[0] > 0.05
    assert worst[1] < 0.2 * worst[0], worst


def test_modes_above_the_models_reach_are_none_of_the_hits() -> None:
    """Beside them, what friction does to the modes of the level was left out, and a calculation in full failed."""
    observations = synthetic([DryFriction(f"f{a}", {f"hub.{a}": 1.0}, 0.3) for a in "xy"])
    (hits,), (modes,) = observations.hits, observations.modes.data
    below = np.arange(len(modes)) < len(modes) - 1
    fewer = replace(modes.only(below), whole=None, kept=None)
    few, kept = hits.within(fewer), hits.modes < len(fewer)
    assert few.reference is fewer
    np.testing.assert_array_equal(few.modes, hits.modes[kept])
    assert few.log_frequency.shape == few.size.shape == (len(hits.names), kept.sum())
    assert few.shapes.shape[0] == len(few.band_hz) == kept.sum() < len(hits.modes)
    assert len(few.with_friction(fewer)) == len(fewer)
    of_fewer = AmplitudeObservations(observations.modes.with_data([fewer]), [few])
    model = Model((parse_effect("dry_friction@hub", RIG),), {})

    def values(data: AmplitudeObservations, force: float) -> np.ndarray:
        problem = model.problem(data)
        x = problem.start({"dry_friction@hub.force": force})
        found = problem.residuals(x, {n: s.start for n, s in data.scatters.items()}, derivatives=False)
        return found.values[: len(fewer)]

    assert np.max(np.abs(values(of_fewer, 0.3) - values(of_fewer, 0.0))) > 1.0


def test_poles_that_move_far_are_read_less_well_than_near_ones() -> None:
    """σ grows with the square of the distance at first: a tenth of a width is read as if nothing were left out."""
    hits = synthetic().hits[0]
    moved = hits.log_frequency.copy()
    hard = hits.level == hits.level.max()
    assert np.max(hits.linearised_std) < 1e-3
    for far, least, most in ((0.1, 0.005, 0.012), (1.0, 0.3, 0.4), (4.0, 1.5, 2.0)):
        there = replace(hits, log_frequency=moved + np.where(hard[:, None], far * RATIO, 0.0))
        std = there.linearised_std[hard]
        assert np.all((std > least) & (std < most)), far
        assert np.max(there.linearised_std[hits.level == 0]) < 1e-3
        assert there.moves[0] == pytest.approx(far, rel=0.1)


def test_modes_that_friction_damps_heavily_are_read_less_well_where_it_is_calculated_in_full() -> None:
    observations = synthetic()
    hits, factor = observations.hits[0], np.ones(len(observations.hits[0].modes))
    defaults = {name: s.default for name, s in observations.scatters.items()}
    assert not np.any(hits.cut_off_std)
    for times, least, most in ((2.9, 0.0, 0.0), (6.0, 0.15, 0.2), (20.0, 0.35, 0.5)):
        factor[1] = times
        there = replace(hits, damping=hits.damping * factor)
        assert np.all(there.cut_off_std[[0, 2, 3]] == 0.0)
        assert least <= there.cut_off_std[1] <= most, times
        own, cut = (HitRows(there, defaults, cut_off=c).whitening(defaults, 1.0).sigma for c in (False, True))
        hit, mode = np.nonzero(there.used)
        variance = (cut**2 - own**2).reshape(3, -1)[1]  # of damping ratios
        added = np.where(mode == 1, there.cut_off_std[1] * there.irregularity[hit, mode], 0.0)
        np.testing.assert_allclose(variance, added**2, rtol=1e-6, atol=1e-12)
        modes = there.with_friction(there.reference)
        left = np.sqrt(modes.log_damping_std**2 - there.reference.log_damping_std**2)
        np.testing.assert_allclose(left, np.where(factor > 3, np.log(factor), 0.0), atol=1e-3)


def test_damping_that_friction_moves_speaks_for_no_damper_that_is_missing() -> None:
    """Linearised, half of its force is found: what is left of its damping is no scatter of other damping."""
    observations = synthetic([DryFriction(f"f{a}", {f"hub.{a}": 1.0}, 0.3) for a in "xy"])
    model = Model((parse_effect("dry_friction@hub", RIG),), {})
    start = model.problem(observations).start({"dry_friction@hub.force": 0.3})
    fit = refined(observations, model, start, {n: s.start for n, s in observations.scatters.items()})
    posterior, residuals = fit.posterior, fit.posterior.residuals
    rows = np.flatnonzero(residuals.share[DAMPING_SCATTER] > 0)
    left = posterior.unknowns.governed(LINEARISATION)
    moved = np.linalg.norm(residuals.jacobian[rows][:, left] * posterior.prior_std[left], axis=1)
    assert np.min(moved) < 0.05
    assert np.max(moved) > 0.2

    def outlying(row: int) -> bool:
        """Whether it speaks against the model that one mode is damped far more than it says."""
        values = residuals.values.copy()
        values[rows] = 0.1
        values[row] = 6.0
        changed = replace(posterior, residuals=replace(residuals, values=values))
        return outlying_damping(observations, replace(fit, posterior=changed)) is not None

    assert outlying(rows[np.argmin(moved)])
    assert not outlying(rows[np.argmax(moved)])


def test_hits_of_one_level_cannot_be_compared() -> None:
    (hits,) = synthetic().hits
    assert comparable(hits)
    assert not comparable(hits.only(hits.level == 1))


def test_what_a_hit_does_not_tell_of_a_mode_moves_nothing() -> None:
    (hits,) = synthetic([PolynomialSpring("cubic", {"hub.x": 1.0}, 0.0, 1e11)]).hits
    on = hits.sheet == 0
    std = hits.log_frequency_std.copy()
    std[np.flatnonzero(on)[:2], 1] = np.inf
    wild = hits.damping.copy()
    wild[~np.isfinite(std)] = 1e-9  # read from noise
    holed = replace(hits, log_frequency_std=std, damping=wild)
    assert np.all(holed.reach(0) <= hits.reach(0) + 1e-12)
    np.testing.assert_allclose(holed.usual_damping, hits.usual_damping, rtol=0.05)
    (still,) = synthetic(drift=0.0).hits
    assert np.all(still.reach(0) < 0.02)


def test_hits_without_any_motion_or_with_gaps_are_left_out() -> None:
    (hits,) = synthetic().hits
    motion = hits.motion.copy()
    motion[0] = np.nan
    std = hits.log_frequency_std.copy()
    std[1] = np.inf
    holed = replace(hits, motion=motion, log_frequency_std=std)
    observations = AmplitudeObservations(ModeObservations(RIG, [holed.reference]), [holed])
    _, found = fitted(observations, base_fit(observations), "bearing_cubic@hub")
    assert np.isfinite(found.log_evidence)


@pytest.mark.parametrize("fading", [0.0, 4.0, 40.0])
def test_what_a_fit_reads_of_a_pole_that_drifts_back_has_a_closed_form(fading: float) -> None:
    """A change exp(-μt) of the pole adds 1/(s'(s' + μ)) to its line, s' = s - λ; a lasting one is read as it is."""
    pole, lines = complex(-3.0, 2 * np.pi * 50.0), np.arange(45.0, 55.0, 0.25)
    instants = np.geomspace(1e-3, 3.0, 40)
    found = momentary_weights(instants, pole, lines)[0] @ np.exp(-fading * instants)
    s = 2j * np.pi * lines - pole
    columns = np.stack([s**-2, 1 / s, *smooth_terms(len(s))], axis=1)
    expected = np.linalg.lstsq(columns, 1 / (s * (s + fading)), rcond=1e-12)[0][0]
    assert abs(found - expected) < 0.02
    if not fading:
        assert expected == pytest.approx(1.0)


@pytest.mark.slow
def test_a_cubic_bearing_is_told_from_simulated_hits() -> None:
    """Direct integration, FRFs, modes and the study of the levels: nothing here knows describing functions."""
    elements = [PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=1e11) for a in "xy"]
    observations = observed(simulated_hits(elements, seed=3, drift=1e-4))
    base = base_fit(observations)
    problem, found = fitted(observations, base, "bearing_cubic@hub")
    gain = found.log_evidence - base.log_evidence
    _, rival = fitted(observations, base, "bearing_cubic@rim")
    assert gain > max(5.0, 5.0 + rival.log_evidence - base.log_evidence)
    assert problem.parameter_values(found.x)["bearing_cubic@hub.stiffness"] == pytest.approx(1e11, rel=0.3)


def test_levels_held_out_are_predicted_without_the_modes_they_were_paired_by() -> None:
    """A held-out level has no modes of its own among the data, and still needs to know which mode moves."""
    observations = synthetic()
    for _, out in observations.folds():
        problem = out.problem((), {})
        found = problem.residuals(problem.start(), {n: s.default for n, s in out.scatters.items()})
        assert np.isfinite(found.cost)
        assert len(found.values)
