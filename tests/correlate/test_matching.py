"""Modes of two tests matched: at common DOFs, in one sign, by shape first and by frequency where there is no shape."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.correlate.matching import common_shapes, mac_between, match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof

A = [[1.0, 2.0, 3.0], [2.0, -1.0, 0.5]]


def modes_of(
    frequency_hz: list[float], dofs: str = "", shapes: list[list[float]] | None = None
) -> MeasuredModes:
    """Modes of a test; shapes as (n_modes, n_dofs)."""
    f = np.array(frequency_hz)
    return MeasuredModes(
        configuration="default",
        frequency_hz=f,
        frequency_std_hz=np.full(f.size, 0.01),
        damping_ratio=np.full(f.size, 0.01),
        damping_std=np.full(f.size, 0.001),
        dofs=tuple(Dof.parse(d) for d in dofs.split()),
        shapes=None if shapes is None else np.array(shapes, dtype=complex).reshape(f.size, -1),
        shape_std=None if shapes is None else np.full(np.shape(shapes), 0.01),
    )


def test_shapes_are_compared_at_common_dofs_in_one_sign() -> None:
    a = modes_of([10.0, 20.0], "m1.x m2.x m3.x", A)
    b = modes_of([10.0, 20.0], "m4.x -m3.x m1.x", [[9.0, -3.0, 1.0], [9.0, -0.5, 2.0]])
    found = common_shapes(a, b)
    assert found is not None
    np.testing.assert_array_equal(found[0], [[1.0, 3.0], [2.0, 0.5]])
    np.testing.assert_array_equal(found[1], [[1.0, 3.0], [2.0, 0.5]])
    alike = mac_between(a, b)
    assert alike is not None
    # (1·2 + 3·0.5)² / ((1 + 9)(4 + 0.25)) between the two shapes
    np.testing.assert_allclose(alike, [[1.0, 12.25 / 42.5], [12.25 / 42.5, 1.0]])


def test_one_common_dof_or_no_shape_gives_no_mac() -> None:
    a = modes_of([10.0, 20.0], "m1.x m2.x m3.x", A)
    assert common_shapes(a, modes_of([10.0], "m1.x m9.x", [[1.0, 1.0]])) is None
    assert common_shapes(a, modes_of([10.0, 20.0])) is None
    assert mac_between(a, modes_of([10.0, 20.0])) is None
    two = common_shapes(a, modes_of([10.0], "m1.x m2.x", [[1.0, 1.0]]))
    assert two is not None
    assert two[0].shape == (2, 2)


def test_modes_that_have_changed_places_are_matched_by_their_shapes() -> None:
    a = modes_of([10.0, 10.2], "m1.x m2.x", [[1.0, 1.0], [1.0, -1.0]])
    b = modes_of([10.0, 10.2], "m1.x m2.x", [[1.0, -1.0], [1.0, 1.0]])
    assert match_modes(a, b).tolist() == [1, 0]


def test_shapes_of_other_modes_and_far_frequencies_are_no_match() -> None:
    one, other = [[1.0, 0.0]], [[0.0, 1.0]]
    a = modes_of([10.0], "m1.x m2.x", one)
    assert match_modes(a, modes_of([10.0], "m1.x m2.x", other)).tolist() == [-1]
    assert match_modes(a, modes_of([13.5], "m1.x m2.x", one)).tolist() == [0]  # ln 1.35 = 0.30
    assert match_modes(a, modes_of([14.5], "m1.x m2.x", one)).tolist() == [-1]  # ln 1.45 = 0.37


def test_the_nearest_of_two_alike_shapes_is_taken() -> None:
    a = modes_of([10.0], "m1.x m2.x", [[1.0, 1.0]])
    b = modes_of([11.0, 10.1], "m1.x m2.x", [[1.0, 1.0], [1.0, 1.0]])
    assert match_modes(a, b).tolist() == [1]


def test_without_shapes_modes_within_five_per_cent_are_matched() -> None:
    a = modes_of([10.0, 20.0, 30.0])
    assert match_modes(a, modes_of([10.4, 21.2])).tolist() == [0, -1, -1]
    assert match_modes(a, modes_of([29.0, 19.5, 9.7])).tolist() == [2, 1, 0]


@pytest.mark.parametrize("order", [(0, 2), (2, 0), (0, 0)])
def test_no_modes_match_nothing(order: tuple[int, int]) -> None:
    a, b = (modes_of([10.0, 20.0][:n]) for n in order)
    assert match_modes(a, b).tolist() == [-1] * order[0]
