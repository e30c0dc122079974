"""Compiled responses of nonlinear assemblies to a hammer blow."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.effects.library import get_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.laws import DryFriction, Nonlinear, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter

RATE = 2048.0
TRUE = {"mass": 1.005, "bearing": 3.9e5, "link": 2.1e5, "modal_damping_ratio": 0.012}


def build(configuration: str, values: dict[str, float]) -> Assembly:
    """Two bodies in the plane, hub on a bearing and rim on the hub."""
    elements: list[Mass | Spring | Damper] = []
    for axis, factor in (("x", 1.0), ("y", 1.15)):
        hub, rim = f"hub.{axis}", f"rim.{axis}"
        elements += [
            Mass(f"hub mass {axis}", {hub: 1.0}, values["mass"]),
            Mass(f"rim mass {axis}", {rim: 1.0}, 0.5),
            Spring(f"hub bearing {axis}", {hub: 1.0}, factor * values["bearing"]),
            Spring(f"rim bearing {axis}", {rim: 1.0}, 1e4),
            Spring(f"link {axis}", {hub: 1.0, rim: -1.0}, values["link"]),
        ]
    return Assembly(("hub.x", "hub.y", "rim.x", "rim.y"), tuple(elements), {}, values["modal_damping_ratio"])


RIG = ParametricRig(
    "two bodies",
    ("test",),
    {
        "mass": Parameter("mass", 1.0, "kg", 0.01),
        "bearing": Parameter("bearing", 4e5, "N/m", 0.1),
        "link": Parameter("link", 2e5, "N/m", 0.1),
        "modal_damping_ratio": Parameter("modal_damping_ratio", 0.01, "1", 0.3),
    },
    build,
)


def pulse(n: int, peak: float, width_s: float = 2e-3) -> np.ndarray:
    t = np.arange(n) / RATE - 4e-3
    return np.where(np.abs(t) < width_s / 2, peak * np.cos(np.pi * t / width_s) ** 2, 0.0)


def plain(
    assembly: Assembly, force: np.ndarray, into: np.ndarray, out: np.ndarray, substeps: int
) -> np.ndarray:
    """The general integrator, which knows nothing of the compiled loop: a given state keeps it from there."""
    rest = np.zeros(len(assembly.dofs))
    return nonlinear_response(
        assembly, RATE, force[None], out, into[None], substeps=substeps, displacement=rest, velocity=rest
    ).acceleration


@pytest.mark.parametrize(
    "element",
    [
        PolynomialSpring("cubic", {"hub.x": 1.0}, cubic=3e11),
        PolynomialSpring("quadratic", {"hub.x": 1.0}, quadratic=-1e8),
        DryFriction("friction", {"hub.x": 1.0}, 4.0),
        PartingSpring("contact", {"hub.x": 1.0, "rim.x": -1.0}, 2e5, preload=1e-5, gap=1e-3),
    ],
    ids=lambda e: e.name,
)
def test_the_compiled_loop_agrees_with_the_general_integrator(element: Nonlinear) -> None:
    assembly = RIG.assembly("test", TRUE).add(element)
    force = pulse(500, 150.0)
    out, into = np.eye(4), np.array([1.0, 0.0, 0.0, 0.0])
    compiled = nonlinear_response(assembly, RATE, force[None], out, into[None], substeps=4)
    expected = plain(assembly, force, into, out, 4)
    assert np.std(compiled.acceleration - expected) < 1e-6 * np.std(expected)


def test_motion_without_bound_is_an_error_of_one_line() -> None:
    model = RIG.assembly("test", TRUE).add(PolynomialSpring("soft", {"hub.x": 1.0}, cubic=-1e16))
    with pytest.raises(EmaError, match="soft") as raised:
        nonlinear_response(model, RATE, pulse(400, 300.0)[None], np.eye(4), np.eye(4)[:1])
    assert "\n" not in str(raised.value)


def test_asymmetric_bearing_drifts_towards_its_soft_side() -> None:
    effect = get_effect("bearing_quadratic")
    soft = effect.apply(RIG.assembly("test", TRUE), "hub", {"stiffness": 1e9})
    x = nonlinear_response(soft, RATE, pulse(800, 200.0)[None], np.eye(4)[:1], np.eye(4)[:1], substeps=8)
    assert np.mean(x.displacement) < -1e-6  # the force K2·x² pushes one way whatever the sign of x
    assert not effect.linear


def test_friction_finer_than_a_step_stops_the_motion_without_ringing() -> None:
    """A mass on a spring, let go by a blow, under F·sign(v): stops where |k·x| < F and stays."""
    k, m, limit = 4e5, 1.0, 40.0
    assembly = Assembly(
        ("p.x",),
        (
            Mass("m", {"p.x": 1.0}, m),
            Spring("k", {"p.x": 1.0}, k),
            DryFriction("f", {"p.x": 1.0}, limit, 1e-6),
        ),
        {},
        1e-4,
    )
    force = pulse(400, 300.0)
    one = np.ones((1, 1))
    moved = nonlinear_response(assembly, RATE, force[None], one, one, substeps=16)
    x, v = moved.displacement[0], moved.velocity[0]
    peaks = [abs(x[i]) for i in range(1, 399) if v[i - 1] * v[i] < 0 and abs(x[i]) > limit / k]
    falls = -np.diff(peaks)[1:3]
    np.testing.assert_allclose(falls, 2 * limit / k, rtol=0.1)  # per half swing
    assert np.max(np.abs(v[300:])) < 1e-3 * np.max(np.abs(v))
    assert np.all(np.abs(x[300:]) <= 1.01 * limit / k)
