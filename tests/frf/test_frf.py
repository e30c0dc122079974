"""FRFs, coherence and variance from hits, against independent computations, exact systems and real data."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frf_hits import POLES, RATE, clean_hits, error, exact, half_sine, hit_of, residues
from numpy.typing import NDArray
from scipy import signal
from simulate_hits import modal_response, record_of

from ema_pipeline.check_result import judged
from ema_pipeline.errors import EmaError
from ema_pipeline.frf import FrfSet, FrfSettings, estimate_frfs
from ema_pipeline.frf.channel_faults import EXCHANGED
from ema_pipeline.frf.windows import force_window
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import HitSamples, Record, cut_hit


def test_h1_of_decayed_clean_hits_is_the_exact_frf() -> None:
    frfs = estimate_frfs(clean_hits(2, 8192))
    for o in range(2):
        # What is left at the end, exp(-24), is all that differs, and no force is at the Nyquist frequency.
        assert error(frfs, o, 0, o) < 1e-8
    assert np.isfinite(frfs.frf).all()
    assert frfs.frequency_hz[0] == 0
    assert frfs.frequency_hz[-1] == RATE / 2
    assert frfs.record_s == 4.0
    assert frfs.delay_s[0] == pytest.approx(22.5 / RATE, abs=1.0 / RATE)
    assert frfs.sensor_mass_kg.tolist() == [0.0, 0.01]


def test_h1_and_coherence_equal_scipy_on_real_hits(test_data: Path) -> None:
    frfs, records = real(test_data / "realdata" / "five_hits_25600hz")
    cross = power = answer = 0.0
    for record in records:
        options = {
            "fs": record.sample_rate_hz,
            "window": "boxcar",
            "nperseg": record.force.size,
            "detrend": False,
        }
        cross = cross + signal.csd(record.force, record.responses[0], **options)[1]
        power = power + signal.welch(record.force, **options)[1]
        answer = answer + signal.welch(record.responses[0], **options)[1]
    assert np.allclose(frfs.frf[0, 0], cross / power, rtol=1e-9, atol=0)
    assert np.allclose(frfs.coherence[0, 0], np.abs(cross) ** 2 / (power * answer), rtol=1e-9, atol=0)
    coherence = next(v for v in frfs.verdicts if v.check == "coherence")
    assert coherence.passes
    assert coherence.value > 0.99


def real(folder: Path, settings: FrfSettings | None = None) -> tuple[FrfSet, list[Record]]:
    """FRFs and records of a raw folder."""
    (test,) = read_campaign(folder).tests
    records = list(load_records(test))
    by_file = {r.file: r for r in records}
    hits = [h for h in hits_of_test(records) if h.accepted]
    return estimate_frfs((cut_hit(by_file[h.file], h) for h in hits), settings), records


def test_single_real_hits_agree_with_the_analyser_within_its_scatter(test_data: Path) -> None:
    """One raw hit per point against an analyser's average of several.

    Its coherence tells the scatter of one hit; its response window adds 0.139 rad/s to every pole, so ours get
    the same one.
    """
    folder = test_data / "realdata" / "aircraft_roving_hammer"
    frfs, _ = real(folder, FrfSettings(exponential_window=0.13889))
    analyser = np.load(folder / "analyser_frf.npz")
    lines = (analyser["f_Hz"] > 15) & (analyser["f_Hz"] < 180)
    frequency = analyser["f_Hz"][lines]
    theirs = np.moveaxis(analyser["H_g_per_N"], 1, 0)[..., lines] * 9.80665
    coherence = np.moveaxis(analyser["coherence"], 1, 0)[..., lines].clip(1e-6, 1 - 1e-6)
    step = frfs.frequency_hz[1]
    order = [int(str(d.body).removeprefix("point")) for d in frfs.inputs]
    ours = np.empty_like(theirs)
    for row in range(3):
        for column, point in enumerate(order):
            frf = frfs.frf[row, column]
            ours[row, point] = np.interp(frequency, step * np.arange(frf.size), frf.real) + 1j * np.interp(
                frequency, step * np.arange(frf.size), frf.imag
            )
    correlation = np.abs(np.sum(ours.conj() * theirs, axis=-1)) ** 2 / (
        np.sum(np.abs(ours) ** 2, axis=-1) * np.sum(np.abs(theirs) ** 2, axis=-1)
    )
    assert np.median(correlation) > 0.995
    scatter = np.abs(theirs) * np.sqrt((1 - coherence) / coherence)
    ratio = np.median(np.abs(ours - theirs) / scatter)
    assert ratio < 1.3
    size = np.median(np.linalg.norm(ours, axis=-1) / np.linalg.norm(theirs, axis=-1))
    assert size == pytest.approx(1, abs=0.01)


def test_signs_of_hammer_and_sensors_are_applied() -> None:
    hits = clean_hits(1, 4096)
    plain = estimate_frfs(hits)
    turned = estimate_frfs([hit_of(-h.force, h.responses, "-p0.z", ("-p0.z", "p1.z")) for h in hits])
    assert [str(d) for d in (*turned.outputs, *turned.inputs)] == ["p0.z", "p1.z", "p0.z"]
    assert np.allclose(turned.frf[0], -plain.frf[0])
    assert np.allclose(turned.frf[1], plain.frf[1])


def test_roving_sensors_and_points_give_the_union_with_nan_where_nothing_was_measured() -> None:
    a, b, c = (clean_hits(1, 8192, seed=s)[0] for s in range(3))
    hits = [
        hit_of(a.force, a.responses, "p0.z", ("p0.z", "p1.z")),
        hit_of(b.force, b.responses[:1], "p0.z", ("p0.z",)),
        hit_of(c.force, c.responses, "p7.z", ("p1.z", "p2.z")),
    ]
    frfs = estimate_frfs(hits)
    assert [str(d) for d in frfs.outputs] == ["p0.z", "p1.z", "p2.z"]
    assert [str(d) for d in frfs.inputs] == ["p0.z", "p7.z"]
    assert frfs.hits.tolist() == [[2, 0], [1, 1], [0, 1]]
    assert np.array_equal(np.isnan(frfs.frf).all(axis=-1), frfs.hits == 0)
    assert np.array_equal(np.isnan(frfs.coherence).all(axis=-1), frfs.hits < 2)
    assert error(frfs, 0, 0, 0) < 1e-7
    assert error(frfs, 1, 0, 1) < 1e-7
    assert error(frfs, 1, 1, 0) < 1e-7


def test_variance_of_h1_is_unbiased_and_predicts_the_scatter_of_repeated_tests() -> None:
    """Monte Carlo: 200 tests of n hits; the mean of the estimates is the variance among the tests."""
    for n, seed in ((2, 0), (5, 1)):
        frf, variance = [], []
        rng = np.random.default_rng(seed)
        base = clean_hits(n, 512, outputs=1)
        for _ in range(200):
            noisy = [replace(h, responses=h.responses + 2.0 * rng.standard_normal((1, 512))) for h in base]
            result = estimate_frfs(noisy)
            frf.append(result.frf[0, 0])
            variance.append(result.variance[0, 0])
        band = slice(10, 150)
        among = np.var(np.array(frf), axis=0)[band]
        told = np.mean(np.array(variance), axis=0)[band]
        assert np.mean(told / among) == pytest.approx(1, abs=0.03)
        # Smoothed to 16 complex degrees of freedom: a relative deviation of 1/√16.
        spread = np.std(np.array(variance), axis=0)[band] / told
        assert np.mean(spread) == pytest.approx(0.25, abs=0.06)


def test_one_hit_has_neither_coherence_nor_variance_and_says_so() -> None:
    frfs = estimate_frfs(clean_hits(1, 4096))
    assert np.isnan(frfs.coherence).all()
    assert np.isnan(frfs.variance).all()
    assert any("one hit" in v.message for v in frfs.verdicts)


def test_two_hits_are_too_few_to_judge_coherence_by() -> None:
    frfs = estimate_frfs(clean_hits(2, 4096, noise=3.0))
    first = next(v for v in frfs.verdicts if v.check == "coherence")
    assert first.passes
    assert "too few" in first.message


def test_h1_h2_and_hv_stand_in_the_right_order_with_noise_on_the_force() -> None:
    rng = np.random.default_rng(0)
    hits = [replace(h, force=h.force + 1.5 * rng.standard_normal(h.force.size)) for h in clean_hits(40, 4096)]
    line = int(143.25 * 2)
    size = {
        e: float(np.abs(estimate_frfs(hits, FrfSettings(estimator=e)).frf[0, 0, line]))
        for e in ("H1", "H2", "Hv")
    }
    true = float(np.abs(exact(np.array([line * 0.5]), 0)[0]))
    assert size["H1"] < size["Hv"] < size["H2"]
    assert size["H2"] == pytest.approx(true, rel=0.15)
    assert size["Hv"] == pytest.approx(np.sqrt(size["H1"] * size["H2"]))


def test_force_and_exponential_window_give_the_frf_with_the_added_damping() -> None:
    """An undecayed record with offsets: exp(-0.5 s·6/s) is 5 % of the response at its end."""
    rng = np.random.default_rng(0)
    hits = []
    for h in clean_hits(3, 1024):
        force = h.force + 3.0 + 0.02 * rng.standard_normal(1024)
        hits.append(replace(h, force=force, responses=h.responses + np.array([[40.0], [-7.0]])))
    settings = FrfSettings(force_window="auto", exponential_window=12.0)
    frfs = estimate_frfs(hits, settings)
    assert frfs.response_decay_rad_s == 12.0
    for o in range(2):
        true = exact(frfs.frequency_hz, o, decay=12.0)
        for pole in POLES:
            line = int(np.argmin(np.abs(frfs.frequency_hz - pole.imag / 2 / np.pi)))
            near = slice(line - 1, line + 2)
            assert np.abs(frfs.frf[o, 0, near]) == pytest.approx(np.abs(true[near]), rel=0.01)


@pytest.mark.parametrize("recorded", [0.0, 3.0])
def test_damping_is_exact_once_the_windows_share_is_taken_off(recorded: float) -> None:
    """The window that is applied, and the one that the analyser has applied already."""
    (h,) = clean_hits(1, 4096, outputs=1)
    window = np.exp(-recorded * np.arange(h.force.size) / RATE)
    h = replace(h, force=h.force * window, responses=h.responses * window, window_decay_rad_s=recorded)
    settings = FrfSettings(exponential_window="auto")
    frfs = estimate_frfs([h], settings)
    assert frfs.response_decay_rad_s == pytest.approx(np.log(100) / 2.0 + recorded)
    # Rational fit in z of the exact order: 3 pairs of poles.
    inside = slice(20, 900)
    z = np.exp(-2j * np.pi * frfs.frequency_hz[inside] / RATE)
    powers = z[:, None] ** np.arange(7)
    measured = frfs.frf[0, 0, inside]
    left = np.hstack([powers[:, :6], -measured[:, None] * powers[:, 1:]])
    weights, *_ = np.linalg.lstsq(
        np.vstack([left.real, left.imag]), np.concatenate([measured.real, measured.imag])
    )
    poles = RATE * np.log(np.roots([1.0, *weights[6:]]))
    found = np.sort_complex(1j * poles[poles.imag > 0])[::-1] / 1j
    found = found[np.argsort(found.imag)] + frfs.response_decay_rad_s
    assert np.allclose(-found.real / np.abs(found), -POLES.real / np.abs(POLES), rtol=1e-4)


def test_record_cut_at_the_blow_keeps_rational_frfs_although_it_has_not_decayed() -> None:
    """At FFT lines, exponentials cut off at the end of the record are whole ones with other residues."""
    n = 512
    force = np.zeros(n)
    force[0] = 50.0
    answer = modal_response(force, RATE, POLES, residues(0))
    frfs = estimate_frfs([hit_of(force, answer[None, :])])
    z = np.exp(2j * np.pi * frfs.frequency_hz / RATE)
    expected = np.zeros(frfs.frequency_hz.size, dtype=complex)
    for pole, residue in zip(POLES, residues(0), strict=True):
        for s, a in ((pole, residue), (pole.conjugate(), residue.conjugate())):
            expected += a / RATE * (1 - np.exp(s * n / RATE)) / (1 - np.exp(s / RATE) / z)
    assert np.allclose(frfs.frf[0, 0], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("number", "still_ringing", "alike"), [(2, True, True), (2, False, False), (1, True, False)]
)
def test_what_still_rings_when_a_later_hit_strikes_changes_residues_alone(
    number: int, still_ringing: bool, alike: bool
) -> None:
    """Around a mode the FRF stays a multiple of that of a structure that was struck at rest."""
    n, blow = 1024, 64
    force = np.zeros(n)
    force[blow] = 50.0
    time = np.arange(n) / RATE
    pole = complex(-1.0, 2 * np.pi * 80.0)  # 2.5 periods before the blow, 61 % left at the end
    answer = modal_response(force, RATE, np.array([pole]), np.array([80j]))
    left = 0.2 * np.ptp(answer) * np.real(np.exp(pole * time + 1j))
    frf = []
    for samples in (answer, answer + left):
        h = hit_of(force, samples[None, :])
        decay = judged(
            "response decay", 0.6, 0.01, not still_ringing, "", "warn", "still rings", channel="a0"
        )
        found = estimate_frfs([replace(h, hit=replace(h.hit, number=number, verdicts=(decay,)))])
        frf.append(found.frf[0, 0, 20:61])  # 20 Hz on either side of the mode
    # a constant stands for what is far away, the static part of what is cut off
    columns = np.stack([frf[0], np.ones(41)], axis=1)
    rest = frf[1] - columns @ np.linalg.lstsq(columns, frf[1], rcond=None)[0]
    assert bool(np.linalg.norm(rest) < 0.03 * np.linalg.norm(frf[1] - frf[0])) is alike


def test_force_window_keeps_the_pulse_whole() -> None:
    force = half_sine(4096, 100, 12, 60.0) + 0.01 * np.random.default_rng(0).standard_normal(4096)
    window = force_window(force, int(np.argmax(force)))
    assert (window[98:114] == 1).all()
    assert (window[400:] == 0).all()


def test_hits_stream_through_and_are_not_kept() -> None:
    alive: list[weakref.ref[NDArray[np.float64]]] = []

    def stream() -> Iterator[HitSamples]:
        for h in range(6):
            hit = clean_hits(1, 2048, seed=h)[0]
            alive.append(weakref.ref(hit.responses))
            yield hit
            del hit
            assert sum(r() is not None for r in alive) <= 1

    assert estimate_frfs(stream()).hits[0, 0] == 6


def test_hits_that_do_not_fit_together_are_refused_with_file_and_remedy() -> None:
    good, short = clean_hits(1, 4096)[0], replace(clean_hits(1, 2048)[0])
    with pytest.raises(EmaError, match="no accepted hit"):
        estimate_frfs([])
    with pytest.raises(EmaError, match="2048 samples, but 4096 in 'r0'"):
        estimate_frfs([good, short])
    with pytest.raises(EmaError, match="sample rate"):
        estimate_frfs([good, replace(good, sample_rate_hz=1000.0)])
    with pytest.raises(EmaError, match="calibrated"):
        estimate_frfs([good, replace(good, force_calibrated=False)])
    with pytest.raises(EmaError, match=r"'a0' and 'a1' both measure p0\.z"):
        estimate_frfs([hit_of(good.force, good.responses, outputs=("p0.z", "-p0.z"))])
    velocity = tuple(replace(c, quantity="velocity") for c in good.channels)
    with pytest.raises(EmaError, match="velocity"):
        estimate_frfs([good, replace(good, channels=velocity)])


def test_band_of_a_soft_tip_ends_in_noise_and_of_a_hard_one_at_the_converters_limit() -> None:
    rng = np.random.default_rng(0)
    bands = {}
    for width in (2, 40):
        force = half_sine(8192, 100, width, 50.0) + 0.05 * rng.standard_normal(8192)
        bands[width] = estimate_frfs([hit_of(force, rng.standard_normal((1, 8192)))]).band_hz
    assert bands[2][1] == pytest.approx(RATE / 2.56)
    # First zero of the half-sine of 40 samples: 1.5 widths, at 77 Hz; noise buries all lobes from about 4 on.
    assert 55 < bands[40][1] < 320


def checks(frfs: FrfSet, name: str) -> list[bool]:
    """Outcomes of one check."""
    return [v.passes for v in frfs.verdicts if v.check == name]


def two_way_hits(sign: float, gain: float) -> list[HitSamples]:
    """A reciprocal structure struck at both of its points; one sensor reversed or miscalibrated."""
    shapes = np.array([[1.0, 0.7], [0.8, -1.0], [0.6, 0.9]])
    rng = np.random.default_rng(0)
    hits = []
    for source in range(2):
        for k in range(3):
            force = half_sine(8192, 20, 5 + k, 60.0 + 10 * k)
            # Residues jω·φφ/2 of accelerance, real modes.
            rows = [
                modal_response(force, RATE, POLES, 1j * POLES.imag / 2 * shapes[:, source] * shapes[:, o])
                for o in range(2)
            ]
            answers = np.array(rows) * np.array([[1.0], [sign * gain]]) + 1e-3 * rng.standard_normal(
                (2, 8192)
            )
            hits.append(hit_of(force, answers, f"p{source}.z"))
    return hits


def test_driving_points_and_reciprocity_pass_on_a_passive_reciprocal_structure() -> None:
    frfs = estimate_frfs(two_way_hits(1.0, 1.0))
    assert checks(frfs, "driving point") == [True, True]
    assert checks(frfs, "reciprocity") == [True]
    assert all(checks(frfs, "coherence"))
    assert all(checks(frfs, "repeatability"))


def test_reversed_sensor_shows_at_its_driving_point_and_in_reciprocity() -> None:
    frfs = estimate_frfs(two_way_hits(-1.0, 1.0))
    assert checks(frfs, "driving point") == [True, False]
    assert checks(frfs, "sensitivity") == [False]
    assert any("reversed" in v.message for v in frfs.verdicts)
    assert any("contradict each other" in v.message and "signs" in v.message for v in frfs.verdicts)


def test_sensitivity_wrong_by_a_factor_shows_as_that_factor_in_reciprocity() -> None:
    frfs = estimate_frfs(two_way_hits(1.0, 9.81))
    (found,) = (v for v in frfs.verdicts if v.check == "sensitivity")
    assert max(found.value, 1 / found.value) == pytest.approx(9.81, rel=0.05)
    assert "mV/g" in found.message


def test_miscalibrated_sensor_shows_in_reciprocity_only() -> None:
    frfs = estimate_frfs(two_way_hits(1.0, 1.3))
    assert checks(frfs, "driving point") == [True, True]
    assert checks(frfs, "reciprocity") == [False]


def test_blows_on_different_spots_show_in_coherence_and_repeatability() -> None:
    rng = np.random.default_rng(0)
    hits = [replace(h, responses=h.responses * rng.uniform(0.5, 1.5)) for h in clean_hits(5, 8192)]
    frfs = estimate_frfs(hits)
    assert not all(checks(frfs, "repeatability"))


@pytest.mark.parametrize(("share", "judged"), [(0.1, 1), (0.4, 2)])
def test_repeatability_is_not_judged_by_what_oblique_blows_make(share: float, judged: int) -> None:
    """A response across the blow changes with its direction; a large one is the structure's."""
    across = share * np.array([1.0, 0.3, 0.5, 1.4, 1.8])
    hits = [
        replace(h, responses=np.stack([h.responses[0], a * h.responses[0]]))
        for h, a in zip(clean_hits(5, 8192, outputs=2), across, strict=True)
    ]
    assert len(checks(estimate_frfs(hits), "repeatability")) == judged


