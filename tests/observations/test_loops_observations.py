"""Force along loops against stepping and closed forms; residuals, their derivatives, and what is held out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.inference import anneal, learn
from ema_pipeline.loops.extract import measure_loop
from ema_pipeline.loops.model import loop_force
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.simulate import simulate_sine_test, steady_force
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.assembly import Assembly, Damper, Spring
from ema_pipeline.mechanics.cycles import Cycles
from ema_pipeline.mechanics.laws import BoucWen, DryFriction, LooseSpring, Maxwell, PolynomialSpring
from ema_pipeline.mechanics.limit_cycle import LimitCycle
from ema_pipeline.mechanics.nonlinear import force_along, steady_deviation
from ema_pipeline.observations.loop_data import LoopData, have_own_scales, left_out, settings_differ
from ema_pipeline.observations.loop_regions import regions
from ema_pipeline.observations.loops import FORCE_SCATTER, NOISE_SCATTER, LoopObservations
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.isolator import isolator

SPRING = {"stiffness": 9e4}
BOUC_WEN = {"hysteresis_force": 80.0, "hysteresis_rho": 900.0, "hysteresis_sigma": 0.6}
ROW = {"isolator.x": 1.0}


def loop(
    values: dict[str, float], frequency_hz: float, amplitude_m: float, points: int = 128, **kwargs
) -> Loop:
    x, force = simulate_sine_test(values, frequency_hz, amplitude_m, cycles=20, **kwargs)
    name = f"{frequency_hz:g} Hz {1e3 * amplitude_m:g} mm"
    settings = LoopSettings(points_per_cycle=points)
    return measure_loop(x, force, 5120.0, frequency_hz, amplitude_m, name=name, settings=settings)


def cycles(one: Loop) -> Cycles:
    return Cycles.of([one.frequency_hz], [one.series], [one.phase])


def placed(label: str) -> PlacedEffect:
    effect, _, place = label.partition("@")
    return PlacedEffect(shipped_effects()[effect], place)


@pytest.mark.parametrize("exponent", [1.0, 2.0, 6.0])
def test_tabulated_hysteresis_is_that_of_the_mechanics_stepped_along_the_cycle(exponent: float) -> None:
    values = SPRING | BOUC_WEN | {"hysteresis_exponent": exponent}
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    fast = cycles(one).force([Spring("k", ROW, 9e4), BoucWen("w", ROW, 80.0, 900.0, 0.6, exponent)])
    stepped = loop_force(values, one.series, one.frequency_hz, one.phase)
    assert np.abs(fast - stepped).max() < 1e-4 * np.ptp(stepped)


def test_closed_forms_are_those_of_the_elements_stepped_in_time() -> None:
    grid = np.arange(4096) / 4096
    x, v = 1e-3 * np.sin(2 * np.pi * grid), 2e-3 * np.pi * 12.0 * np.cos(2 * np.pi * grid)
    motion = Cycles.of([12.0], [np.array([0.0, 0.0, 1e-3])], [grid])
    for element in (
        Damper("c", ROW, 40.0),
        PolynomialSpring("p", ROW, -1e7, 3e9),
        DryFriction("f", ROW, 5.0, 2e-3),
        Maxwell("m", ROW, 1e4, 0.02),
    ):
        stepped = force_along([element], x, v, 1 / (12.0 * 4096), deviation=steady_deviation)
        assert np.abs(motion.force([element]) - stepped).max() < 2e-3 * np.ptp(stepped), element.name


def test_limit_cycle_meets_its_closed_form() -> None:
    # n = 1, σ = ½: unloading is a straight line, loading is 1 - exp(-x), so that W - ln(1 - W) = ρ·2X.
    cycle, top = LimitCycle(0.5, 1.0), 0.7
    span = np.array([top - np.log(1 - top)])
    assert cycle.along(span, span) == pytest.approx([top], abs=1e-5)
    assert cycle.along(np.array([0.2]), span) == pytest.approx([-(top - 0.2)], abs=1e-5)


def test_play_before_a_spring_is_a_dead_zone() -> None:
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    force = cycles(one).force([LooseSpring("k", ROW, 9e4, preload=-2e-4, gap=4e-4)])
    x = one.displacement
    expected = 9e4 * np.sign(x) * np.maximum(np.abs(x) - 2e-4, 0.0)
    assert np.abs(force - expected).max() < 1e-6 * np.ptp(expected)


def test_play_before_spring_damper_and_hysteresis_is_that_of_a_simulation_in_time() -> None:
    values = SPRING | BOUC_WEN | {"viscous_damping": 30.0, "backlash_gap": 3e-4}
    one = loop(values, 12.0, 1e-3, noise=0.0)
    loose = LooseSpring("k", ROW, 9e4, preload=-1.5e-4, gap=3e-4)
    force = cycles(one).force([loose, Damper("c", ROW, 30.0), BoucWen("w", ROW, 80.0, 900.0, 0.6)])
    stepped = steady_force(values, one.frequency_hz, 1e-3, one.phase)
    assert np.sqrt(np.mean((force - stepped) ** 2)) < 2e-3 * np.ptp(stepped)
    assert np.mean(np.abs(force) < 1e-9) > 0.05  # the play is there


@pytest.mark.parametrize("play", [False, True])
def test_derivatives_are_those_of_the_residuals(play: bool) -> None:
    observations = LoopObservations(isolator(), [loop(SPRING, f, 1e-3) for f in (10.0, 16.0)])
    own = ["quadratic_stiffness", "cubic_stiffness", "viscous_damping", "hysteresis", "relaxation"]
    labels = [f"{e}@isolator" for e in own]
    problem = observations.problem([placed(e) for e in labels + ["backlash@isolator.mount"] * play], {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    x = problem.unknowns.clipped(problem.start({}) + 0.05)
    jacobian = problem.residuals(x, scatters).jacobian
    for i, name in enumerate(problem.unknowns.names):
        step = np.zeros(len(x))
        step[i] = 1e-4
        ends = [problem.residuals(x + s * step, scatters, derivatives=False).values for s in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-4
        # Where contact is lost, the force of a damper jumps.
        assert np.linalg.norm(slope - jacobian[:, i]) < (0.08 if play else 0.02) * np.linalg.norm(slope), name


def test_error_is_one_with_the_true_effects_and_sizes_hold_the_calibration() -> None:
    random = np.random.default_rng(1)
    values = SPRING | {"cubic_stiffness": 3e9, "viscous_damping": 40.0}
    data = [loop(values, f, a, random=random) for f in (10.0, 16.0) for a in (1e-3, 2e-3)]
    observations = LoopObservations(isolator(), data)
    problem = observations.problem(
        [placed("cubic_stiffness@isolator"), placed("viscous_damping@isolator")], {}
    )
    scatters = {n: s.start for n, s in observations.scatters.items()}
    found = learn(problem, anneal(problem, scatters, problem.start()), observations.scatters)
    assert found.error == pytest.approx(1.0, abs=0.1)
    known = problem.parameter_values(found.x)
    truth = {
        "stiffness": 9e4,
        "cubic_stiffness@isolator.stiffness": 3e9,
        "viscous_damping@isolator.coefficient": 40.0,
    }
    for name, value in truth.items():
        i = problem.unknowns.index[name]
        size = problem.sizes.get(name)
        std = found.std[i] * (known[name] if size is None else size.slope(found.x[i]))
        assert abs(known[name] - value) < 3 * std, name
        assert std > 0.025 * value, name  # force and displacement are known to 2 % each
    assert found.scatters[FORCE_SCATTER] < 1e-3
    assert found.scatters[NOISE_SCATTER] < 0.3


def test_scatter_of_noise_is_learned_where_the_cycles_do_not_show_it() -> None:
    import dataclasses

    random = np.random.default_rng(5)
    data = [loop(SPRING, f, a, random=random) for f in (10.0, 16.0) for a in (1e-3, 2e-3)]
    sure = [dataclasses.replace(d, force_std_n=d.force_std_n / 4) for d in data]
    observations = LoopObservations(isolator(), sure)
    problem = observations.problem((), {})
    scatters = {n: s.start for n, s in observations.scatters.items()}
    found = learn(problem, anneal(problem, scatters, problem.start()), observations.scatters)
    assert found.scatters[NOISE_SCATTER] > 2.0  # √15, but for what counts as a force that no model explains
    assert found.error == pytest.approx(4.0, rel=0.15)  # counted in the noise that was stated


def test_loops_are_left_out_by_amplitude_frequency_and_setting() -> None:
    nine = [loop(SPRING, f, a) for f in (10.0, 12.0, 15.0) for a in (1e-3, 1.5e-3, 2e-3)]
    assert left_out(nine) == [
        (0, 3, 6), (1, 4, 7), (2, 5, 8),  # amplitudes
        (0, 1, 2), (3, 4, 5), (6, 7, 8),  # frequencies
    ]  # fmt: skip
    assert left_out(nine[:1]) == []
    assert left_out(nine[:2]) == [(0,), (1,)]
    soft, stiff = (loop({"stiffness": 9e4, "viscous_damping": c}, 10.0, 1e-3) for c in (40.0, 80.0))
    assert settings_differ([soft, stiff])
    assert not settings_differ(nine)
    assert left_out([soft, stiff, nine[5]], settings_differ=True)[-2:] == [(0,), (1,)]
    pairs = LoopObservations(isolator(), nine).folds()
    assert [len(kept.loops) for kept, _ in pairs] == [6] * 6
    assert all(out.typical == kept.typical for kept, out in pairs)  # sizes of effects have the same units


def test_scales_of_sizes_follow_the_measured_force() -> None:
    observations = LoopObservations(isolator(), [loop(SPRING, 12.0, 1e-3)])
    scaled = observations.scaled(placed("cubic_stiffness@isolator"))
    assert scaled.effect.parameters[0].scale * 1e-3**3 == pytest.approx(0.5 * 90.0, rel=0.02)
    assert observations.scaled(scaled) == scaled
    rho = observations.scaled(placed("hysteresis@isolator")).effect.parameters[1]
    assert rho.start == pytest.approx(1e3, rel=0.02)


def test_no_loops_are_refused() -> None:
    with pytest.raises(EmaError, match="no loops"):
        LoopObservations(isolator(), [])


def test_a_misfit_is_placed_on_its_third_of_the_way_and_told_by_what_acts_like_it() -> None:
    """A spring that is there only on the last third of the way up."""
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    rising = one.velocity > -0.03 * np.max(one.velocity)  # with the turning point
    top = rising & (one.displacement > one.amplitude_m / 3)
    odd = replace(one, force=one.force + 2e4 * one.displacement * top, force_std_n=0.5)
    problem = LoopObservations(isolator(), [odd]).problem([], {})
    found = regions(problem, problem.start({}))
    assert len(found) == 6
    assert found[0].place == "way up, last third"
    assert {r.place for r in found if "after the reversal" in r.place} == {
        f"way {way}, first third (after the reversal)" for way in ("up", "down")
    }
    assert found[0].acts_like == "stiffness"
    rest = odd.force - problem.forces(problem.start({}))[0]
    rest = (rest - rest.mean())[top]
    x = one.displacement[top]
    assert found[0].size == pytest.approx(x @ rest / (x @ x), rel=0.05)
    assert found[0].squares == pytest.approx(rest @ rest / 0.5**2, rel=0.1)


def test_the_unit_of_the_scatter_is_the_force_at_the_first_harmonic_whatever_its_phase() -> None:
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    units = [
        LoopData.of(replace(one, force=30.0 * np.cos(2 * np.pi * one.phase - turn))).unit
        for turn in (0.0, 1.3)
    ]
    np.testing.assert_allclose(units[1], units[0], rtol=1e-5)
    assert units[0][0] == pytest.approx(30.0 * np.sqrt(len(one.phase) / 2), rel=0.02)


@pytest.mark.parametrize(
    ("count", "stated", "several", "own"),
    [
        (1, "auto", True, False), (1, "yes", True, False), (2, "yes", False, True), (2, "no", True, False),
        (2, "auto", True, True), (2, "auto", False, False),
    ],
)  # fmt: skip
def test_loops_have_scales_of_their_own_where_that_is_stated_or_their_settings_differ(
    count: int, stated: Literal["auto", "yes", "no"], several: bool, own: bool
) -> None:
    loops = [loop(SPRING, f, 1e-3) for f in (10.0, 16.0)[:count]]
    assert have_own_scales(loops, LoopSettings(own_scales=stated), several) == own


def test_an_element_that_is_stretched_twice_as_much_makes_four_times_the_force() -> None:
    """By the row of a lever of two: k·(2·x)·2."""
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    rig = isolator()

    def levered(configuration: str, values: Mapping[str, float]) -> Assembly:
        built = rig.build(configuration, values)
        return built.add(Spring("lever", {"mass.x": 2.0}, 1e4))

    more = ParametricRig("levered", rig.configurations, rig.parameters, levered)
    problems = [LoopObservations(r, [one]).problem([], {}) for r in (rig, more)]
    plain, both = (p.forces(np.zeros(len(p.unknowns)))[0] for p in problems)
    np.testing.assert_allclose(both - plain, 4e4 * one.displacement, atol=1e-6 * np.ptp(plain))


def test_fits_begin_as_stiff_as_the_loops_and_at_several_shapes() -> None:
    data = LoopObservations(isolator(), [loop(SPRING, 12.0, a, noise=0.0) for a in (1e-3, 2e-3)])
    plain = data.problem((), {})
    stated = data.rig.parameters["stiffness"].value
    assert plain.start()[plain.unknowns.index["stiffness"]] == pytest.approx(np.log(9e4 / stated), abs=1e-3)
    effect = placed("relaxation@isolator")
    problem = data.problem([effect], {})
    names = [effect.parameter_name(p.name) for p in effect.effect.parameters]
    assert [problem._is_shape(n) for n in names] == [False, True]
    assert problem._options(names[1]) == (-1.5, 0.0, 1.5)
    x = np.full(len(problem.unknowns), 0.1)
    tried = np.array(list(problem._shapes(x)))
    at = problem.unknowns.index[names[1]]
    assert tried[:, at].tolist() == [0.1, -1.5, 0.0, 1.5]
    assert np.all(np.delete(tried, at, axis=1) == 0.1)
