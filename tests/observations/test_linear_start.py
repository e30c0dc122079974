"""Where fits of records begin: FRFs of known rigs lead to their values from far off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import ema_pipeline as ema
from ema_pipeline.dof import Dof
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.observations.linear_start import MeasuredFrfs, _starts, linear_start
from ema_pipeline.observations.parts import DAMPING
from ema_pipeline.observations.record_model import loosened
from ema_pipeline.observations.rig_model import RigModel

LINES = np.arange(0.0, 128.0, 0.25)
POWER = {"displacement": 0, "velocity": 1, "acceleration": 2}
CHAIN = """modal_damping_ratio = {ratio}
masses = [{{ at = "a.x", value = {a} }}, {{ at = "b.x", value = {b} }}]
springs = [{{ at = "a.x", value = {k} }}, {{ between = ["a.x", "b.x"], value = {l} }}]
"""
TRUE = {"a": 2.0, "b": 1.0, "k": 5e4, "l": 8e4, "ratio": 0.03}
FAR = {"a": 0.5, "b": 1.0, "k": 1e6, "l": 1e6, "ratio": 0.01}


def loose_model(path: Path, text: str) -> tuple[RigModel, str, list[str]]:
    path.write_text(text)
    rig = ema.load_rig(path)
    rig, shared, loose = loosened(rig, rig.configurations[0])
    return RigModel(rig, (), {}, shared), rig.configurations[0], list(loose)


def frfs_of(
    model: RigModel,
    outputs: tuple[str, ...] = ("a.x", "b.x"),
    quantities: tuple[str, ...] = ("acceleration", "velocity"),
    band_hz: tuple[float, float] = (5.0, 100.0),
) -> FrfSet:
    """Of the model as it is stated, driven at the first body."""
    system = model.rig.system(model.rig.configurations[0])
    rows = np.array([[float(d == o) for d in system.dofs] for o in outputs])
    drive = np.array([[float(d == "a.x") for d in system.dofs]])
    with np.errstate(divide="ignore", invalid="ignore"):
        h = np.nan_to_num(receptance(system, np.maximum(LINES, 1e-3), rows, drive))
    h = h * np.stack([(2j * np.pi * LINES) ** POWER[q] for q in quantities])[:, None]
    none = np.full(h.shape, np.nan)
    return FrfSet(
        LINES, h, none, none, tuple(map(Dof.parse, outputs)), (Dof("a", "x"),), quantities,
        np.ones(h.shape[:2], np.int64), "H1", 1.0, 0.0, np.zeros(1), band_hz, True, np.zeros(len(outputs)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def true(tmp_path_factory: pytest.TempPathFactory) -> tuple[RigModel, str, list[str]]:
    return loose_model(tmp_path_factory.mktemp("true") / "rig.toml", CHAIN.format(**TRUE))


def test_values_far_off_are_led_to_those_of_the_frfs(
    true: tuple[RigModel, str, list[str]], tmp_path: Path
) -> None:
    model, configuration, loose = loose_model(tmp_path / "rig.toml", CHAIN.format(**FAR))
    assert len(loose) == 4
    found = linear_start(model, configuration, loose, DAMPING, frfs_of(true[0]))
    assert list(found) == [*loose, DAMPING]
    expected = [np.log(TRUE[n] / FAR[n]) for n in ("a", "b", "k", "l", "ratio")]
    np.testing.assert_allclose(list(found.values()), expected, atol=2e-3)


def test_searches_begin_at_the_rigs_own_frequencies_and_with_each_mode_at_the_peak(
    true: tuple[RigModel, str, list[str]], tmp_path: Path
) -> None:
    """All values scaled alike so that FRFs agree on average, springs so that a mode is there; 2 % of damping."""
    model, configuration, loose = loose_model(tmp_path / "rig.toml", CHAIN.format(**FAR))
    given = frfs_of(true[0])
    measured = MeasuredFrfs.of(given)
    names = [*loose, DAMPING]
    at = [model.unknowns.index[n] for n in names]

    def system(values: np.ndarray) -> LinearSystem:
        x = np.zeros(len(model.unknowns))
        x[at] = values
        return model.system(configuration, x)

    def residual(values: np.ndarray) -> np.ndarray:
        return measured.difference(system(values), given)

    found = list(_starts(model, configuration, names, DAMPING, measured, residual))
    assert len(found) == 3
    own = np.sqrt(scipy.linalg.eigvalsh(*(getattr(system(np.zeros(5)), m) for m in ("stiffness", "mass"))))
    for k, start in enumerate(found):
        there = system(start)
        assert there.modal_damping_ratio == pytest.approx(0.02)
        factor = 1.0 if k == 0 else measured.peak / own[k - 1]
        np.testing.assert_allclose(np.sqrt(scipy.linalg.eigvalsh(there.stiffness, there.mass)), factor * own)
        assert np.median(residual(start)[: measured.log.size]) == pytest.approx(0.0, abs=1e-9)


def test_a_damper_is_found_where_no_ratio_is(tmp_path: Path) -> None:
    text = """modal_damping_ratio = 0.0
