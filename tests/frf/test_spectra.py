"""Sums over blocks, variances of multisines and windows of the force, against values written down by hand."""

from __future__ import annotations

import numpy as np
import pytest
from frf_hits import half_sine

from ema_pipeline.dof import Dof
from ema_pipeline.frf.distortion import distortion
from ema_pipeline.frf.overview import representative_frfs
from ema_pipeline.frf.spectra import Spectra, solved
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.frf.windows import force_window
from ema_pipeline.ingest.driven import DrivenRecord, ForceChannel
from ema_pipeline.ingest.pulse import find_pulse
from ema_pipeline.ingest.records import ResponseChannel


def summed(force: list[complex], response: list[complex]) -> Spectra:
    """One force and one response at two lines, alike in both, over blocks."""
    total = Spectra.none(1, 1, 2)
    for f, y in zip(force, response, strict=True):
        total.add(np.full((1, 2), f, complex), np.full((1, 2), y, complex))
    return total


def test_blocks_are_counted_and_their_variance_is_that_of_a_mean() -> None:
    # Forces of ±1 and responses 2f + e: the residual power is Σ|e|² = 4 over 4 - 1 degrees of freedom, Σ|f|² = 4.
    total = summed([1, -1, 1, -1], [3, -1, 1, -3])
    assert total.count == 4
    found = solved(total, 4.0, np.array([False, True]), "H1")
    assert found.frf[0, 0].tolist() == [0.0, 2.0]
    assert found.variance[0, 0, 1] == pytest.approx(4 / 3 / 4)
    assert np.isnan(found.variance[0, 0, 0])
    # 8 of 10 parts of the response's power ΣFF·|H|² = 16 of 20
    assert found.coherence[0, 0, 1] == pytest.approx(0.8)


def test_h2_and_hv_of_one_force_stand_above_h1_by_its_coherence() -> None:
    total = summed([1, -1, 1, -1], [3, -1, 1, -3])
    h1, h2, hv = (
        solved(total, 4.0, np.array([False, True]), e).frf[0, 0, 1].real for e in ("H1", "H2", "Hv")
    )
    assert h2 == pytest.approx(h1 / 0.8)
    assert hv == pytest.approx(np.sqrt(h1 * h2))


def test_as_many_averages_as_forces_give_neither_variance_nor_coherence() -> None:
    found = solved(summed([1], [2]), 1.0, np.array([False, True]), "H1")
    assert np.isnan(found.variance).all()
    assert np.isnan(found.coherence).all()


def test_explained_share_and_coherence_of_two_forces() -> None:
    total = Spectra.none(2, 1, 1)
    for a, b in ((1, 1), (1, -1), (1, 1), (1, 1)):  # Σab* = 2 of 4
        total.add(np.array([[a], [b]], complex), np.zeros((1, 1), complex))
    assert total.force_power.tolist() == [[4.0], [4.0]]
    assert total.input_coherence()[0, 1, 0] == pytest.approx(0.25)
    np.testing.assert_allclose(total.explained_by_others()[:, 0], 0.25, atol=1e-9)


def test_lines_are_excited_where_every_force_has_its_share_and_never_at_0_hz() -> None:
    total = Spectra.none(2, 1, 4)
    total.add(np.array([[9.0, 1.0, 1.0, 0.1], [9.0, 1.0, 0.5, 1.0]], complex), np.zeros((1, 4), complex))
    assert total.excited(0.25).tolist() == [False, True, True, False]


def multisine(gain: float, name: str, noise: tuple[float, ...] = (0.0, 0.0)) -> DrivenRecord:
    """Two periods of one line, the response `gain` times the force, off by `noise` in each period."""
    wave = np.cos(2 * np.pi * 2 * np.arange(16) / 16)
    force = np.tile(wave, 2)
    response = np.concatenate([(gain + e) * wave for e in noise])
    point = Dof("a", "x")
    return DrivenRecord(
        name=name,
        file="r.h5",
        excitation="multisine",
        use="fit",
        sample_rate_hz=16.0,
        forces=(ForceChannel("f", point, 0.0, 0.0),),
        force=force[None],
        channels=(ResponseChannel("x", point, "displacement"),),
        responses=response[None],
        period=16,
    )


def test_two_realisations_show_distortion_and_one_shows_noise_alone() -> None:
    two = distortion([multisine(1.0, "a"), multisine(3.0, "b")], 16)
    # gains of 1 and 3: variance 2 of one, 1 of their mean
    assert two.distortion[0, 0, 2] == pytest.approx(2.0)
    assert two.total[0, 0, 2] == pytest.approx(1.0)
    assert two.noise[0, 0, 2] == pytest.approx(0.0)
    one = distortion([multisine(1.0, "a", (0.1, -0.1))], 16)
    # gains of 1.1 and 0.9: variance 0.02 of one period, 0.01 of the mean of two
    assert one.noise[0, 0, 2] == pytest.approx(0.01)
    assert one.total[0, 0, 2] == pytest.approx(0.01)
    assert np.isnan(one.distortion).all()
    assert one.excited.nonzero()[0].tolist() == [2]


def test_noise_over_periods_is_taken_off_the_scatter_over_realisations() -> None:
    found = distortion([multisine(1.0, "a", (0.5, -0.5)), multisine(3.0, "b", (0.5, -0.5))], 16)
    assert found.noise[0, 0, 2] == pytest.approx(0.25 / 2)
    assert found.distortion[0, 0, 2] == pytest.approx(2.0 - 0.25)


def test_the_force_window_is_as_wide_before_the_pulse_as_after_it() -> None:
    force = half_sine(4096, 500, 12, 60.0)
    pulse = find_pulse(force, int(np.argmax(force)))
    margin = int(2 * pulse.width) + 8
    window = force_window(force, int(np.argmax(force)))
    ones = np.flatnonzero(window == 1)
    assert (ones[0], ones[-1]) == (pulse.start - margin, pulse.stop - 1 + margin)
    zeros = np.flatnonzero(window == 0)
    assert zeros[zeros < 500].max() == ones[0] - 2 * margin
    assert zeros[zeros > 500].min() == ones[-1] + 2 * margin
    assert window[ones[0] - margin] == pytest.approx(0.5)  # half-way down the cosine


def test_frfs_are_chosen_by_their_power_not_by_their_mean_level() -> None:
    frf = np.ones((2, 1, 100), complex)
    frf[1] = 0.0
    frf[1, 0, 50] = 20.0  # mean 0.2, root mean square 2
    shape = frf.shape
    frfs = FrfSet(
        frequency_hz=np.arange(100.0),
        frf=frf,
        coherence=np.ones(shape),
        variance=np.zeros(shape),
        outputs=(Dof("a", "x"), Dof("b", "x")),
        inputs=(Dof("c", "x"),),
        quantities=("acceleration", "acceleration"),
        hits=np.full(shape[:2], 3),
        estimator="H1",
        record_s=1.0,
        response_decay_rad_s=0.0,
        delay_s=np.zeros(1),
        band_hz=(0.0, 99.0),
        force_calibrated=True,
        sensor_mass_kg=np.zeros(2),
    )
    assert representative_frfs(frfs, 1) == ((1, 0),)
