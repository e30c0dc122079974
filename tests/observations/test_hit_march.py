"""What nonlinear elements make of the sizes of modes, against hits simulated and read like measured ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numba
import numpy as np
import pytest
from scipy.optimize import brentq
from simulate_amplitude import COORDINATES, RIG, observed, simulated_hits, true_assembly

from ema_pipeline.effects.library import parse_effect
from ema_pipeline.levels.differences import smooth_terms
from ema_pipeline.mechanics.laws import Nonlinear, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.observations.amplitude import AmplitudeObservations
from ema_pipeline.observations.fitting import Model, fit_base
from ema_pipeline.observations.hit_data import HitData
from ema_pipeline.observations.hit_lattice import uninterpolated
from ema_pipeline.observations.hit_march import Driven, marched_modes
from ema_pipeline.observations.hit_modes import Linear, changed_modes
from ema_pipeline.observations.hit_reading import drive_gains, momentary_weights
from ema_pipeline.observations.hit_residuals import AMPLITUDE

MESH = {"hub.x": 1.0, "rim.x": -1.0}
PRELOAD = 4e-4


def teeth(preload: float, gap: float = 1e-2) -> PartingSpring:
    stiffness = next(e.stiffness for e in true_assembly().springs() if e.name == "hub-rim mesh")
    return PartingSpring("hub-rim mesh", MESH, stiffness, preload=preload, gap=gap)


@cache
def simulated(kind: str) -> AmplitudeObservations:
    element: Nonlinear = (
        teeth(PRELOAD) if kind == "teeth" else PolynomialSpring("q", {"hub.y": 1.0}, quadratic=1e7)
    )
    return observed(simulated_hits([element], noise=1e-4))


def modes_of(data: HitData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues and shapes of the true rig, and the amplitude of its modal coordinates in every hit."""
    values, shapes = eigen_solution(true_assembly().system())
    seen = shapes[[COORDINATES.index(str(d)) for d in data.dofs]]
    factor = np.einsum("om,mo->m", seen, data.shapes) / np.sum(seen**2, axis=0)
    return values, shapes, data.motion * factor


def marched(data: HitData, element: PartingSpring, scale: float = 1.0) -> np.ndarray:
    values, shapes, displacement = modes_of(data)
    assert data.pulses is not None
    struck = np.array([d.sign * shapes[COORDINATES.index(d.point)] for d in data.pulses.struck])
    stretch = element_rows(true_assembly(), [element]) @ shapes
    driven = Driven.of(data, stretch, struck, np.arange(len(values)), values, scale)
    found = marched_modes(data, [element], driven, scale * displacement)
    assert found is not None
    return found


def about_mean(data: HitData, values: np.ndarray) -> np.ndarray:
    means = [values[data.sheet == s].mean(axis=0) for s in data.sheet]
    return np.asarray(values - means)


def agreement(data: HitData, size: np.ndarray) -> tuple[float, float]:
    """Slope and correlation of what is read of sizes in quadrature over what is predicted."""
    told = about_mean(data, (size * data.relative_size).imag)
    read = about_mean(data, data.relative_size.imag)
    known = data.used & (np.abs(told) > 1e-3)
    told, read = told[known], read[known]
    return float(told @ read / (told @ told)), float(told @ read / np.sqrt((told @ told) * (read @ read)))


@pytest.mark.slow
def test_sizes_that_teeth_change_are_those_of_simulated_hits() -> None:
    """From raw hits through FRFs and modes: no equivalent stiffness tells them."""
    (data,) = simulated("teeth").hits
    slope, correlation = agreement(data, marched(data, teeth(PRELOAD))[1])
    assert slope == pytest.approx(1.0, abs=0.04)
    assert correlation > 0.99
    other = agreement(data, marched(data, teeth(0.9 * PRELOAD))[1])
    assert abs(other[0] - 1) > 2 * abs(slope - 1)


@pytest.mark.slow
def test_sizes_that_a_quadratic_spring_changes_are_those_of_simulated_hits() -> None:
    (data,) = simulated("quadratic").hits
    values, shapes, displacement = modes_of(data)
    spring = PolynomialSpring("q", {"hub.y": 1.0}, quadratic=1e7)
    stretch = element_rows(true_assembly(), [spring]) @ shapes
    linear = Linear.of(data, stretch, np.arange(len(values)), values, displacement)
    slope, correlation = agreement(data, changed_modes(data, [spring], linear)[1])
    assert slope == pytest.approx(0.9, abs=0.1)
    assert correlation > 0.99
    turned = changed_modes(data, [replace(spring, quadratic=-1e7)], linear)[1]
    assert agreement(data, turned)[0] < 0  # its sign shows, which frequencies hardly tell


def test_teeth_that_never_part_or_have_no_gap_change_nothing() -> None:
    (data,) = simulated("teeth").hits
    assert not np.any(marched(data, teeth(1.0)))
    np.testing.assert_allclose(marched(data, teeth(1e-5, gap=0.0)), 0.0, atol=1e-9)