masses = [{ at = "a.x", value = 2.0 }]
springs = [{ at = "a.x", value = %g }]
dampers = [{ at = "a.x", value = %g }]
"""
    measured = frfs_of(
        loose_model(tmp_path / "true.toml", text % (5e4, 20.0))[0], ("a.x",), ("displacement",)
    )
    model, configuration, loose = loose_model(tmp_path / "rig.toml", text % (5e5, 2.0))
    found = linear_start(model, configuration, loose, "", measured)
    by_kind = {n.rpartition("(")[2]: v for n, v in found.items()}
    assert by_kind["mass)"] == pytest.approx(0.0, abs=1e-3)
    assert by_kind["spring)"] == pytest.approx(-np.log(10.0), abs=1e-3)
    assert by_kind["damper)"] == pytest.approx(np.log(10.0), abs=1e-2)


def test_without_loose_values_or_frfs_nothing_is_searched(true: tuple[RigModel, str, list[str]]) -> None:
    model, configuration, loose = true
    measured = frfs_of(model)
    assert linear_start(model, configuration, [], "", measured) == {}
    assert (
        linear_start(model, configuration, loose, "", replace(measured, hits=np.zeros((2, 1), np.int64)))
        == {}
    )


def test_differences_are_logarithms_and_phases_by_their_uncertainty(
    true: tuple[RigModel, str, list[str]],
) -> None:
    """Nothing at the truth; a factor and a phase of one FRF are told as such, whatever it measures."""
    model, configuration, _ = true
    given = frfs_of(model, band_hz=(20.0, 40.0))
    system = model.rig.system(configuration)
    measured = MeasuredFrfs.of(given)
    assert measured.pairs == ((0, 0), (1, 0))
    np.testing.assert_allclose(measured.difference(system, given), 0.0, atol=1e-8)
    turned = given.frf.copy()
    turned[1] *= 1.2 * np.exp(0.3j)
    turned[0, 0, 100] = 0.0  # a line without a value tells nothing
    variance = np.full(given.frf.shape, np.nan)
    variance[1] = (0.1 * np.abs(turned[1])) ** 2
    other = MeasuredFrfs.of(replace(given, frf=turned, variance=variance))
    gap = other.difference(system, given).reshape(2, 2, -1)
    weight = 1 / np.hypot(0.05, 0.1)
    np.testing.assert_allclose(gap[0, 1], -np.log(1.2) * weight)
    np.testing.assert_allclose(gap[1, 1], -0.3 * weight)
    np.testing.assert_allclose(gap[:, 0], 0.0, atol=1e-8)
    hertz = other.omega / (2 * np.pi)
    on = np.isclose(hertz, LINES[100])
    assert np.sum(on) == 1
    np.testing.assert_allclose(other.weight[0], np.where(on, 0.0, 1 / 0.05))


def test_lines_are_few_within_the_band_and_never_nought(true: tuple[RigModel, str, list[str]]) -> None:
    measured = MeasuredFrfs.of(frfs_of(true[0])).omega / (2 * np.pi)
    assert (measured[0], measured[-1], len(measured)) == (5.0, 99.75, 120)
    assert np.ptp(np.diff(measured)) < 0.26
    assert len(MeasuredFrfs.of(frfs_of(true[0], band_hz=(5.0, 10.0))).omega) == 20
    np.testing.assert_allclose(
        MeasuredFrfs.of(frfs_of(true[0], band_hz=(0.0, 0.1))).omega / (2 * np.pi), [0.25]
    )


def test_the_peak_is_that_of_the_velocity_of_all_outputs(true: tuple[RigModel, str, list[str]]) -> None:
    omega = np.array([10.0, 20.0, 40.0])
    log = np.log(np.array([[3.0, 1.0, 0.6], [0.0001, 1.3, 0.6]]))
    weight = np.ones((2, 3))
    # Of velocity: 30² + 0, 20² + 26², 24² + 24²
    assert MeasuredFrfs(omega, log.astype(complex), weight, ((0, 0), (1, 0))).peak == 40.0
    weight[1, 2] = 0.0
    assert MeasuredFrfs(omega, log.astype(complex), weight, ((0, 0), (1, 0))).peak == 20.0
