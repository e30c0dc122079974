"""Universal files are read back by pyuff and by a strict reader of our own; CSV and SEP-005 round trips."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyuff

from ema_pipeline.correlate.types import Pair, Pairing
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.exchange import (
    Geometry,
    from_sep005,
    modes_table,
    node_table,
    shapes_table,
    to_sep005,
    write_frf_csv,
    write_table,
    write_uff,
)
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import Record, ResponseChannel, cut_hit
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart

N_LINES = 33
DOFS = tuple(Dof.parse(d) for d in ("sun.x", "sun.y", "planet1.zeta", "planet1.u", "carrier.rz"))


def frf_set() -> FrfSet:
    rng = np.random.default_rng(11)
    shape = (len(DOFS), 2, N_LINES)
    scale = 10.0 ** rng.integers(-9, 9, (len(DOFS), 2, 1))
    frf = scale * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    hits = np.full(shape[:2], 3)
    frf[4, 1], hits[4, 1] = np.nan, 0
    coherence = rng.uniform(0.5, 1.0, shape)
    coherence[3, 0] = np.nan
    return FrfSet(
        frequency_hz=np.arange(N_LINES) / 3.7,
        frf=frf,
        coherence=coherence,
        variance=np.full(shape, np.nan),
        outputs=DOFS,
        inputs=DOFS[:2],
        quantities=("acceleration", "acceleration", "velocity", "displacement", "acceleration"),
        hits=hits,
        estimator="H1",
        record_s=3.7,
        response_decay_rad_s=1.25,
        delay_s=np.zeros(2),
        band_hz=(0.5, 8.0),
        force_calibrated=True,
        sensor_mass_kg=np.zeros(len(DOFS)),
    )


def modal_model(scaled: bool = True) -> ModalModel:
    rng = np.random.default_rng(12)
    modes = []
    for f, zeta in ((45.712345, 0.0098), (515.0, 0.0123)):
        w = 2 * np.pi * f
        shape = rng.standard_normal(len(DOFS)) + 0.1j * rng.standard_normal(len(DOFS))
        shape[1] = np.nan
        pole = complex(-zeta * w, w * np.sqrt(1 - zeta**2))
        modes.append(
            Mode(f, 0.02, zeta, 4e-4, pole, shape, np.zeros(len(DOFS)), 0.97, "plscf", 0.8, ("a, b", "c"))
        )
    none = np.empty(0)
    return ModalModel(
        dofs=DOFS,
        modes=tuple(modes),
        band_hz=(1, 1000),
        scaled=scaled,
        scaling_note="" if scaled else "no driving point",
        references=DOFS[:1],
        frequency_hz=none,
        synthesis=np.empty((0, 0, 0), complex),
        outputs=DOFS,
        inputs=DOFS[:2],
        chart=StabilisationChart(none.astype(int), none, none, none.astype(bool), none.astype(int)),
    )


GEOMETRY = Geometry(
    {"sun": (0.0, 0.0, 0.0), "planet1": (0.123456, 0.0, -0.5), "carrier": (0.0, 0.0, 0.04)},
    (("sun", "planet1", "carrier"),),
)


def strict_datasets(path: Path) -> list[tuple[int, list[str]]]:
    """Datasets of a universal file by the letter of the specification: every line within 80 columns."""
    lines = path.read_bytes().decode("ascii").split("\n")
    assert lines.pop() == ""
    found: list[tuple[int, list[str]]] = []
    k = 0
    while k < len(lines):
        assert lines[k] == "    -1"
        end = lines.index("    -1", k + 1)
        assert all(len(line) <= 80 for line in lines[k:end])
        found.append((int(lines[k + 1][:6]), lines[k + 2 : end]))
        k = end + 1
    return found


def columns(line: str, *widths: int) -> list[str]:
    edges = np.concatenate([[0], np.cumsum(widths)])
    return [line[a:b] for a, b in pairwise(edges.tolist())]


def numbers(lines: list[str], width: int) -> np.ndarray:
    return np.array([float(line[k : k + width]) for line in lines for k in range(0, len(line), width)])


def strict_58(body: list[str]) -> dict[str, Any]:
    assert all(line.strip() for line in body[:5])  # ID lines may not be blank
    dof = columns(body[5], 5, 10, 5, 10, 1, 10, 10, 4, 1, 10, 10, 4)
    form = columns(body[6], 10, 10, 10, 13, 13, 13)
    axes = [columns(line, 10, 5, 5, 5, 1, 20, 1, 20) for line in body[7:11]]
    values = numbers(body[11:], 20)
    if int(form[0]) == 6:
        values = values[0::2] + 1j * values[1::2]
    assert values.size == int(form[1])
    assert int(form[2]) == 1
    return {
        "type": int(dof[0]),
        "response": (int(dof[6]), int(dof[7])),
        "reference": (int(dof[10]), int(dof[11])),
        "names": (dof[5].strip(), dof[9].strip()),
        "start": float(form[3]),
        "step": float(form[4]),
        "kinds": [int(a[0]) for a in axes],
        "units": [a[7].strip() for a in axes],
        "values": values,
    }


def strict_55(body: list[str]) -> dict[str, Any]:
    assert all(line.strip() for line in body[:5])
    head = [int(t) for t in columns(body[5], *[10] * 6)]
    count = [int(t) for t in columns(body[6], 10, 10)]
    reals = numbers(body[7:8], 13)
    assert reals.size == count[1]
    case, mode = (int(t) for t in columns(body[6], *[10] * 4)[2:])
    nodes = {int(body[k]): numbers(body[k + 1 : k + 2], 13) for k in range(8, len(body), 2)}
    return {"head": head, "reals": reals, "case": case, "mode": mode, "nodes": nodes}


def test_frfs_come_back_through_pyuff_and_a_strict_reader_to_1e_6(tmp_path: Path) -> None:
    frfs = frf_set()
    path = tmp_path / "out.uff"
    table = write_uff(path, frfs, None)
    strict = [strict_58(body) for number, body in strict_datasets(path) if number == 58]
    peer = [d for d in pyuff.UFF(str(path)).read_sets() if d["type"] == 58]
    expected = [(o, i, kind) for o in range(5) for i in range(2) for kind in (4, 6)]
    expected = [e for e in expected if e[:2] != (4, 1) and e != (3, 0, 6)]
    assert len(strict) == len(peer) == len(expected)
    kinds = {"acceleration": 12, "velocity": 11, "displacement": 8}
    for (o, i, kind), ours, theirs in zip(expected, strict, peer, strict=True):
        values = frfs.frf[o, i] if kind == 4 else frfs.coherence[o, i]
        assert ours["type"] == theirs["func_type"] == kind
        np.testing.assert_allclose(ours["values"], values, rtol=1e-11)
        np.testing.assert_allclose(theirs["data"], values, rtol=1e-11)
        grid = ours["start"] + ours["step"] * np.arange(N_LINES)
        np.testing.assert_allclose(grid, frfs.frequency_hz, rtol=1e-6)
        np.testing.assert_allclose(theirs["x"], frfs.frequency_hz, rtol=1e-6)
        assert ours["response"] == (theirs["rsp_node"], theirs["rsp_dir"]) == table.dofs[DOFS[o].point]
        assert ours["reference"] == (theirs["ref_node"], theirs["ref_dir"]) == table.dofs[DOFS[i].point]
        assert ours["names"] == (DOFS[o].body, DOFS[i].body)
        assert ours["kinds"][0] == theirs["abscissa_spec_data_type"] == 18
        if kind == 4:
            assert ours["kinds"][1] == theirs["ordinate_spec_data_type"] == kinds[frfs.quantities[o]]
            assert ours["kinds"][2] == theirs["orddenom_spec_data_type"] == 13
            assert ours["units"][2] == "N"
        assert DOFS[o].point in theirs["id2"]


def test_shapes_come_back_as_dataset_55_real_and_complex_to_1e_6(tmp_path: Path) -> None:
    modal = modal_model()
    path = tmp_path / "out.uff"
    table = write_uff(path, None, modal)
    strict = [strict_55(body) for number, body in strict_datasets(path) if number == 55]
    peer = [d for d in pyuff.UFF(str(path)).read_sets() if d["type"] == 55]
    assert [s["case"] for s in strict] == [1, 2, 1, 2]
    assert [s["mode"] for s in strict] == [p["mode_n"] for p in peer] == [1, 1, 2, 2]
    for k, mode in enumerate(modal.modes):
        normal, complex_ = strict[2 * k], strict[2 * k + 1]
        assert normal["head"] == [1, 2, 2, 8, 2, 3]
        assert complex_["head"] == [1, 3, 2, 8, 5, 3]
        expected = [mode.frequency_hz, 1.0, mode.damping_ratio, 0.0]
        np.testing.assert_allclose(normal["reals"], expected, rtol=1e-6)
        assert peer[2 * k]["freq"] == pytest.approx(mode.frequency_hz, rel=1e-6)
        assert peer[2 * k]["modal_damp_vis"] == pytest.approx(mode.damping_ratio, rel=1e-6)
        assert complex(*complex_["reals"][:2]) == pytest.approx(mode.pole, rel=1e-6)
        assert peer[2 * k + 1]["eig"] == pytest.approx(mode.pole, rel=1e-6)
        # the residue of the receptance is φφᵀ over modal A
        assert peer[2 * k + 1]["modal_a"] == pytest.approx(2j * mode.pole.imag, rel=1e-6)
        for dof, value in zip(DOFS, mode.shape, strict=True):
            node, direction = table.dofs[dof.point]
            if not np.isfinite(value) or direction > 3:
                continue
            pair = complex_["nodes"][node][2 * direction - 2 : 2 * direction]
            assert complex(*pair) == pytest.approx(value, rel=2e-6)
            theirs = peer[2 * k + 1]
            at = list(theirs["node_nums"]).index(node)
            assert theirs[f"r{direction}"][at] == pytest.approx(value, rel=2e-6)


def test_the_reader_of_sdynpy_gives_the_same_frfs_shapes_and_lines(tmp_path: Path) -> None:
    """A second reader that shares no code with pyuff; it holds every field against the specification."""
    peer = pytest.importorskip("sdynpy.fileio.sdynpy_uff", reason="SDynPy is not installed")
    frfs, modal = frf_set(), modal_model()
    path = tmp_path / "out.uff"
    table = write_uff(path, frfs, modal, GEOMETRY)
    found = peer.readuff(str(path))
    expected = [(o, i, kind) for o in range(5) for i in range(2) for kind in (4, 6)]
    expected = [e for e in expected if e[:2] != (4, 1) and e != (3, 0, 6)]
    for (o, i, kind), function in zip(expected, found[58], strict=True):
        values = frfs.frf[o, i] if kind == 4 else frfs.coherence[o, i]
        assert function.function_type == kind
        np.testing.assert_allclose(function.ordinate, values, rtol=1e-11)
        np.testing.assert_allclose(function.abscissa, frfs.frequency_hz, rtol=1e-6)
        response = (function.response_node, function.response_direction)
        reference = (function.reference_node, function.reference_direction)
        assert (response, reference) == (table.dofs[DOFS[o].point], table.dofs[DOFS[i].point])
    for k, mode in enumerate(modal.modes):
        complex_ = found[55][2 * k + 1]
        assert complex(*complex_.real_data[:2]) == pytest.approx(mode.pole, rel=1e-6)
        for dof, value in zip(DOFS, mode.shape, strict=True):
            node, direction = table.dofs[dof.point]
            if np.isfinite(value) and direction <= 3:
                assert complex_.node_data_dictionary[node][direction - 1] == pytest.approx(value, rel=1e-6)
    assert len(found[82]) == 1


def test_shapes_along_z_come_back_and_coherences_have_no_physical_type(tmp_path: Path) -> None:
    dofs = tuple(Dof.parse(d) for d in ("sun.x", "sun.y", "sun.z", "planet1.z"))
    modal = modal_model()
    modes = tuple(
        replace(m, shape=np.array([1.0, -2.0, 3.0, 0.5], complex), shape_std=np.zeros(4)) for m in modal.modes
    )
    path = tmp_path / "out.uff"
    table = write_uff(path, frf_set(), replace(modal, dofs=dofs, outputs=dofs, modes=modes))
    found = strict_datasets(path)
    normal = strict_55(next(body for number, body in found if number == 55))
    nodes = {d: table.dofs[d.point] for d in dofs}
    assert {d.direction: n[1] for d, n in nodes.items()} == {"x": 1, "y": 2, "z": 3}
    np.testing.assert_allclose(normal["nodes"][nodes[dofs[0]][0]], [1.0, -2.0, 3.0])
    np.testing.assert_allclose(normal["nodes"][nodes[dofs[3]][0]], [0.0, 0.0, 0.5])
    coherence = next(f for f in (strict_58(b) for n, b in found if n == 58) if f["type"] == 6)
    assert coherence["kinds"] == [18, 0, 0, 0]  # frequency; the others unknown


def test_unscaled_shapes_have_no_modal_mass(tmp_path: Path) -> None:
    path = tmp_path / "out.uff"
    write_uff(path, None, modal_model(scaled=False))
    body = next(b for n, b in strict_datasets(path) if n == 55)
    assert strict_55(body)["reals"][1] == 0.0
    assert "unscaled: no driving point" in body[1]


def test_geometry_comes_back_with_local_nodes_at_their_bodies(tmp_path: Path) -> None:
    path = tmp_path / "out.uff"
    table = write_uff(path, frf_set(), modal_model(), GEOMETRY)
    found = strict_datasets(path)
    assert [n for n, _ in found[:3]] == [164, 15, 82]
    rows = {int(line[:10]): numbers([line[40:]], 13) for line in found[1][1]}
    assert rows[table.nodes["planet1"]] == pytest.approx(GEOMETRY.positions_m["planet1"], rel=1e-6)
    assert rows[table.nodes["planet1 local"]] == pytest.approx(GEOMETRY.positions_m["planet1"], rel=1e-6)
    peer = pyuff.UFF(str(path)).read_sets()
    assert peer[0]["units_code"] == 1
    assert dict(zip(peer[1]["node_nums"], peer[1]["x"], strict=True))[
        table.nodes["planet1"]
    ] == pytest.approx(0.123456, rel=1e-6)
    assert list(peer[2]["nodes"]) == [table.nodes[b] for b in GEOMETRY.lines[0]]
    assert columns(found[2][1][0], 10, 10, 10) == [
        "         1",
        "         3",
        "         0",
    ]  # line 1 of three nodes


def test_lines_of_the_geometry_must_join_known_bodies(tmp_path: Path) -> None:
    with pytest.raises(EmaError, match="'moon', which has no position"):
        write_uff(tmp_path / "o.uff", None, None, Geometry({"sun": (0, 0, 0)}, (("sun", "moon"),)))


def test_an_unwritable_path_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(EmaError, match="cannot be written"):
        write_uff(tmp_path / "no" / "o.uff", frf_set(), None)


def test_local_directions_get_a_node_of_their_own() -> None:
    table = node_table(DOFS)
    assert table.nodes == {"sun": 1, "planet1": 2, "carrier": 3, "planet1 local": 4}
    assert table.dofs == {
        "sun.x": (1, 1),
        "sun.y": (1, 2),
        "planet1.zeta": (4, 1),
        "planet1.u": (4, 2),
        "carrier.rz": (3, 6),
    }


def test_more_local_directions_than_a_node_has_go_to_another_node() -> None:
    table = node_table([Dof("planet1", d) for d in ("zeta", "eta", "u", "tilt")])
    assert table.nodes == {"planet1": 1, "planet1 local": 2, "planet1 local 2": 3}
    assert table.body["planet1 local 2"] == "planet1"
    found = [table.dofs[f"planet1.{d}"] for d in ("zeta", "eta", "u", "tilt")]
    assert found == [(2, 1), (2, 2), (2, 3), (3, 1)]


def test_points_keep_the_numbers_in_their_names() -> None:
    table = node_table([Dof.parse("point07.z"), Dof.parse("point12.z")])
    assert table.dofs == {"point07.z": (7, 3), "point12.z": (12, 3)}


def test_tables_of_modes_and_shapes_come_back_from_csv(tmp_path: Path) -> None:
    modal = modal_model()
    write_table(tmp_path / "modes.csv", modes_table(modal, "no_ring"))
    write_table(tmp_path / "shapes.csv", shapes_table(modal, "no_ring"))
    with (tmp_path / "modes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["frequency_hz"]) for r in rows] == [m.frequency_hz for m in modal.modes]
    assert rows[1]["configuration"] == "no_ring"
    assert rows[1]["flags"] == "a, b; c"
    with (tmp_path / "shapes.csv").open(encoding="utf-8") as file:
        shapes = list(csv.DictReader(file))
    assert [s["mode"] for s in shapes] == [r["mode"] for r in rows] == ["1", "2"]
    shape = shapes[0]
    assert complex(float(shape["sun.x re"]), float(shape["sun.x im"])) == modal.modes[0].shape[0]
    assert shape["sun.y re"] == ""


def test_table_of_modes_numbers_the_model_modes_from_1_and_leaves_out_what_has_no_partner() -> None:
    pair = Pair(
        measured=1, model=4, measured_frequency_hz=515.0, model_frequency_hz=500.0, mac=0.93, family="planet"
    )
    pairing = Pairing((), (pair,), (), (), np.empty((2, 0)))
    alone, paired = modes_table(modal_model(), "no_ring", pairing)
    assert (alone["mode"], alone["model_mode"], alone["mac"], alone["family"]) == (1, None, None, None)
    assert (paired["mode"], paired["model_mode"], paired["mac"], paired["family"]) == (2, 5, 0.93, "planet")
    assert paired["model_frequency_hz"] == 500.0
    assert paired["difference_percent"] == pytest.approx(100 * (515.0 - 500.0) / 500.0)


def test_no_modes_still_give_a_table_with_its_header(tmp_path: Path) -> None:
    write_table(tmp_path / "modes.csv", [])
    assert (tmp_path / "modes.csv").read_text().startswith("configuration,mode,frequency_hz")


def test_frfs_come_back_from_csv(tmp_path: Path) -> None:
    frfs = frf_set()
    write_frf_csv(tmp_path / "frf.csv", frfs)
    read = np.genfromtxt(tmp_path / "frf.csv", delimiter=",", names=True, deletechars="", replace_space=" ")
    assert read.dtype.names is not None
    np.testing.assert_allclose(read["frequency_hz"], frfs.frequency_hz, rtol=1e-11)
    real = read["planet1.zeta/sun.y re (m/s/N)"]
    np.testing.assert_allclose(real, frfs.frf[2, 1].real, rtol=1e-11)
    assert not any(name.startswith("carrier.rz/sun.y") for name in read.dtype.names)
    assert "planet1.u/sun.x coherence" not in read.dtype.names


def record() -> Record:
    rng = np.random.default_rng(13)
    channels = (
        ResponseChannel("a1", Dof.parse("-sun.y"), "acceleration"),
        ResponseChannel("v1", Dof.parse("planet1.zeta"), "velocity"),
    )
    return Record(
        file="sun_x_1.csv",
        impact=Dof.parse("-sun.x"),
        sample_rate_hz=25600.0,
        force_name="hammer",
        force=rng.standard_normal(50),
        responses=rng.standard_normal((2, 50)),
        channels=channels,
    )


def test_a_record_comes_back_through_sep005_and_passes_its_validator() -> None:
    sep005 = pytest.importorskip("sdypy_sep005.sep005", reason="sdypy_sep005 is not installed")
    before = record()
    channels = to_sep005(before)
    sep005.assert_sep005(channels)
    after = from_sep005(channels)
    assert (after.file, after.impact, after.channels) == (before.file, before.impact, before.channels)
    assert after.sample_rate_hz == before.sample_rate_hz
    np.testing.assert_array_equal(after.force, before.force)
    np.testing.assert_array_equal(after.responses, before.responses)


def test_the_pages_example_of_sep005_gives_the_frfs_of_the_records_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = Path(__file__).resolve().parents[2]
    monkeypatch.chdir(root)
    page = root / "docs" / "method_measurement.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    found: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), found)
    records = {r.file: r for r in load_records(found["test"])}
    direct = estimate_frfs(cut_hit(records[h.file], h) for h in found["hits"])
    assert found["frfs"].outputs == direct.outputs
    np.testing.assert_array_equal(found["frfs"].frf, direct.frf)


def test_sep005_units_become_si_and_time_gives_the_rate() -> None:
    time = np.arange(4) / 1024
    channels = [
        {"name": "acc", "data": [1.0, 2.0, 3.0, 4.0], "unit_str": "g", "time": time},
        {"name": "ham", "data": [1.0, 0.0, 0.0, 0.0], "unit_str": "kN", "fs": 1024},
    ]
    made = from_sep005(channels, impact="sun.x", dofs={"acc": "sun.y"})
    assert made.sample_rate_hz == pytest.approx(1024)
    assert made.force[0] == 1000.0
    assert made.responses[0, 1] == pytest.approx(2 * 9.80665)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unit_str": "furlong"}, "unknown unit 'furlong'"),
        ({"unit_str": "N"}, "one force channel is needed, found 'hammer', 'a1'"),
        ({"unit_str": "V"}, "'a1' is in V"),
        ({"fs": 100.0}, "differ in sample rate or length"),
        ({"fs": None}, "neither 'fs' nor 'time'"),
        ({"dof": None}, "'a1' has no dof"),
        ({"data": [1.0, np.nan]}, "two finite samples"),
    ],
)
def test_unusable_sep005_channels_are_named(change: dict[str, Any], message: str) -> None:
    channels = to_sep005(record())
    channels[1] |= change
    with pytest.raises(EmaError, match=message):
        from_sep005(channels)
