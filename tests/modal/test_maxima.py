"""Peaks by prominence, against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from ema_pipeline.levels.scatter import _log_density
from ema_pipeline.modal.hit_to_hit import _by_chance
from ema_pipeline.modal.maxima import prominent_peaks


@pytest.mark.parametrize("prominence", [0.0, 0.5, 2.0])
def test_peaks_are_those_of_scipy(prominence: float) -> None:
    rng = np.random.default_rng(1)
    for length in range(1, 120):
        rough = rng.normal(size=length)
        for curve in (rough, np.cumsum(rough), np.round(rough)):  # the last one has flat tops
            places, rise = prominent_peaks(curve, prominence)
            known, of = scipy.signal.find_peaks(curve, prominence=prominence)
            assert np.array_equal(places, known)
            assert np.array_equal(rise, of["prominences"])


def test_chance_of_a_rank_correlation_is_that_of_scipy() -> None:
    rng = np.random.default_rng(2)
    for n in (6, 9, 30):
        a = rng.integers(0, 8, size=n).astype(float)  # with ties
        b = a + rng.normal(size=n) * 4
        assert _by_chance(a, b) == pytest.approx(scipy.stats.spearmanr(a, b).pvalue, rel=1e-9)


def test_density_of_f_is_that_of_scipy() -> None:
    ratio = np.exp(np.random.default_rng(3).normal(size=(5, 4)))
    dof = np.array([1.0, 3.0, 7.0, 40.0])
    assert np.allclose(_log_density(ratio, dof, 2.0), scipy.stats.f.logpdf(ratio, dof, 2.0), rtol=1e-12)
