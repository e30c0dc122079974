"""Readers: files written by independent writers come back with the values that went in."""

from __future__ import annotations

import contextlib
import gzip
import struct
from pathlib import Path
from types import ModuleType

import h5py
import numpy as np
import pytest
import scipy.io
from ingest_example import RATE, SAMPLES, hammer_test, write_csv, write_uff
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import wavfile

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import readers
from ema_pipeline.ingest.readers import READERS, read_raw, reader_of
from ema_pipeline.ingest.readers.raw import FULL_SCALE

DATA = hammer_test()


def table_text(delimiter: str, decimal: str = ".", header: str = "time;hammer;tip") -> str:
    rows = [header.replace(";", delimiter)]
    for i in range(SAMPLES):
        cells = [f"{v:.10g}" for v in (i / RATE, DATA["hammer"][i], DATA["tip"][i])]
        rows.append(delimiter.join(c.replace(".", decimal) for c in cells))
    return "\n".join(rows) + "\n"


def check(path: Path, rate: float | None = RATE, rtol: float = 1e-9, format_name: str | None = None) -> None:
    raw = read_raw(path)
    assert set(raw.channels) == {"hammer", "tip"}
    for name, samples in DATA.items():
        assert_allclose(raw.channels[name].samples, samples, rtol=rtol, atol=rtol)
    if rate is None:
        assert raw.sample_rate_hz is None
    else:
        assert raw.sample_rate_hz == pytest.approx(rate, rel=1e-9)
    reader = reader_of(path)
    assert reader is not None
    if format_name is not None:
        assert format_name == reader.NAME


# --- text -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), (" ", ","), ("  ", ".")],
)
def test_text_is_read_whatever_its_delimiter_and_decimal_sign(
    tmp_path: Path, delimiter: str, decimal: str
) -> None:
    path = tmp_path / "hit.dat"
    path.write_text(table_text(delimiter, decimal))
    check(path, format_name="CSV/TXT")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_text_is_read_whatever_its_encoding_and_units_keep_their_squares(
    tmp_path: Path, encoding: str
) -> None:
    path = tmp_path / "hit.csv"
    path.write_text(table_text(";", header="Zeit [s];hammer [N];tip [m/s²]"), encoding=encoding)
    check(path)
    units = {n: c.unit for n, c in read_raw(path).channels.items()}
    assert units == {"hammer": "N", "tip": "m/s²"}


def test_a_time_column_in_milliseconds_gives_the_rate_in_hertz(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    rows = ["Time (ms),hammer,tip"] + [
        f"{1000 * i / RATE:.9g},{a:.17g},{b:.17g}"
        for i, (a, b) in enumerate(zip(DATA["hammer"], DATA["tip"], strict=True))
    ]
    path.write_text("\r\n".join(rows))
    check(path)


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("Sampling interval (ms): 0.5", 2000.0),
        ("Sampling interval [s]: 0.5e-3", 2000.0),
        ("Delta t: 0.25", 4.0),
        ("Sample rate: 2.5 kHz", 2500.0),
        ("Sample rate: 2,5", 2.5),
    ],
)
def test_rates_and_intervals_above_a_table_are_taken_in_their_units(
    tmp_path: Path, line: str, rate: float
) -> None:
    path = tmp_path / "hit.txt"
    path.write_text(f"{line}\n\nhammer\ttip\n" + "".join(f"{i % 7}.5\t{i % 5}.25\n" for i in range(50)))
    assert read_raw(path).sample_rate_hz == pytest.approx(rate, rel=1e-12)


