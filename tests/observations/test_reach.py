"""Measured modes above the reach of a model are no reason to doubt it."""

from __future__ import annotations

import numpy as np
import pytest
from frequencies import from_frequencies
from imperfect_modes import GOOD, chain, chain_modes

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.observations.fitting import Model, fit_base
from ema_pipeline.observations.mode_data import ModeData, prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.reach import within_reach
from ema_pipeline.rigs import model_modes

RIG = chain()
MODEL_HZ = np.array([m.frequency_hz for m in model_modes(RIG, "all")])


def within(frequency_hz: list[float]) -> ModeData:
    measured = from_frequencies("all", frequency_hz)
    return within_reach(prepare(measured), RIG)


@pytest.mark.parametrize("above", [[1.31], [1.31, 3.0]])
def test_modes_above_the_reach_are_left_out_and_the_band_ends_below_them(above: list[float]) -> None:
    top = MODEL_HZ[-1]
    kept = within([*MODEL_HZ, *(top * a for a in above)])
    assert np.exp(kept.log_frequency) == pytest.approx(MODEL_HZ)
    assert kept.band_hz[1] == pytest.approx(above[0] * top)
    assert len(within([*MODEL_HZ, 1.29 * top])) == len(MODEL_HZ) + 1


def test_all_stay_where_the_highest_modes_of_the_model_may_have_been_lifted_there() -> None:
    """Of a chain of five the two highest lie within a factor of 1.3 of each other."""
    top = MODEL_HZ[-1]
    assert len(within([*MODEL_HZ[:-1], 1.4 * top])) == len(MODEL_HZ)
    assert len(within([*MODEL_HZ[:3], 1.0 * top, 1.4 * top])) == len(MODEL_HZ)
    assert len(within([*MODEL_HZ[2:], 1.4 * top])) == 3  # lower ones were not measured


def test_a_mode_above_the_reach_leaves_the_error_as_it_was() -> None:
    measured = chain_modes(0, GOOD)["all"]
    assert measured.shapes is not None
    assert measured.shape_std is not None
    one_more = MeasuredModes(
        "all",
        np.append(measured.frequency_hz, 3 * MODEL_HZ[-1]),
        np.append(measured.frequency_std_hz, 0.01),
        np.append(measured.damping_ratio, 0.01),
        np.append(measured.damping_std, 1e-4),
        np.concatenate([measured.shapes, measured.shapes[:1]]),
        np.concatenate([measured.shape_std, measured.shape_std[:1]]),
        measured.dofs,
        band_hz=(1.0, 4 * MODEL_HZ[-1]),
    )

    def error(data: ModeData) -> float:
        observations = ModeObservations(RIG, [data])
        return fit_base(observations, Model((), {})).posterior.error

    data = prepare(one_more)
    assert error(within_reach(data, RIG)) == pytest.approx(error(prepare(measured)), rel=1e-6)
    assert error(data) > 1.2 * error(prepare(measured))
