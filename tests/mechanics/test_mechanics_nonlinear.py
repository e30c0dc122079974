"""Nonlinear elements, time and harmonic responses against scipy's integrators and closed forms."""

from __future__ import annotations

import time

import numpy as np
import pytest
import scipy.integrate

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.dissipation import HystereticSpring, SquareDamper
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.harmonic import describing_function, harmonic_response
from ema_pipeline.mechanics.laws import (
    BoucWen,
    DryFriction,
    Maxwell,
    Nonlinear,
    PartingSpring,
    PolynomialSpring,
    parting,
)
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.nonlinear import force_along, nonlinear_response, steady_deviation
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.mechanics.time_response import time_response
from ema_pipeline.rigs import load_rig

ROW = {"m.x": 1.0}
ONE = np.eye(1)


def oscillator(*more: object, mass: float = 1.0, stiffness: float = 0.0, damping: float = 0.0) -> Assembly:
    elements: list = [Mass("m", ROW, mass), *more]
    if stiffness:
        elements.append(Spring("k", ROW, stiffness))
    if damping:
        elements.append(Damper("c", ROW, damping))
    return Assembly(("m.x",), tuple(elements))


def test_duffing_response_to_a_blow_agrees_with_a_tight_integrator() -> None:
    k, cubic, c, rate = 4e4, 4e10, 2.0, 5120.0
    assembly = oscillator(PolynomialSpring("cubic", ROW, 0.0, cubic), stiffness=k, damping=c)
    t = np.arange(2048) / rate
    force = np.where(t < 0.002, 200.0 * np.sin(np.pi * t / 0.002) ** 2, 0.0)
    ours = nonlinear_response(assembly, rate, force[None], ONE, ONE, substeps=16).displacement[0]

    def slope(time_s: float, z: np.ndarray) -> list[float]:
        return [z[1], np.interp(time_s, t, force) - k * z[0] - cubic * z[0] ** 3 - c * z[1]]

    options = {"rtol": 1e-10, "atol": 1e-14, "max_step": 1 / rate}
    exact = scipy.integrate.solve_ivp(slope, (0, t[-1]), [0, 0], t_eval=t, **options).y[0]
    assert cubic * np.max(np.abs(exact)) ** 2 > 0.5 * k  # strongly nonlinear
    assert np.max(np.abs(ours - exact)) < 1e-4 * np.max(np.abs(exact))


@pytest.mark.parametrize(
    "element",
    [
        PolynomialSpring("e", ROW, 2e6, 4e9),
        DryFriction("e", ROW, 5.0, 2e-2),
        PartingSpring("e", ROW, 1e6, preload=2e-4, gap=3e-4),
        PartingSpring("e", ROW, 1e6, preload=-2e-4, gap=3e-4),
        BoucWen("e", ROW, 80.0, 900.0, 0.6),
        BoucWen("e", ROW, 80.0, 900.0, 0.6, 2.0),
        Maxwell("e", ROW, 1e4, 0.02),
        SquareDamper("e", ROW, 80.0),
        HystereticSpring("e", ROW, 7e4, 80.0, 0.4, 1.5),
    ],
    ids=lambda e: f"{type(e).__name__}",
)
def test_every_element_states_the_slopes_of_its_own_force(element: Nonlinear) -> None:
    """Newton's method and the derivatives of simulations rest on them."""
    before, h, worst = 1e-4, 1e-9, []
    for stretch in (-8e-4, -3.5e-4, 1.5e-4, 5e-4):
        for rate in (-0.03, 0.01):
            given = before, stretch, rate, element.start, 1e-3
            _, by_stretch, by_rate, _ = element.step(*given)
            ends = [element.step(before, stretch + s, rate, element.start, 1e-3)[0] for s in (-h, h)]
            rates = [element.step(before, stretch, rate + 1e3 * s, element.start, 1e-3)[0] for s in (-h, h)]
            # one element takes its path in steps of fourth order, which are not exact
            assert by_stretch == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-2, abs=1.0)
            assert by_rate == pytest.approx((rates[1] - rates[0]) / (2e3 * h), rel=1e-4, abs=1e-6)
            worst.append(abs(by_stretch) + abs(by_rate))
    assert max(worst) > 1.0  # there was something to see


def test_error_falls_with_the_square_of_the_step() -> None:
    assembly = oscillator(PolynomialSpring("cubic", ROW, 0.0, 4e10), stiffness=4e4, damping=2.0)
    start = {"displacement": np.array([1e-3])}
    force = np.zeros((1, 512))
    runs = [
        nonlinear_response(assembly, 5120.0, force, ONE, ONE, substeps=n, **start).displacement[0]
        for n in (4, 8, 64)
    ]
    coarse, fine = (np.max(np.abs(r - runs[2])) for r in runs[:2])
    assert 3.3 < coarse / fine < 4.7


