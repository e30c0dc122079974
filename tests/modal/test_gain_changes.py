"""Sensors whose gain differs between points of impact: found, sized, taken out; close modes are not taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from numpy.typing import NDArray
from simulate_modal import TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.gain_changes import GainChanges, gain_changes
from ema_pipeline.modal.hit_to_hit import HitModes, identify_hits
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.low_rank import low_rank, tangent
from ema_pipeline.modal.plain_residues import plain_residues
from ema_pipeline.modal.settings import ModalSettings

OUTPUTS, INPUTS = [0, 1, 2, 3], [0, 2, 3]
SYSTEM = TrueSystem(
    np.array([41.0, 83.0, 131.0, 190.0]),
    np.array([0.012, 0.009, 0.01, 0.008]),
    np.random.default_rng(4).uniform(0.3, 1.0, (4, 4))
    * np.sign(np.random.default_rng(5).standard_normal((4, 4))),
)
BAND = 5.0, 240.0


def hits_of(
    gains: NDArray[np.float64], system: TrueSystem = SYSTEM, noise: float = 1e-3, drift: float = 0.0
) -> list[HitSamples]:
    """Hits by a sensor whose gain is `gains` (n_outputs, n_inputs), times a constant of each sensor."""
    made = simulate_hits(
        system, OUTPUTS, INPUTS, f_max=260, record_s=3.0, n_hits=3, rng=np.random.default_rng(11),
        force_noise=noise, response_noise=noise, calibration=0.04, drift=drift,
    )  # fmt: skip
    changed = replace(made, responses=made.responses * gains.T[:, None, :, None])
    return accepted(records_of(changed, OUTPUTS, INPUTS))


def constant() -> NDArray[np.float64]:
    return np.ones((len(OUTPUTS), len(INPUTS)))


def found(hits: list[HitSamples]) -> GainChanges | None:
    frfs = estimate_frfs(hits)
    return gain_changes(frfs, plain_residues(frfs, BAND))


def identified(hits: list[HitSamples]) -> HitModes:
    return identify_hits(lambda: hits, lambda: estimate_frfs(hits), FrfSettings(), ModalSettings())


@pytest.mark.parametrize("factor", [0.97, 1.1, 0.3])
def test_a_gain_that_changed_is_sized_and_leaves_no_second_modes(factor: float) -> None:
    gains = constant()
    gains[1, 2] = factor
    hits = hits_of(gains)
    assert len(identify(estimate_frfs(hits), ModalSettings()).modes) > 4, "otherwise there is nothing to mend"

    changes = found(hits)
    assert changes is not None
    assert np.flatnonzero(changes.factors != 1).tolist() == [1 * len(INPUTS) + 2]
    assert abs(np.log(changes.factors[1, 2] / factor)) < 3 * changes.std
    assert changes.std < 0.004
    size = 100 * abs(changes.factors[1, 2] - 1)
    assert (
        f"{changes.outputs[1]} reads {size:.2g} % {'more' if factor > 1 else 'less'} in hits" in changes.note
    )

    modes = identified(hits).modal
    assert [round(m.frequency_hz) for m in modes.modes] == [41, 83, 131, 190]
    for mode, true, zeta in zip(modes.modes, SYSTEM.frequency_hz, SYSTEM.damping_ratio, strict=True):
        assert abs(mode.frequency_hz - true) < 4 * mode.frequency_std_hz
        assert abs(mode.damping_ratio - zeta) < 4 * mode.damping_std
    assert modes.sensor_notes == (changes.note,)


def test_gains_that_all_differ_are_found_against_the_mean_of_sensors_and_points() -> None:
    true = 0.015 * np.random.default_rng(3).standard_normal((len(OUTPUTS), len(INPUTS)))
    changes = found(hits_of(np.exp(true)))
    assert changes is not None
    centred = true - true.mean(axis=0) - true.mean(axis=1)[:, None] + true.mean()
    off = np.log(changes.factors) - centred
    assert np.std(off) < 0.25 * np.std(centred)
    assert len(identified(hits_of(np.exp(true))).modal.modes) == 4


@pytest.mark.parametrize("drift", [0.0, 1e-3])
def test_constant_gains_are_left_alone(drift: float) -> None:
    """Calibrations of 4 % are no changes, nor is a frequency that drifts."""
    hits = hits_of(constant(), drift=drift)
    again = identified(hits)
    assert not again.modal.sensor_notes
    assert len(again.modal.modes) == 4


def test_close_modes_are_not_taken_for_changes() -> None:
    """Three pairs that each make one peak: their residues are of rank two, but share no factor."""
    close = TrueSystem(
        np.array([60.0, 60.15, 110.0, 110.25, 180.0, 180.4]),
        np.full(6, 0.01),
        np.random.default_rng(8).standard_normal((6, 4)),
    )
    assert found(hits_of(constant(), close)) is None
    assert len(identified(hits_of(constant(), close)).modal.modes) == 6


def test_sensors_that_rove_have_no_gain_that_changed_but_may_be_reversed() -> None:
    gains = constant()
    gains[1, 2] = 1.3
    channels = (ChannelQuality("stays"), *(ChannelQuality("roves") for _ in OUTPUTS[1:]))
    roving = replace(estimate_frfs(hits_of(gains)), channels=channels)
    assert gain_changes(roving, plain_residues(roving, BAND)) is None
    gains[1, 2] = -1.0
    reversed_once = replace(estimate_frfs(hits_of(gains)), channels=channels)
    changes = gain_changes(reversed_once, plain_residues(reversed_once, BAND))
    assert changes is not None
    assert np.flatnonzero(changes.factors != 1).tolist() == [1 * len(INPUTS) + 2]


def test_two_peaks_and_one_point_cannot_show_it() -> None:
    gains = constant()
    gains[1, 2] = 0.9
    few = TrueSystem(SYSTEM.frequency_hz[:2], SYSTEM.damping_ratio[:2], SYSTEM.shapes[:2])
    assert found(hits_of(gains, few)) is None
    one_point = [hit for hit in hits_of(gains) if hit.hit.impact.point == hits_of(gains)[0].hit.impact.point]
    assert found(one_point) is None


def test_many_changes_are_counted_not_listed() -> None:
    frfs = estimate_frfs(hits_of(constant()))
    factors = np.full(frfs.hits.shape, 1.02)
    changes = GainChanges(frfs.outputs, frfs.inputs, factors, 0.001)
    assert "and 9 more (± 0.1 %)" in changes.note
    assert changes.taken_out(frfs).frf == pytest.approx(frfs.frf / 1.02)
    assert changes.taken_out(frfs).variance == pytest.approx(frfs.variance / 1.02**2)


def test_low_rank_fit_and_its_tangent() -> None:
    """Against the singular value decomposition; the dimension is known: rank · (rows + columns − rank)."""
    rng = np.random.default_rng(2)
    values = rng.standard_normal((5, 7)) + 1j * rng.standard_normal((5, 7))
    u, s, v = np.linalg.svd(values, full_matrices=False)
    for rank in (1, 2):
        start = rng.standard_normal((rank, 7)) + 0j
        left, right = low_rank(values, np.ones(values.shape), start, 400)
        assert left @ right == pytest.approx((u[:, :rank] * s[:rank]) @ v[:rank], abs=1e-6)
        basis = tangent(left, right, np.ones(values.shape))
        assert basis.shape == (35, rank * (5 + 7 - rank))
        assert basis.conj().T @ basis == pytest.approx(np.eye(basis.shape[1]), abs=1e-9)
        off = (values - left @ right).ravel()
        assert basis.conj().T @ off == pytest.approx(np.zeros(basis.shape[1]), abs=1e-6)


def test_weights_of_zero_leave_entries_out() -> None:
    rng = np.random.default_rng(6)
    true = np.outer(rng.standard_normal(4) + 1j, rng.standard_normal(5) - 1j)
    spoilt, weight = true.copy(), np.ones(true.shape)
    spoilt[1, 2], weight[1, 2] = 1e3, 0.0
    left, right = low_rank(spoilt, weight, np.ones((1, 5), dtype=complex), 200)
    assert left @ right == pytest.approx(true, abs=1e-6)


@pytest.mark.parametrize("places", [[(1, 2)], [(1, 2), (3, 0)]])
@pytest.mark.parametrize("factor", [-1.0, -0.9])
def test_a_sensor_that_was_reversed_while_a_point_was_struck_is_told(
    places: list[tuple[int, int]], factor: float
) -> None:
    gains = constant()
    for place in places:
        gains[place] = factor
    changes = found(hits_of(gains))
    assert changes is not None
    assert np.argwhere(changes.factors < 0).tolist() == [list(place) for place in places]
    for place in places:
        assert abs(np.log(changes.factors[place] / factor)) <= 3 * changes.std
    told = "is reversed in" if factor == -1 else "is reversed and reads 10 % less in"
    assert f"{changes.outputs[1]} {told} hits on" in changes.note

    modes = identified(hits_of(gains)).modal
    assert [round(m.frequency_hz) for m in modes.modes] == [41, 83, 131, 190]
