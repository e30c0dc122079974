"""What is left of probabilities where something may be missing that is not in the library."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.diagnose.probability import complete, shared
from ema_pipeline.diagnose.types import NOTHING, UNKNOWN


@pytest.mark.parametrize("count", [10, 40, 400])
def test_an_error_below_one_tells_of_nothing_that_the_library_lacks(count: int) -> None:
    assert complete(0.6, count) == complete(1.0, count) == 1.0
    errors = np.linspace(1.0, 1.5, 26)
    told = [complete(error, count) for error in errors]
    assert all(np.diff(told) < 0)


def test_the_more_data_the_more_a_large_error_tells() -> None:
    few, some, many = (complete(1.25, count) for count in (10, 40, 400))
    assert few > 0.9 > some > many
    assert complete(1.1, 400) > 0.98  # one in twenty models that lack nothing has as much
    assert complete(1.29, 10**6) < 0.5
    assert 0 < complete(3.0, 0) < 1


def test_what_others_lose_is_the_probability_of_what_is_not_in_the_library() -> None:
    told = {"a@x": 0.5, "b@x": 0.25, NOTHING: 0.25}
    assert shared(told, 1.0, 1.0) == told
    assert shared(told, 1.0, 0.0) == {"a@x": 0.5, "b@x": 0.25, NOTHING: 0.0, UNKNOWN: 0.25}
    assert shared(told, 0.5, 0.5) == {"a@x": 0.25, "b@x": 0.125, NOTHING: 0.125, UNKNOWN: 0.5}
