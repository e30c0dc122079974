"""No file, however it is made, crashes a reader, hangs it, fills the memory, or is taken for a record."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from hostile_files import SIGNAL, TRAPS

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers import apart, helper, read_raw
from ema_pipeline.ingest.readers.apart import read_apart

SECONDS, MEGABYTES = 10.0, 500.0
"""What any trap may take: time of this process (its helper has a limit of its own), memory of each of the two."""

READER = """
import json, os, sys, time
from pathlib import Path
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.readers import apart, helper, read_raw

def told(path):
    try:
        read_raw(path)
        said = "read"
    except EmaError as error:
        said = str(error)
    seconds, used = time.process_time(), 0.0
    helper = apart._running
    for process in ["self"] if helper is None else ["self", str(helper._process.pid)]:
        status = Path(f"/proc/{process}/status").read_text()
        used = max(used, int(status.partition("VmHWM:")[2].split()[0]) / 1e3) if "VmHWM" in status else used
    if helper is not None:
        helper.close()
    return seconds, used, said

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        print(json.dumps(told(Path(json.loads(line)))), flush=True)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    if status:
        print(json.dumps([0.0, 0.0, f"crashed: {status}\\n"]), flush=True)
"""
"""Reads every file that it is told in a process of its own, a copy of one in which the readers are loaded."""

MAY_BE_READ = {"many_lines.csv"}
"""Large, but what they say."""


@pytest.fixture(scope="module")
def reader() -> Iterator[Callable[[Path], tuple[float, float, str]]]:
    """Reads a file as `READER` does: processor time in s, most memory in MB, what was said."""
    with subprocess.Popen(
        [sys.executable, "-c", READER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        asked, answers = process.stdin, process.stdout
        assert asked is not None
        assert answers is not None

        def read(path: Path) -> tuple[float, float, str]:
            asked.write(json.dumps(str(path)) + "\n")
            asked.flush()
            seconds, megabytes, said = json.loads(answers.readline())
            return seconds, megabytes, said

        yield read
        asked.close()


@pytest.mark.parametrize("name", list(TRAPS))
def test_a_trap_is_refused_in_one_line_fast_and_without_filling_the_memory(
    tmp_path: Path, reader: Callable[[Path], tuple[float, float, str]], name: str
) -> None:
    path = tmp_path / name
    TRAPS[name](path)
    seconds, megabytes, said = reader(path)
    assert "\n" not in said
    assert said == "read" if name in MAY_BE_READ else str(path) in said
    assert "unexpected" not in said
    assert seconds < SECONDS
    assert 1.0 < megabytes < MEGABYTES


def test_a_helper_that_dies_harms_only_the_file_it_read(tmp_path: Path) -> None:
    path = tmp_path / "good.h5"
    with h5py.File(path, "w") as file:
        file["hammer"] = SIGNAL
    with pytest.raises(EmaError, match="crashes the library that reads it"):
        read_apart("no_reader", path, ReadLimits())
    assert read_raw(path).channels
    apart._helper().close()
    assert read_raw(path).channels


def test_a_limit_is_a_setting(tmp_path: Path) -> None:
    path = tmp_path / "zeros.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("hammer", data=np.zeros(10_000_000), chunks=True, compression="gzip")
    with pytest.raises(EmaError, match=r"--set ingest\.unpack_ratio"):
        read_raw(path)
    assert read_raw(path, ReadLimits(unpack_ratio=2000)).channels["hammer"].samples.size == 10_000_000
    with pytest.raises(EmaError, match=r"--set ingest\.largest_mb"):
        read_raw(path, ReadLimits(largest_mb=0.01))


def test_the_helper_may_use_what_it_has_its_spare_and_three_copies_of_the_samples(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    resource = pytest.importorskip("resource", reason="limits of a process exist on Unix only")
    if not Path("/proc/self/statm").exists():
        pytest.skip("the memory of a process is read from /proc")
    limits: dict[int, int] = {}
    monkeypatch.setattr(helper, "_lower", lambda what, limit: limits.update({what: limit}))
    helper._restrain(1_000_000_000, 7.0)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    assert limits[resource.RLIMIT_AS] == pytest.approx(used + 256e6 + 3e9, abs=50e6)
    spent = resource.getrusage(resource.RUSAGE_SELF)
    assert limits[resource.RLIMIT_CPU] - (spent.ru_utime + spent.ru_stime) == pytest.approx(8, abs=1.1)
