"""Which mode of the model is which measured one: frequencies and shapes with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from frequencies import from_frequencies

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.observations.mode_data import ModeData, prepare
from ema_pipeline.observations.mode_pairing import paired, turned

UP, BENT = np.array([1.0, 0.5, 1.0]), np.array([1.0, 0.4, -1.0])
"""Two shapes that have nothing in common but 2 % (MAC)."""


def with_shapes(frequency_hz: list[float], shapes: list[np.ndarray]) -> ModeData:
    """Measured modes far apart by their half-widths, 0.1 % damping."""
    f = np.array(frequency_hz)
    given = np.array(shapes, complex)
    dofs = tuple(Dof.parse(f"m{k}.x") for k in range(given.shape[1]))
    return prepare(
        MeasuredModes("test", f, 1e-4 * f, np.full(len(f), 1e-3), np.full(len(f), 1e-5), given,
                      np.full(given.shape, 0.01), dofs, band_hz=(1.0, 1e3))
    )  # fmt: skip


def by_frequency(measured: list[float], model: list[float]) -> list[int]:
    data = prepare(from_frequencies("test", measured))
    return paired(data, np.array(model), np.zeros((0, len(model)))).tolist()


def test_frequencies_alone_pair_up_to_thirty_percent() -> None:
    assert by_frequency([100.0], [100 * np.exp(0.28), 300.0]) == [0]
    assert by_frequency([100.0], [30.0, 100 * np.exp(-0.28)]) == [1]
    assert by_frequency([100.0], [100 * np.exp(0.32), 300.0]) == [-1]
    assert by_frequency([100.0, 200.0], [200.0, 150.0, 100.0]) == [2, 0]


def test_close_modes_keep_their_order_where_all_are_off_to_one_side() -> None:
    assert by_frequency([100.0, 101.0], [105.0, 106.0]) == [0, 1]
    assert by_frequency([105.0, 106.0], [100.0, 101.0]) == [0, 1]


def test_a_rigid_body_mode_of_the_model_is_no_partner() -> None:
    assert by_frequency([10.0, 20.0], [0.0, 10.5, 19.0]) == [1, 2]


def test_a_mode_of_the_model_has_one_partner_only() -> None:
    assert by_frequency([100.0, 102.0], [101.9]) == [-1, 0]


def test_shapes_tell_modes_whose_frequencies_have_crossed() -> None:
    data = with_shapes([100.0, 104.0], [UP, BENT])
    read = np.column_stack([-3.0 * BENT, 0.1 * UP])  # neither sign nor size matters
    assert paired(data, np.array([100.0, 104.0]), read).tolist() == [1, 0]


@pytest.mark.parametrize(("heat", "reach"), [((), 0.13), ((1.0,), 0.13), ((11.0,), 0.26)])
@pytest.mark.parametrize("shape", [UP, np.array([1.0, 0.8j, -0.3])], ids=["real", "whirling"])
def test_equal_shapes_pair_up_to_thirteen_percent_and_further_while_a_fit_is_annealed(
    shape: np.ndarray, heat: tuple[float, ...], reach: float
) -> None:
    data = with_shapes([100.0], [shape])
    assert data.whirling.all() == np.iscomplexobj(shape)
    for sign in (-1, 1):
        near, far = (100 * np.exp([sign * share * reach]) for share in (0.97, 1.03))
        assert paired(data, near, 5 * shape[:, None], *heat).tolist() == [0]
        assert paired(data, far, 5 * shape[:, None], *heat).tolist() == [-1]


def test_equal_frequencies_with_shapes_that_have_little_in_common_pair() -> None:
    """A mode whose shape is quite wrong is told by its shape, not left out."""
    assert paired(with_shapes([100.0], [UP]), np.array([100.0]), BENT[:, None]).tolist() == [0]


def test_a_sensor_without_a_reading_says_nothing() -> None:
    """Over the two sensors that read, the shapes are equal, which makes up for 12 % of frequency."""
    lacking = np.where([True, False, True], UP, np.nan)
    read = np.array([1.0, 5.0, 1.0])[:, None]
    model = np.array([112.0])
    assert paired(with_shapes([100.0], [lacking]), model, read).tolist() == [0]
    assert paired(with_shapes([100.0], [UP]), model, read).tolist() == [-1]


def test_modes_that_whirl_either_way_are_told_by_their_sense() -> None:
    forward, backward = np.array([1.0, 0.8j]), np.array([1.0, -0.8j])
    data = with_shapes([100.0, 102.0], [forward * np.exp(0.9j), -2.0 * backward])
    assert data.whirling.all()
    read = np.column_stack([backward, forward * np.exp(-0.4j)])
    assert paired(data, np.array([100.0, 102.0]), read).tolist() == [1, 0]
    assert paired(data, np.array([100.0, 102.0]), read[:, ::-1]).tolist() == [0, 1]


def test_a_mode_that_whirls_leaves_the_others_compared_by_their_real_parts() -> None:
    """Of three modes the middle one whirls; what the model reads is complex by a factor for all."""
    whirl = np.array([1.0, 0.9j, 0.3])
    data = with_shapes([100.0, 102.0, 104.0], [UP, whirl, BENT])
    assert data.whirling.tolist() == [False, True, False]
    read = np.column_stack([BENT * np.exp(0.7j), UP * np.exp(-1.2j), 2j * whirl])
    assert paired(data, np.array([100.0, 102.0, 104.0]), read).tolist() == [1, 2, 0]
    read = np.column_stack([UP, np.conj(whirl), BENT, whirl])  # its sense is told all the same
    assert paired(data, np.array([100.0, 102.0, 104.0, 103.0]), read).tolist() == [0, 3, 2]


def test_complex_shapes_are_turned_to_real_ones() -> None:
    shapes = np.column_stack([UP * np.exp(0.7j), BENT * np.exp(-1.3j)])
    for found, real in zip(turned(shapes).T, (UP, BENT), strict=True):
        assert found * np.sign(found[0]) == pytest.approx(real)
    assert turned(np.column_stack([UP, -BENT])).tolist() == np.column_stack([UP, -BENT]).tolist()
