"""The share of a shape's uncertainty that its entries do not have in common."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imperfect_modes import GOOD, chain_modes

from ema_pipeline.correlate.measured import from_modal_model, to_modal_model
from ema_pipeline.dof import Dof
from ema_pipeline.modal.fit import Estimate
from ema_pipeline.modal.fit_covariance import own_share
from ema_pipeline.modal.noise import Noise
from ema_pipeline.modal.scaling import scale_shapes
from ema_pipeline.observations.mode_data import prepare

POLES = np.array([-2.0 + 100.0j, -2.0 + 300.0j])
OMEGA = np.linspace(50.0, 350.0, 601)
ESTIMATE = Estimate(POLES, np.ones((2, 1), complex))


def fitted(common: float, own: float, transposed: bool = False, in_turn: bool = False) -> np.ndarray:
    """Share of three rows of two modes, the last row not measured; noise of its own twice as strong about mode two."""
    level = np.where(OMEGA < 200.0, own, 2.0 * own) * np.ones((3, 1, 1))
    noise = Noise(np.full((3, 1, len(OMEGA)), common), level)
    measured = np.array([[True], [True], [False]])
    data: Any = SimpleNamespace(
        omega=OMEGA, frf=level, transposed=transposed, in_turn=in_turn, measured=measured
    )
    return own_share(data, ESTIMATE, noise)


def test_noise_of_the_hits_is_in_common_and_noise_of_the_channels_is_not() -> None:
    np.testing.assert_allclose(fitted(0.0, 3.0), 1.0)
    np.testing.assert_allclose(fitted(3.0, 0.0)[:2], 0.0, atol=1e-12)
    share = fitted(3.0, 1.0)
    np.testing.assert_allclose(share[:2], [[1 / 4, 2 / 5]] * 2, rtol=0.02)
    assert share[2].tolist() == [1.0, 1.0]  # nothing is known of what was not measured


def test_struck_points_and_turns_of_moved_sensors_have_hits_of_their_own() -> None:
    np.testing.assert_array_equal(fitted(3.0, 1.0, transposed=True), 1.0)
    np.testing.assert_array_equal(fitted(3.0, 1.0, in_turn=True), 1.0)


@pytest.mark.parametrize("calibrated", [True, False])
def test_what_is_in_common_is_no_part_of_what_entries_have_of_their_own(calibrated: bool) -> None:
    rows = (Dof("a", "x"), Dof("b", "x"), Dof("c", "x"))
    shapes, stds = np.array([[1.0, -2.0, 0.5]], complex), np.full((1, 3), 0.1)
    share = np.array([[0.25, 0.25, 1.0]])
    part = np.array([[1.0, 0.3]], complex)
    found = scale_shapes(
        rows, (rows[0], Dof("d", "x")), POLES[:1], shapes, stds, share, part, np.full((1, 2), 0.05),
        calibrated=calibrated,
    )  # fmt: skip
    assert found.own_stds.shape == found.stds.shape == (1, 4)
    assert np.all(found.own_stds[:, :3] <= found.stds[:, :3])
    size = np.abs(found.shapes[0, 1] / shapes[0, 1])
    np.testing.assert_allclose(found.own_stds[0, 1:3], 0.1 * size * np.array([0.5, 1.0]))


def test_a_point_that_was_only_hit_is_as_uncertain_as_the_scale() -> None:
    """The driving point lies near a node: what it shows may be motion across the hit."""
    rows = (Dof("a", "x"), Dof("b", "x"))
    stds, share = np.full((1, 2), 1e-4), np.ones((1, 2))

    def relative(at_driving_point: float) -> tuple[float, float]:
        shapes = np.array([[at_driving_point, 1.0]], complex)
        part = np.array([[at_driving_point, 1.0]], complex)
        found = scale_shapes(
            rows, (rows[0], Dof("c", "x")), POLES[:1], shapes, stds, share, part, np.full((1, 2), 1e-4),
            calibrated=True,
        )  # fmt: skip
        return float(found.own_stds[0, 2] / abs(found.shapes[0, 2])), float(found.scale_std[0])

    near, scale = relative(0.01)
    assert near > 1.0
    assert near == pytest.approx(2 * scale, rel=1e-2)
    assert relative(1.0)[0] < 0.1


def test_shapes_are_compared_by_what_is_their_own_where_that_is_known() -> None:
    measured = chain_modes(7, GOOD)["all"]
    model = to_modal_model(measured)
    assert from_modal_model(model, "all").shape_own_std is None
    assert measured.shapes is not None
    own = 0.003 * np.abs(measured.shapes).max() * np.ones(measured.shapes.shape)
    for mode, std in zip(model.modes, own, strict=True):
        object.__setattr__(mode, "shape_own_std", std)
    known = from_modal_model(model, "all")
    assert known.shape_own_std is not None
    np.testing.assert_array_equal(known.shape_own_std, own)
    largest = np.max(np.abs(np.real(measured.shapes)), axis=1, keepdims=True)
    np.testing.assert_allclose(prepare(known).shape_std, own / largest, rtol=1e-3)
    assert not np.allclose(prepare(measured).shape_std, own / largest)
