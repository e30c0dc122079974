"""Where model and measurement differ: what stands in no table of differences."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from ema_pipeline.fit.comparison import _alone


def test_modes_that_the_fit_gave_no_partner_are_told_with_the_mode_of_their_shape() -> None:
    fitted: Any = SimpleNamespace(
        posterior=SimpleNamespace(residuals=SimpleNamespace(matching=(np.array([0, -1, -1]),))),
        observations=SimpleNamespace(data=[SimpleNamespace(configuration="all")]),
    )
    measured: Any = {"all": SimpleNamespace(frequency_hz=np.array([10.0, 20.0, 30.0]))}
    pairs = [SimpleNamespace(measured=k, model_frequency_hz=hz, mac=0.99) for k, hz in ((0, 10.1), (1, 16.0))]
    pairings: Any = {"all": SimpleNamespace(pairs=pairs)}
    first, second = _alone(fitted, measured, pairings)
    assert (first.configuration, first.measured, first.measured_frequency_hz) == ("all", 1, 20.0)
    assert (first.model_frequency_hz, first.mac) == (16.0, 0.99)
    assert (second.measured, second.measured_frequency_hz) == (2, 30.0)
    assert np.isnan([second.model_frequency_hz, second.mac]).all()
