"""FRFs of continuous tests: several forces at once, singular forces, and distortion apart from noise."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.driven import estimate_driven_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.driven import DrivenRecord, ForceChannel
from ema_pipeline.ingest.records import ResponseChannel
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.simulation import between_samples, driven_system, march

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
    assert np.median(gap / np.abs(known)) < 0.08
    if estimator == "H1":
        sigma = np.sqrt(frfs.variance[:, :, on])
        assert 0.3 < np.median(gap / sigma) < 1.6  # the median of |error|/σ of a complex value is 0.83
    assert frfs.multiple_coherence is not None
    assert np.median(frfs.multiple_coherence[:, on]) > 0.95
    assert frfs.input_coherence is not None
    assert np.median(frfs.input_coherence[0, 1, on]) < 0.2


def test_forces_that_are_one_signal_are_refused_and_correlated_ones_named() -> None:
    one = np.random.default_rng(4).standard_normal(40_000)
    force = np.stack([one, 0.5 * one])
    with pytest.raises(EmaError, match="forces 'f0' and 'f1' are one and the same signal"):
        estimate_driven_frfs([_record(force, _responded(force))])
    force = np.stack([one, 0.5 * one + 0.3 * np.random.default_rng(5).standard_normal(40_000)])
    frfs = estimate_driven_frfs([_record(force, _responded(force))])
    assert any(v.check == "inputs" and "f0 and f1" in v.message for v in frfs.verdicts)


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