def test_twice_the_motion_at_twice_the_lengths_changes_the_same() -> None:
    (data,) = simulated("teeth").hits
    once, twice = marched(data, teeth(PRELOAD, 2e-4)), marched(data, teeth(2 * PRELOAD, 4e-4), scale=2.0)
    np.testing.assert_allclose(twice, once, rtol=1e-5, atol=1e-9)


def test_marched_hits_lie_straight_between_those_of_the_lattice_in_any_order() -> None:
    observations = simulated("teeth")
    (data,) = observations.hits
    base = fit_base(observations, Model())
    effects = [parse_effect("mesh_backlash@hub-rim", RIG)]

    def changes(about: AmplitudeObservations, unknown: float) -> np.ndarray:
        problem = about.problem(effects, {})
        x = problem.start({"mesh_backlash@hub-rim.preload": PRELOAD, "mesh_backlash@hub-rim.gap": 1e-2})
        at = problem.unknowns.index["mesh_backlash@hub-rim.preload"]
        x[at] = unknown
        x[problem.unknowns.index[AMPLITUDE]] = 0.0
        assert about.lattice is not None
        return about.lattice.changes(data, problem, x)

    places = (2.0, 2.02, 2.05)
    first, second = (observations.about((), base.posterior) for _ in range(2))
    forward = [changes(first, u) for u in places]
    backward = [changes(second, u) for u in reversed(places)][::-1]
    for a, b in zip(forward, backward, strict=True):
        np.testing.assert_array_equal(a, b)
    low, between, high = forward
    np.testing.assert_allclose(between, low + 0.4 * (high - low), rtol=1e-9, atol=1e-12)
    some = data.only(data.level > 0)
    assert first.lattice is not None
    problem = first.problem(effects, {})
    x = problem.start()
    whole = first.lattice.changes(data, problem, x)
    np.testing.assert_array_equal(first.lattice.changes(some, problem, x), whole[:, data.level > 0])


def test_sizes_that_are_tried_lie_on_the_lattice_where_each_costs_one_march() -> None:
    observations = simulated("teeth")
    about = observations.about((), fit_base(observations, Model()).posterior)
    problem = about.problem([parse_effect("mesh_backlash@hub-rim", RIG)], {})
    x = problem.start({"mesh_backlash@hub-rim.preload": PRELOAD, "mesh_backlash@hub-rim.gap": 1e-2})
    x[problem.unknowns.index[AMPLITUDE]] = 0.013
    lattice = about.lattice
    assert lattice is not None
    moved = uninterpolated(problem, x)
    at = lattice._place(problem, moved, problem.lattice_groups[0])[1]
    np.testing.assert_allclose(
        at, np.rint(lattice._place(problem, x, problem.lattice_groups[0])[1]), atol=1e-9
    )
    others = np.setdiff1d(np.arange(len(x)), problem.marched_sizes)
    np.testing.assert_array_equal(moved[others], x[others])
    (data,) = about.hits
    lattice.changes(data, problem, moved)
    assert len(lattice._nodes) == 1
    lattice.changes(data, problem, x)
    assert len(lattice._nodes) == 3  # ahead in both sizes


@pytest.mark.parametrize(
    "exponent", [complex(-6.0, 2 * np.pi * 97.0), complex(-6.0, 0.0), complex(-3.5, 2 * np.pi * 49.0)]
)
def test_what_a_fit_reads_of_a_driven_mode_has_a_closed_form(exponent: complex) -> None:
    pole, lines = complex(-3.0, 2 * np.pi * 50.0), np.arange(45.0, 55.0, 0.25)
    s = 2j * np.pi * lines - pole
    columns = np.stack([s**-2, 1 / s, *smooth_terms(len(s))], axis=1)
    expected = np.linalg.lstsq(columns, 1 / (s * (2j * np.pi * lines - exponent)), rcond=1e-12)[0][:2]
    found = drive_gains(np.array([[exponent]]), pole, lines)
    assert found.shape == (2, 1, 1)
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-6)


def test_a_change_of_the_pole_from_the_blow_on_changes_no_size() -> None:
    pole, lines = complex(-3.0, 2 * np.pi * 50.0), np.arange(45.0, 55.0, 0.25)
    instants = np.geomspace(1e-3, 3.0, 40)
    read, size = momentary_weights(instants, pole, lines) @ np.ones(len(instants))
    assert read == pytest.approx(1.0, abs=0.02)
    assert abs(size) < 0.02 / 3.0


