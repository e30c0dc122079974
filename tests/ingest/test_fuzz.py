"""Whatever happens to a file, reading it ends with a record or with one clear line.

The normal suite tries some hundred damaged files. ``EMA_FUZZ=20 pytest tests/ingest/test_fuzz.py`` tries twenty
times as many, and ``EMA_FUZZ_SEED=7`` other ones. A file that once found a fault is kept in
``tests/ingest/fuzz_corpus`` and tried in every run.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from fuzz_seeds import tomls, write_records
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from ingest_example import hammer_test, write_csv

from ema_pipeline.describe import checked_rig, describe_modes
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import read_description
from ema_pipeline.ingest.load import load_record
from ema_pipeline.ingest.readers import read_raw
from ema_pipeline.plain_text import printable
from ema_pipeline.run.settings import load_pipeline

TIMES = int(os.environ.get("EMA_FUZZ", "1"))
SEED = int(os.environ.get("EMA_FUZZ_SEED", "1"))
SECONDS = 10.0
ROOT = Path(__file__).parents[2]
CORPUS = Path(__file__).parent / "fuzz_corpus"
RECORDS = (
    "a.csv", "a.csv.gz", "a.lvm", "a.tdms", "ascii.uff", "binary.uff", "blanks.txt", "float.wav", "new.h5",
    "newer.mat", "old.h5", "packed.mat", "plain.mat", "whole.wav",
)  # fmt: skip
TOMLS = ("test", "rig", "elements", "modes", "table", "pipeline")

fuzzed = settings(
    max_examples=20 * TIMES,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return write_records(tmp_path_factory.mktemp("records"))


@cache
def texts() -> dict[str, str]:
    return tomls(ROOT / "docs")


# --- what can happen to a file ----------------------------------------------------------------------------

WORDS = [
    bytes(4),
    b"\xff" * 4,
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\x01\x00\x00\x00",
    b"\x00" * 8,
    b"\xff" * 8,
]
WORDS += [
    b"\x00\x00\x00\x00\x00\x00\xf0\x7f",
    b"1e999",
    b"nan",
    b"-",
    b"9" * 40,
    b"\n",
    b"\r",
    b"\x1b[2J",
    b'"',
    b"    -1\n",
]

place = st.floats(0, 1, exclude_max=True)
edits = st.lists(
    st.tuples(
        st.sampled_from(["put", "put", "put", "insert", "cut", "repeat", "stop"]),
        # most formats say what they are in their first bytes
        st.one_of(place, place.map(lambda x: x**4)),
        st.one_of(st.binary(min_size=1, max_size=8), st.sampled_from(WORDS)),
    ),
    min_size=1,
    max_size=8,
)


def damaged(content: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    """The content after each of the changes, one after the other."""
    for what, share, word in changes:
        at = int(share * len(content))
        if what == "put":
            content = content[:at] + word + content[at + len(word) :]
        elif what == "insert":
            content = content[:at] + word + content[at:]
        elif what == "cut":
            content = content[:at] + content[at + 16 * len(word) :]
        elif what == "repeat":
            content = content[:at] + content[max(0, at - 64 * len(word)) :]
        else:
            content = content[: max(at, 1)]
    return content


VALUES = ["-1", "0", "1e999", "nan", "inf", "1e308", "9" * 400, '""', '"\\u001b[2J"', '"../x"', '"' + "n" * 3000 + '"',
          "[]", "{}", "[[]]", "true", "1979-05-27", "07:32:00", '"sun.x"', "{a = {b = 1}}", "[1, 'a', {}]"]  # fmt: skip
token = re.compile(r'"[^"\n]*"|[-+.\w]+')
toml_edits = st.lists(
    st.tuples(
        st.sampled_from(["value", "value", "value", "drop", "repeat", "swap", "text"]),
        place,
        st.one_of(
            st.sampled_from(VALUES), st.text(max_size=12), st.integers().map(str), st.floats().map(str)
        ),
        place,
    ),
    min_size=1,
    max_size=4,
)


def changed(text: str, changes: list[tuple[str, float, str, float]]) -> str:
    """The text after each of the changes: values replaced, lines dropped, repeated or swapped."""
    for what, share, value, other in changes:
        lines = text.splitlines(keepends=True) or [""]
        line, second = int(share * len(lines)), int(other * len(lines))
        if what == "value":
            tokens = list(token.finditer(text))
            if tokens:
                found = tokens[int(share * len(tokens))]
                text = text[: found.start()] + value + text[found.end() :]
            continue
        if what == "drop":
            del lines[line]
        elif what == "repeat":
            lines.insert(line, lines[line])
        elif what == "swap":
            lines[line], lines[second] = lines[second], lines[line]
        else:
            lines.insert(line, value)
        text = "".join(lines)
    return text


# --- what must be true of every outcome -------------------------------------------------------------------


def outcome(read: Callable[[], object]) -> str:
    """What is said; empty where the file was read. Any other exception escapes and fails the test."""
    started = time.process_time()
    try:
        read()
        said = ""
    except EmaError as error:
        said = str(error)
    assert time.process_time() - started < SECONDS
    assert "\n" not in said
    assert printable(said) == said
    assert "unexpected" not in said
    return said


def read_record(path: Path) -> None:
    """Read all that is in a file, as a description that fits would have it."""
    raw = read_raw(path)
    for channel in raw.channels.values():
        assert channel.samples[:].size == channel.samples.size


def load_as_described(folder: Path, name: str) -> None:
    """Load a file as the record of a test."""
    text = texts()["test"].replace("hit1.csv", name).replace("sample_rate_hz = 2048\n", "")
    (folder / "test.toml").write_text(text, encoding="utf-8")
    test = read_description(folder)
    record = load_record(test, test.records[0])
    assert record.responses[:].shape[1] == record.force.size


def read_toml_of(kind: str, path: Path) -> None:
    """Read a TOML file as what it is meant to be."""
    if kind == "test":
        read_description(path.parent)
    elif kind in ("rig", "elements"):
        checked_rig(str(path))
    elif kind in ("modes", "table"):
        describe_modes(path, "planetary", None, ())
    else:
        load_pipeline(str(path))


@pytest.mark.parametrize("name", RECORDS)
def test_a_damaged_record_is_read_or_refused_in_one_line(
    tmp_path: Path, records: dict[str, bytes], name: str
) -> None:
    assert outcome(lambda: read_record(_write(tmp_path / name, records[name]))) == ""

    @seed(SEED)
    @fuzzed
    @given(edits)
    def check(changes: list[tuple[str, float, bytes]]) -> None:
        path = _write(tmp_path / name, damaged(records[name], changes))
        if outcome(lambda: read_record(path)) == "":
            outcome(lambda: load_as_described(tmp_path, name))

    check()


@pytest.mark.parametrize("kind", TOMLS)
def test_a_changed_toml_is_understood_or_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    write_csv(tmp_path / "hit1.csv", hammer_test())
    path = tmp_path / _file_of(kind)
    assert outcome(lambda: read_toml_of(kind, _write(path, texts()[kind].encode()))) == ""

    @seed(SEED)
    @fuzzed
    @given(toml_edits)
    def check(changes: list[tuple[str, float, str, float]]) -> None:
        content = changed(texts()[kind], changes).encode("utf-8", errors="surrogatepass")
        outcome(lambda: read_toml_of(kind, _write(path, content)))

    check()


@pytest.mark.parametrize("kept", sorted(p.name for p in CORPUS.iterdir() if p.name != "README.md"))
def test_what_once_found_a_fault_finds_none_any_more(tmp_path: Path, kept: str) -> None:
    kind = kept.partition("-")[0]
    path = _write(tmp_path / kept, (CORPUS / kept).read_bytes())
    if kind in TOMLS:
        write_csv(tmp_path / "hit1.csv", hammer_test())
        path = path.rename(tmp_path / _file_of(kind))
        outcome(lambda: read_toml_of(kind, path))
    elif outcome(lambda: read_record(path)) == "":
        outcome(lambda: load_as_described(tmp_path, kept))


def _file_of(kind: str) -> str:
    return "table.csv" if kind == "table" else f"{kind}.toml"


def _write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path
