"""Time axes: what is one, its rate, and how uncertain rounding makes the rate."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.readers.timebase import rate_from_times, time_unit_scale


def test_rounding_is_the_largest_step_off_the_median_over_the_span() -> None:
    # steps of 1, 1 and 1.2: 0.2 off over 3.2
    assert rate_from_times(np.array([0.0, 1.0, 2.0, 3.2]))[1] == pytest.approx(0.2 / 3.2)
    assert rate_from_times(np.array([0.0, 1.0, 2.1]))[1] == pytest.approx(0.05 / 2.1)
    assert rate_from_times(np.array([0.0, 1.0])) == (None, 0.0)


def test_the_rate_of_an_axis_is_its_intervals_over_its_span() -> None:
    assert rate_from_times(np.arange(11) * 0.25 + 7.0) == (pytest.approx(4.0), 0.0)


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
        ("time", None, None),
        ("time", "g", None),
    ],
)
def test_times_are_in_the_unit_that_unit_or_name_states(
    name: str, unit: str | None, scale: float | None
) -> None:
    assert time_unit_scale(name, unit) == scale


RATE = 2048.0
TIMES = np.arange(4096) / RATE


def significant(times: np.ndarray, digits: int) -> np.ndarray:
    return np.array([float(f"{t:.{digits}g}") for t in times])


@pytest.mark.parametrize(
    ("times", "rate"),
    [
        (np.round(TIMES, 3), RATE),
        (np.floor(TIMES * 1000) / 1000, RATE),
        (np.round(np.arange(3002) / 1501, 3), 1501.0),
        (np.round(np.arange(2002) / 1001, 3), 1001.0),
        (significant(np.arange(50000) / 25600 - 0.3, 5), 25600.0),
        (significant(np.arange(12 * 999) / 999, 4), 999.0),
        (significant(np.arange(24000) / RATE, 3), RATE),
        (np.repeat(np.arange(100) * 0.016, 16), 1000.0),  # a board that stamps blocks
    ],
)
def test_stamps_rounded_to_more_than_a_sample_give_the_rate_to_within_their_rounding(
    times: np.ndarray, rate: float
) -> None:
    assert np.any(np.diff(times) == 0)
    found, uncertainty = rate_from_times(times)
    assert uncertainty == np.max(np.abs(np.diff(times) - np.median(np.diff(times)))) / np.ptp(times)
    assert found == pytest.approx(rate, rel=uncertainty)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (
            np.delete(np.round(TIMES, 3), np.s_[1201:1500]),
            r"time jumps by 0\.146 s at sample 1201 .* missing",
        ),
        (
            np.delete(np.round(TIMES, 3), np.s_[1201:1204]),
            r"time jumps by 0\.002 s at sample 1201 .* missing",
        ),
        (
            np.delete(np.floor(TIMES * 20) / 20, np.s_[1040:1110]),
            r"0\.5 s has 3. samples where 10. .* missing",
        ),
        (
            np.insert(TIMES, 500, [TIMES[499]] * 20),
            "stands still at 0.243652 s for 21 samples from sample 499 on",
        ),
        (np.insert(TIMES, 500, TIMES[499]), "for 2 samples from sample 499 on: rows are repeated"),
        (np.insert(np.round(TIMES, 6), 500, TIMES[499].round(6)), "for 2 samples from sample 499 on"),
        (np.insert(np.round(TIMES, 3), 500, [0.244] * 20), "stands still at 0.244 s for 22 samples"),
        (np.append(TIMES, [TIMES[-1]] * 20), "for 21 samples from sample 4095 on"),
        (np.full(50, 3.0), "stands still at 3 s"),
    ],
)
def test_missing_and_repeated_rows_are_found_although_stamps_are_equal(times: np.ndarray, said: str) -> None:
    with pytest.raises(EmaError, match=said):
        rate_from_times(times)


def test_a_handful_of_different_stamps_tells_no_rate() -> None:
    assert rate_from_times(np.floor(TIMES))[0] is None
