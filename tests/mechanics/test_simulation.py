"""The compiled simulation under measured forces: against SciPy's integrator, its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from driven import driven_system, set_difference
from scipy.integrate import solve_ivp

from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.dissipation import HystereticSpring, SquareDamper
from ema_pipeline.mechanics.driven_system import Slopes, resolved
from ema_pipeline.mechanics.laws import BoucWen, DryFriction, Maxwell, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.mechanics.simulation import (
    Sensors,
    between_samples,
    march,
)

RATE, SUBSTEPS = 500.0, 8
ROW = {"a.x": 1.0}
BETWEEN = {"a.x": 1.0, "b.x": -1.0}


def _chain(*more: object) -> Assembly:
    return Assembly(
        ("a.x", "b.x"),
        (
            Mass("a", ROW, 1.5),
            Mass("b", {"b.x": 1.0}, 2.0),
            Spring("ground", ROW, 4e4),
            Spring("link", BETWEEN, 2e4),
            Damper("ground damper", ROW, 12.0),
            Damper("link damper", BETWEEN, 6.0),
            *more,  # type: ignore[arg-type]
        ),
    )


def _force(samples: int) -> np.ndarray:
    time = np.arange(samples) / RATE
    return 30.0 * (np.cos(2 * np.pi * 17 * time) + np.sin(2 * np.pi * 31 * time + 1.0))


def _exact_force(time: float) -> float:
    return float(30.0 * (np.cos(2 * np.pi * 17 * time) + np.sin(2 * np.pi * 31 * time + 1.0)))


LAWS = {
    "cubic": (PolynomialSpring("e", BETWEEN, 1e6, 4e9), lambda d, v: 1e6 * d**2 + 4e9 * d**3),
    "friction": (DryFriction("e", BETWEEN, 3.0, 0.05), lambda d, v: 3.0 * np.tanh(v / 0.05)),
    "square damper": (SquareDamper("e", BETWEEN, 80.0), lambda d, v: 80.0 * abs(v) * v),
}


ALONE = {
    "linear": (),
    "cubic and friction": (PolynomialSpring("e", ROW, 1e6, 4e9), DryFriction("f", ROW, 3.0, 0.05)),
    "square damper": (SquareDamper("e", ROW, 80.0),),
    "hysteresis": (HystereticSpring("e", ROW, 2e4, 20.0, 0.3, 1.0),),
    "relaxation beside a contact": (PartingSpring("e", ROW, 1e4, preload=1e-4), Maxwell("f", ROW, 1e4, 5e-3)),
    "two that remember": (HystereticSpring("e", ROW, 2e4, 20.0, 0.3, 1.6), Maxwell("f", ROW, 1e4, 5e-3)),
}


@pytest.mark.parametrize("name", ALONE)
def test_one_coordinate_alone_moves_as_beside_one_that_rests(name: str) -> None:
    parts = (Mass("a", ROW, 1.5), Spring("ground", ROW, 4e4), Damper("damper", ROW, 12.0), *ALONE[name])
    idle = (Mass("b", {"b.x": 1.0}, 1.0), Spring("idle", {"b.x": 1.0}, 1e3))
    fine = between_samples(_force(300)[None], 2 * SUBSTEPS)
    motions = []
    for assembly in (Assembly(("a.x",), parts), Assembly(("a.x", "b.x"), (*parts, *idle))):
        n = len(assembly.dofs)
        system = driven_system(assembly, np.eye(n)[:1])
        begin = np.zeros(system.size)
        begin[[0, n]], begin[2 * n :] = (1e-3, 0.1), 1e-4
        found = march(system, RATE, SUBSTEPS, fine, begin)
        assert found is not None
        motions.append(np.delete(found[0], [1, 3], axis=1) if n == 2 else found[0])
    scale = np.max(np.abs(motions[1]), axis=0)
    np.testing.assert_allclose(motions[0] / scale, motions[1] / scale, atol=1e-11)


@pytest.mark.parametrize("name", LAWS)
def test_motion_is_that_of_another_integrator(name: str) -> None:
    element, law = LAWS[name]
    samples = 400
    system = driven_system(_chain(element), np.array([[1.0, 0.0]]))
    fine = between_samples(_force(1250)[None], 2 * SUBSTEPS)[: 2 * SUBSTEPS * (samples - 1) + 1]
    found = march(system, RATE, SUBSTEPS, fine, np.zeros(system.size))
    assert found is not None

    def rate(time: float, y: np.ndarray) -> list[float]:
        d, v = y[0] - y[1], y[2] - y[3]
        link = 2e4 * d + 6.0 * v + law(d, v)
        a = (_exact_force(time) - 4e4 * y[0] - 12.0 * y[2] - link) / 1.5
        return [y[2], y[3], a, link / 2.0]

    time = np.arange(samples) / RATE
    known = solve_ivp(rate, (0, time[-1]), np.zeros(4), t_eval=time, rtol=1e-9, atol=1e-13).y.T
    # the first samples of a record that begins within a wave are known least
    assert np.max(np.abs(found[0][:, :4] - known)[50:]) < 3e-3 * np.max(np.abs(known), axis=0).max()
    moved = np.linalg.norm(found[0][:, 0] - known[:, 0]) / np.linalg.norm(known[:, 0])
    assert moved < 3e-3


def test_hysteresis_is_that_of_the_normalised_law_where_both_hold() -> None:
    sigma, rho, limit = 0.6, 900.0, 20.0
    normal = BoucWen("e", BETWEEN, limit, rho, sigma)
    free = HystereticSpring("e", BETWEEN, limit * rho, limit / sigma, (1 - sigma) / sigma)
    force, rows = _force(300)[None], np.array([[1.0, 0.0]])
    a, b = (
        march(driven_system(_chain(e), rows), RATE, 4, between_samples(force, 8), np.zeros(5))
        for e in (normal, free)
    )
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(a[0], b[0], rtol=1e-9, atol=1e-15)
    slow = nonlinear_response(_chain(normal), RATE, force, np.eye(2), rows, substeps=64).displacement
    # that one takes straight lines between the samples of the force
    assert np.corrcoef(slow[0, 20:], a[0][20:, 0])[0, 1] > 0.999


@pytest.mark.slow
def test_derivatives_are_those_of_the_motion() -> None:
    def assembly(p: np.ndarray) -> Assembly:
        return _chain(
            PolynomialSpring("c", ROW, 0.0, 1e9 * p[0]),
            SquareDamper("q", BETWEEN, 50.0 * p[1]),
            HystereticSpring("h", BETWEEN, 1e4 * p[2], 20.0 * p[3], 0.4 * p[4], 1.0 + p[5]),
            Maxwell("m", ROW, 3e3 * p[6], 0.02 * p[7]),
            DryFriction("f", ROW, 1.0 * p[8], 0.05 * p[9]),
        )

    point, rows = np.array([1.0, 1, 1, 1, 1, 0.7, 1, 1, 1, 1]), np.array([[1.0, 0.0]])
    fine = between_samples(_force(260)[None], 8)
    sensors = Sensors(np.eye(2), ("displacement", "acceleration"))

    def read(p: np.ndarray, slopes: Slopes | None = None) -> tuple[np.ndarray, np.ndarray]:
        system, own = resolved(driven_system(assembly(p), rows), 1 / (RATE * 4), slopes)
        found = march(system, RATE, 4, fine, np.zeros(system.size), own)
        assert found is not None
        return sensors.read(system, found[0], fine[::8], found[1], own)

    slopes = Slopes.none(driven_system(assembly(point), rows), len(point))
    step = 1e-5
    for k in range(len(point)):
        low, high = point.copy(), point.copy()
        low[k] -= step
        high[k] += step
        ends = [driven_system(assembly(p), rows) for p in (low, high)]
        set_difference(slopes, k, *ends, 2 * step)
    _, change = read(point, slopes)
    for k in range(len(point)):
        low, high = point.copy(), point.copy()
        low[k] -= step
        high[k] += step
        by_difference = (read(high)[0] - read(low)[0]) / (2 * step)
        np.testing.assert_allclose(
            change[:, :, k], by_difference, atol=2e-5 * max(float(np.max(np.abs(by_difference))), 1e-30)
        )


def test_a_signal_between_samples_is_band_limited() -> None:
    time = np.arange(600) / RATE
    signal = np.cos(2 * np.pi * 150 * time + 0.3)
    fine = between_samples(signal[None], 4)[:, 0]
    known = np.cos(2 * np.pi * 150 * np.arange(len(fine)) / (4 * RATE) + 0.3)
    middle = slice(400, -400)
    assert np.max(np.abs(fine - known)[middle]) < 0.01
    assert np.allclose(fine[::4], signal, atol=1e-9)


def test_motion_without_bound_is_told() -> None:
    system = driven_system(_chain(PolynomialSpring("e", ROW, 0.0, -1e11)), np.array([[1.0, 0.0]]))
    fine = between_samples(100 * _force(400)[None], 4)
    assert march(system, RATE, 2, fine, np.zeros(system.size)) is None
