"""Tables of modes as input, and two real frames fitted from their tables."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ema_pipeline.correlate.measured import MeasuredModes, to_modal_model
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.exchange.mode_table import read_mode_table
from ema_pipeline.exchange.tables import write_table
from ema_pipeline.fit.parameters import fit_modes, fit_result
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import FitResult
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.report import summary
from ema_pipeline.report.results import RunResults
from ema_pipeline.rigs import Rig, load_rig, model_modes

TABLE = """\
schema = 1
title = "bench frame"

[default]
frequency_hz = [30.0, 10.0]
frequency_std_hz = 0.02
damping_ratio = [0.011, 0.004]
damping_std = [0.001, 0.002]
dofs = ["storey1.x", "-storey2.x"]
shape = [[1.0, 0.4],
         [0.5, 1.0]]
shape_std = 0.02
band_hz = [1.0, 50.0]
references = ["storey2.x"]
"""


def table(folder: Path, text: str, name: str = "modes.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_dof_at_a_node_is_zero_in_all_shapes_but_no_shape_may_be_zero(tmp_path: Path) -> None:
    text = TABLE.replace('["storey1.x", "-storey2.x"]', '["storey1.x", "storey2.x", "storey3.x"]')
    node = text.replace("[0.5, 1.0]]", "[0.5, 1.0], [0.0, 0.0]]")
    rig = load_rig("frame")
    modes = read_mode_table(table(tmp_path, node), rig)["default"]
    assert modes.shapes is not None
    np.testing.assert_array_equal(modes.shapes[:, 2], 0)
    empty = text.replace("[1.0, 0.4]", "[1.0, 0.0]").replace("[0.5, 1.0]]", "[0.5, 0.0], [0.2, 0.0]]")
    with pytest.raises(EmaError, match="shape of a mode is all zero"):
        read_mode_table(table(tmp_path, empty), rig)


def test_the_band_of_a_table_is_kept_and_unknown_where_it_has_none(tmp_path: Path) -> None:
    rig = load_rig("frame")
    assert to_modal_model(read_mode_table(table(tmp_path, TABLE), rig)["default"]).band_hz == (1.0, 50.0)
    without = TABLE.replace("band_hz = [1.0, 50.0]\n", "")
    assert np.isnan(to_modal_model(read_mode_table(table(tmp_path, without), rig)["default"]).band_hz).all()


def test_toml_table_is_read_in_ascending_order_with_signs_applied(tmp_path: Path) -> None:
    modes = read_mode_table(table(tmp_path, TABLE), load_rig("frame"))["default"]
    np.testing.assert_array_equal(modes.frequency_hz, [10.0, 30.0])
    np.testing.assert_array_equal(modes.frequency_std_hz, [0.02, 0.02])
    np.testing.assert_array_equal(modes.damping_ratio, [0.004, 0.011])
    np.testing.assert_array_equal(modes.damping_std, [0.002, 0.001])
    assert modes.dofs == (Dof("storey1", "x"), Dof("storey2", "x"))
    assert modes.shapes is not None
    np.testing.assert_array_equal(modes.shapes, [[0.4, -1.0], [1.0, -0.5]])
    np.testing.assert_allclose(modes.shape_std, 0.02)  # type: ignore[arg-type]
    assert modes.band_hz == (1.0, 50.0)
    assert modes.references == (Dof("storey2", "x"),)
    assert not modes.scaled


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("damping_ratio", "damping_ration", r"\[default\].*did you mean 'damping_ratio'"),
        ("[0.011, 0.004]", "[0.011]", r"damping_ratio has 1 numbers for 2 frequencies"),
        ("[30.0, 10.0]", "[30.0, -10.0]", r"frequency_hz = -10.*above 0 Hz"),
        ("0.004]", "-0.004]", r"damping_ratio = -0\.004 is negative"),
        ("0.004]", "1.2]", r"damping_ratio = 1\.2: .* 1 % is written 0\.01"),
        ("0.004]", "1.0]", r"damping_ratio = 1: .* 1 % is written 0\.01"),
        ("frequency_std_hz = 0.02", "frequency_std_hz = -1", r"frequency_std_hz = -1: .* above 0"),
        ("[0.001, 0.002]", "[0.001, 0.0]", r"damping_std = 0: .* leave out what is unknown"),
        ("[1.0, 50.0]", "[50.0, 1.0]", r"band_hz = \[50, 1\]: give the lower limit first"),
        ("[[1.0, 0.4],", "[[1.0],", r"shape has 2 rows of 1, 2 numbers.*one row for each of 2 dofs"),
        ("storey1.x", "storey9.x", r"no dof 'storey9\.x'"),
        ("storey1.x", "storey2.x", r"a place is named twice"),
        ("[default]", "[defautl]", r"did you mean 'default'"),
        ("[default]", "", r"key 'frequency_hz' is not in a table"),
        ("schema = 1", "schema = 7", r"schema = 7 is unknown"),
        ("[30.0,", "[30.0", r"not valid TOML"),
        ("[[1.0, 0.4],", "[[0.0, 0.4],", None),
        ("[0.5, 1.0]]", "[0.0, 1.0]]", None),
    ],
)
def test_mistakes_in_a_table_are_one_clear_line(
    tmp_path: Path, old: str, new: str, message: str | None
) -> None:
    path = table(tmp_path, TABLE.replace(old, new, 1))
    if message is None:
        assert len(read_mode_table(path, load_rig("frame"))["default"]) == 2
        return
    with pytest.raises(EmaError, match=message) as caught:
        read_mode_table(path, load_rig("frame"))
    assert "\n" not in str(caught.value)


def test_a_standard_deviation_is_no_finer_than_the_rounding_of_the_numbers(tmp_path: Path) -> None:
    exact = np.random.default_rng(0).uniform(10.0, 400.0, 20_000)
    rounding = float(np.std(np.round(exact, 1) - exact))
    text = (
        "[default]\nfrequency_hz = [12.1, 34.5, 56.7, 80.0]\nfrequency_std_hz = [0.001, 0.001, 0.001, 0.2]\n"
    )
    modes = read_mode_table(table(tmp_path, text))["default"]
    np.testing.assert_allclose(modes.frequency_std_hz, [*[rounding] * 3, 0.2], rtol=0.02)
    (note,) = modes.notes
    assert "0.029 Hz is taken" in note


def test_csv_table_holds_several_configurations_and_complex_shapes(tmp_path: Path) -> None:
    text = (
        "configuration,frequency_hz,damping_ratio,sun.x re,sun.x im,carrier.u\n"
        "no_ring,85.7,0.01,1.0,0.1,0.2\nno_ring,62.5,0.02,0.3,0,1\nwith_ring,47.5,0.03,0.5,0.0,-1\n"
    )
    found = read_mode_table(table(tmp_path, text, "modes.csv"), load_rig("planetary"))
    assert set(found) == {"no_ring", "with_ring"}
    np.testing.assert_array_equal(found["no_ring"].frequency_hz, [62.5, 85.7])
    assert np.all(np.isnan(found["no_ring"].frequency_std_hz))
    assert found["no_ring"].shapes is not None
    np.testing.assert_array_equal(found["no_ring"].shapes, [[0.3, 1.0], [1.0 + 0.1j, 0.2]])


def test_semicolons_and_a_missing_configuration_are_understood(tmp_path: Path) -> None:
    path = table(tmp_path, "frequency_hz; damping_ratio\n10; 0.01\n20; 0.02\n", "modes.csv")
    (modes,) = read_mode_table(path, load_rig("gearbox")).values()
    assert modes.configuration == "default"
    assert modes.shapes is None


def test_rows_without_a_configuration_are_of_the_rigs_only_one(tmp_path: Path) -> None:
    path = table(tmp_path, "frequency_hz\n10\n20\n", "modes.csv")
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'configurations = ["bench"]\n[[masses]]\nat = "a.x"\nvalue = 1.0\n[[springs]]\nat = "a.x"\nvalue = 1e4\n'
    )
    assert list(read_mode_table(path, load_rig(rig))) == ["bench"]
    assert list(read_mode_table(path)) == ["default"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("freq_hz\n10\n", r"no column 'frequency_hz'.*did you mean 'freq_hz'"),
        ("frequency_hz,dampin_ratio\n10,1\n", r"'dampin_ratio'.*did you mean 'damping_ratio'"),
        ("frequency_hz,frequency_hz\n33,63\n", r"line 1: column 'frequency_hz' is there twice; keep one"),
        ("frequency_hz,sun.x,sun.x re\n33,1,2\n", r"line 1: column 'sun.x' is there twice; keep one"),
        ("frequency_hz,damping_ratio\n10,high\n", r"line 2: damping_ratio = 'high' is no number"),
        ('frequency_hz,damping_ratio\n"39,33",0.01\n', r"'39,33' is no number; write decimals with a point"),
        ("frequency_hz,damping_ratio\n10,0.1\n11,\n", r"line 3: damping_ratio is missing"),
        ("frequency_hz\n", r"holds no modes"),
    ],
)
def test_mistakes_in_a_csv_table_are_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(EmaError, match=message):
        read_mode_table(table(tmp_path, text, "modes.csv"))


def test_modes_of_a_table_have_the_poles_of_their_frequencies_and_dampings(tmp_path: Path) -> None:
    modes = to_modal_model(read_mode_table(table(tmp_path, TABLE), load_rig("frame"))["default"]).modes
    poles = np.array([m.pole for m in modes])
    np.testing.assert_allclose(np.abs(poles) / (2 * np.pi), [10.0, 30.0], rtol=1e-12)
    np.testing.assert_allclose(-poles.real / np.abs(poles), [0.004, 0.011], rtol=1e-12)
    assert np.all(poles.imag > 0)


def test_a_table_that_the_program_wrote_is_read_back(tmp_path: Path) -> None:
    rows = [
        {"configuration": "default", "index": 0, "frequency_hz": 12.5, "frequency_std_hz": 0.01,
         "damping_ratio": 0.02, "damping_std": 1e-3, "mpc": 1.0, "method": "plscf", "flags": ""}
    ]  # fmt: skip
    write_table(tmp_path / "modes.csv", rows)
    modes = read_mode_table(tmp_path / "modes.csv")["default"]
    assert modes.frequency_hz[0] == 12.5
    assert modes.damping_std[0] == 1e-3


def frame_rig(folder: Path, masses: list[float], stiffnesses: list[float], tolerance: float) -> Rig:
    lines = ['base = "frame"', "[geometry]", f"storeys = {len(masses)}", "[parameters]"]
    for n, (m, k) in enumerate(zip(masses, stiffnesses, strict=True), 1):
        lines.append(f'storey{n}_mass = {{ value = {m}, unit = "kg", tolerance = 0.01 }}')
        lines.append(f'storey{n}_stiffness = {{ value = {k}, unit = "N/m", tolerance = {tolerance} }}')
    return load_rig(table(folder, "\n".join(lines), "rig.toml"))


def frame_modes(folder: Path, data: dict[str, Any], storeys: list[int], rig: Rig) -> dict[str, MeasuredModes]:
    dofs = ", ".join(f'"storey{n}.x"' for n in storeys)
    lines = ["[default]", f"frequency_hz = {data['frequency_hz']}", f"dofs = [{dofs}]"]
    lines += [f"{key} = {data[key]}" for key in ("shape", "damping_ratio") if key in data]
    return read_mode_table(table(folder, "\n".join(lines)), rig)


def fit_rig(rig: Rig, measured: dict[str, MeasuredModes]) -> FitResult:
    observations = ModeObservations(rig, [prepare(m) for m in measured.values()])
    return fit_result(fit_modes(observations, Model()), rig, measured, FitSettings(sweep_points=50))


def results(fit: FitResult) -> RunResults:
    return RunResults(title="frame", rig="frame", fit=fit)


def errors(rig: Rig, measured: MeasuredModes, values: dict[str, float] | None = None) -> np.ndarray:
    model = [m.frequency_hz for m in model_modes(rig, "default", values)]
    return np.array(model[: len(measured)]) / measured.frequency_hz - 1


def test_four_storey_frame_is_mended_by_fitting_its_stiffnesses(test_data: Path, tmp_path: Path) -> None:
    data = tomllib.loads((test_data / "realdata" / "frames_modal.toml").read_text())["four_storey"]
    rig = frame_rig(tmp_path, data["storey_mass_kg"], data["storey_stiffness_n_per_m"], 0.3)
    measured = frame_modes(tmp_path, data, [1, 2, 3, 4], rig)
    nominal = errors(rig, measured["default"])
    assert np.max(np.abs(nominal)) == pytest.approx(0.12, abs=0.002)
    fit = fit_rig(rig, measured)
    assert np.max(np.abs(errors(rig, measured["default"], fit.values()))) < 0.1 * np.max(np.abs(nominal))
    assert all(p.identified for n, p in fit.parameters.items() if n.endswith("_stiffness"))
    (told,) = (line for line in summary.findings(results(fit)) if "the data narrow" in line)
    assert "storey4 stiffness" in told
    assert fit.parameters["storey4_stiffness"].value == pytest.approx(2560, rel=0.1)


def test_eighteen_stiffnesses_are_not_identified_by_three_modes(test_data: Path, tmp_path: Path) -> None:
    data = tomllib.loads((test_data / "realdata" / "frames_modal.toml").read_text())["eighteen_storey"]
    masses = [1e3 * w / 9.80665 for w in data["storey_weight_kn"]]
    rig = frame_rig(tmp_path, masses, [1e3 * k for k in data["storey_stiffness_kn_per_m"]], 0.2)
    measured = frame_modes(tmp_path, data, data["measured_storeys"], rig)
    assert np.max(np.abs(errors(rig, measured["default"]))) == pytest.approx(0.16, abs=0.002)
    fit = fit_rig(rig, measured)
    stiffnesses = {n: p for n, p in fit.parameters.items() if n.endswith("_stiffness")}
    assert len(stiffnesses) == 18
    left = [p for p in stiffnesses.values() if not p.identified]
    assert len(left) >= 15
    assert all("tolerance determines it" in p.note for p in left)
    assert "are not identified individually" in " ".join(summary.findings(results(fit)))
