"""What modes have of their own damping, about the point where two of them cross."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.mechanics.modal_losses import slopes_of_own
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.rigs import load_rig

OWN = np.array([0.0, 0.7, -0.7, 0.2])
"""Logarithms of the damping ratios of the four lowest modes."""


def own_damping(hz: list[float]) -> np.ndarray:
    """What each mode has of these, at a common damping ratio of 1 %."""
    values = (2 * np.pi * np.array(hz)) ** 2
    return np.asarray(OWN @ slopes_of_own(values, np.full(len(hz), 0.01), len(OWN)))


def test_modes_that_are_apart_have_the_damping_of_their_number() -> None:
    """Half a half-width counts as apart; above the lowest ones modes have none of their own."""
    assert own_damping([0.16, 100.0, 100.5, 200.0, 300.0]) == pytest.approx([*OWN, 0.0], abs=3e-3)


def test_modes_that_coincide_have_the_mean_and_damping_is_continuous() -> None:
    assert own_damping([0.16, 100.0, 100.0, 200.0]) == pytest.approx([0.0, 0.0, 0.0, 0.2], abs=1e-9)
    apart = np.geomspace(1e-4, 1.0, 4000)
    told = np.array([own_damping([0.16, 100.0, 100.0 + d, 200.0]) for d in apart])
    assert np.max(np.abs(np.diff(told, axis=0))) < 0.01
    assert told[0] == pytest.approx([0.0, 0.0, 0.0, 0.2], abs=1e-3)
    assert told[-1] == pytest.approx(OWN, abs=1e-3)


def test_rigid_bodies_share_what_they_have() -> None:
    assert own_damping([0.16, 0.16, 0.16, 200.0]) == pytest.approx([0.0, 0.0, 0.0, 0.2], abs=1e-9)


def test_modes_in_the_band_are_counted_at_nominal_values() -> None:
    rig = load_rig("planetary")
    model = RigModel(rig)
    configuration = rig.configurations[0]
    hz = np.sqrt(model.modes(configuration, model.start())[1].eigenvalues) / (2 * np.pi)  # type: ignore[union-attr]
    between = float(0.5 * (hz[6] + hz[7]))
    assert model.count_below(configuration, between, 3) == 7
    assert model.count_below(configuration, between, 9) == 9
    assert model.count_below(configuration, 1.0, 1000) == len(hz)
