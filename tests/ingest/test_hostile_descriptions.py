"""Descriptions, rigs, pipelines and raw folders made to crash the program, lead it elsewhere or steer the terminal."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench import ema
from ingest_example import DESCRIPTION, hammer_test, make_test, write_csv

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import load_record, read_description
from ema_pipeline.names import check_name
from ema_pipeline.plain_text import printable
from ema_pipeline.toml_text import LARGEST_BYTES, parse_toml, read_toml

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e"


def one_line(err: str) -> str:
    """The one line of a message that blames the data, not the program."""
    assert err.count("\n") == 1
    assert err.startswith("ema: ")
    assert "a fault in ema" not in err
    assert "Traceback" not in err
    return err


TOMLS = {
    "nested arrays": "x = " + "[" * 3000 + "]" * 3000,
    "nested tables": "x = " + "{a=" * 3000 + "1" + "}" * 3000,
    "long key": ".".join("a" * 50_000) + " = 1",
    "long inline key": "x = {" + ".".join("a" * 50_000) + " = 1}",
    "long table": "[" + ".".join("a" * 50_000) + "]",
    "many digits": "schema = " + "9" * 5000,
    "no UTF-8": b"title = '\xff'",
    "zeros": bytes(1000),
    "huge": b"# " + b"x" * (LARGEST_BYTES + 1),
    "escape": f"title = {ESCAPES!r}",
}


@pytest.mark.parametrize("name", list(TOMLS))
@pytest.mark.parametrize("verb", ["check", "rig", "pipeline", "modes"])
def test_toml_that_is_no_description_is_one_line_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, verb: str
) -> None:
    content = TOMLS[name]
    file = tmp_path / "case" / "test.toml"
    file.parent.mkdir()
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    words = {
        "check": ["check", file.parent],
        "rig": ["model", "--rig", file],
        "pipeline": ["run", make_test(tmp_path / "raw"), "--pipeline", file, "--out", tmp_path / "out"],
        "modes": ["run", "--modes", file, "--rig", "planetary", "--out", tmp_path / "out"],
    }
    started = time.process_time()
    code, out, err = ema(capsys, *words[verb])
    assert time.process_time() - started < 5
    assert code == 1
    assert out == ""
    assert str(file) in one_line(err)


@pytest.mark.parametrize("special", ["fifo", "device", "folder"])
def test_a_description_that_is_no_plain_file_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], special: str
) -> None:
    file = tmp_path / "test.toml"
    if special == "fifo":
        os.mkfifo(file)
    elif special == "device":
        file.symlink_to("/dev/zero")
    else:
        file.mkdir()
    code, _, err = ema(capsys, "check", tmp_path)
    assert code == 1
    assert "not a" in one_line(err)


def test_a_key_with_many_dots_in_its_text_is_understood() -> None:
    assert parse_toml("x = [" + "1.5, " * 5000 + "]", "here")["x"][0] == 1.5
    with pytest.raises(EmaError, match="here: line 2 has a key"):
        parse_toml("a = 1\n" + ".".join("a" * 200) + " = 1", "here")


def test_a_toml_in_windows_encoding_with_mark_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbftitle = 'x'\r\n")
    assert read_toml(tmp_path / "a.toml") == {"title": "x"}


BAD_NAMES = [
    "../x",
    "a/b",
    "a\\b",
    "..",
    ".hidden",
    "",
    " ",
    "x ",
    "all",
    "ALL",
    "a\x1b[2J",
    "a\nb",
    "n" * 5000,
    "C:x",
]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_would_lead_elsewhere_are_refused(name: str) -> None:
    with pytest.raises(EmaError, match="configuration"):
        check_name(name, "configuration")


@pytest.mark.parametrize("name", ["no_ring", "mit Träger", "speed 1.5", "日本"])
def test_ordinary_names_are_taken(name: str) -> None:
    assert check_name(name, "configuration") == name


@pytest.mark.parametrize("name", BAD_NAMES[:8])
def test_a_configuration_that_is_a_path_is_refused_when_it_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    text = DESCRIPTION.replace(
        'title = "Beam"', f'title = "Beam"\nconfiguration = "{name}"'.replace("\\", "\\\\")
    )
    raw = make_test(tmp_path / "raw", text)
    code, _, err = ema(capsys, "check", raw)
    assert code == 1
    assert "configuration" in one_line(err)


def test_a_rig_whose_configuration_is_a_path_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'name = "r"\nconfigurations = ["../../evil", "b"]\n[[masses]]\nbody = "a"\nvalue = 1.0\n',
        encoding="utf-8",
    )
    code, _, err = ema(capsys, "simulate", tmp_path / "deep" / "raw", "--rig", rig)
    assert code == 1
    one_line(err)
    assert not (tmp_path / "evil").exists()


def test_a_file_name_that_no_file_can_have_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = make_test(tmp_path / "raw", file="n" * 5000)
    code, _, err = ema(capsys, "check", raw)
    assert code == 1
    assert "file of record 1" in one_line(err)
    raw = make_test(tmp_path / "raw2", file="n" * 900)
    code, _, err = ema(capsys, "check", raw)
    assert code == 1
    assert "no such file" in one_line(err)


@pytest.mark.parametrize("key", ["title", "channel", "file", "dataset"])
def test_control_sequences_never_reach_the_screen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    quoted = "".join(f"\\u{ord(c):04x}" for c in ESCAPES)
    changes = {
        "title": ("Beam", quoted),
        "channel": ('"tip"', f'"tip{quoted}"'),
        "file": ("{file}", f"a{quoted}"),
    }
    text = DESCRIPTION.replace(*changes[key]) if key in changes else DESCRIPTION
    raw = make_test(tmp_path / "raw", text, file="hit1.csv" if key != "dataset" else "hit1.h5")
    if key == "dataset":
        with h5py.File(raw / "hit1.h5", "w") as file:
            file["hammer"] = hammer_test()["hammer"]
            file[f"tip{ESCAPES}"] = hammer_test()["tip"]
    code, out, err = ema(capsys, "check", raw)
    assert code == 1
    shown = out + one_line(err)
    assert printable(shown) == shown
    assert "\\x1b" in shown


def test_a_folder_with_an_odd_name_does_not_steer_the_terminal(tmp_path: Path) -> None:
    raw = make_test(tmp_path / f"raw{ESCAPES[:8]}")
    done = subprocess.run(
        [sys.executable, "-m", "ema_pipeline.cli", "init", os.fsencode(raw)], capture_output=True, check=False
    )
    assert done.returncode == 1
    assert b"\x1b" not in done.stdout + done.stderr
    assert b"exists already" in done.stderr


def table(path: Path, hammer: np.ndarray, tip: np.ndarray) -> None:
    write_csv(path, {"hammer": hammer, "tip": tip}, with_time=False)


def load_scaled(folder: Path, sensitivity: float, tip: np.ndarray, rate: str = "2048") -> None:
    text = DESCRIPTION.replace('"m/s^2"\n', f'"m/s^2"\nsensitivity_mv = {sensitivity!r}\n')
    text = text.replace("sample_rate_hz = 2048", f"sample_rate_hz = {rate}")
    folder.mkdir()
    table(folder / "hit1.csv", hammer_test()["hammer"], tip)
    test = read_description(make_test(folder, text))
    load_record(test, test.records[0])


def test_a_value_that_overflows_when_scaled_is_one_line(tmp_path: Path) -> None:
    data = hammer_test()["tip"]
    with pytest.raises(EmaError, match=r"hit1\.csv: channel 'tip': .* beyond all measurement once scaled"):
        load_scaled(tmp_path / "raw", 1e-300, data * 1e-3)


def test_one_sample_of_ten_kilovolts_is_one_line(tmp_path: Path) -> None:
    data = hammer_test()["tip"] * 1e-3
    data[531] = 1e4
    with pytest.raises(EmaError, match=r"channel 'tip': 1e\+04 V at sample 531 .* more than any converter"):
        load_scaled(tmp_path / "raw", 10.0, data)


@pytest.mark.parametrize("rate", ["1e300", "1e-300", "inf", "nan", "0", "-5"])
def test_an_absurd_sample_rate_is_one_line(tmp_path: Path, rate: str) -> None:
    with pytest.raises(EmaError, match=r"sample.rate"):
        load_scaled(tmp_path / "raw", 10.0, hammer_test()["tip"] * 1e-3, rate)


@pytest.mark.parametrize("rate", [np.inf, 1e300, 1e-300, 1e-320])
@pytest.mark.parametrize("key", ["fs", "dt"])
def test_an_absurd_sample_rate_of_a_file_is_one_line(tmp_path: Path, rate: float, key: str) -> None:
    text = DESCRIPTION.replace("sample_rate_hz = 2048", "")
    raw = make_test(tmp_path / "raw", text, file="hit1.h5")
    with h5py.File(raw / "hit1.h5", "w") as file:
        file.attrs[key] = rate
        for name, samples in hammer_test().items():
            file[name] = samples
    test = read_description(raw)
    with pytest.raises(EmaError, match=r"hit1\.h5: .*(sample rate|time step)"):
        load_record(test, test.records[0])


def test_a_fault_of_the_program_writes_a_report_and_says_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("ema_pipeline.raw_folder.check_records", fail)
    code, out, err = ema(capsys, "check", tmp_path)
    assert code == 1
    assert out == ""
    assert err.count("\n") == 1
    assert "unexpected" not in err
    (report,) = tmp_path.glob("ema-crash-*.txt")
    assert str(report) in err
    content = report.read_text(encoding="utf-8")
    assert "ZeroDivisionError: a bug" in content
    assert "Traceback" in content
    assert report.stat().st_mode & 0o077 == 0


def test_a_full_disk_is_one_line_wherever_it_is_met(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "truth.json"))

    monkeypatch.setattr("ema_pipeline.raw_folder.check_records", fail)
    code, _, err = ema(capsys, "check", tmp_path)
    assert code == 1
    assert "truth.json: No space left on device" in one_line(err)


def test_a_full_disk_that_a_library_meets_is_no_fault_of_the_program(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """pyuff raises a bare Exception in its place."""

    def fail(*_: object) -> None:
        try:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            raise Exception("Error writing data-set #58")  # noqa: B904

    monkeypatch.setattr("ema_pipeline.raw_folder.check_records", fail)
    code, _, err = ema(capsys, "check", tmp_path)
    assert code == 1
    assert "No space left on device; check the disk's free space" in one_line(err)