@pytest.mark.parametrize("preload", [2e-5, -1e-5, 0.0])
def test_free_decay_with_backlash_agrees_with_a_tight_integrator(preload: float) -> None:
    k, gap, c, rate = 1e6, 2e-5, 20.0, 25600.0
    mesh = PartingSpring("mesh", ROW, k, preload=preload, gap=gap)
    assembly = oscillator(mesh, damping=c)
    start = 1e-4
    ours = nonlinear_response(
        assembly, rate, np.zeros((1, 1024)), ONE, ONE, substeps=24, displacement=np.array([start])
    ).displacement[0]

    def force(x: float) -> float:
        return k * (max(x + preload, 0.0) + min(x + preload + gap, 0.0) - max(preload, 0.0))

    t = np.arange(1024) / rate
    exact = scipy.integrate.solve_ivp(
        lambda _, z: [z[1], -force(z[0]) - c * z[1]],
        (0, t[-1]),
        [start, 0],
        t_eval=t,
        rtol=1e-10,
        atol=1e-15,
        max_step=1e-5,
    ).y[0]
    assert np.min(exact) < -max(preload, 0.0)  # the teeth do part
    assert np.max(np.abs(ours - exact)) < 1e-4 * start


@pytest.mark.parametrize(
    ("sigma", "exponent"), [(0.169, 1.0), (0.8, 1.0), (0.5, 1.0), (0.7, 2.0), (2.0, 1.5)]
)
def test_bouc_wen_loop_agrees_with_a_tight_integrator(sigma: float, exponent: float) -> None:
    k_w, rho, amplitude = 133.25, 631.42, 1e-3
    t = np.linspace(0, 2.3, 2000)
    phase = 2 * np.pi * t
    x = amplitude * (np.sin(phase) + 0.6 * np.sin(2.7 * phase))
    v = amplitude * 2 * np.pi * (np.cos(phase) + 0.6 * 2.7 * np.cos(2.7 * phase))

    def slope(time_s: float, w: np.ndarray) -> list[float]:
        p = 2 * np.pi * time_s
        rate = amplitude * 2 * np.pi * (np.cos(p) + 0.6 * 2.7 * np.cos(2.7 * p))
        size = abs(w[0])
        pull = sigma * abs(rate) * size ** (exponent - 1) * w[0] if size else 0.0
        return [rho * (rate - pull + (sigma - 1) * rate * size**exponent)]

    exact = scipy.integrate.solve_ivp(
        slope, (0, t[-1]), [0.0], t_eval=t, rtol=1e-10, atol=1e-13, max_step=2e-3
    ).y[0]
    ours = force_along((BoucWen("h", ROW, k_w, rho, sigma, exponent),), x, v, t[1])
    # Between samples the path is taken to be monotone; only the turning points are cut off.
    assert np.max(np.abs(ours - k_w * exact)) < 1e-4 * k_w * np.max(np.abs(exact))


def test_bouc_wen_oscillator_rings_as_a_tight_integrator_says() -> None:
    k, k_w, rho, sigma, rate = 9.7e4, 133.25, 631.42, 0.6, 5120.0
    assembly = oscillator(BoucWen("h", ROW, k_w, rho, sigma), stiffness=k, mass=2.0, damping=5.0)
    t = np.arange(1500) / rate
    ours = nonlinear_response(
        assembly, rate, np.zeros((1, 1500)), ONE, ONE, substeps=16, velocity=np.array([0.5])
    ).displacement[0]

    def slope(_: float, z: np.ndarray) -> list[float]:
        x, v, w = z
        rise = rho * (v - sigma * abs(v) * w + (sigma - 1) * v * abs(w))
        return [v, -(k * x + 5.0 * v + k_w * w) / 2.0, rise]

    exact = scipy.integrate.solve_ivp(
        slope, (0, t[-1]), [0, 0.5, 0], t_eval=t, rtol=1e-10, atol=1e-13, max_step=1e-4
    ).y[0]
    assert np.max(np.abs(ours - exact)) < 1e-4 * np.max(np.abs(exact))