def test_records_of_the_same_channels_average_to_the_same_whatever_the_threads() -> None:
    hits = clean_hits(3, 2048, outputs=9, noise=0.1)
    one, two = (estimate_frfs(hits, FrfSettings(threads=t)) for t in (1, 2))
    assert np.array_equal(one.frf, two.frf)
    assert np.array_equal(one.variance, two.variance)


def test_record_helper_gives_whole_records() -> None:
    h = clean_hits(1, 2048)[0]
    record = record_of(h.force, h.responses, RATE)
    (hit,) = hits_of_test([record])
    assert np.array_equal(cut_hit(record, hit).force, h.force)


def gauss_pulse(cut_hz: float, n: int = 8192) -> NDArray[np.float64]:
    """A pulse whose autospectrum falls as exp(-a·f²), by 40 dB at `cut_hz`."""
    tau = np.sqrt(8 * np.log(10)) / (2 * np.pi * cut_hz)
    return 100 * np.exp(-(((np.arange(n) / RATE - 0.05) / tau) ** 2))


@pytest.mark.parametrize(("drop_db", "end_hz"), [(40.0, 300.0), (30.0, 259.8), (20.0, 212.1)])
def test_the_band_of_a_clean_pulse_ends_at_the_drop_that_the_settings_say(
    drop_db: float, end_hz: float
) -> None:
    force = gauss_pulse(300.0)
    frfs = estimate_frfs([hit_of(force, force[None])], FrfSettings(band_drop_db=drop_db))
    assert frfs.band_hz[1] == pytest.approx(end_hz, abs=5)  # blocks of lines are 4 Hz wide