def test_times_rounded_to_microseconds_still_give_the_whole_rate(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    rate = 25600
    path.write_text("t,hammer\n" + "\n".join(f"{i / rate:.6f},{i % 7}" for i in range(5000)))
    assert read_raw(path).sample_rate_hz == pytest.approx(rate, rel=1e-6)


def test_a_row_of_units_below_the_names_is_no_data(tmp_path: Path) -> None:
    path = tmp_path / "hit.txt"
    text = table_text("\t", header="Time;hammer;tip").split("\n", 1)
    path.write_text("Measured on Monday\nSample rate: 2048 Hz\n" + text[0] + "\n(s)\t(lbf)\t(g)\n" + text[1])
    check(path)
    assert {n: c.unit for n, c in read_raw(path).channels.items()} == {"hammer": "lbf", "tip": "g"}


def test_a_sample_number_column_is_no_channel_and_no_time(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    rows = [f"{i},{a:.17g},{b:.17g}" for i, (a, b) in enumerate(zip(*DATA.values(), strict=True))]
    path.write_text("Sample,hammer,tip\n" + "\n".join(rows))
    check(path, rate=None)


def test_dates_in_the_first_column_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    rows = [f"2026-04-09 15:46:59,{a:.17g},{b:.17g}" for a, b in zip(*DATA.values(), strict=True)]
    path.write_text("Date,hammer,tip\n" + "\n".join(rows))
    check(path, rate=None)


def test_a_footer_below_the_table_is_no_data(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    path.write_text(table_text(",") + "End of data\n")
    check(path)


def test_a_trailing_delimiter_is_no_channel(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    path.write_text("\n".join(line + "," for line in table_text(",").splitlines()))
    check(path)


def test_commented_headers_of_numpy_are_read(tmp_path: Path) -> None:
    path = tmp_path / "hit.txt"
    time = np.arange(SAMPLES) / RATE
    np.savetxt(path, np.column_stack([time, *DATA.values()]), header="time hammer tip")
    check(path)


def test_gzip_is_unpacked_on_the_way(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv.gz"
    path.write_bytes(gzip.compress(table_text(",").encode()))
    check(path)


KYOWA = """{q}ID No.{q},{q}PCD-400A{q}
{q}Title{q},{q}{q}
{q}Test Date{q},{q}2026/04/09{q},{q}15:54:47{q}
{q}MEAS CHs{q},2
{q}Digital Input{q},{q}OFF{q}
{q}Sampling Rate(Hz){q},50
{q}Data Nos/CH{q},{n}
{q}MEAS Time(sec){q},2
{q}CH Name{q}{pad}
{q}CH No.{q},{q}CH2{q},{q}CH8{q}
{q}Range{q},2000,5
{q}Calibration Coefficient{q},2.022,100000
{q}Offset{q},-97.55164,-13.17073
{q}Unit{q},{q}cm/s2{q},{q}V{q}
"""


@pytest.mark.parametrize(("quote", "pad"), [('"', ""), ("", ",,")])
def test_kyowa_preambles_give_names_units_and_rate(tmp_path: Path, quote: str, pad: str) -> None:
    path = tmp_path / "set1.CSV"
    rows = [f"{i * 0.02:.2f},{np.sin(i):.12f},{-i % 5}" for i in range(100)]
    path.write_text(KYOWA.format(q=quote, n=100, pad=pad) + "\n".join(rows) + "\n", newline="\r\n")
    raw = read_raw(path)
    assert raw.sample_rate_hz == 50.0
    assert {n: c.unit for n, c in raw.channels.items()} == {"CH2": "cm/s2", "CH8": "V"}
    assert_allclose(raw.channels["CH2"].samples, np.sin(np.arange(100)), atol=1e-11)


def test_a_kyowa_file_with_fewer_rows_than_it_states_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "set1.CSV"
    rows = [f"{i * 0.02:.2f},{np.sin(i):.12f},{-i % 5}" for i in range(100)]
    path.write_text(KYOWA.format(q="", n=200, pad=",,") + "\n".join(rows) + "\n")
    with pytest.raises(EmaError, match=r"set1\.CSV: holds 100 of the 200 samples"):
        read_raw(path)


def test_real_kyowa_files_are_read_as_they_are(test_data: Path) -> None:
    files = sorted((test_data / "realdata" / "frame3_hammer").glob("*.gz"))
    assert len(files) == 3
    for file, count in zip(files, (9028, 9120, 9105), strict=True):
        raw = read_raw(file)
        assert raw.sample_rate_hz == 50.0
        assert [c.unit for c in raw.channels.values()] == ["cm/s2"] * 4 + ["V"]
        assert {c.samples.size for c in raw.channels.values()} == {count}
    first = read_raw(files[0])
    assert first.channels["CH8"].samples[13] == -921.524389
    assert first.channels["CH2"].samples[0] == -1.778343902


# --- UFF --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("binary", [True, False])
def test_uff_58_round_trip(tmp_path: Path, binary: bool) -> None:
    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary, ordinate_axis_units_lab="V")
    check(path, rtol=1e-11 if binary else 1e-9, format_name="UFF58")
    assert read_raw(path).channels["tip"].unit == "V"
    assert read_raw(path).channels["tip"].dof == "2.z"


def test_uff_binary_of_doubles_labelled_single_is_read_as_what_it_is(tmp_path: Path) -> None:
    import pyuff

    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary=True)
    content = path.read_bytes()
    # What pyuff's own writer does with force_double=False: header of singles, body of doubles.
    marked = content.replace(b"\n         4      2048", b"\n         2      2048")
    marked = marked.replace(b"%12i" % (8 * SAMPLES), b"%12i" % (4 * SAMPLES))
    assert marked.count(b"\n         2      2048") == 2
    path.write_bytes(marked)
    assert (
        len(pyuff.UFF(str(path)).read_sets(0)["data"]) == 2 * SAMPLES
    )  # why pyuff is not asked for the body
    check(path, rtol=1e-12)


@pytest.mark.parametrize("order", ["<", ">"])
def test_uff_binary_singles_of_either_byte_order_are_read(tmp_path: Path, order: str) -> None:
    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary=True)
    parts = []
    for block in path.read_bytes().split(b"    -1\n    58b")[1:]:
        lines = (b"    58b" + block).split(b"\n", 12)
        body = lines[12][: 8 * SAMPLES]
        single = np.frombuffer(body, "<f8").astype(order + "f4").tobytes()
        lines[0] = b"    58b%6i%6i%12i%12i" % (1 if order == "<" else 2, 2, 11, len(single))
        lines[7] = lines[7].replace(b"         4", b"         2", 1)
        parts.append(b"    -1\n" + b"\n".join(lines[:12]) + b"\n" + single + b"    -1\n")
    path.write_bytes(b"".join(parts))
    check(path, rtol=1e-6)


def test_uff_steps_rounded_to_six_digits_give_the_whole_rate(tmp_path: Path) -> None:
    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary=True, x=np.arange(SAMPLES) / 5120.0)
    assert b"1.95312e-04" in path.read_bytes() or b"1.95313e-04" in path.read_bytes()
    assert read_raw(path).sample_rate_hz == 5120.0


def test_uff_without_id_line_names_channels_by_node_and_direction(tmp_path: Path) -> None:
    path = tmp_path / "hit.unv"
    write_uff(path, {"NONE": DATA["hammer"]}, binary=False, rsp_node=12, rsp_dir=-3)
    assert list(read_raw(path).channels) == ["-12.z"]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("share", [0.2, 0.45, 0.53, 0.75, 0.97])
def test_a_uff_cut_anywhere_is_refused(tmp_path: Path, binary: bool, share: float) -> None:
    path = tmp_path / "hit.uff"
    write_uff(path, DATA, binary)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(EmaError, match=r"hit\.uff: .*(cut short|damaged)"):
        read_raw(path)


# --- HDF5 and MAT -----------------------------------------------------------------------------------------


def test_hdf5_datasets_at_the_root_with_attributes(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file.attrs["fs"] = RATE
        for name, samples in DATA.items():
            file[name] = samples
        file["tip"].attrs["unit"] = "g"
        file["tip"].attrs["units_note"] = "by hand"
    check(path, rtol=0, format_name="HDF5")
    assert read_raw(path).channels["tip"].unit == "g"


def test_hdf5_datasets_in_groups_with_a_time_vector(tmp_path: Path) -> None:
    path = tmp_path / "hit.bin"
    with h5py.File(path, "w") as file:
        file["measurement/time"] = np.arange(SAMPLES) / RATE
        for name, samples in DATA.items():
            file[f"measurement/{name}"] = samples.reshape(-1, 1)
    check(path, rtol=0)


def test_hdf5_times_in_milliseconds_do_not_contradict_the_stated_rate(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate_hz"] = RATE
        file["time"] = np.round(np.arange(SAMPLES) / RATE, 3)
        for name, samples in DATA.items():
            file[name] = samples
    check(path)
    with h5py.File(path, "a") as file:
        file.attrs["sample_rate_hz"] = 2 * RATE
    with pytest.raises(EmaError, match="contradicts itself"):
        read_raw(path)


def test_hdf5_step_attribute_and_named_columns(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file["data"] = np.column_stack(list(DATA.values()))
        file["data"].attrs["dt"] = 1 / RATE
        file["data"].attrs["channels"] = ["hammer", "tip"]
        file["data"].attrs["units"] = ["N", "g"]
    check(path, rtol=0)
    assert [c.unit for c in read_raw(path).channels.values()] == ["N", "g"]


def test_hdf5_that_contradicts_itself_about_the_rate_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        for i, (name, samples) in enumerate(DATA.items()):
            file[name] = samples
            file[name].attrs["sample_rate_hz"] = RATE * (1 + i)
    with pytest.raises(EmaError, match=r"hit\.h5: contradicts itself: sample rate 2048 Hz .* and 4096 Hz"):
        read_raw(path)


@pytest.mark.parametrize("stated", [-5.0, float("nan"), "abc", "2 kHz"])
def test_hdf5_that_states_no_sample_rate_under_that_name_is_refused(
    tmp_path: Path, stated: float | str
) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = stated
        file["tip"] = DATA["tip"]
    with pytest.raises(
        EmaError, match=rf"states sample_rate = '{stated}' .* no sample rate; correct or remove"
    ):
        read_raw(path)


@pytest.mark.parametrize("stated", ["2048", "2048.0 Hz"])
def test_hdf5_may_state_its_sample_rate_as_text(tmp_path: Path, stated: str) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file.attrs["Sample rate"] = stated
        file["tip"] = DATA["tip"]
    assert read_raw(path).sample_rate_hz == 2048.0


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (DATA["tip"] * 1j, "'tip' is complex"),
        (DATA["tip"][:1000].reshape(10, 10, 10), "'tip' has 3 dimensions"),
        ([f"{x:.4f}" for x in DATA["tip"][:100]], "'tip' holds text"),
    ],
    ids=["complex", "3-D", "text"],
)
def test_hdf5_without_channels_says_why(tmp_path: Path, values: object, why: str) -> None:
    path = tmp_path / "hit.h5"
    with h5py.File(path, "w") as file:
        file["tip"] = values
    with pytest.raises(EmaError, match=rf"holds no channels \({why}.*; export the time data as numbers"):
        read_raw(path)


def test_mat_5_vectors_with_a_rate_scalar(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    scipy.io.savemat(path, {**DATA, "Fs": RATE, "comment": "first"})
    check(path, rtol=0, format_name="MAT")


def test_mat_5_struct_with_a_time_vector(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    scipy.io.savemat(path, {"rec": {**DATA, "t": np.arange(SAMPLES) / RATE}})
    check(path, rtol=0)


@pytest.mark.parametrize(
    ("beside", "assumed"),
    [({"t": 1e3}, True), ({"t_ms": 1e3}, False), ({"t": 1.0, "fs": None}, False), ({"fs": None}, False)],
)
def test_times_of_no_stated_unit_are_marked_as_read_as_seconds(
    tmp_path: Path, beside: dict[str, float | None], assumed: bool
) -> None:
    """Not where the file states its sample rate as well."""
    stated = {n: RATE if unit is None else unit * np.arange(SAMPLES) / RATE for n, unit in beside.items()}
    scipy.io.savemat(tmp_path / "hit.mat", {**DATA, **stated})
    with h5py.File(tmp_path / "hit.h5", "w") as file:
        for name, values in {**DATA, **stated}.items():
            file[name] = values
    for name in ("hit.h5", "hit.mat"):
        raw = read_raw(tmp_path / name)
        assert raw.seconds_assumed == assumed
        assert raw.sample_rate_hz == pytest.approx(RATE / 1e3 if assumed else RATE)


def test_mat_5_matrix_columns_are_numbered(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    scipy.io.savemat(path, {"acc": np.column_stack(list(DATA.values())), "dt": 1 / RATE})
    raw = read_raw(path)
    assert list(raw.channels) == ["acc_1", "acc_2"]
    assert_array_equal(raw.channels["acc_2"].samples, DATA["tip"])
    assert raw.sample_rate_hz == pytest.approx(RATE)


def test_mat_5_matrix_with_time_in_its_first_column(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    time = np.arange(SAMPLES) / RATE - 0.01
    scipy.io.savemat(path, {n: np.column_stack([time, x]) for n, x in DATA.items()})
    check(path, rtol=0)


def test_mat_73_as_matlab_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "hit.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in {**DATA, "fs": np.array([RATE])}.items():
            file[name] = value.reshape(1, -1)  # MATLAB stores columns as rows
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["note"] = np.array([[104], [105]], dtype=np.uint16)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Thu Apr  9 2026".ljust(124))
        raw.write(struct.pack("<HH", 0x0200, 0x4D49))
    check(path, rtol=0, format_name="MAT")


def test_an_untouched_analyser_export_gives_its_time_histories_with_units(test_data: Path) -> None:
    raw = read_raw(test_data / "realdata" / "aircraft_roving_hammer" / "signalcalc_export_sample.mat")
    assert raw.sample_rate_hz == pytest.approx(512.0)
    assert raw.channels["X1"].unit == "N"
    assert raw.channels["X3"].unit == "g"
    assert {c.samples.size for c in raw.channels.values()} == {4096}
    assert any("spectrum" in note for note in raw.notes)


# --- WAV, TDMS, LVM ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "scale"), [("int16", 2**15), ("int32", 2**31)])
def test_whole_number_wav_gives_fractions_of_full_scale(tmp_path: Path, dtype: str, scale: int) -> None:
    path = tmp_path / "hit.wav"
    fractions = np.column_stack([DATA["hammer"] / 200, DATA["tip"] / 200])
    wavfile.write(path, int(RATE), np.round(fractions * scale).astype(dtype))
    raw = read_raw(path)
    assert raw.sample_rate_hz == RATE
    assert raw.channels["ch1"].unit == FULL_SCALE
    assert_allclose(raw.channels["ch1"].samples, fractions[:, 0], atol=1.0 / scale)
    assert_allclose(raw.channels["ch2"].samples, fractions[:, 1], atol=1.0 / scale)


def test_24_bit_wav_gives_fractions_of_full_scale(tmp_path: Path) -> None:
    path = tmp_path / "hit.wav"
    values = [0, 1, -1, 2**22, -(2**23), 2**23 - 1] * 20
    body = b"".join(v.to_bytes(3, "little", signed=True) for v in values)
    header = struct.pack("<4sI4s4sIHHIIHH4sI", b"RIFF", 36 + len(body), b"WAVE", b"fmt ", 16, 1, 1, 8000,
                         24000, 3, 24, b"data", len(body))  # fmt: skip
    path.write_bytes(header + body)
    assert_allclose(read_raw(path).channels["ch1"].samples, np.array(values) / 2**23, rtol=0, atol=0)


def test_float_wav_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "hit.wav"
    wavfile.write(path, int(RATE), np.column_stack(list(DATA.values())).astype(np.float32))
    raw = read_raw(path)
    assert raw.channels["ch1"].unit is None
    assert_allclose(raw.channels["ch1"].samples, DATA["hammer"], rtol=1e-6)


def test_tdms_channels_with_increment_and_unit(tmp_path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    path = tmp_path / "hit.tdms"
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                ChannelObject("run", n, x, {"wf_increment": 1 / RATE, "unit_string": "V"})
                for n, x in DATA.items()
            ]
        )
    check(path, rtol=0, format_name="TDMS")
    assert read_raw(path).channels["tip"].unit == "V"


LVM_HEAD = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t.
Multi_Headings\tNo
X_Columns\tOne
Time_Pref\tRelative
***End_of_Header***\t

Channels\t2\t
Samples\t{n}\t{n}
Date\t2026/04/09\t2026/04/09
Y_Unit_Label\tN\tm/s²
X_Dimension\tTime\tTime
X0\t0.0\t0.0
Delta_X\t{dt}\t{dt}
***End_of_Header***\t\t
X_Value\thammer\ttip\tComment
"""


def lvm_text(rows: int = SAMPLES, times: np.ndarray | None = None, step: float = 1 / RATE) -> str:
    times = np.arange(SAMPLES) / RATE if times is None else times
    body = [f"{times[i]:.9f}\t{DATA['hammer'][i]:.17g}\t{DATA['tip'][i]:.17g}" for i in range(rows)]
    return LVM_HEAD.format(n=SAMPLES, dt=step) + "\n".join(body) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_lvm_keeps_its_units_in_any_encoding(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "hit.lvm"
    path.write_text(lvm_text(), encoding=encoding)
    check(path, format_name="LVM")
    assert {n: c.unit for n, c in read_raw(path).channels.items()} == {"hammer": "N", "tip": "m/s²"}
    assert list(tmp_path.iterdir()) == [path]  # no pickles beside the data


@pytest.mark.parametrize(
    ("times", "step", "said"),
    [
        (np.arange(SAMPLES) / 4096, 1 / RATE, "header states 2048 Hz and its time column X_Value 4096 Hz"),
        (np.arange(SAMPLES)[::-1] / RATE, 1 / RATE, "time runs backwards at sample 1"),
        (
            np.arange(SAMPLES) / RATE + 0.3 * (np.arange(SAMPLES) > 1500),
            1 / RATE,
            "time jumps by 0.300488 s at sample 1501",
        ),
        (np.arange(SAMPLES) / RATE, 0.0, "states Delta_X = 0 s, which is no time step"),
        (np.arange(SAMPLES) / RATE, -1 / RATE, "states Delta_X = -0.000488281 s"),
    ],
)
def test_an_lvm_whose_times_contradict_its_step_is_refused(
    tmp_path: Path, times: np.ndarray, step: float, said: str
) -> None:
    path = tmp_path / "hit.lvm"
    path.write_text(lvm_text(times=times, step=step), encoding="utf-8")
    with pytest.raises(EmaError) as caught:
        read_raw(path)
    assert said in str(caught.value)


def test_lvm_times_may_be_rounded_left_blank_or_stand_alone(tmp_path: Path) -> None:
    path = tmp_path / "hit.lvm"
    path.write_text(lvm_text(times=np.round(np.arange(SAMPLES) / RATE, 3)), encoding="utf-8")
    check(path)
    path.write_text(lvm_text(times=np.full(SAMPLES, np.nan)).replace("nan\t", "\t"), encoding="utf-8")
    check(path)
    text = lvm_text()
    path.write_text(
        "".join(x for x in text.splitlines(True) if not x.startswith("Delta_X")), encoding="utf-8"
    )
    check(path)


# --- damaged and foreign files ----------------------------------------------------------------------------


def damaged(kind: str, folder: Path) -> Path:
    path = folder / f"bad_{kind}"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "junk":
        path.write_bytes(np.random.default_rng(0).bytes(5000))
    elif kind == "zip.mat":
        path.write_bytes(b"PK\x03\x04" + bytes(range(256)) * 20)
    elif kind == "half.h5":
        with h5py.File(path, "w") as file:
            for name, samples in DATA.items():
                file[name] = samples
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind == "half.mat":
        scipy.io.savemat(path, DATA)
        whole = (folder / f"bad_{kind}.mat") if not path.exists() else path
        path.write_bytes(whole.read_bytes()[:20000])
    elif kind == "half.wav":
        wavfile.write(path, int(RATE), np.column_stack(list(DATA.values())).astype(np.float32))
        header = path.stat().st_size - 8 * SAMPLES
        path.write_bytes(path.read_bytes()[: header + 8 * 500])  # whole frames, just too few
    elif kind == "half.tdms":
        from nptdms import ChannelObject, TdmsWriter

        with TdmsWriter(str(path)) as writer:
            writer.write_segment([ChannelObject("run", n, x) for n, x in DATA.items()])
        path.write_bytes(path.read_bytes()[:9000])
    elif kind == "no_data.wav":
        wavfile.write(path, int(RATE), DATA["tip"].astype(np.float32))
        content = path.read_bytes()
        end = content.index(b"data")
        path.write_bytes(content[:4] + struct.pack("<I", end - 8) + content[8:end])
    elif kind == "odd_type.tdms":
        from nptdms import ChannelObject, TdmsWriter

        with TdmsWriter(str(path)) as writer:
            writer.write_segment([ChannelObject("run", n, x) for n, x in DATA.items()])
        content = path.read_bytes()
        at = content.index(b"'hammer'") + 8
        path.write_bytes(content[: at + 4] + b"rats" + content[at + 8 :])
    elif kind == "header.mat":
        scipy.io.savemat(path, DATA, appendmat=False)
        path.write_bytes(path.read_bytes()[:100])
    elif kind == "headless.lvm":
        path.write_text(LVM_HEAD.partition("Channels")[0].strip())
    elif kind == "digits.csv":
        lines = table_text(",").splitlines()
        lines[700] = lines[700].rsplit(",", 1)[0] + ",\u0661\u0662"
        path.write_text("\n".join(lines), encoding="utf-8")
    elif kind == "half.lvm":
        path.write_text(lvm_text(1000), encoding="utf-8")
    elif kind == "half.gz":
        path.write_bytes(gzip.compress(table_text(",").encode())[:2000])
    elif kind == "prose":
        path.write_text("Dear all,\nthe data are on the other disk.\n")
    elif kind == "header_only.csv":
        path.write_text("time,hammer,tip\n")
    elif kind == "blank_cell.csv":
        lines = table_text(",").splitlines()
        lines[700] = lines[700].rsplit(",", 1)[0] + ","
        path.write_text("\n".join(lines))
    elif kind == "nan_cell.csv":
        lines = table_text(",").splitlines()
        lines[1] = lines[1].rsplit(",", 1)[0] + ",NaN"
        path.write_text("\n".join(lines))
    elif kind == "short_line.csv":
        lines = table_text(",").splitlines()
        path.write_text("\n".join([*lines[:-1], lines[-1].rsplit(",", 1)[0]]))
    elif kind == "word.csv":
        lines = table_text(",").splitlines()
        lines[900] = lines[900].rsplit(",", 1)[0] + ",OVER"
        path.write_text("\n".join(lines))
    elif kind == "gap.csv":
        lines = table_text(",").splitlines()
        path.write_text("\n".join(lines[:500] + lines[600:]))
    elif kind == "twice.csv":
        path.write_text(table_text(",").replace("time,hammer,tip", "time,tip,tip"))
    elif kind == "spectrum.uff":
        write_uff(path, DATA, binary=False, func_type=4)
    return path


DAMAGE = {
    "empty": "is empty",
    "junk": "unknown format",
    "zip.mat": "looks like a zip archive",
    "half.h5": "cannot be read as HDF5",
    "half.mat": "cannot be read as MAT",
    "half.wav": "cut short",
    "half.tdms": "cut short",
    "no_data.wav": "cannot be read as WAV; the file is damaged or cut short",
    "odd_type.tdms": "cannot be read as TDMS; the file is damaged or cut short",
    "header.mat": "cannot be read as MAT; the file is damaged or cut short",
    "headless.lvm": "has no segment of samples under a header: it is damaged or cut short",
    "digits.csv": "line 701, channel 'tip': '\u0661\u0662' is not a number",
    "half.lvm": "holds 1000 of the 2048 samples",
    "half.gz": "cannot be unpacked",
    "prose": "unknown format",
    "header_only.csv": "unknown format",
    "blank_cell.csv": "line 701, channel 'tip': is blank",
    "nan_cell.csv": "line 2, channel 'tip': 'NaN' is not a number",
    "short_line.csv": "line 2049 has 2 cells where the table has 3",
    "word.csv": "line 901, channel 'tip': 'OVER' is not a number",
    "gap.csv": "time jumps",
    "twice.csv": "two columns have the name 'tip'",
    "spectrum.uff": "holds no time histories",
}


@pytest.mark.parametrize("kind", list(DAMAGE))
def test_a_damaged_or_foreign_file_gives_one_line_that_names_it(tmp_path: Path, kind: str) -> None:
    path = damaged(kind, tmp_path)
    with pytest.raises(EmaError) as caught:
        read_raw(path)
    message = str(caught.value)
    assert path.name in message
    assert DAMAGE[kind] in message
    assert "\n" not in message


def test_a_missing_file_gives_one_line_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(EmaError, match=r"gone\.csv: cannot be read"):
        read_raw(tmp_path / "gone.csv")


@pytest.mark.parametrize("seed", range(20))
def test_no_damage_makes_a_reader_raise_anything_but_an_ema_error(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path / "hit"
    makers = [
        lambda: write_csv(path, DATA),
        lambda: write_uff(path, DATA, binary=True),
        lambda: write_uff(path, DATA, binary=False),
        lambda: path.write_text(lvm_text()),
        lambda: wavfile.write(path, int(RATE), DATA["tip"].astype(np.float32)),
        lambda: _write_h5(path),
    ]
    makers[seed % len(makers)]()
    content = bytearray(path.read_bytes())
    for at in rng.integers(0, min(len(content), 3000), 30):
        content[at] = int(rng.integers(0, 256))
    path.write_bytes(bytes(content[: int(rng.integers(len(content) // 3, len(content)))]))
    with contextlib.suppress(EmaError):  # anything else escapes and fails the test
        assert read_raw(path).channels


def _write_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, samples in DATA.items():
            file[name] = samples


def test_every_reader_has_its_own_name() -> None:
    assert len({r.NAME for r in READERS}) == len(READERS) == 7


def test_the_reader_of_the_documentation_works_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "adding_a_reader.md").read_text(encoding="utf-8")
    module = ModuleType("nlog")
    exec(page.split("```python\n")[1].split("```")[0], module.__dict__)
    monkeypatch.setattr(readers, "READERS", (*READERS[:-1], module, READERS[-1]))
    path = tmp_path / "hit.dat"
    head = b"NLOG" + struct.pack("<dii", RATE, 2, SAMPLES) + b"hammer".ljust(16, b"\0") + b"tip".ljust(16)
    whole = head + b"".join(x.astype("<f4").tobytes() for x in DATA.values())
    path.write_bytes(whole)
    check(path, rtol=1e-5, format_name="NLOG")
    for cut in (6, 8, len(whole) - len(head), len(whole) - 30):  # 8: one sample of each channel
        path.write_bytes(whole[:-cut])
        with pytest.raises(EmaError, match=rf"hit\.dat: has {len(whole) - cut} bytes .*cut short"):
            read_raw(path)
    path.write_bytes(whole[:10])
    with pytest.raises(EmaError, match=r"hit\.dat: cannot be read as NLOG; .*cut short"):
        read_raw(path)


@pytest.mark.parametrize(
    ("header", "delimiter", "unit"),
    [
        ("time, hammer, tip", ",", None),
        ('"Time, s","hammer, N","tip, g"', ",", "N"),
        ("Time (s)   hammer (N)   tip (g)", "  ", "N"),
        ("time\thammer [N]\ttip [g]", "\t", "N"),
        ("File: x\nSample rate: 2048\n\ntime;hammer (N);tip (g)", ";", "N"),
        ("sep=;\ntime;hammer;tip", ";", None),
    ],
)
def test_headers_of_many_programs_give_names_and_units(
    tmp_path: Path, header: str, delimiter: str, unit: str | None
) -> None:
    path = tmp_path / "hit.csv"
    body = table_text(delimiter).split("\n", 1)[1]
    path.write_text(header + "\n" + body)
    check(path)
    assert read_raw(path).channels["hammer"].unit == unit


def test_a_blank_comment_column_is_no_channel(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    lines = table_text(",").splitlines()
    path.write_text("\n".join([lines[0] + ",Comment", *(line + "," for line in lines[1:])]))
    check(path)


def test_a_table_with_texts_among_its_numbers_says_what_to_export(tmp_path: Path) -> None:
    path = tmp_path / "hit.csv"
    lines = table_text(",").splitlines()
    path.write_text("\n".join([lines[0] + ",Event", *(line + ",ok" for line in lines[1:])]))
    with pytest.raises(EmaError, match=r"hit\.csv: no table of numbers found; export"):
        read_raw(path)
