"""How hits were aimed, from the motion that they left."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulate_amplitude import COORDINATES, observed, simulated_hits, true_assembly

from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.observations.hit_aim import as_aimed
from ema_pipeline.observations.hit_data import HitData


@pytest.fixture(scope="module")
def data() -> HitData:
    (found,) = observed(simulated_hits(noise=1e-4)).hits
    return found


def along(dofs: list[str]) -> np.ndarray:
    """Motion of some DOFs in the shapes of the true rig."""
    shapes = eigen_solution(true_assembly().system())[1]
    return np.asarray(shapes[[COORDINATES.index(d) for d in dofs]])


def rows_of(data: HitData) -> tuple[np.ndarray, list[np.ndarray]]:
    """Along each blow, and across it."""
    assert data.pulses is not None
    struck = [d.point for d in data.pulses.struck]
    other = {"x": "y", "y": "x"}
    return along(struck), [along([f"{p[:-1]}{other[p[-1]]}"]) for p in struck]


def motion(data: HitData, rows: np.ndarray) -> np.ndarray:
    """Amplitude that blows along these rows leave, by the response to a force at once: -j/ω·φ·∫f·exp(-λt)dt."""
    assert data.pulses is not None
    t = (np.arange(data.pulses.force_n.shape[1]) - data.pulses.peak) / data.pulses.sample_rate_hz
    poles = 1j * data.omega - data.decay
    impulse = (
        np.array([[f @ np.exp(-p * t) for p in poles] for f in data.pulses.force_n])
        / data.pulses.sample_rate_hz
    )
    return np.asarray(-1j / data.omega * impulse * rows)


def all_heard(data: HitData) -> HitData:
    """The same, with every mode heard in every hit, whatever its size."""
    known = replace(data)
    known.__dict__["used"] = np.ones(data.log_frequency.shape, bool)
    return known


@pytest.mark.slow
def test_the_motion_of_simulated_hits_is_that_of_blows_as_they_were_aimed(data: HitData) -> None:
    """Read from raw hits along one direction: whatever is found across is an error."""
    nominal, across = rows_of(data)
    shapes = eigen_solution(true_assembly().system())[1]
    seen = shapes[[COORDINATES.index(str(d)) for d in data.dofs]]
    displacement = data.motion * np.einsum("om,mo->m", seen, data.shapes) / np.sum(seen**2, axis=0)
    found = as_aimed(data, nominal, across, displacement, np.arange(nominal.shape[1]), 1.0)
    largest = np.max(np.abs(nominal))
    assert np.max(np.abs(found.real - nominal)) < 0.03 * largest
    assert np.max(np.abs(found.imag)) < 0.1 * largest


@pytest.mark.parametrize("share", [-0.3, 0.1, 0.2])
def test_a_hit_aimed_otherwise_is_found_so_and_moves_nothing_that_it_does_not_strike(
    data: HitData, share: float
) -> None:
    data = all_heard(data)
    nominal, across = rows_of(data)
    true = nominal + share * np.concatenate(across)
    displacement = motion(data, true)
    match = np.arange(nominal.shape[1])
    np.testing.assert_allclose(as_aimed(data, nominal, across, displacement, match, 1.0), true, atol=1e-6)
    np.testing.assert_allclose(as_aimed(data, nominal, across, 2 * displacement, match, 2.0), true, atol=1e-6)
    unknown = match.copy()
    unknown[0] = -1  # a mode of the model that was not measured follows from the others
    found = as_aimed(data, nominal, across, displacement, unknown, 1.0)
    np.testing.assert_allclose(found[:, 0], true[:, 0], atol=0.02 * np.abs(true).max())
    assert data.pulses is not None
    for h, dof in enumerate(data.pulses.struck):
        others = along([d for d in COORDINATES if d.split(".")[0] != dof.body])
        assert np.max(np.abs(others @ found[h])) < 0.03 * np.abs(nominal[h] @ nominal[h])


def test_a_mode_that_hardly_rings_does_not_turn_the_blow(data: HitData) -> None:
    data = all_heard(data)
    nominal, across = rows_of(data)
    displacement = motion(data, nominal)
    displacement[:, 1] *= -30.0
    found = as_aimed(data, nominal, across, displacement, np.arange(nominal.shape[1]), 1.0)
    np.testing.assert_allclose(found, nominal, atol=0.05 * np.abs(nominal).max())


def test_without_what_tells_the_stated_direction_stays(data: HitData) -> None:
    nominal, across = rows_of(data)
    silent: Any = np.zeros_like(motion(data, nominal))
    match = np.arange(nominal.shape[1])
    np.testing.assert_array_equal(as_aimed(data, nominal, across, silent, match, 1.0), nominal)
    one = [rows[:0] for rows in across]  # a rig that moves along one line
    found = as_aimed(all_heard(data), nominal, one, motion(data, 1.02 * nominal), match, 1.0)
    np.testing.assert_allclose(found, 1.02 * nominal, rtol=1e-6)