def test_the_band_ends_10_db_above_the_flat_part_of_the_force_spectrum() -> None:
    force = gauss_pulse(300.0)
    flat = np.zeros(force.size)
    flat[4000] = np.abs(np.fft.rfft(force)).max() * 10 ** (
        -35 / 20
    )  # a click far from the pulse: 35 dB lower
    end_hz = estimate_frfs([hit_of(force + flat, force[None])]).band_hz[1]
    assert -40 * (end_hz / 300) ** 2 == pytest.approx(-35 + 10, abs=1.5)


def test_a_disturbance_far_above_the_pulse_does_not_widen_the_band() -> None:
    force = gauss_pulse(300.0)
    spectrum = np.fft.rfft(np.random.default_rng(0).standard_normal(force.size))
    frequency = np.fft.rfftfreq(force.size, 1 / RATE)
    spectrum[(frequency < 700) | (frequency > 760)] = 0.0
    spectrum *= 0.1 * np.abs(np.fft.rfft(force)).max() / np.abs(spectrum).max()  # 20 dB below the pulse
    disturbed = force + np.fft.irfft(spectrum, force.size)
    clean, seen = (estimate_frfs([hit_of(f, force[None])]).band_hz for f in (force, disturbed))
    assert seen == pytest.approx(clean, abs=5)