def test_maxwell_branch_has_its_closed_form_stiffness_and_loss() -> None:
    k, tau, f, amplitude = 5e4, 0.01, 12.0, 1e-3
    n = 4000
    phase = 2 * np.pi * np.arange(n) / n
    x, v = amplitude * np.cos(phase), -amplitude * 2 * np.pi * f * np.sin(phase)
    force = force_along((Maxwell("relaxation", ROW, k, tau),), x, v, 1 / (f * n), deviation=steady_deviation)
    dynamic = 2 * np.fft.rfft(force)[1] / n / amplitude
    jwt = 2j * np.pi * f * tau
    assert dynamic == pytest.approx(k * jwt / (1 + jwt), rel=1e-5)


def test_dry_friction_takes_four_times_limit_times_amplitude_per_cycle() -> None:
    n, f, amplitude, limit = 4096, 20.0, 1e-3, 7.0
    phase = 2 * np.pi * np.arange(n) / n
    x, v = amplitude * np.sin(phase), amplitude * 2 * np.pi * f * np.cos(phase)
    force = force_along((DryFriction("f", ROW, limit, 1e-6),), x, v, 1 / (f * n))
    energy = float(np.mean(force * v)) / f
    assert energy == pytest.approx(4 * limit * amplitude, rel=1e-4)


def test_without_deviation_the_nonlinear_response_is_the_linear_one() -> None:
    rig = load_rig("planetary")
    linear = rig.assembly("with_ring")
    idle = linear.add(PolynomialSpring("idle", {"sun.x": 1.0}), DryFriction("none", {"ring.y": 1.0}, 0.0))
    system = linear.system()
    force = np.random.default_rng(3).standard_normal((1, 800))
    rows = sensor_rows(system, (Dof("sun", "x"), Dof("planet1", "y")))
    a = time_response(system, 5120.0, force, rows, rows[:1])
    b = nonlinear_response(idle, 5120.0, force, rows, rows[:1])
    np.testing.assert_allclose(b.acceleration, a.acceleration, atol=1e-9 * np.abs(a.acceleration).max())


def test_one_second_of_a_rig_with_two_nonlinear_elements_takes_less_than_three_seconds() -> None:
    assembly = load_rig("planetary").assembly("with_ring")
    assert len(assembly.dofs) == 15
    assembly = assembly.add(
        PolynomialSpring("cubic", {"sun.x": 1.0}, 0.0, 1e13), DryFriction("friction", {"carrier.y": 1.0}, 5.0)
    )
    t = np.arange(25600) / 25600
    force = np.where(t < 1e-3, 300 * np.sin(np.pi * t / 1e-3) ** 2, 0.0)[None]
    row = sensor_rows(assembly.system(), (Dof("sun", "x"),))
    start = time.perf_counter()
    nonlinear_response(assembly, 25600.0, force, row, row)
    assert time.perf_counter() - start < 3.0


def test_motion_that_grows_without_bound_is_refused_in_one_line() -> None:
    assembly = oscillator(PolynomialSpring("softening", ROW, 0.0, -1e10), stiffness=1e4)
    with pytest.raises(EmaError, match=r"no solution at step \d+ .* with softening: .*without bound"):
        nonlinear_response(assembly, 1e3, np.zeros((1, 500)), ONE, ONE, displacement=np.array([1e-2]))


@pytest.mark.parametrize(
    ("element", "stiffness"),
    [
        (PartingSpring("mesh", ROW, 5e5, preload=1e-5), 5e5),
        (BoucWen("h", ROW, 100.0, 600.0, 0.5), 6e4),
        (Maxwell("r", ROW, 3e4, 0.1), 3e4),
    ],
)
def test_linear_system_holds_the_tangent(element: Nonlinear, stiffness: float) -> None:
    frequency_hz, _ = normal_modes(oscillator(element, mass=2.0, stiffness=1e4).system())
    assert frequency_hz[0] == pytest.approx(np.sqrt((1e4 + stiffness) / 2.0) / (2 * np.pi))


def test_harmonic_balance_of_duffing_agrees_with_the_time_response_at_steady_state() -> None:
    assembly = oscillator(
        PolynomialSpring("cubic", ROW, 1e7, 2e10), PartingSpring("stop", ROW, 2e4, preload=-4e-4, gap=8e-4),
        stiffness=4e4, damping=20.0,
    )  # fmt: skip
    f, amplitude, samples = 36.0, 30.0, 256
    hb = harmonic_response(assembly, np.array([f]), amplitude, ONE, ONE[0], harmonics=9)
    assert hb.converged.all()
    rate = f * samples
    t = np.arange(60 * samples) / rate
    force = amplitude * np.cos(2 * np.pi * f * t)[None]
    x = nonlinear_response(assembly, rate, force, ONE, ONE, substeps=4).displacement[0, -samples:]
    spectrum = np.fft.rfft(x)[:10] / samples * np.where(np.arange(10) > 0, 2.0, 1.0)
    np.testing.assert_allclose(hb.displacement[0, :4, 0], spectrum[:4], atol=2e-4 * abs(spectrum[1]))