def test_how_far_a_hit_is_aimed_otherwise_is_noise_of_what_is_read() -> None:
    """The drift of a hit whose sizes differ is known less well."""
    (data,) = simulated("teeth").hits
    astray = data.size.copy()
    astray[4] *= 1.5
    other = replace(data, size=astray)
    assert np.all((other.otherwise[4] > data.otherwise[4] + 0.1)[data.used[4]])
    told = []
    for hits in (data, other):
        observations = AmplitudeObservations(simulated("teeth").modes, [hits])
        problem = observations.problem((), {})
        scatters = {n: s.default for n, s in observations.scatters.items()}
        drift = problem.unknowns.index[f"drift of test {data.names[4]}"]
        told.append(np.linalg.norm(problem.residuals(problem.start(), scatters).jacobian[:, drift]))
    assert told[1] < 0.5 * told[0]


def test_hits_in_which_one_mode_scatters_about_any_smooth_curve_are_known_less_well() -> None:
    (data,) = simulated("teeth").hits
    assert np.all(data.irregularity < 1.5)  # as they part, and are read, smoothly
    mode = int(np.flatnonzero(data.used[:6].all(axis=0))[0])
    astray = data.damping.copy()
    noise = 9 * np.hypot(data.damping_std[:6, mode], data.linearised_std[:6, mode] * astray[:6, mode])
    astray[:6, mode] += noise * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    factor = replace(data, damping=astray).irregularity
    assert np.all(factor[:6, mode] > 1.5)
    others = np.ones(factor.shape, bool)
    others[:6, mode] = False
    np.testing.assert_array_equal(factor[others], data.irregularity[others])
    whole = data.damping.copy()  # where all modes do, the structure does
    whole[:6] *= 1 + 0.2 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])[:, None]
    np.testing.assert_array_equal(replace(data, damping=whole).irregularity[:6], 1.0)


def test_a_mode_that_aim_alone_excites_tells_nothing_by_its_phase() -> None:
    """Over a mean of nearly nothing sizes were ±70 with any phase, and friction of 1 mN explained it."""
    (data,) = simulated("teeth").hits
    mode = int(np.flatnonzero(data.used.all(axis=0) | data.used[:6].all(axis=0))[0])
    astray = data.size.copy()
    size = astray[0, mode]
    astray[:6, mode] = size * (1 + 70 * np.array([1.0, -1.0, 0.9, -0.8, 0.7, -0.8]) * np.exp(0.5j))
    costs = []
    for hits in (data, replace(data, size=astray)):
        observations = AmplitudeObservations(simulated("teeth").modes, [hits])
        problem = observations.problem((), {})
        scatters = {n: s.default for n, s in observations.scatters.items()}
        costs.append(problem.residuals(problem.start(), scatters).cost)
    assert costs[1] < costs[0] + 10


def test_hits_aimed_to_both_sides_differ_in_phase_and_not_in_quadrature() -> None:
    """Their mean is nearly nothing, of any phase: relative to it teeth that were not there explained the scatter."""
    (data,) = simulated("teeth").hits
    mode = int(np.flatnonzero(data.used[:6].all(axis=0))[0])
    aim = np.array([1.7, -0.9, -0.7, 1.6, -0.9, 0.9])
    astray = data.size.copy()
    astray[:6, mode] = np.abs(astray[0, mode]) * (aim + 0.25j) * np.exp(1.1j)
    std = data.size_std.copy()
    std[:6, mode] = 1e-3 * np.abs(astray[0, mode])
    relative = replace(data, size=astray, size_std=std).relative_size[:6, mode]
    size = np.sqrt(np.mean(aim**2 + 0.25**2))
    np.testing.assert_allclose(np.ptp(relative.real), np.ptp(aim) / size, rtol=0.02)
    assert np.std(relative.imag) < 0.1 * np.std(relative.real)
    straight = data.size.copy()  # where all hits are alike, the mean is what they are compared with
    straight[:6, mode] = straight[0, mode] * np.array([1.0, 1.02, 0.98, 1.01, 0.99, 1.0])
    relative = replace(data, size=straight, size_std=std).relative_size[:6, mode]
    np.testing.assert_allclose(relative, [1.0, 1.02, 0.98, 1.01, 0.99, 1.0], rtol=1e-3)


@pytest.mark.parametrize("stop", [0.0, 0.01, 1.0, 3.0])
def test_friction_at_the_end_of_a_step_solves_its_equation(stop: float) -> None:
    from ema_pipeline.mechanics.modal_response_kernel import _gripped

    def rate(u: float) -> float:
        return u + stop * np.tanh(u) - abs(free)

    solve = numba.njit(lambda free, stop, before: _gripped(free, stop, before))
    for free in (*np.geomspace(1e-9, 1e3, 25), -0.4, -30.0, 0.0):
        u = brentq(rate, 0.0, abs(free), xtol=1e-14, rtol=1e-14) if free else 0.0
        for before in (0.0, 1.0, -1.0, 0.3):
            assert solve(free, stop, before) == pytest.approx(np.sign(free) * np.tanh(u), rel=1e-7, abs=1e-15)