def test_repeatability_is_the_scatter_of_single_hits_beyond_the_noise() -> None:
    factors = np.array([0.8, 0.9, 1.0, 1.1, 1.2])
    rng = np.random.default_rng(3)
    hits = [
        replace(h, responses=f * h.responses + 0.02 * rng.standard_normal(h.responses.shape))
        for h, f in zip(clean_hits(5, 8192, outputs=1), factors, strict=True)
    ]
    verdicts = estimate_frfs(hits).verdicts
    repeatability = next(v for v in verdicts if v.check == "repeatability")
    coherence = next(v for v in verdicts if v.check == "coherence")
    assert repeatability.value == pytest.approx(np.std(factors, ddof=1), rel=0.15)
    assert coherence.value == pytest.approx(1 / (1 + np.var(factors)), abs=0.01)
    assert (repeatability.passes, coherence.passes) == (False, True)
    steady = [replace(h, responses=h.responses + 0.02 * rng.standard_normal(h.responses.shape))
              for h in clean_hits(5, 8192, outputs=1)]  # fmt: skip
    assert next(v for v in estimate_frfs(steady).verdicts if v.check == "repeatability").value < 0.02


def test_two_channels_at_one_dof_are_named() -> None:
    hit = hit_of(half_sine(256, 10, 4, 1.0), np.ones((3, 256)), outputs=("p0.z", "p1.z", "p1.z"))
    with pytest.raises(EmaError, match=r"channels 'a1' and 'a2' both measure p1\.z"):
        estimate_frfs([hit])


