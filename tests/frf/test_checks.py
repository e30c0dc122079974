"""Checks on sets of FRFs that are written down by hand: coherence, scatter, driving points, reciprocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.frf.channel_faults import factor_words, likely_cause
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.frf.checks import check_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet

LINES = 100


def made(
    frf: np.ndarray,
    band_hz: tuple[float, float] = (1.0, 99.0),
    hits: int = 1,
    coherence: np.ndarray | float = np.nan,
    variance: np.ndarray | float = 0.0,
    sensors: tuple[str, str] = ("s1", "s2"),
) -> FrfSet:
    """Accelerances between a.x and b.x, (n_outputs, n_inputs, lines 1 Hz apart)."""
    dofs = (Dof("a", "x"), Dof("b", "x"))
    shape = frf.shape
    return FrfSet(
        frequency_hz=np.arange(float(shape[2])),
        frf=frf.astype(complex),
        coherence=np.broadcast_to(coherence, shape).copy(),
        variance=np.broadcast_to(variance, shape).copy(),
        outputs=dofs[: shape[0]],
        inputs=dofs[: shape[1]],
        quantities=("acceleration",) * shape[0],
        hits=np.full(shape[:2], hits),
        estimator="H1",
        record_s=1.0,
        response_decay_rad_s=0.0,
        delay_s=np.zeros(shape[1]),
        band_hz=band_hz,
        force_calibrated=True,
        sensor_mass_kg=np.zeros(shape[0]),
        channels=tuple(ChannelQuality(s, 0.02, 0.03) for s in sensors[: shape[0]]),
    )


def only(frfs: FrfSet, check: str, settings: FrfSettings | None = None) -> CheckResult:
    (found,) = (v for v in check_frfs(frfs, settings) if v.check == check)
    return found


def square(h12: np.ndarray | float, h21: np.ndarray | float) -> np.ndarray:
    """Driving points of 1j; transfer FRFs as given."""
    frf = np.full((2, 2, LINES), 1j)
    frf[0, 1], frf[1, 0] = h12, h21
    return frf


def test_reciprocity_is_the_difference_over_the_mean_size() -> None:
    found = only(made(square(1.0, 1.2)), "reciprocity")
    assert found.value == pytest.approx(0.2 / 1.1)
    assert only(made(square(1.0, 1.2)), "reciprocity", FrfSettings(reciprocity=0.19)).passes
    assert not only(made(square(1.0, 1.2)), "reciprocity", FrfSettings(reciprocity=0.18)).passes


def test_a_difference_that_noise_explains_is_taken_off() -> None:
    # (0.2)² per line less twice the variance of both FRFs, 2·(0.005 + 0.005)
    found = only(made(square(1.0, 1.2), variance=0.005), "reciprocity")
    assert found.value == pytest.approx(np.sqrt(0.04 - 0.02) / 1.1)


def test_lines_below_a_tenth_of_the_largest_do_not_count_in_reciprocity() -> None:
    one, other = np.ones(LINES), np.ones(LINES)
    one[20:], other[20:] = 0.05, -0.09
    assert only(made(square(one, other)), "reciprocity").value == pytest.approx(0.0, abs=1e-9)


def test_a_constant_factor_is_a_sensitivity_of_two_sensors_and_none_of_one_that_roves() -> None:
    found = only(made(square(2.0, 1.0)), "sensitivity")
    assert found.value == pytest.approx(2.0)
    assert not found.passes
    assert not [v for v in check_frfs(made(square(2.0, 1.0))) if v.check == "reciprocity"]
    roved = only(made(square(2.0, 1.0), sensors=("s1", "s1")), "reciprocity")
    assert roved.value == pytest.approx(1.0 / 1.5)


@pytest.mark.parametrize(
    ("size", "factor", "check"),
    [
        (0.9, 1.7, "sensitivity"),  # as strong as the driving points: a factor of 1.5 and more counts
        (
            0.5,
            1.7,
            "reciprocity",
        ),  # half as strong: of 1.5 squared, since the same oblique blow makes twice the error
        (0.5, 3.0, "sensitivity"),
        (0.15, 3.0, "reciprocity"),  # weak beside the driving points: only one of 7 and more
        (0.15, 8.0, "sensitivity"),
    ],
)
def test_weak_frfs_name_sensors_by_large_factors_only(size: float, factor: float, check: str) -> None:
    assert {v.check for v in check_frfs(made(square(factor * size, size)))} >= {check}
    other = {"sensitivity": "reciprocity", "reciprocity": "sensitivity"}[check]
    assert other not in {v.check for v in check_frfs(made(square(factor * size, size)))}


def test_opposite_signs_are_a_factor_of_minus_one() -> None:
    assert only(made(square(1.0, -1.0)), "sensitivity").value == pytest.approx(-1.0)


def test_driving_points_count_by_the_squares_of_their_loss_from_the_first_to_the_last_line_of_the_band() -> (
    None
):
    loss = np.zeros(LINES)
    loss[[9, 10, 20, 21]] = [-5.0, 2.0, -1.0, -7.0]  # the band is from line 10 to line 20
    frf = 1j * loss[None, None]
    assert only(made(frf, band_hz=(10.0, 20.0), hits=3), "driving point").value == pytest.approx(1.0 / 5.0)
    with_next = only(made(frf, band_hz=(10.0, 21.0), hits=3), "driving point")
    assert with_next.value == pytest.approx(50.0 / 54.0)
    assert "reversed" in with_next.message
    loss[10] = 8.0
    mixed = only(made(1j * loss[None, None], band_hz=(10.0, 21.0), hits=3), "driving point")
    assert mixed.value == pytest.approx(50.0 / 114.0)
    assert "not at one point" in mixed.message


@pytest.mark.parametrize("power", [0, 1, 2], ids=["acceleration", "velocity", "displacement"])
def test_noise_of_a_sensor_turns_no_driving_point(power: int) -> None:
    rng = np.random.default_rng(1)
    frequency = np.arange(1.0, LINES)
    turn = 1j**power  # the accelerance of a resonance is positive imaginary
    resonance = 1j / turn / (1 + 1j * (frequency - 15.0))
    noise = 0.05 * (rng.standard_normal(LINES - 1) + 1j * rng.standard_normal(LINES - 1))
    frf = np.concatenate([[0.0], resonance + noise])[None, None]
    quantity = ("acceleration", "velocity", "displacement")[power]
    set_of = {sign: replace(made(sign * frf), quantities=(quantity,)) for sign in (1.0, -1.0)}
    found = only(set_of[1.0], "driving point")
    assert found.passes
    assert found.value < 0.08
    assert "reversed" in only(set_of[-1.0], "driving point").message


def test_line_0_holds_the_offset_and_counts_in_no_check() -> None:
    loss = np.zeros(LINES)
    loss[:3] = [-9.0, 1.0, 1.0]
    assert only(made(1j * loss[None, None], band_hz=(0.0, 50.0)), "driving point").value == 0.0


def test_coherence_is_weighted_by_power_where_the_frf_is_large() -> None:
    frf, coherence = np.full((1, 1, LINES), 0.01), np.zeros((1, 1, LINES))
    frf[0, 0, 10:14], coherence[0, 0, 10:14] = [1.0, 2.0, 2.0, 1.0], [0.5, 1.0, 1.0, 0.5]
    found = only(made(frf, hits=3, coherence=coherence), "coherence")
    assert found.value == pytest.approx((0.5 + 4 + 4 + 0.5) / 10)
    assert not only(
        made(frf, hits=3, coherence=coherence), "coherence", FrfSettings(minimum_coherence=0.95)
    ).passes
    assert only(made(frf, hits=2, coherence=coherence), "coherence").passes  # two hits are too few to judge


def test_scatter_of_single_hits_is_what_peaks_have_beyond_the_floor() -> None:
    frf, variance = np.full((1, 1, 6400), 1e-3), np.full((1, 1, 6400), 1e-12)
    frf[0, 0, 4000:4020], variance[0, 0, 4000:4020] = 2.0, 0.01
    found = only(made(frf, (1.0, 6399.0), hits=4, coherence=1.0, variance=variance), "repeatability")
    # the variance of one of four hits is 4·0.01, over |H|² = 4: 0.1
    assert found.value == pytest.approx(0.1, rel=1e-6)


def test_factors_of_any_size_are_told_in_a_few_digits() -> None:
    assert factor_words(1e250) == "1e+250 times too high"
    assert factor_words(123.4) == "123 times too high"
    assert likely_cause(1e250, "force") == " (a gain of 1e+250)"
