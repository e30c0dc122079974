"""Modal identification end to end, on simulated hammer tests with known modes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from simulate_modal import (
    QUANTITIES,
    TrueSystem,
    frf_set,
    h1,
    random_system,
    records_of,
    simulate_hits,
    write_raw_folder,
)

from ema_pipeline import threads
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import cut_hit
from ema_pipeline.modal import segment, sub_bands
from ema_pipeline.modal.all_rows import backgrounds
from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.band_end import seen_band
from ema_pipeline.modal.data import FitData, arrange
from ema_pipeline.modal.fit import Estimate
from ema_pipeline.modal.identify import _mode, identify
from ema_pipeline.modal.noise import fit_law
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.polish import polish
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.modal.windowed import power_of


def hammer_test(
    system: TrueSystem,
    dofs_out: list[int],
    dofs_in: list[int],
    *,
    f_max: float = 400.0,
    record_s: float = 4.0,
    n_hits: int = 3,
    noise: float = 0.01,
    seed: int = 0,
    decay_rad_s: float = 0.0,
) -> FrfSet:
    hits = simulate_hits(
        system,
        dofs_out,
        dofs_in,
        f_max=f_max,
        record_s=record_s,
        n_hits=n_hits,
        force_noise=noise,
        response_noise=noise,
        rng=np.random.default_rng(seed),
        decay_rad_s=decay_rad_s,
    )
    return h1(hits, dofs_out, dofs_in, f_max, decay_rad_s)


def frequencies(model: ModalModel) -> np.ndarray:
    return np.array([m.frequency_hz for m in model.modes])


def dampings(model: ModalModel) -> np.ndarray:
    return np.array([m.damping_ratio for m in model.modes])


FIVE = TrueSystem(
    np.array([48.0, 81.0, 120.0, 190.0, 310.0]),
    np.array([0.012, 0.004, 0.008, 0.02, 0.005]),
    np.random.default_rng(42).standard_normal((5, 8)),
)


@pytest.fixture(scope="module")
def five() -> ModalModel:
    return identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings())


def test_all_modes_are_found_and_none_invented(five: ModalModel) -> None:
    assert frequencies(five) == pytest.approx(FIVE.frequency_hz, rel=1e-4)
    assert dampings(five) == pytest.approx(FIVE.damping_ratio, rel=0.01)


def test_errors_are_of_the_size_that_the_standard_deviations_say(five: ModalModel) -> None:
    for k, mode in enumerate(five.modes):
        assert abs(mode.frequency_hz - FIVE.frequency_hz[k]) < 4 * mode.frequency_std_hz
        assert abs(mode.damping_ratio - FIVE.damping_ratio[k]) < 4 * mode.damping_std
        assert mode.damping_std < 0.01 * mode.damping_ratio


def test_shapes_are_mass_normalised_where_a_driving_point_was_measured(five: ModalModel) -> None:
    assert five.scaled
    assert five.scaling_note == ""
    for k, mode in enumerate(five.modes):
        truth = FIVE.shapes[k] * np.sign(np.vdot(FIVE.shapes[k], mode.shape).real)
        assert np.max(np.abs(mode.shape - truth)) < 0.02 * np.max(np.abs(truth))
        assert mode.mpc > 0.999


def test_synthesis_follows_the_true_frfs(five: ModalModel) -> None:
    truth = FIVE.accelerance(five.frequency_hz, list(range(8)), [0, 3])
    error = np.sqrt(np.mean(np.abs(five.synthesis - truth) ** 2) / np.mean(np.abs(truth) ** 2))
    assert error < 0.02


def test_chart_shows_every_mode_as_selected_and_stable(five: ModalModel) -> None:
    chart = five.chart
    for k in range(5):
        voters = chart.selected == k
        assert np.count_nonzero(voters & chart.stable) >= 5
        assert np.median(chart.frequency_hz[voters]) == pytest.approx(FIVE.frequency_hz[k], rel=1e-3)


@pytest.mark.parametrize("engine", ["lscf", "sdypy"])
def test_other_engines_lead_to_the_same_modes(engine: str, five: ModalModel) -> None:
    model = identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings(engine=engine))
    assert frequencies(model) == pytest.approx(frequencies(five), rel=1e-6)
    assert {m.method for m in model.modes} == {engine}


def test_damping_error_without_polish_is_larger(five: ModalModel) -> None:
    raw = identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings(polish=False))
    assert len(raw.modes) == 5
    before = np.abs(dampings(raw) / FIVE.damping_ratio - 1)
    after = np.abs(dampings(five) / FIVE.damping_ratio - 1)
    assert np.median(after) < 0.5 * np.median(before)


def test_roving_hammer_gives_the_modes_of_roving_sensors(five: ModalModel) -> None:
    model = identify(hammer_test(FIVE, [0, 3], list(range(8))), ModalSettings())
    assert frequencies(model) == pytest.approx(FIVE.frequency_hz, rel=1e-4)
    assert [str(d) for d in model.references] == ["p0.z", "p3.z"]
    for a, b in zip(model.modes, five.modes, strict=True):
        assert np.max(np.abs(a.shape - b.shape)) < 0.03 * np.max(np.abs(b.shape))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_modes_of_a_repeated_pole_are_found_with_two_references(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    system = TrueSystem(
        np.array([90.0, 150.0, 150.0, 230.0]),
        np.array([0.01, 0.006, 0.006, 0.01]),
        rng.standard_normal((4, 10)),
    )
    model = identify(hammer_test(system, list(range(10)), [0, 4], seed=seed), ModalSettings())
    assert frequencies(model) == pytest.approx(system.frequency_hz, rel=2e-4)
    pair = np.array([m.shape for m in model.modes[1:3]])
    qa, qb = np.linalg.qr(pair.T)[0], np.linalg.qr(system.shapes[1:3].T)[0]
    assert np.min(np.linalg.svd(qa.conj().T @ qb, compute_uv=False)) ** 2 > 0.98


def test_pair_half_a_percent_apart_is_told_apart_with_one_reference() -> None:
    shapes = np.random.default_rng(5).standard_normal((3, 8))
    system = TrueSystem(np.array([100.0, 100.5, 160.0]), np.array([0.005, 0.005, 0.01]), shapes)
    model = identify(hammer_test(system, list(range(8)), [1]), ModalSettings())
    assert frequencies(model) == pytest.approx(system.frequency_hz, rel=2e-4)
    assert any("one reference cannot show a multiplicity" in note for note in model.notes)


@pytest.mark.parametrize(("n_hits", "n_out"), [(1, 1), (1, 12), (3, 6)])
def test_pure_noise_has_no_modes(n_hits: int, n_out: int) -> None:
    rng = np.random.default_rng(n_hits + n_out)
    each = rng.standard_normal((n_hits, n_out, 2, 1000, 2)) @ np.array([1, 1j])
    variance = None if n_hits == 1 else np.var(each, axis=0) / (n_hits - 1)
    frfs = frf_set(
        np.arange(1000) * 0.5, each.mean(axis=0), list(range(n_out)), [0, 1], variance=variance, n_hits=n_hits
    )
    assert identify(frfs, ModalSettings()).modes == ()


def test_rigid_body_motion_is_not_a_mode_but_is_in_the_synthesis() -> None:
    frequency = np.arange(2001) * 0.25
    system = TrueSystem(np.array([120.0]), np.array([0.01]), np.array([[1.0, -0.6, 0.3]]))
    rng = np.random.default_rng(1)
    frf = system.accelerance(frequency, [0, 1, 2], [0]) + 0.5
    frf = frf + 1e-3 * (rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape))
    model = identify(frf_set(frequency, frf, [0, 1, 2], [0], band_hz=(5.0, 400.0)), ModalSettings())
    assert frequencies(model) == pytest.approx([120.0], rel=1e-4)
    low = np.argmin(np.abs(model.frequency_hz - 20))
    assert model.synthesis[0, 0, low].real == pytest.approx(0.5, abs=0.05)


def test_modes_of_a_wide_band_are_found_at_both_ends_whatever_the_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = TrueSystem(
        np.array([50.2, 52.1, 108.0, 330.0, 1100.0, 1400.0]),
        np.full(6, 0.01),
        np.random.default_rng(3).standard_normal((6, 12)),
    )
    frfs = hammer_test(system, list(range(12)), [0, 5], f_max=2000.0, record_s=2.0, n_hits=2)
    monkeypatch.setattr(threads, "WORTH_A_THREAD", 1 << 12)
    models = []
    for cores in (1, 3):
        monkeypatch.setattr(threads, "cores", lambda n=cores: n)
        models.append(identify(frfs, ModalSettings()))
    assert frequencies(models[0]) == pytest.approx(system.frequency_hz, rel=3e-4)
    assert dampings(models[0]) == pytest.approx(np.full(6, 0.01), rel=0.04)
    assert [repr(m) for m in models[0].modes] == [repr(m) for m in models[1].modes]
    assert np.array_equal(models[0].synthesis, models[1].synthesis)


def test_a_cut_record_does_not_bias_frequency_damping_or_scale() -> None:
    system = TrueSystem(
        np.array([40.0, 77.0]), np.array([0.001, 0.002]), np.random.default_rng(4).standard_normal((2, 6))
    )
    frfs = hammer_test(system, list(range(6)), [0], f_max=100.0, record_s=4.0, noise=0.003)
    left_over = np.exp(-0.001 * 2 * np.pi * 40 * 4)
    assert left_over > 0.3  # a third of the response is still there at the end
    model = identify(frfs, ModalSettings())
    assert frequencies(model) == pytest.approx(system.frequency_hz, rel=1e-4)
    assert dampings(model) == pytest.approx(system.damping_ratio, rel=0.02)
    for k, mode in enumerate(model.modes):
        truth = system.shapes[k] * np.sign(np.vdot(system.shapes[k], mode.shape).real)
        assert np.max(np.abs(mode.shape - truth)) < 0.02 * np.max(np.abs(truth))


def test_damping_added_by_an_exponential_window_is_taken_off() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0], record_s=2.0, decay_rad_s=2.0)
    model = identify(frfs, ModalSettings())
    assert dampings(model) == pytest.approx(FIVE.damping_ratio, rel=0.02)


@pytest.mark.parametrize("by", ["analyser", "program"])
def test_damping_under_an_exponential_window_is_right_whoever_put_it_on(by: str, tmp_path: Path) -> None:
    """Records of 2 s that ring on, windows that end at 20 % and at 1 %."""
    errors = []
    for seed, decay in enumerate((0.8, 2.3)):
        rng = np.random.default_rng(seed)
        system = random_system(
            rng, n_modes=5, n_dofs=6, low_hz=40, high_hz=360, min_spacing=0.05, damping=(0.001, 0.01)
        )
        hits = simulate_hits(
            system, list(range(6)), [0, 2], f_max=400.0, record_s=2.0, n_hits=3, force_noise=0.005,
            response_noise=0.005, rng=rng, decay_rad_s=decay if by == "analyser" else 0.0,
        )  # fmt: skip
        folder = tmp_path / str(seed)
        records = records_of(hits, list(range(6)), [0, 2])
        write_raw_folder(folder, records, decay if by == "analyser" else 0.0)
        records = list(load_records(read_description(folder)))
        owner = {r.file: r for r in records}
        window = decay if by == "program" else "none"
        frfs = estimate_frfs(
            (cut_hit(owner[h.file], h) for h in hits_of_test(records)), FrfSettings(exponential_window=window)
        )
        assert frfs.response_decay_rad_s == pytest.approx(decay)
        model = identify(frfs, ModalSettings())
        assert frequencies(model) == pytest.approx(system.frequency_hz, rel=1e-4)
        errors += list(np.abs(dampings(model) / system.damping_ratio - 1))
    assert np.median(errors) < 0.005


def test_a_truncated_record_is_flagged_at_its_hits_and_at_the_modes_that_ring_on() -> None:
    """A mode of damping ζ at f has exp(-2πfζT) left after a time T; 5 % is the limit for modes."""
    rest = 4.0 - 20 / 256.0
    zeta = -np.log([0.10, 0.02]) / (2 * np.pi * np.array([40.0, 77.0]) * rest)
    system = TrueSystem(np.array([40.0, 77.0]), zeta, np.random.default_rng(4).standard_normal((2, 4)))
    flags, passes = {}, {}
    for record_s in (4.0, 12.0):
        hits = simulate_hits(
            system, [0, 1, 2, 3], [0], f_max=100.0, record_s=record_s, n_hits=2, force_noise=0.002,
            response_noise=0.002, rng=np.random.default_rng(1),
        )  # fmt: skip
        records = records_of(hits, [0, 1, 2, 3], [0])
        judged = hits_of_test(records)
        passes[record_s] = {v.passes for h in judged for v in h.verdicts if v.check == "response decay"}
        model = identify(
            estimate_frfs(cut_hit(r, h) for r, h in zip(records, judged, strict=True)), ModalSettings()
        )
        flags[record_s] = [any("decays longer than the record" in f for f in m.flags) for m in model.modes]
        assert dampings(model) == pytest.approx(system.damping_ratio, rel=0.02)
    assert False in passes[4.0]
    assert flags[4.0] == [True, False]
    assert passes[12.0] == {True}
    assert flags[12.0] == [False, False]


def test_poles_with_much_damping_are_backgrounds_unless_they_make_a_peak() -> None:
    peak, far_down = (
        2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2)) for f, zeta in ((100.0, 0.06), (200.0, 0.06))
    )
    light = 2 * np.pi * 200.0 * (-0.01 + 1j)
    omega = 2 * np.pi * np.arange(40.0, 300.0, 0.5)
    frf = (1 / (1j * omega - peak) + 1e-3)[None, None]
    data = FitData(omega, frf, np.ones(frf.shape), np.ones((1, 1), dtype=bool), 3.0, False)
    poles = np.array([peak, light, far_down])
    assert backgrounds(data, Estimate(poles, np.ones((3, 1)))).tolist() == [False, False, True]


def test_a_mode_that_a_strong_damper_damps_is_found_and_does_not_bend_those_around_it() -> None:
    system = TrueSystem(
        np.array([40.0, 79.0, 109.0, 118.0, 150.0]),
        np.array([0.009, 0.017, 0.26, 0.017, 0.017]),
        np.random.default_rng(4).standard_normal((5, 6)),
    )
    model = identify(hammer_test(system, list(range(6)), [0, 3], f_max=250.0, noise=2e-3), ModalSettings())
    stds = np.array([(m.frequency_std_hz, m.damping_std) for m in model.modes])
    assert np.all(np.abs(frequencies(model) - system.frequency_hz) < 3.5 * stds[:, 0])
    assert np.all(np.abs(dampings(model) - system.damping_ratio) < 3.5 * stds[:, 1])
    assert np.all(stds[:, 1] < 0.02 * system.damping_ratio)
    shapes = np.array([m.shape for m in model.modes])
    assert np.diag(mac(shapes, system.shapes)) == pytest.approx(np.ones(5), abs=2e-3)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_modes_that_ring_on_are_right_whatever_the_sensors_measure(quantity: str) -> None:
    """Hardly any noise; a third of the first mode and of one below the band is left at the end of the record."""
    frequency, record_s, outputs = np.array([1.5, 61.0, 150.0]), 2.0, [0, 1, 2, 3]
    rest = np.array([0.4, 0.33, 1e-3])
    system = TrueSystem(
        frequency,
        -np.log(rest) / (2 * np.pi * frequency * record_s),
        np.random.default_rng(2).standard_normal((3, 4)),
    )
    hits = simulate_hits(
        system, outputs, [0, 1], f_max=200.0, record_s=record_s, n_hits=2, force_noise=1e-6, response_noise=1e-6,
        rng=np.random.default_rng(5), quantity=quantity,
    )  # fmt: skip
    records = records_of(hits, outputs, [0, 1])
    frfs = estimate_frfs(cut_hit(r, h) for r, h in zip(records, hits_of_test(records), strict=True))
    model = identify(frfs, ModalSettings(low_hz=20.0))
    assert frfs.rings_on
    assert frequencies(model) == pytest.approx(frequency[1:], rel=3e-6)
    assert dampings(model) == pytest.approx(system.damping_ratio[1:], rel=3e-3)


def test_a_mode_that_the_polish_drives_away_is_kept_as_it_was_with_a_flag_and_a_wider_uncertainty(
    five: ModalModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(data, weight, start, iterations, held):  # the third mode's damping falls below zero
        estimate, solution = polish(data, weight, start, iterations, held)
        gone = (np.abs(estimate.poles.imag / (2 * np.pi) - 120.0) < 1.0) & ~held
        poles = np.where(gone, -estimate.poles.conj(), estimate.poles)
        return Estimate(poles, estimate.participation), solution

    monkeypatch.setattr(segment, "polish", failing)
    model = identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings())
    assert frequencies(model) == pytest.approx(FIVE.frequency_hz, rel=1e-3)
    assert ["polish failed" in "".join(m.flags) for m in model.modes] == [False, False, True, False, False]
    kept, polished = model.modes[2], five.modes[2]
    assert kept.damping_std > 2 * polished.damping_std
    assert abs(kept.damping_ratio - 0.008) < 3 * kept.damping_std


def test_the_interval_of_a_mode_held_at_its_peak_holds_half_the_way_that_the_fit_would_have_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pole = FIVE.poles[2]
    far = -2 * pole.real  # rad/s

    def straying(data, weight, start, iterations, held):
        estimate, solution = polish(data, weight, start, iterations, held)
        gone = (np.abs(estimate.poles.imag / (2 * np.pi) - 120.0) < 1.0) & ~held
        return Estimate(np.where(gone, pole + 1j * far, estimate.poles), estimate.participation), solution

    monkeypatch.setattr(segment, "polish", straying)
    peak = KnownPeaks(np.array([pole]), np.array([far]), np.array([[0.01, 0.01]]))
    frfs = hammer_test(FIVE, list(range(8)), [0, 3])
    mode = identify(frfs, ModalSettings(), peaks=peak).modes[2]
    assert any("pole from single hits" in flag for flag in mode.flags)
    assert mode.frequency_hz == pytest.approx(120.0, rel=1e-4)
    assert mode.frequency_std_hz == pytest.approx(0.5 * far / (2 * np.pi), rel=0.05)


def test_what_the_polish_drives_away_and_the_frfs_do_not_show_is_no_mode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    frf = FIVE.accelerance(np.arange(1601) * 0.25, [0, 1, 2, 3], [0])
    frf = frf + 0.01 * np.abs(frf).max() * (
        rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape)
    )
    frfs = frf_set(np.arange(1601) * 0.25, frf, [0, 1, 2, 3], [0], band_hz=(200.0, 290.0))

    def failing(data, weight, start, iterations, held):
        estimate, solution = polish(data, weight, start, iterations, held)
        return Estimate(
            np.where(held, estimate.poles, -estimate.poles.conj()), estimate.participation
        ), solution

    monkeypatch.setattr(segment, "polish", failing)
    assert identify(frfs, ModalSettings(low_hz=200, high_hz=290)).modes == ()


def test_a_held_pole_stays_where_it_is_to_the_last_bit() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0, 3])
    data = arrange(frfs, (20.0, 390.0))
    off = FIVE.poles * (1 + 3e-4j * np.arange(5))
    start = Estimate(off, FIVE.shapes[:, [0, 3]].astype(complex))
    held = np.array([False, True, False, True, False])
    found, _ = polish(data, np.ones(data.frf.shape), start, held=held)
    np.testing.assert_array_equal(found.poles[held], off[held])
    assert np.all(found.poles[~held] != off[~held])


def test_without_polish_the_uncertainty_holds_the_bias_of_the_engine() -> None:
    raw = identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings(polish=False))
    stds = np.array([m.damping_std for m in raw.modes])
    assert np.all(np.abs(dampings(raw) - FIVE.damping_ratio) < 4 * stds)


def test_noise_of_neighbouring_lines_under_a_window_correlates_as_the_fit_takes_it() -> None:
    rng = np.random.default_rng(3)
    n, rate, sigma = 1024, 512.0, 3.0
    noise = rng.standard_normal((4000, n)) * np.exp(-sigma * np.arange(n) / rate)
    lines = np.fft.rfft(noise)[:, 40:52] / np.sqrt(np.sum(np.exp(-2 * sigma * np.arange(n) / rate)))
    omega = 2 * np.pi * np.arange(40, 52) * rate / n
    data = FitData(
        omega, np.zeros((1, 1, 12)), np.zeros((1, 1, 12)), np.ones((1, 1), bool), 2.0, False, sigma
    )
    factors = rng.standard_normal((3, 12)) + 1j * rng.standard_normal((3, 12))
    drawn = np.real(factors @ lines.T)
    assert 2 * np.cov(drawn) == pytest.approx(power_of(factors, data), rel=0.1, abs=0.1 * 24)


def test_records_under_different_windows_are_not_averaged() -> None:
    hits = simulate_hits(
        FIVE, [0], [0], f_max=400.0, record_s=1.0, n_hits=2, force_noise=0.0, response_noise=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    one, other = records_of(hits, [0], [0])
    other = replace(other, window_decay_rad_s=1.5)
    found = [cut_hit(r, hits_of_test([r])[0]) for r in (one, other)]
    with pytest.raises(EmaError, match=r"exponential window of 1.5 rad/s, 'p0_0.h5' with 0 rad/s"):
        estimate_frfs(found)


@pytest.mark.parametrize("seed", range(3))
def test_blows_off_their_direction_make_no_second_mode_where_sensors_are_moved(seed: int) -> None:
    """Each position of two sensors has blows of its own, whose directions mix what the others excite."""
    frfs, rng = hammer_test(FIVE, list(range(8)), [0, 3, 6]), np.random.default_rng(seed)
    frf = frfs.frf.copy()
    for first in range(0, 8, 2):
        mix = 0.1 * rng.standard_normal((3, 3))
        np.fill_diagonal(mix, 1 + 0.01 * rng.standard_normal(3))
        frf[first : first + 2] = np.einsum("oil,ij->ojl", frfs.frf[first : first + 2], mix)

    channels = tuple(ChannelQuality(name) for name in ["a0", "a1"] * 4)
    moved = identify(replace(frfs, frf=frf, channels=channels), ModalSettings())
    assert frequencies(moved) == pytest.approx(FIVE.frequency_hz, rel=1e-3)


def test_frfs_that_were_not_measured_cost_no_modes_and_get_shapes_where_measured() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0, 3])
    frf = frfs.frf.copy()
    frf[5, 1] = np.nan  # measured for the first reference only
    frf[7] = np.nan  # not measured at all
    model = identify(FrfSet(**{**frfs.__dict__, "frf": frf}), ModalSettings())
    assert frequencies(model) == pytest.approx(FIVE.frequency_hz, rel=1e-4)
    for k, mode in enumerate(model.modes):
        truth = FIVE.shapes[k] * np.sign(np.vdot(FIVE.shapes[k][:7], mode.shape[:7]).real)
        assert abs(mode.shape[5] - truth[5]) < 0.03 * np.max(np.abs(truth))
        assert np.isnan(mode.shape[7])
    assert np.isnan(model.synthesis[7]).all()


def test_shapes_stay_unscaled_without_a_driving_point_and_the_note_says_so() -> None:
    model = identify(hammer_test(FIVE, [1, 2, 4, 5], [0]), ModalSettings())
    assert not model.scaled
    assert "driving point" in model.scaling_note
    for mode in model.modes:
        assert np.max(np.abs(mode.shape)) == pytest.approx(1.0)


def test_shapes_stay_unscaled_for_a_hammer_in_volts() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0])
    model = identify(FrfSet(**{**frfs.__dict__, "force_calibrated": False}), ModalSettings())
    assert not model.scaled
    assert "volts" in model.scaling_note


def test_velocity_and_displacement_frfs_give_the_same_modes() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0])
    jw = 2j * np.pi * frfs.frequency_hz
    jw[0] = 1.0
    parts = {"frf": frfs.frf / jw**2, "variance": frfs.variance / np.abs(jw) ** 4}
    model = identify(
        FrfSet(**{**frfs.__dict__, **parts, "quantities": ("displacement",) * 8}), ModalSettings()
    )
    same = identify(frfs, ModalSettings())
    assert frequencies(model) == pytest.approx(frequencies(same), rel=1e-6)


def test_modes_outside_the_chosen_band_are_not_reported() -> None:
    model = identify(hammer_test(FIVE, list(range(8)), [0, 3]), ModalSettings(low_hz=60, high_hz=250))
    assert frequencies(model) == pytest.approx([81.0, 120.0, 190.0], rel=2e-4)


AT_THE_END = TrueSystem(
    np.array([290.0, 388.0, 399.0, 404.0]),
    np.array([0.008, 0.007, 0.013, 0.014]),
    np.random.default_rng(43).standard_normal((4, 8)),
)


def test_modes_that_the_end_of_the_band_cuts_neither_get_lost_nor_into_the_shapes_of_others() -> None:
    frfs = hammer_test(AT_THE_END, list(range(8)), [0, 3], f_max=500.0)
    model = identify(frfs, ModalSettings(high_hz=400))
    assert frequencies(model) == pytest.approx(AT_THE_END.frequency_hz[:3], rel=1e-4)
    shapes = np.array([m.shape for m in model.modes])
    assert np.diag(mac(shapes, AT_THE_END.shapes[:3])) == pytest.approx(1.0, abs=1e-4)
    assert model.frequency_hz[-1] == 400
    assert model.synthesis.shape[-1] == len(model.frequency_hz)
    chart = model.chart
    assert np.all(chart.frequency_hz[chart.selected >= 0] < 402)
    assert not model.left_out


def test_the_fit_sees_lines_beyond_the_band_only_where_a_peak_stands_at_its_end_and_a_hammer_went_on() -> (
    None
):
    frfs = hammer_test(AT_THE_END, list(range(8)), [0, 3], f_max=500.0)
    level = np.full((8, 2), 1e-4)
    low, high = seen_band(frfs, (5.0, 400.0), level)
    assert low == 5.0
    assert 410 < high <= 440
    assert seen_band(frfs, (5.0, 340.0), level) == (5.0, 340.0)
    assert seen_band(replace(frfs, excitation="random"), (5.0, 400.0), level) == (5.0, 400.0)
    assert seen_band(frfs, (5.0, 400.0), 1e9 * level) == (5.0, 400.0)


def test_a_band_without_lines_is_refused_with_a_remedy() -> None:
    frfs = hammer_test(FIVE, list(range(8)), [0], record_s=2.0)
    with pytest.raises(EmaError, match=r"fewer than 16 lines .*widen band_hz of test\.toml, or low_hz"):
        identify(frfs, ModalSettings(low_hz=100, high_hz=101))


@pytest.mark.parametrize("seed", range(3))
def test_random_systems_lose_and_gain_no_modes(seed: int) -> None:
    rng = np.random.default_rng(700 + seed)
    system = random_system(rng, n_modes=8, n_dofs=10, low_hz=30, high_hz=380, min_spacing=0.02)
    record_s = float(np.clip(5 / system.slowest_decay, 3, 12))
    frfs = hammer_test(system, list(range(10)), [0, 1, 2], record_s=record_s, noise=0.02, seed=seed)
    model = identify(frfs, ModalSettings())
    assert len(model.modes) == 8
    assert frequencies(model) == pytest.approx(system.frequency_hz, rel=1e-3)


def test_progress_is_told_and_rises() -> None:
    seen: list[float] = []
    frfs = hammer_test(FIVE, [0, 1], [0], record_s=1.0)
    identify(frfs, ModalSettings(), lambda share, text: seen.append(share))
    assert seen == sorted(seen)
    assert seen[-1] >= 0.9


def test_noise_averaged_over_lines_is_not_taken_for_more_of_it_beside_a_narrow_peak() -> None:
    """The variance from few hits is averaged over neighbouring lines: the law is fitted to it as to single lines."""
    n_lines, wide = 1200, 17
    x = np.arange(n_lines) - n_lines / 2
    response = np.ones((3, 1, 1)) / (x / 1.5 + 1j)
    square = np.abs(response) ** 2
    true = 4e-4 * square + 1e-6
    draws = np.random.default_rng(4).exponential(size=(40, *true.shape)).mean(axis=0)
    averaged = uniform_filter1d(true * draws, wide, axis=-1, mode="nearest")
    measured = np.ones((3, 1), dtype=bool)
    laws = [
        fit_law(averaged, response, measured, inputs_are_rows=False, averaged=lines)
        for lines in (None, np.full((3, 1), wide))
    ]
    peak = slice(n_lines // 2 - 1, n_lines // 2 + 2)
    flank = slice(n_lines // 2 + 10, n_lines // 2 + 60)
    wrong, right = (law.at(response).variance / true for law in laws)
    assert right[..., peak].mean() == pytest.approx(1, abs=0.1)
    assert right[..., flank].mean() == pytest.approx(1, abs=0.1)
    assert max(wrong[..., peak].mean(), wrong[..., flank].mean()) > 1.3


@pytest.mark.parametrize(
    ("after", "holds"),
    [
        ([-3 + 100j, -6 + 110j, -1 + 150j], True),
        ([-3 + 101j, -6 + 112j], True),
        ([-9 + 104j], False),  # one for both, near to either
        ([-9 + 104j, -1 + 150j], False),
        ([-3 + 100j, -6 + 125j], False),
        ([], False),
    ],
)
def test_weak_candidates_may_not_merge_modes_that_were_found(after: list[complex], holds: bool) -> None:
    """Else what a tool holder shows depends on the processor: one has a weak candidate more than another."""

    def at(poles: list[complex]) -> Estimate:
        return Estimate(np.array(poles, complex), np.ones((len(poles), 1), complex))

    assert sub_bands._holds(at(after), at([-3 + 100j, -6 + 110j])) is holds
    assert sub_bands._holds(at(after), at([]))


@pytest.mark.parametrize(
    ("scale_std", "said"),
    [
        (0.05, ()),
        (0.25, ("scale uncertain by 25 %: the driving point lies near a node",)),
        (55.64, ("scale not determined: the driving point lies near a node",)),
    ],
)
def test_a_scale_that_is_uncertain_by_more_than_itself_is_not_determined(
    scale_std: float, said: tuple[str, ...]
) -> None:
    shape = np.ones(2)
    found = _mode(-1.0 + 100.0j, 1e-4 * np.eye(2), shape + 0j, shape, shape, "", 1.0, scale_std, [])
    assert found.flags == said