def test_the_force_window_leaves_out_what_the_hammer_reads_long_after_the_pulse() -> None:
    (clean,) = clean_hits(1, 4096, outputs=1)
    late = clean.force.copy()
    late[3000:3020] += 0.2 * clean.force.max()
    disturbed = replace(clean, force=late)
    lines = slice(10, 800)
    true = estimate_frfs([clean]).frf[0, 0, lines]

    def off(settings: FrfSettings) -> float:
        found = estimate_frfs([disturbed], settings).frf[0, 0, lines]
        return float(np.abs(found - true).max() / np.abs(true).max())

    assert off(FrfSettings(force_window="auto")) < 1e-3 < 0.1 < off(FrfSettings())


def test_windows_find_the_pulse_of_a_hit_that_was_cut_from_a_long_recording() -> None:
    (clean,) = clean_hits(1, 4096, outputs=1)
    later = replace(clean, hit=replace(clean.hit, start=20000, stop=24096, peak=clean.hit.peak + 20000))
    settings = FrfSettings(force_window="auto", exponential_window=12.0)
    np.testing.assert_array_equal(estimate_frfs([later], settings).frf, estimate_frfs([clean], settings).frf)


def value(frfs: FrfSet, check: str) -> float:
    """Value of the last verdict of a check."""
    return [v.value for v in frfs.verdicts if v.check == check][-1]


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.3])
def test_reciprocity_is_the_difference_of_two_frfs_over_their_mean_size(gain: float) -> None:
    frfs = estimate_frfs(two_way_hits(1.0, gain))
    assert value(frfs, "reciprocity") == pytest.approx(abs(gain - 1) / (0.5 * (gain + 1)), abs=0.01)


