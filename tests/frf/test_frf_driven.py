"""FRFs of continuous tests: several forces at once, singular forces, and distortion apart from noise."""

from __future__ import annotations

import base64
import zlib

import numpy as np
import pytest
from driven import driven_system

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.driven import estimate_driven_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.driven import DrivenRecord, ForceChannel
from ema_pipeline.ingest.records import ResponseChannel
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.simulation import between_samples, march
from ema_pipeline.report.figures.frf import frf_sheet
from ema_pipeline.report.interactive.packing import LEVELS, packed_frfs

RATE = 512.0
ROWS = {"a": {"a.x": 1.0}, "b": {"b.x": 1.0}}
LINK = {"a.x": 1.0, "b.x": -1.0}
RIG = Assembly(
    ("a.x", "b.x"),
    (
        Mass("a", ROWS["a"], 1.0),
        Mass("b", ROWS["b"], 1.5),
        Spring("ground a", ROWS["a"], 3e4),
        Spring("ground b", ROWS["b"], 4e4),
        Spring("link", LINK, 2e4),
        Damper("da", ROWS["a"], 12.0),
        Damper("db", ROWS["b"], 14.0),
    ),
)


def _record(force: np.ndarray, response: np.ndarray, name: str = "r", **more: object) -> DrivenRecord:
    points = [Dof.parse("a.x"), Dof.parse("b.x")]
    return DrivenRecord(
        name=name,
        file="r.h5",
        excitation="random",
        use="fit",
        sample_rate_hz=RATE,
        forces=tuple(ForceChannel(f"f{k}", points[k], 0.02, 0.03) for k in range(len(force))),
        force=force,
        channels=tuple(ResponseChannel(f"x{k}", points[k], "displacement") for k in range(2)),
        responses=response,
        **more,  # type: ignore[arg-type]
    )


def _responded(force: np.ndarray, noise: float = 0.0, seed: int = 9) -> np.ndarray:
    rows = np.eye(2)[: len(force)]
    system = driven_system(RIG, rows)
    found = march(system, RATE, 4, between_samples(force, 8), np.zeros(system.size))
    assert found is not None
    x = found[0][:, :2].T
    return x + noise * np.std(x) * np.random.default_rng(seed).standard_normal(x.shape)


@pytest.mark.parametrize("estimator", ["H1", "Hv"])
def test_two_forces_at_once_give_the_matrix_and_a_variance_that_is_true(estimator: str) -> None:
    force = np.random.default_rng(3).standard_normal((2, 120_000))
    frfs = estimate_driven_frfs([_record(force, _responded(force, 0.02))], FrfSettings(estimator=estimator))
    on = (frfs.frequency_hz > 8) & (frfs.frequency_hz < 60)
    known = receptance(RIG.system(), frfs.frequency_hz[on], np.eye(2), np.eye(2))
    gap = np.abs(frfs.frf[:, :, on] - known)
    assert np.median(gap / np.abs(known)) < 0.04
    if estimator == "H1":
        sigma = np.sqrt(frfs.variance[:, :, on])
        assert 0.3 < np.median(gap / sigma) < 1.6  # the median of |error|/σ of a complex value is 0.83
    assert frfs.multiple_coherence is not None
    assert np.median(frfs.multiple_coherence[:, on]) > 0.95
    assert frfs.input_coherence is not None
    assert np.median(frfs.input_coherence[0, 1, on]) < 0.2


def test_multiple_coherence_is_shown_beside_the_partial_one() -> None:
    force = np.random.default_rng(3).standard_normal((2, 20_000))
    frfs = estimate_driven_frfs([_record(force, _responded(force, 0.05))])
    assert frfs.multiple_coherence is not None
    lines = (frfs.frequency_hz > 0) & (frfs.frequency_hz <= 60.0)
    packed = packed_frfs(frfs, 60.0)
    shown = np.frombuffer(zlib.decompress(base64.b64decode(packed["multiple"])), np.uint8) / 250
    rows = frfs.multiple_coherence[[o for o, _, _ in packed["pairs"]]][:, lines]
    np.testing.assert_allclose(shown.reshape(rows.shape), rows, atol=0.003)
    axes = frf_sheet(frfs, None, [(1, 0)]).axes[2]
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["partial", "multiple"]
    partial, multiple = (np.asarray(line.get_ydata()) for line in axes.get_lines()[:2])
    assert np.all(multiple >= partial - 1e-9)  # all forces explain what one does, and more
    alone = estimate_driven_frfs([_record(force[:1], _responded(force[:1], 0.05))])
    assert packed_frfs(alone, 60.0)["multiple"] is None
    assert frf_sheet(alone, None, [(1, 0)]).axes[2].get_legend() is None


