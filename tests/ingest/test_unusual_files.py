"""Record files that are laid out otherwise than most: read as they are, or refused in words that say why."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from ingest_example import DESCRIPTION, RATE, SAMPLES, hammer_test, make_test, write_uff
from numpy.testing import assert_allclose
from scipy.io import wavfile

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.load import load_record
from ema_pipeline.ingest.readers import read_raw

DATA = hammer_test()


def check(path: Path, rate: float | None = RATE) -> None:
    raw = read_raw(path)
    assert raw.sample_rate_hz == (None if rate is None else pytest.approx(rate))
    for name, samples in DATA.items():
        assert_allclose(raw.channels[name].samples, samples, rtol=1e-6, atol=1e-6)


def matlab_73(path: Path, write: Callable[[h5py.File], None]) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in {**DATA, "fs": np.array([RATE])}.items():
            file[name] = value.reshape(1, -1)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        write(file)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Thu Apr  9 2026".ljust(124))
        raw.write(struct.pack("<HH", 0x0200, 0x4D49))


def cell(file: h5py.File, name: str, items: list[h5py.Reference]) -> None:
    file[name] = np.array([items], dtype=h5py.ref_dtype)
    file[name].attrs["MATLAB_class"] = np.bytes_("cell")


# --- names and units that stand in lists of their own ------------------------------------------------------


def test_a_list_of_names_beside_variables_of_their_own_renames_none_of_them(tmp_path: Path) -> None:
    """HDF5 sorts its datasets by name, a list has its own order: the channels would be exchanged."""
    path = tmp_path / "hit.h5"
    values = {"hammer": DATA["hammer"], "a1": DATA["tip"]}
    with h5py.File(path, "w") as file:
        for name, samples in values.items():
            file[name] = samples
        file["channel_names"] = ["hammer", "a1"]
        file["units"] = ["N", "g"]
    raw = read_raw(path)
    for name, samples in values.items():
        assert_allclose(raw.channels[name].samples, samples)
        assert raw.channels[name].unit is None


def test_names_of_the_columns_of_a_matrix_may_include_its_time_axis(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    table = np.column_stack([np.arange(SAMPLES) / RATE, *DATA.values()])
    names = np.array(["time", *DATA], dtype=object)
    scipy.io.savemat(path, {"data": table, "names": names, "units": np.array(["s", "N", "g"], dtype=object)})
    check(path)
    assert [c.unit for c in read_raw(path).channels.values()] == ["N", "g"]


# --- MAT --------------------------------------------------------------------------------------------------


def test_mat_5_structs_within_structs(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    scipy.io.savemat(path, {"test": {"signals": DATA, "setup": {"fs": RATE}}})
    check(path)


@pytest.mark.parametrize("what", ["no reference", "struct", "odd characters", "text beyond the BMP"])
def test_mat_73_cells_of_anything_do_no_harm(tmp_path: Path, what: str) -> None:
    def write(file: h5py.File) -> None:
        if what == "no reference":
            cell(file, "names", [h5py.Reference(), h5py.Reference()])
        elif what == "struct":
            cell(file, "names", [file.create_group("#refs#/a").ref])
        elif what == "odd characters":
            file["#refs#/a"] = np.array([[2**31]], dtype=np.uint32)
            cell(file, "names", [file["#refs#/a"].ref])
        else:
            file["#refs#/a"] = np.frombuffer("\N{GRINNING FACE}".encode("utf-16-le"), "<u2")
            cell(file, "names", [file["#refs#/a"].ref])

    path = tmp_path / "hit.mat"
    matlab_73(path, write)
    check(path)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_vectors_in_a_cell_are_named_as_what_was_left_out(tmp_path: Path, version: str) -> None:
    path = tmp_path / "hit.mat"
    if version == "5":
        vectors = np.empty(2, dtype=object)
        vectors[:] = list(DATA.values())
        scipy.io.savemat(path, {"data": vectors, "fs": RATE})
    else:

        def write(file: h5py.File) -> None:
            for name in DATA:
                file.move(name, f"#refs#/{name}")
            cell(file, "data", [file[f"#refs#/{name}"].ref for name in DATA])

        matlab_73(path, write)
    with pytest.raises(EmaError, match=r"'data' is a cell or struct array and is left out; save its vectors"):
        read_raw(path)


# --- HDF5 and TDMS ----------------------------------------------------------------------------------------


def test_hdf5_attributes_that_hold_nothing_are_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        for name, samples in DATA.items():
            file[name] = samples
            file[name].attrs["unit"] = h5py.Empty("S10")
        file.attrs["sample_rate_hz"] = h5py.Empty("f8")
        file["tip"].attrs["fs"] = RATE
    check(path)


def test_hdf5_tables_have_a_channel_per_column(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    table = np.zeros(SAMPLES, dtype=[("time", "f8"), ("hammer", "f8"), ("tip", "f4"), ("note", "S4")])
    table["time"] = np.arange(SAMPLES) / RATE
    for name, samples in DATA.items():
        table[name] = samples
    with h5py.File(path, "w") as file:
        file["data"] = table
    check(path)


def test_hdf5_groups_of_different_rates_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        for i, (name, samples) in enumerate(DATA.items()):
            file[f"{name}_data/{name}"] = samples
            file[f"{name}_data"].attrs["fs"] = RATE * (1 + i)
    with pytest.raises(
        EmaError, match=r"sample rate 2048 Hz \(group 'hammer_data'\) and 4096 Hz \(group 'tip_"
    ):
        read_raw(path)


def test_hdf5_rates_of_groups_without_samples_give_way_to_that_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file.attrs["fs"] = RATE
        file.create_group("camera").attrs["fs"] = 25.0
        for name, samples in DATA.items():
            file[f"data/{name}"] = samples
    check(path)


def test_tdms_groups_of_different_rates_are_refused(tmp_path: Path) -> None:
    from nptdms import ChannelObject, GroupObject, TdmsWriter

    path = tmp_path / "hit.tdms"
    with TdmsWriter(str(path)) as writer:
        groups = [GroupObject(n, {"fs": RATE * (1 + i)}) for i, n in enumerate(DATA)]
        writer.write_segment([*groups, *(ChannelObject(n, n, x) for n, x in DATA.items())])
    with pytest.raises(EmaError, match=r"sample rate 2048 Hz \(group 'hammer'\) and 4096 Hz \(group 'tip'\)"):
        read_raw(path)


@pytest.mark.parametrize("index", ["rubbish", "of a shorter recording"])
def test_the_index_file_beside_a_tdms_file_is_not_believed(tmp_path: Path, index: str) -> None:
    from nptdms import ChannelObject, TdmsWriter

    path = tmp_path / "hit.tdms"
    for samples in (SAMPLES // 4, SAMPLES):
        with TdmsWriter(str(path), index_file=samples < SAMPLES) as writer:
            channels = [
                ChannelObject("g", n, x[:samples], {"wf_increment": 1 / RATE}) for n, x in DATA.items()
            ]
            writer.write_segment(channels)
    if index == "rubbish":
        path.with_suffix(".tdms_index").write_bytes(b"rubbish")
    check(path)


# --- UFF and WAV ------------------------------------------------------------------------------------------


def test_uff_with_half_the_bytes_of_its_doubles_is_no_single_precision(tmp_path: Path) -> None:
    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary=True)
    content = path.read_bytes()
    twice = content.replace(b"         4      2048", b"         4      4096")
    assert twice.count(b"4      4096") == 2
    path.write_bytes(twice)
    with pytest.raises(EmaError, match=r"channel 'hammer' stores 16384 bytes for 4096 samples; .* damaged"):
        read_raw(path)


def test_uff_channels_that_start_at_different_times_are_refused(tmp_path: Path) -> None:
    early, late = tmp_path / "early.uff", tmp_path / "late.uff"
    write_uff(early, {"hammer": DATA["hammer"]}, binary=False)
    write_uff(late, {"tip": DATA["tip"]}, binary=False, x=0.25 + np.arange(SAMPLES) / RATE)
    path = tmp_path / "hit.uff"
    path.write_bytes(early.read_bytes() + late.read_bytes())
    with pytest.raises(EmaError, match=r"start at different times \('hammer' at 0 s, 'tip' at 0\.25 s\)"):
        read_raw(path)


def test_a_wav_that_ends_within_a_sample_says_nothing_of_the_program(tmp_path: Path) -> None:
    path = tmp_path / "hit.wav"
    wavfile.write(path, int(RATE), np.column_stack(list(DATA.values())).astype(np.float32))
    content = bytearray(path.read_bytes())
    size = content.index(b"data") + 4
    content[size : size + 4] = struct.pack("<I", SAMPLES * 8 - 4)
    path.write_bytes(content[:-4])
    with pytest.raises(EmaError) as refused:
        read_raw(path)
    assert str(refused.value).endswith(
        "hit.wav: cannot be read as WAV; the file is damaged or cut short, copy or export it again"
    )


@pytest.mark.parametrize(("empty", "shown"), [("", "blank"), ("NaN", "'NaN'")])
@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", ","), (";", ".")])
def test_a_column_without_any_number_is_named(
    tmp_path: Path, empty: str, shown: str, delimiter: str, decimal: str
) -> None:
    rows = [["time", "hammer", "mid", "tip"]]
    rows += [
        [f"{i / RATE:.7f}".replace(".", decimal), f"{i % 7}{decimal}5", empty, f"{i % 3}{decimal}25"]
        for i in range(99)
    ]
    path = tmp_path / "hit.csv"
    path.write_text("\n".join(delimiter.join(r) for r in rows) + "\n", encoding="utf-8")
    with pytest.raises(
        EmaError, match=rf"hit\.csv: line 51: column 3 is {shown}, no number; export its values"
    ):
        read_raw(path)


# --- from the file to the test ----------------------------------------------------------------------------


def test_a_channel_that_a_reader_left_out_says_why(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION, "hit.mat")
    scipy.io.savemat(folder / "hit.mat", {"hammer": DATA["hammer"], "tip": DATA["tip"] + 1j, "fs": RATE})
    test = read_description(folder)
    with pytest.raises(EmaError, match=r"has no channel 'tip': 'tip' is complex .* left out; export it as"):
        load_record(test, test.records[0])