def test_the_noise_of_two_frfs_is_not_taken_for_a_lack_of_reciprocity() -> None:
    rng = np.random.default_rng(0)
    noisy = [
        replace(h, responses=h.responses + 0.1 * np.std(h.responses) * rng.standard_normal(h.responses.shape))
        for h in two_way_hits(1.0, 1.0)
    ]
    assert value(estimate_frfs(noisy), "reciprocity") < 0.05


def test_a_reversed_driving_point_has_nearly_all_of_its_imaginary_part_negative() -> None:
    right, wrong = estimate_frfs(two_way_hits(1.0, 1.0)), estimate_frfs(two_way_hits(1.0, -1.0))
    assert value(right, "driving point") < 0.02
    assert value(wrong, "driving point") > 0.98
    assert "reversed" in [v.message for v in wrong.verdicts if v.check == "driving point"][-1]


def test_a_sensor_beside_the_point_that_is_struck_is_not_called_reversed() -> None:
    """One of three modes has another sign there."""
    force = half_sine(8192, 20, 5, 60.0)
    shapes = np.array([1.0, -0.7, 0.8])
    answer = modal_response(force, RATE, POLES, 1j * POLES.imag / 2 * shapes)
    (found,) = (
        v for v in estimate_frfs([hit_of(force, answer[None])]).verdicts if v.check == "driving point"
    )
    assert found.limit < found.value < 0.5
    assert "hammer and sensor are not at one point, or its quantity is wrong" in found.message
    assert "reversed" not in found.message