def test_harmonic_balance_of_a_linear_rig_is_its_receptance() -> None:
    assembly = load_rig("planetary").assembly("with_ring")
    system = assembly.system()
    rows = sensor_rows(system, (Dof("sun", "x"), Dof("planet2", "u")))
    f = np.array([40.0, 300.0, 965.0])
    linear = harmonic_response(assembly, f, 10.0, rows, rows[0])
    exact = 10.0 * receptance(system, f, rows, rows[:1])[:, 0]
    np.testing.assert_allclose(linear.displacement[:, 1], exact, rtol=1e-8)


def test_hardening_oscillator_jumps_at_another_frequency_up_than_down() -> None:
    assembly = oscillator(PolynomialSpring("cubic", ROW, 0.0, 4e10), stiffness=4e4, damping=8.0)
    f = np.arange(30.0, 52.0, 0.5)
    up = np.abs(harmonic_response(assembly, f, 20.0, ONE, ONE[0]).displacement[0, 1])
    down = np.abs(harmonic_response(assembly, f[::-1], 20.0, ONE, ONE[0]).displacement[0, 1])[::-1]
    assert f[np.argmax(up)] > f[np.argmax(down)] + 2.0


@pytest.mark.parametrize("ratio", [1.2, 2.0, 5.0])
def test_describing_functions_are_the_textbook_ones(ratio: float) -> None:
    k, b = 1e6, 1e-5
    a = ratio * b
    expected = k * (1 - 2 / np.pi * (np.arcsin(1 / ratio) + np.sqrt(1 - ratio**-2) / ratio))
    backlash = PartingSpring("mesh", ROW, k, preload=-b, gap=2 * b)
    # The element counts its tangent from contact on, so the middle of the gap is an offset, not a motion.
    assert describing_function(backlash, a, 100.0, 8192).real == pytest.approx(expected, rel=1e-3)
    cubic = describing_function(PolynomialSpring("c", ROW, 0.0, 1e12), a, 100.0)
    assert cubic == pytest.approx(0.75e12 * a**2, rel=1e-9)


def test_backlash_lowers_the_apparent_frequency_as_its_describing_function_says() -> None:
    k, b, mass = 1e6, 1e-5, 1.0
    mesh = PartingSpring("mesh", ROW, k, preload=-b, gap=2 * b)
    rate = 51200.0
    omega = np.sqrt(k / mass)
    for ratio in (1.3, 2.0, 4.0, 10.0):
        start = np.array([ratio * b])
        x = nonlinear_response(
            oscillator(mesh, mass=mass), rate, np.zeros((1, 8192)), ONE, ONE, displacement=start
        ).displacement[0]
        up = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
        crossings = up + x[up] / (x[up] - x[up + 1])
        measured = rate * (len(crossings) - 1) / (crossings[-1] - crossings[0])
        # One full swing in contact, and the gap crossed twice at the speed of parting.
        exact = omega / (2 * np.pi + 4 / (ratio - 1))
        assert measured == pytest.approx(exact, rel=2e-4)
        if ratio >= 2:  # nearer to the gap one harmonic is too few
            described = np.sqrt(describing_function(mesh, ratio * b, 100.0, 4096).real / mass)
            assert measured == pytest.approx(described / (2 * np.pi), rel=0.025)


@pytest.mark.parametrize(
    ("stretch", "preload", "gap", "force", "slope"),
    [
        # stiffness 1e6 N/m, contact at stretch -preload, back contact a gap further; less the tangent in contact
        (-3e-6, 2e-6, 5e-6, -2.0 + 3.0, -1e6),  # parted: the force is -2 N, not -3 N
        (-9e-6, 2e-6, 5e-6, -4.0 + 9.0, 0.0),  # the back is reached at -7 µm: 2 µm of contact on top of -2 N
        (1e-6, 2e-6, 5e-6, 0.0, 0.0),
        (-9e-6, np.inf, 5e-6, 0.0, 0.0),  # teeth that nothing parts
    ],
)
def test_forces_of_teeth_that_separate_are_those_of_their_gap(
    stretch: float, preload: float, gap: float, force: float, slope: float
) -> None:
    found = parting(stretch, 0.0, 1e6, preload, gap)
    np.testing.assert_allclose(found, (force, slope, 0.0), rtol=1e-12, atol=1e-12)
