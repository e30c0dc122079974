"""Time axes: what is one, its rate, and how uncertain rounding makes the rate."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.readers.timebase import rate_from_times, time_rounding, time_unit_scale


def test_rounding_is_the_largest_step_off_the_median_over_the_span() -> None:
    # steps of 1, 1 and 1.2: 0.2 off over 3.2
    assert time_rounding(np.array([0.0, 1.0, 2.0, 3.2])) == pytest.approx(0.2 / 3.2)
    assert time_rounding(np.array([0.0, 1.0, 2.1])) == pytest.approx(0.05 / 2.1)
    assert time_rounding(np.array([0.0, 1.0])) == 0.0
    assert time_rounding(np.array([3.0, 2.0, 1.0])) == 0.0


def test_the_rate_of_an_axis_is_its_intervals_over_its_span() -> None:
    assert rate_from_times(np.arange(11) * 0.25 + 7.0) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0.0, 1.0, np.nan, 3.0], "not a number at sample 2"),
        ([0.0, 1.0, 3.0, 2.0, 4.0], "runs backwards at sample 3"),
    ],
)
def test_axes_that_cannot_be_are_refused_with_their_place(times: list[float], said: str) -> None:
    with pytest.raises(EmaError, match=said):
        rate_from_times(np.array(times))


@pytest.mark.parametrize(
    ("name", "unit", "scale"),
    [
        ("time", "ms", 1e-3),
        ("time_ms", None, 1e-3),
        ("t us", None, 1e-6),
        ("time", None, 1.0),
        ("time", "g", 1.0),
    ],
)
def test_times_are_in_the_unit_that_unit_or_name_states(name: str, unit: str | None, scale: float) -> None:
    assert time_unit_scale(name, unit) == scale