def test_exchanged_sensors_are_named_once_and_neither_is_called_reversed() -> None:
    rows = two_way_hits(1.0, 1.0)
    swapped = [replace(h, responses=np.asarray(h.responses)[::-1]) for h in rows]
    found = estimate_frfs(swapped).verdicts
    assert not [v for v in found if v.check == "driving point"]
    (told,) = (v for v in found if v.check == EXCHANGED)
    assert not told.passes
    assert (
        "exchange the dof of these channels or the impact of these hits, whichever is wrong" in told.message
    )
    assert "reversed" not in " ".join(v.message for v in found)
    for right in (rows, two_way_hits(1.0, -1.0)):
        assert EXCHANGED not in {v.check for v in estimate_frfs(right).verdicts}


def test_one_hit_each_way_is_enough_for_reciprocity() -> None:
    single = [two_way_hits(1.0, 1.3)[k] for k in (0, 3)]
    assert value(estimate_frfs(single), "reciprocity") == pytest.approx(0.3 / 1.15, abs=0.01)


def test_coherence_is_judged_from_three_hits_on() -> None:
    rng = np.random.default_rng(5)
    poor = [
        replace(h, responses=h.responses + 2 * np.std(h.responses) * rng.standard_normal(h.responses.shape))
        for h in clean_hits(3, 8192, outputs=1)
    ]
    two, three = estimate_frfs(poor[:2]), estimate_frfs(poor)
    assert value(three, "coherence") < 0.9
    assert checks(three, "coherence") == [False]
    assert checks(two, "coherence") == [True]
    assert "two hits are too few" in next(v.message for v in two.verdicts if v.check == "coherence")
