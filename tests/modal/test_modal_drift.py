"""Frequencies that move from hit to hit: spectra between lines, factors of hits, modes without twins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from simulate_modal import TrueSystem, frf_set, random_system, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.warp import WarpedTransform
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.combine_estimates import NamedEstimate, pool
from ema_pipeline.modal.drift.align import _movements, _warps
from ema_pipeline.modal.drift.follow import PURE, FollowedPeak, follow_peak
from ema_pipeline.modal.drift.local import change_in_decay
from ema_pipeline.modal.drift.shifts import movement
from ema_pipeline.modal.drift.windows import HitKey, PeakWindow
from ema_pipeline.modal.fit import Estimate
from ema_pipeline.modal.heavily_damped import has_peak
from ema_pipeline.modal.hit_to_hit import HitModes, identify_hits
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.left_out import left_out, sentences
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.settings import ModalSettings

SYSTEM = random_system(
    np.random.default_rng(3),
    n_modes=6,
    n_dofs=8,
    low_hz=40,
    high_hz=380,
    min_spacing=0.06,
    damping=(0.002, 0.006),
)


def identified(system: TrueSystem, n_hits: int, references: list[int], **moves: float) -> HitModes:
    dofs = list(range(system.shapes.shape[1]))
    made = simulate_hits(
        system,
        dofs,
        references,
        f_max=400,
        record_s=4.0,
        n_hits=n_hits,
        force_noise=0.01,
        response_noise=0.01,
        rng=np.random.default_rng(11),
        **moves,
    )
    hits = source(records_of(made, dofs, references))
    frfs = estimate_frfs(hits(), FrfSettings())
    return identify_hits(hits, lambda: frfs, FrfSettings(), ModalSettings())


def _peak(pole: complex, poles: np.ndarray, std: np.ndarray, residues: np.ndarray) -> FollowedPeak:
    """One mode: its poles in the hits, their σ in rad/s, and residues, (n_hits, n_outputs)."""
    size = pole.imag
    share = np.ones((len(poles), 1))
    left = np.zeros(len(poles))
    return FollowedPeak(
        np.array([pole]), (poles - pole) / size, std / size, residues[:, :, None], share, left
    )


def source(records: list) -> Callable[[], Iterator[HitSamples]]:
    hits = accepted(records)
    return lambda: iter(hits)


@pytest.mark.parametrize("n", [200, 201])
def test_a_spectrum_between_lines_is_that_of_the_definition(n: int) -> None:
    samples = np.random.default_rng(0).standard_normal((2, n))
    shift = 1e-2 * np.sin(np.arange(n // 2 + 1))
    place = np.arange(n // 2 + 1) * (1 + shift)
    exact = samples @ np.exp(-2j * np.pi * np.outer(np.arange(n), place) / n)
    np.testing.assert_allclose(WarpedTransform(n, shift)(samples), exact, atol=1e-7 * np.abs(exact).max())


def test_common_factors_are_told_from_movement_of_one_mode_and_from_what_a_point_shows() -> None:
    rng = np.random.default_rng(5)
    point = np.repeat(np.arange(4), 3)
    common = 1e-3 * rng.standard_normal(12)
    own = np.zeros((12, 5))
    own[:, 2] = 2e-3 * rng.standard_normal(12)
    mixture = np.zeros((4, 5))
    mixture[:, 4] = 2e-3 * rng.standard_normal(4)
    noise = np.full((12, 5), 3e-5)
    shift = common[:, None] + own + mixture[point] + noise * rng.standard_normal((12, 5))
    found = movement(shift, noise, np.ones((12, 5)), point)
    assert found.common - found.common.mean() == pytest.approx(common - common.mean(), abs=1e-4)
    assert np.argmax(found.own_spread) == 2
    assert np.argmax(found.point_spread) == 4


@pytest.mark.parametrize(("second", "shared"), [(1.0, 1.5e-3), (-1.0, 0.0)])
def test_drift_from_point_to_point_is_no_mixture_of_modes(second: float, shared: float) -> None:
    """Two peaks that move alike between two points have drifted; two that move apart have not."""
    rng = np.random.default_rng(8)
    point, noise = np.repeat([0, 1], 3), np.full((6, 2), 1e-5)
    step = np.array([-0.75e-3, 0.75e-3])
    shift = np.outer(step[point], [1.0, second]) + noise * rng.standard_normal((6, 2))
    found = movement(shift, noise, np.ones((6, 2)), point)
    assert found.common[3:].mean() - found.common[:3].mean() == pytest.approx(shared, abs=2e-4)
    assert (found.point_spread.max() > 5e-4) == (second < 0)


def test_drift_from_point_to_point_is_known_from_as_many_values_as_points() -> None:
    """Hits on a point move alike: five of them tell no more of the mean than one does."""
    rng = np.random.default_rng(2)
    drift, noise = 1e-3 * rng.standard_normal(8), np.full((40, 4), 2e-5)
    stds = []
    for point, common in ((np.repeat(np.arange(8), 5), np.repeat(drift, 5)), (np.arange(8), drift)):
        shift = common[:, None] + noise[: len(point)] * rng.standard_normal((len(point), 4))
        stds.append(movement(shift, noise[: len(point)], np.ones(shift.shape), point).mean_std)
    assert stds[0] == pytest.approx(stds[1], rel=0.15)
    assert stds[0] > drift.std(ddof=1) / np.sqrt(8)


def test_a_trend_over_the_hits_is_known_far_better_than_its_size() -> None:
    rng = np.random.default_rng(4)
    trend, noise = 2e-3 * np.linspace(-0.5, 0.5, 8), np.full((8, 5), 1e-5)
    shift = trend[:, None] + noise * rng.standard_normal((8, 5))
    found = movement(shift, noise, np.ones((8, 5)), np.repeat([0, 1], 4))
    assert found.common == pytest.approx(trend, abs=2e-5)
    assert found.spread == pytest.approx(trend.std(), rel=0.1)
    assert found.mean_std < 0.03 * found.spread


def test_peaks_that_different_points_show_are_brought_together_by_the_trend() -> None:
    """Each peak shows on one point only: nothing but the trend tells how far the rig drifted from point to point."""
    rng = np.random.default_rng(6)
    point = np.repeat([0, 1], 5)
    trend, side = 1e-3 * np.linspace(-0.5, 0.5, 10), np.array([0, 0, 1, 1])
    shown = side == point[:, None]
    noise = np.where(shown, 5e-6, 5e-4)
    shift = trend[:, None] + noise * rng.standard_normal((10, 4))
    found = movement(shift, noise, np.where(shown, 1.0, 0.01), point)
    for c in range(4):
        share = shown[:, c] / 5.0
        error = float(share @ (found.common - trend))
        assert abs(error) < 1e-4  # as measured the hits on either point are off by 2.8e-4
        assert abs(error) < 1.645 * found.error.mean_std(share)
        assert found.error.mean_std(share) > found.mean_std


@pytest.mark.parametrize("trend", [1.0, 0.0], ids=["trend", "hits"])
@pytest.mark.parametrize("n_points", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_nine_of_ten_intervals_hold_whatever_the_drift(trend: float, n_points: int) -> None:
    rng = np.random.default_rng(12)
    inside, widths = [], []
    for _ in range(120):
        n = 4 * n_points
        drift = 1e-3 * (trend * np.linspace(-0.5, 0.5, n) + (1 - trend) * rng.standard_normal(n) / 3)
        noise = np.full((n, 3), 1e-5)
        shift = drift[:, None] + noise * rng.standard_normal((n, 3))
        found = movement(shift, noise, np.ones((n, 3)), np.repeat(np.arange(n_points), 4))
        mean = shift.mean(axis=0) - found.common.mean()
        std = np.hypot(found.mean_std, 1e-5 / np.sqrt(n))
        inside.append(abs(mean[0]) < 1.645 * std)
        widths.append(std)
    assert 0.84 < np.mean(inside) < 0.99
    assert np.median(widths) < (1e-4 if trend else 4e-4)


def test_drift_of_all_frequencies_makes_no_twins_and_is_in_the_intervals() -> None:
    found = identified(SYSTEM, 2, [0, 3, 5], drift=1.5e-3)
    modes = found.modal.modes
    assert found.alignment.aligned
    assert len(modes) == len(SYSTEM.frequency_hz)
    for mode, f, z in zip(modes, SYSTEM.frequency_hz, SYSTEM.damping_ratio, strict=True):
        assert abs(mode.frequency_hz - f) < 3 * mode.frequency_std_hz
        # six hits: the mean of the drift is known to 1.5e-3/√6
        assert 2e-4 * f < mode.frequency_std_hz < 2e-3 * f
        assert mode.damping_ratio == pytest.approx(z, rel=0.1)
    assert any("from hit to hit" in note for note in found.modal.notes)


def test_modes_that_soften_say_so_and_are_not_split() -> None:
    found = identified(SYSTEM, 6, [0, 3, 5], softening=2e-3)
    modes = found.modal.modes
    assert len(modes) == len(SYSTEM.frequency_hz)
    soft, stiff = modes[: len(modes) // 2], modes[len(modes) // 2 :]
    assert all(any("falls by" in flag for flag in mode.flags) for mode in soft)
    assert not any("falls by" in flag for mode in stiff for flag in mode.flags)
    for mode, f in zip(modes, SYSTEM.frequency_hz, strict=True):
        assert abs(mode.frequency_hz - f) < 3 * mode.frequency_std_hz


def test_the_pole_of_a_peak_is_told_at_the_mean_drift_of_all_hits() -> None:
    """One hit that shows the peak ten times as strongly as the others does not bring its own drift with it."""
    poles = 2 * np.pi * np.array([complex(-0.3, 50.0), complex(-0.4, 80.0)])
    drift = np.array([2e-3, -1e-3, 0.0, 1e-3, -1e-3, -1e-3])  # 0 on average
    strength = np.array([10.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    weight = strength**2 / np.sum(strength**2)
    peaks = [
        _peak(
            pole * (1 + weight @ drift),
            pole * (1 + drift),
            np.full(6, 1e-4),
            strength[:, None] * np.ones((1, 3)),
        )
        for pole in poles
    ]
    keys = tuple(HitKey(f"{k}.h5", 0, f"p{k}.z", 100.0) for k in range(6))
    found = _movements(peaks, keys)[1]
    assert [p.frequency_hz for p in found] == pytest.approx(np.abs(poles) / (2 * np.pi), rel=1e-4)
    assert [p.hits for p in found] == pytest.approx([1.1, 1.1], abs=0.05)


def test_a_peak_that_hits_on_one_point_hardly_show_stays_at_its_pole() -> None:
    """Hits on the second point show the flank of another mode there, far off: no hit is moved for that."""
    poles = 2 * np.pi * np.array([complex(-0.3, 50.0), complex(-0.4, 80.0), complex(-0.5, 120.0)])
    common = np.array([-8e-4, 6e-4, -2e-4, -3e-4, 5e-4, 2e-4])
    flank = np.array([2e-5, -1e-5, -1e-5, -9e-3, -6e-3, -7.5e-3])
    peaks = []
    for c, pole in enumerate(poles):
        shift = common + (flank if c == 2 else 0.0)
        strength = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0]) if c == 2 else np.ones(6)
        std = np.where((strength < 10) & (c == 2), 1e-3, 1e-5) * pole.imag
        mean = np.average(shift, weights=strength**2)
        peaks.append(_peak(pole * (1 + mean), pole * (1 + shift), std, strength[:, None] * np.ones((1, 3))))
    keys = tuple(HitKey(f"{k}.h5", 0, f"p{k // 3}.z", 100.0) for k in range(6))
    moved, found = _movements(peaks, keys)
    assert found[2].frequency_hz == pytest.approx(120.0, rel=2e-4)
    assert np.abs(moved.own[:3, 2]).max() < 2e-4


def test_a_peak_that_moves_takes_its_flanks_along_and_nothing_that_lies_farther_off() -> None:
    poles = 2 * np.pi * np.array([complex(-0.3, 50.0), complex(-0.3, 51.5), complex(-0.5, 120.0)])
    own = np.outer([5e-4, -4e-4, 2e-4, -3e-4, 1e-4, -1e-4], [0.0, 1.0, 1.0])
    peaks = [
        _peak(p, p * (1 + own[:, c]), np.full(6, 1e-6 * p.imag), np.ones((6, 3))) for c, p in enumerate(poles)
    ]
    keys = tuple(HitKey(f"{k}.h5", 0, "p0.z", 100.0) for k in range(6))
    moved, looked_at = _movements(peaks, keys)
    frequency = np.arange(0.0, 200.0, 0.25)
    warps = _warps(looked_at, moved, frequency)
    for h in range(6):
        at_50, flank, at_51, between, flank_of_120, at_120 = np.interp(
            [50.0, 50.75, 51.5, 90.0, 119.75, 120.0], frequency, warps[h] - moved.common[h]
        )
        assert [at_50, at_51, at_120] == pytest.approx(
            own[h] - own[:, 1].mean() * np.array([0, 1, 1]), abs=5e-5
        )
        assert flank == pytest.approx(
            0.5 * (at_50 + at_51), rel=0.02
        )  # straight from one plateau to the next
        assert flank_of_120 == at_120
        assert between == pytest.approx(0.0, abs=1e-7)


def test_hits_that_do_not_move_are_left_as_they_are() -> None:
    found = identified(SYSTEM, 3, [0, 3])
    assert not found.alignment.aligned
    assert not any("moves" in flag for mode in found.modal.modes for flag in mode.flags)


def test_points_at_which_modes_have_moved_do_not_take_the_others_with_them() -> None:
    rng = np.random.default_rng(3)
    points, outputs = list(range(40)), [0, 1, 2]
    system = random_system(
        rng, n_modes=5, n_dofs=40, low_hz=60, high_hz=340, min_spacing=0.05, damping=(0.003, 0.01)
    )
    f = np.arange(1, 3201) * 0.125
    frf = np.empty((3, 40, len(f)), dtype=complex)
    for i in points:  # every fourth was struck while the modes were elsewhere, each by 0.2 %
        moved = 1 + (2e-3 if i % 4 == 0 else 1e-5) * rng.standard_normal(5)
        there = replace(system, frequency_hz=system.frequency_hz * moved)
        frf[:, i] = there.accelerance(f, outputs, [i])[:, 0]
    noise = rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape)
    frf += 1e-3 * np.median(np.abs(frf)) * noise
    model = identify(frf_set(f, frf, outputs, points), ModalSettings())
    for true, zeta in zip(system.frequency_hz, system.damping_ratio, strict=True):
        mode = min(model.modes, key=lambda m, true=true: abs(m.frequency_hz - true))
        assert mode.frequency_hz == pytest.approx(true, rel=6e-5)
        assert mode.damping_ratio == pytest.approx(zeta, rel=3e-3)


def test_estimates_that_disagree_widen_the_interval_and_two_of_them_move_the_value() -> None:
    pole = NamedEstimate("all FRFs", 40.06, 0.01)
    circle, hit = NamedEstimate("circles", 40.16, 0.01), NamedEstimate("single hits", 40.17, 0.01)
    assert pool([pole, NamedEstimate("circles", 40.07, 0.01)], 0.0, "Hz", 1.0) == (40.06, 0.01, "")
    value, std, said = pool([pole, circle], 0.0, "Hz", 1.0)
    assert value == pole.value
    assert std == pytest.approx(np.hypot(0.01, 0.05))
    assert "circles 40.16 Hz" in said
    value, std, _ = pool([pole, circle, hit], 0.0, "Hz", 1.0)
    assert value == pytest.approx(40.13, abs=0.01)
    assert all(abs(w.value - value) < 2 * std for w in (pole, circle, hit))


def test_what_is_always_allowed_does_not_add_up_with_the_standard_deviations() -> None:
    pole, hits = NamedEstimate("all FRFs", 0.134, 0.006), NamedEstimate("single hits", 0.099, 0.0055)
    value, std, said = pool([pole, hits], 0.0134, "%", 1.0)  # 0.035 apart: each alone allows less
    assert value == pole.value
    assert std == pytest.approx(np.hypot(0.006, 0.0175))
    assert said
    nearer = NamedEstimate("single hits", 0.108, 0.0055)
    assert pool([pole, nearer], 0.0134, "%", 1.0) == (pole.value, pole.std, "")


def test_a_heavy_pole_without_a_peak_is_told_from_one_that_makes_a_peak() -> None:
    omega = 2 * np.pi * np.linspace(10, 100, 600)
    pole = complex(-0.04, 1.0) * 2 * np.pi * 50
    power = np.abs(1 / (1j * omega - pole)) ** 2
    assert has_peak(omega, power, pole)
    heavy, beside = complex(-0.05, 1.0) * 2 * np.pi * 50, complex(-0.005, 1.0) * 2 * np.pi * 47
    pair = np.abs(1 / (1j * omega - heavy) + 0.3 / (1j * omega - beside)) ** 2
    assert has_peak(omega, pair, heavy)  # smoothing by its width would fill the dip between the two
    wave = 1 + 0.13 * np.cos(2 * np.pi * (omega - heavy.imag) / (-4 * heavy.real))  # 1.1 dB on a plateau
    assert not has_peak(omega, wave, heavy)
    slope = 1 / (1 + (omega / omega[0]) ** 2)
    noise = np.random.default_rng(2).exponential(size=len(omega))
    assert not has_peak(omega, slope * (1 + 0.1 * noise), pole)


def test_a_plain_peak_without_a_mode_is_named() -> None:
    peak = KnownPeaks(np.array([-3 + 300j, -4 + 500j]), np.array([6.0, 8.0]), np.zeros((2, 2)))
    modes = Estimate(np.array([-3.1 + 300.2j]), np.ones((1, 1), complex))
    (named,) = left_out([], peak, modes, 0.0)
    assert named.frequency_hz == pytest.approx(500 / (2 * np.pi), rel=1e-3)
    assert "has no mode" in sentences((named,))[0]


@pytest.mark.parametrize("change_hz", [0.0, 0.05, -0.05])
def test_one_hit_tells_what_a_frequency_does_within_its_decay(change_hz: float) -> None:
    """An independent record: the phase is the integral of 2π·(f + change·exp(−2σt))."""
    rate, n, f, sigma = 512.0, 4096, 60.0, 1.2
    t = np.arange(n) / rate
    phase = 2 * np.pi * (f * t + change_hz * (1 - np.exp(-2 * sigma * t)) / (2 * sigma))
    clean = np.exp(-sigma * t) * np.sin(phase)
    rng = np.random.default_rng(4)
    records = np.array([1.0, -0.4, 0.7])[:, None] * clean + 1e-3 * rng.standard_normal((3, n))
    lines = slice(round((f - 3) * n / rate), round((f + 3) * n / rate))
    frf = np.fft.rfft(records)[:, lines] / rate
    omega = 2 * np.pi * np.arange(n // 2 + 1)[lines] * rate / n
    window = PeakWindow(lines, complex(-sigma, 2 * np.pi * f), np.zeros(0, complex), np.arange(3))
    peak = follow_peak(window, frf[None], omega, n / rate, one_point=True)
    assert peak is not None
    found = change_in_decay(window, frf, complex(peak.of_hits[0, 0]), omega, n / rate)
    assert found is not None
    assert found.change / (2 * np.pi) == pytest.approx(
        change_hz, abs=0.2 * abs(change_hz) + 4 * found.std / 6.3
    )
    assert found.std / (2 * np.pi) < 0.003


def test_the_interval_of_one_hit_holds_what_it_cannot_show() -> None:
    found = identified(SYSTEM, 1, [0])
    assert found.alignment.n_hits == 1
    assert any("one hit cannot show" in note for note in found.modal.notes)
    for mode in found.modal.modes:
        assert mode.frequency_std_hz == pytest.approx(1e-3 * mode.frequency_hz, rel=0.1)
    several = identified(SYSTEM, 2, [0])
    assert not any("one hit cannot show" in note for note in several.modal.notes)


def test_a_second_mode_under_a_peak_is_no_change_of_its_frequency() -> None:
    rate, n = 512.0, 2048
    time = np.arange(n) / rate
    near, far = complex(-6, 2 * np.pi * 60), complex(-12, 2 * np.pi * 62)
    decay = np.real(np.exp(near * time)) + 0.8 * np.imag(np.exp(far * time))
    lines = np.arange(200, 281)
    omega = 2 * np.pi * lines * rate / n
    frf = (np.fft.rfft(decay) / rate)[None, None, lines]
    window = PeakWindow(slice(200, 281), near, np.zeros(0, complex), np.array([0]))
    peak = follow_peak(window, frf, omega, n / rate, one_point=True)
    assert peak is not None
    found = change_in_decay(window, frf[0], complex(peak.of_hits[0, 0]), omega, n / rate)
    assert found is not None
    assert abs(found.change) > 3 * found.std
    assert not found.single
    assert found.width == pytest.approx(-2 * peak.of_hits[0, 0].real)


def test_two_points_do_not_widen_the_interval_of_drift_that_scatters_from_hit_to_hit() -> None:
    """Beside a trend nothing tells what two points differ by: told apart, their intervals were six times too wide."""
    rng, scatter, point = np.random.default_rng(5), 1e-3, np.repeat([0, 1], 5)
    widths, errors = [], []
    for _ in range(40):
        shift = scatter * rng.standard_normal((10, 1)) + 1e-5 * rng.standard_normal((10, 4))
        found = movement(shift - shift.mean(axis=0), np.full((10, 4), 1e-5), np.ones((10, 4)), point)
        widths.append(found.mean_std)
        errors.append(abs(shift.mean()))
    held = np.mean(np.array(errors) < 1.645 * np.array(widths))
    assert held >= 0.85
    assert np.quantile(widths, 0.9) < scatter
    jump = np.where(point == 0, -1.0, 1.0)[:, None] * scatter + 0.03 * scatter * rng.standard_normal((10, 1))
    found = movement(jump + np.zeros((10, 4)), np.full((10, 4), 1e-5), np.ones((10, 4)), point)
    assert found.mean_std > scatter  # of two points hardly anything is known


def test_drift_is_told_from_pairs_of_close_modes_that_points_show_in_other_ratios() -> None:
    """Every peak is made by two modes: one pole seems to move by more than drift moves it."""
    centre = np.repeat([50.0, 90.0, 160.0, 300.0], 2)
    apart = np.tile([-1.0, 1.0], 4) * 0.004 * centre  # 0.8 half-widths
    shapes = np.random.default_rng(9).standard_normal((8, 8))
    system = TrueSystem(centre + apart, np.full(8, 0.01), shapes)
    found = identified(system, 2, [0, 1, 2, 3, 4, 5], drift=1e-3)
    assert len(found.modal.modes) == 8
    off = np.array([m.frequency_hz for m in found.modal.modes]) / system.frequency_hz - 1
    assert np.std(off) < 4e-5  # what is common is the mean drift, which is in the intervals
    for mode, shape in zip(found.modal.modes, system.shapes, strict=True):
        assert 1 - mac(mode.shape, shape).item() < 3e-5


def _peak_of_hits(records: np.ndarray, rate: float, centre: float, reach: float) -> FollowedPeak | None:
    """The peak that decays, (n_hits, n_outputs, n), make about a frequency."""
    n = records.shape[-1]
    lines = slice(round((centre - reach) * n / rate), round((centre + reach) * n / rate))
    frf = np.fft.rfft(records)[..., lines] / rate
    omega = 2 * np.pi * np.arange(n // 2 + 1)[lines] * rate / n
    start = complex(-1.0, 2 * np.pi * centre)
    window = PeakWindow(lines, start, np.zeros(0, complex), np.arange(records.shape[1]))
    return follow_peak(window, frf, omega, n / rate, one_point=False)


def test_two_modes_under_a_peak_are_told_to_move_as_their_frequencies_do() -> None:
    rate, n, rng = 512.0, 4096, np.random.default_rng(2)
    time, drift = np.arange(n) / rate, np.array([1e-3, 1e-3, -5e-4, -5e-4, 0.0, -1e-3])
    ratio = np.array([1.0, 1.0, 0.1, 0.1, -0.6, -0.6])  # of the second mode, as three points excite it
    records = np.empty((6, 3, n))
    for h, (moved, second) in enumerate(zip(drift, ratio, strict=True)):
        one = np.exp(-1.2 * time) * np.sin(2 * np.pi * 60.0 * (1 + moved) * time)
        two = np.exp(-1.0 * time) * np.sin(2 * np.pi * 60.3 * (1 + moved) * time)
        records[h] = np.outer([1.0, 0.5, -0.8], one) + second * np.outer([0.3, -1.0, -0.6], two)
    peak = _peak_of_hits(records + 1e-3 * rng.standard_normal(records.shape), rate, 60.1, 3.0)
    assert peak is not None
    assert not peak.single
    assert np.sort(peak.poles.imag) / (2 * np.pi) == pytest.approx([60.0, 60.3], rel=1e-3)
    assert peak.share.sum(axis=1) == pytest.approx(np.ones(6))
    moved = peak.moved.imag + peak.share @ (peak.poles.imag / (2 * np.pi) / [60.0, 60.3] - 1)
    assert moved == pytest.approx(drift, abs=5e-5)


def test_a_frequency_that_moves_within_the_decay_is_one_mode_on_all_points() -> None:
    """Two poles follow its peak better than one, but they have one shape at the sensors."""
    rate, n, rng = 512.0, 4096, np.random.default_rng(2)
    time = np.arange(n) / rate
    phase = 2 * np.pi * (60.0 * time + 1.0 * (1 - np.exp(-2.4 * time)) / 2.4)
    records = np.outer([1.0, 0.5, 0.7, -0.9], np.exp(-1.2 * time) * np.sin(phase))[:, None]
    records = records * np.array([1.0, -0.4, 0.7])[:, None]
    peak = _peak_of_hits(records + 4e-2 * rng.standard_normal(records.shape), rate, 60.0, 3.0)
    assert peak is not None
    assert peak.second_shape > PURE
    assert len(peak.poles) == 1
