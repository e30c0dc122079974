"""Thresholds from a test's own fitted null."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from test_diagnose import FEW, RIG, SETTINGS, measure

from ema_pipeline.diagnose import bootstrap
from ema_pipeline.diagnose.bootstrap import FittedNull, fitted_null, null_gains, own_thresholds, simulate_null
from ema_pipeline.effects.library import shipped_effects

TWO = SETTINGS.model_copy(update={"bootstrap": 2})
TORSION_ONLY = {"shaft_torsion": shipped_effects()["shaft_torsion"]}


@cache
def null() -> FittedNull:
    return fitted_null(RIG, measure({}, seed=2), TWO, TORSION_ONLY)


def test_simulated_modes_scatter_about_the_fitted_model_as_much_as_the_measured_ones() -> None:
    given = null().case.measured["no_ring"]
    drawn = [simulate_null(null(), np.random.default_rng(k))[1]["no_ring"] for k in range(60)]
    f = np.array([m.frequency_hz for m in drawn])
    relative = f.std(axis=0) / given.frequency_hz
    # the test's own scatter, 0.03 %, and the noise level on top of it
    expected = np.hypot(3e-4, null().fit.frequency_floor)
    assert np.sqrt(np.mean(relative**2)) == pytest.approx(expected, rel=0.15)
    assert np.abs(f.mean(axis=0) / given.frequency_hz - 1).max() < 2e-3
    sizes = [np.abs(m.shapes).max(axis=1) for m in drawn if m.shapes is not None]
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.05)


def test_nominal_values_are_drawn_from_the_tolerances() -> None:
    rigs = [simulate_null(null(), np.random.default_rng(k))[0] for k in range(60)]
    masses = np.array([r.parameters["sun_mass"].value for r in rigs])
    assert masses.std() == pytest.approx(0.01 * 2.0, rel=0.3)
    assert masses.mean() == pytest.approx(null().base.values["sun_mass"], rel=0.01)
    assert rigs[0].parameters["sun_planet_mesh_stiffness"].free


def test_gains_of_a_null_are_small_and_each_sample_has_its_own_random_numbers() -> None:
    first, second = null_gains(null(), 0, 2, lambda share, text: None)
    assert set(first) == {"shaft_torsion", "out_of_tolerance"}
    # χ² with one degree of freedom, largest of two places: 99.9 % lie below 12.1
    assert 0 <= first["shaft_torsion"] < 12.1
    assert first != second
    (again,) = null_gains(null(), 1, 2, lambda share, text: None)
    assert again == second


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []

    def gains(found: FittedNull, first: int, count: int, tell: object) -> Iterator[dict[str, float]]:
        asked.append((first, count))
        yield from ({"sensor_mass": float(k)} for k in range(first, count))

    monkeypatch.setattr(bootstrap, "null_gains", gains)
    monkeypatch.setattr(bootstrap, "fitted_null", lambda *given: None)
    memory, measured = tmp_path / "bootstrap.jsonl", measure({}, seed=2)
    ten = SETTINGS.model_copy(update={"bootstrap": 10})

    def run(version: str = "1", settings: object = ten) -> dict[str, float]:
        return own_thresholds(RIG, measured, settings, FEW, memory, version, lambda share, text: None)  # type: ignore[arg-type]

    whole = run()
    lines = memory.read_text().splitlines()
    memory.write_text("\n".join([*lines[:5], lines[5][:8]]))  # killed while it wrote the fifth sample
    assert run() == whole
    assert asked == [(0, 10), (4, 10)]
    assert [json.loads(line) for line in memory.read_text().splitlines()[1:]] == [
        {"sensor_mass": float(k)} for k in range(10)
    ]
    run()
    assert len(asked) == 2
    run("another version")
    assert asked[-1] == (0, 10)
