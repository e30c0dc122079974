"""Steady responses by shooting: what settles by itself after many periods, and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from driven import driven_system, set_difference

from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.dissipation import HystereticSpring
from ema_pipeline.mechanics.driven_system import DrivenSystem, Slopes
from ema_pipeline.mechanics.laws import Nonlinear, PolynomialSpring
from ema_pipeline.mechanics.periodic import steady_response
from ema_pipeline.mechanics.simulation import between_samples, march

RATE, PERIOD, FINE = 256.0, 256, 4
ROWS = ({"a.x": 1.0}, {"a.x": 1.0, "b.x": -1.0})


def _system(law: Nonlinear, stiffness: float = 4e3) -> DrivenSystem:
    elements = (
        Mass("a", {"a.x": 1.0}, 1.0),
        Mass("b", {"b.x": 1.0}, 2.0),
        Spring("ground", ROWS[0], stiffness),
        Spring("link", ROWS[1], 6e3),
        Damper("ground", ROWS[0], 0.8),
        Damper("link", ROWS[1], 0.6),
    )
    return driven_system(Assembly(("a.x", "b.x"), (*elements, law)), np.array([[0.0, 1.0]]))


def _force() -> np.ndarray:
    random = np.random.default_rng(2)
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[3:30] = np.exp(2j * np.pi * random.uniform(size=27))
    force = np.fft.irfft(spectrum, PERIOD)
    return between_samples(10 * force[None] / np.std(force), 2 * FINE, periodic=True)


LAWS = [
    PolynomialSpring("cubic", ROWS[1], 0.0, 1e6),
    HystereticSpring("loop", ROWS[1], 800.0, 4.0, 0.2, 1.0),
]


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_it_is_what_the_motion_settles_to(law: Nonlinear) -> None:
    system, force = _system(law), _force()
    found = steady_response(system, RATE, FINE, force)
    assert found is not None
    repeated = np.concatenate([np.tile(force[:-1], (250, 1)), force])
    long = march(system, RATE, FINE, repeated, np.zeros(system.size))
    assert long is not None
    last = long[0][-PERIOD - 1 :]
    assert np.max(np.abs(found[0] - last)) < 1e-5 * np.max(np.abs(last))


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_its_derivatives_are_those_of_the_settled_motion(law: Nonlinear) -> None:
    step, force = 1.0, _force()
    low, here, high = (_system(law, 4e3 + d) for d in (-step, 0.0, step))
    slopes = Slopes.none(here, 1)
    set_difference(slopes, 0, low, high, 2 * step)
    found = steady_response(here, RATE, FINE, force, slopes)
    ends = [steady_response(s, RATE, FINE, force) for s in (low, high)]
    assert found is not None
    assert ends[0] is not None
    assert ends[1] is not None
    difference = (ends[1][0] - ends[0][0]) / (2 * step)
    assert np.max(np.abs(found[1][..., 0] - difference)) < 1e-2 * np.max(np.abs(difference))