def test_coherence_of_several_multisines_is_bridged_where_there_is_no_force() -> None:
    random, period = np.random.default_rng(8), 1024
    lines, records = np.arange(21, 221, 2), []
    for k in range(4):
        spectrum = np.zeros((2, period // 2 + 1), complex)
        spectrum[:, lines] = np.exp(2j * np.pi * random.uniform(size=(2, len(lines))))
        one = np.fft.irfft(spectrum, period)
        response = np.stack([one[0] + 0.5 * one[1], one[1]])
        response += 1e-3 * np.std(response) * random.standard_normal(response.shape)
        records.append(_record(np.tile(one, 4), np.tile(response, 4), f"r{k}", period=period))
    frfs = estimate_driven_frfs(records)
    assert frfs.multiple_coherence is not None
    assert frfs.multiple_coherence[:, lines[0] : lines[-1] + 1].min() > 0.99


def test_forces_that_are_one_signal_are_refused_and_correlated_ones_named() -> None:
    one = np.random.default_rng(4).standard_normal(40_000)
    force = np.stack([one, 0.5 * one])
    with pytest.raises(EmaError, match="forces 'f0' and 'f1' are the same signal"):
        estimate_driven_frfs([_record(force, _responded(force))])
    force = np.stack([one, 0.5 * one + 0.3 * np.random.default_rng(5).standard_normal(40_000)])
    frfs = estimate_driven_frfs([_record(force, _responded(force))])
    assert any(v.check == "inputs" and "f0 and f1" in v.message for v in frfs.verdicts)


def test_forces_that_repeat_together_and_too_few_blocks_are_told_as_such() -> None:
    force = np.tile(np.random.default_rng(9).standard_normal((2, 512)), 8)
    record = _record(force, _responded(force), period=512)
    with pytest.raises(EmaError, match=r"'f0' and 'f1' repeat together.*at least 2 realisations"):
        estimate_driven_frfs([record])
    with pytest.raises(EmaError, match=r"^1 period does not tell 2 forces apart"):
        estimate_driven_frfs([_record(force[:, :512], _responded(force[:, :512]), period=512)])


def test_half_overlapping_blocks_count_by_what_is_independent_in_them() -> None:
    """19 Hann blocks of a tenth of the record are worth 18: neighbours correlate by 1/6 (Welch 1967)."""
    force = np.random.default_rng(5).standard_normal((1, 10_240))
    frfs = estimate_driven_frfs([_record(force, _responded(force))], FrfSettings(block_samples=1024))
    assert frfs.hits.tolist() == [[18], [18]]
    assert frfs.record_s == 1024 / RATE


def test_several_random_forces_are_estimated_over_whole_records_unless_blocks_are_asked_for() -> None:
    force = np.random.default_rng(5).standard_normal((2, 10_240))
    record = _record(force, _responded(force))
    assert estimate_driven_frfs([record]).record_s == 10_240 / RATE
    assert estimate_driven_frfs([record], FrfSettings(block_samples=1024)).record_s == 1024 / RATE
    one = _record(force[:1], _responded(force[:1]))
    assert estimate_driven_frfs([one]).record_s < 10_240 / RATE


def test_h2_of_several_forces_is_refused() -> None:
    force = np.random.default_rng(6).standard_normal((2, 20_000))
    with pytest.raises(EmaError, match="H2 is not defined for several forces"):
        estimate_driven_frfs([_record(force, _responded(force))], FrfSettings(estimator="H2"))


def test_noise_and_distortion_of_multisines_are_told_apart() -> None:
    random, period, periods = np.random.default_rng(7), 1024, 4
    lines = np.arange(21, 220, 2)  # odd lines only
    records = []
    for k in range(6):
        spectrum = np.zeros(period // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.uniform(size=len(lines)))
        one = np.fft.irfft(spectrum, period) * period / 10
        force = np.tile(one, periods)[None]
        quadratic = np.tile(0.02 * one**2, periods)
        response = 0.1 * np.stack([force[0], force[0]]) + quadratic + 0.02 * np.tile(one**3, periods) / 10
        response = response + 1e-3 * random.standard_normal(response.shape)
        records.append(_record(force, response, f"r{k}", period=period))
    frfs = estimate_driven_frfs(records)
    assert frfs.noise_variance is not None
    assert frfs.distortion_variance is not None
    assert frfs.detected_distortion is not None
    noise = np.nanmedian(frfs.noise_variance[0, 0, lines])
    size = np.median(np.abs(np.fft.rfft(records[0].force[0, :period])[lines]) ** 2)
    assert noise == pytest.approx(1e-6 * period / periods / 6 / size, rel=0.3)
    assert np.nanmedian(frfs.distortion_variance[0, 0, lines]) > 10 * noise
    odd, even = frfs.detected_distortion[0]
    assert np.nanmedian(even) > 0
    assert np.all(np.isnan(odd[lines]))
    assert np.nanmax(np.abs(frfs.variance[0, 0, lines])) > 0


def test_lines_without_force_tell_odd_from_even_distortion_and_leave_the_frfs_whole() -> None:
    random, period, periods = np.random.default_rng(8), 1024, 4
    lines = np.arange(21, 221, 2)
    lines = lines[random.permutation(len(lines)) > 15]  # odd lines without force among the others
    records = []
    for k in range(6):
        spectrum = np.zeros(period // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.uniform(size=len(lines)))
        one = np.fft.irfft(spectrum, period)
        one /= np.std(one)
        force = np.tile(one, periods)[None] + 0.01 * random.standard_normal((1, period * periods))
        response = np.tile(np.stack([one + 0.1 * one**3, one + 0.1 * one**2]), periods)
        records.append(
            _record(force, response + 1e-3 * random.standard_normal(response.shape), f"r{k}", period=period)
        )
    frfs = estimate_driven_frfs(records)
    assert frfs.band_hz == (lines[0] * RATE / period, lines[-1] * RATE / period)
    inside = slice(lines[0], lines[-1] + 1)
    assert np.allclose(frfs.frf[1, 0, inside], 1.0, atol=0.1)  # bridged where there is no force
    assert np.all(frfs.variance[:, 0, inside] > 0)
    assert frfs.detected_distortion is not None
    odd, even = np.nanmedian(frfs.detected_distortion, axis=2).T
    assert odd[0] > 10 * even[0]
    assert even[1] > 10 * odd[1]
    levels = packed_frfs(frfs, 200.0)["levels"]
    assert levels is not None
    assert set(levels) == set(LEVELS)
    assert not any("strike" in v.message for v in frfs.verdicts)
