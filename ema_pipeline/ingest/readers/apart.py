"""Reading in a process apart: a file made to crash or flood the library that reads it harms nothing but that process.

One helper process serves all files of a run. Arrays come back as plain bytes, the rest as JSON; nothing is
unpickled.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
from io import BufferedReader
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord, StoredFile, StoredSamples

SECONDS = 8.0
"""Processor time for any file; ordinary ones take a fraction of a second."""

SECONDS_PER_MB = 0.1
"""And for each MB of it: ten times what compressed files take."""

_WALL_SECONDS = 10
"""A busy machine or slow network drive may stretch the processor's time so many times."""

_LARGEST_HEADER = 50_000_000

_START = "import sys; sys.path[:] = {path!r}; from ema_pipeline.ingest.readers.helper import main; main()"


def read_apart(reader: str, path: Path, limits: ReadLimits) -> RawRecord:
    """Read a file by the reader of that module name in the helper process.

    Raises
    ------
    EmaError
        As the reader says, and where the helper crashed, took too long or ran out of memory.
    RuntimeError
        Anything else that the reader raised.
    """
    with _LOCK:
        return _helper().read(reader, path, limits)


class _Helper:
    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        self._late = False

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def read(self, reader: str, path: Path, limits: ReadLimits) -> RawRecord:
        seconds = SECONDS + SECONDS_PER_MB * path.stat().st_size / 1e6
        request = {
            "reader": reader,
            "path": str(path.resolve()),
            "limits": limits.model_dump(),
            "seconds": seconds,
        }
        watch = threading.Timer(_WALL_SECONDS * seconds, self._too_late)
        watch.start()
        try:
            answer = self._ask(json.dumps(request).encode() + b"\n")
            return self._record(answer, path)
        except (EmaError, RuntimeError):
            raise
        except (OSError, EOFError):
            raise self._death(seconds) from None
        except BaseException:  # interrupted: the rest of the answer must not be taken for the next one
            self._process.kill()
            raise
        finally:
            watch.cancel()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()

    def _too_late(self) -> None:
        self._late = True
        self._process.kill()

    def _ask(self, request: bytes) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(request)
        self._process.stdin.flush()
        line = self._process.stdout.readline(_LARGEST_HEADER)
        if not line.endswith(b"\n"):
            raise EOFError
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise EmaError(answer["error"])
        if "failure" in answer:
            raise RuntimeError(answer["failure"])
        return answer

    def _record(self, answer: dict[str, Any], path: Path) -> RawRecord:
        channels, file = {}, StoredFile(path)
        for channel in answer["channels"]:
            size, stored = int(channel["size"]), channel["stored"]
            samples = self._samples(size) if stored is None else StoredSamples(file, stored, size)
            channels[channel["name"]] = RawChannel(samples, channel["unit"], channel["dof"])
        rate = answer["sample_rate_hz"]
        notes, assumed = tuple(answer["notes"]), bool(answer["seconds_assumed"])
        return RawRecord(channels, rate, notes, answer["rate_tolerance"], assumed)

    def _samples(self, size: int) -> NDArray[np.float64]:
        answers = cast(BufferedReader, self._process.stdout)
        samples = np.empty(size)
        left = samples.data.cast("B") if size else memoryview(b"")
        while left.nbytes:
            count = answers.readinto(left)
            if not count:
                raise EOFError
            left = left[count:]
        return samples

    def _death(self, seconds: float) -> EmaError:
        code = self._process.wait()
        if self._late or code == -int(getattr(signal, "SIGXCPU", 0) or 0):
            return EmaError(
                f"takes more than {seconds:.0f} s to read: it is damaged or a trap; copy or export it again"
            )
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return EmaError(
            f"crashes the library that reads it ({how}): it is damaged or a trap; copy or export it again"
        )


_LOCK = threading.Lock()
_running: _Helper | None = None


def _helper() -> _Helper:
    """The helper process, started anew where it has died."""
    global _running
    if _running is None:
        atexit.register(end_helper)
    elif not _running.is_alive():
        _running.close()
        _running = None
    if _running is None:
        _running = _Helper()
    return _running


def end_helper() -> None:
    """End the helper process, which takes 30 MB; the next file starts another."""
    global _running
    with _LOCK:
        if _running is not None:
            _running.close()
            _running = None
            atexit.unregister(end_helper)
