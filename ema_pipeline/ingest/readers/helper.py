"""The process that `apart` asks to read files: within limits of memory and time, and free to crash."""

from __future__ import annotations

import importlib
import json
import os
import sys
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.failures import words_of
from ema_pipeline.ingest.readers.raw import RawRecord, StoredSamples, held_open
from ema_pipeline.processes import die_with_parent

_SPARE_BYTES = 256_000_000
"""What libraries need beside the samples: their code, tables and buffers."""

_COPIES = 3
"""So often a reader holds the samples at once: as stored, as numbers, and cut into channels."""

_PIECE = 1 << 20

_LIBRARIES = {"hdf5": "h5py", "mat": "scipy.io", "tdms": "nptdms"}
"""What a reader imports; it must be there before the memory is limited."""


def main() -> None:
    """Answer requests, one per line on stdin, until there are none."""
    die_with_parent(os.getppid())
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not get among the answers
    for line in sys.stdin.buffer:
        request = json.loads(line)
        answer, record = _answer(request)
        answers.write(json.dumps(answer).encode() + b"\n")
        _send_samples(record, answers)
        answers.flush()


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], RawRecord | None]:
    path, limits = Path(request["path"]), ReadLimits(**request["limits"])
    reader = importlib.import_module(f"ema_pipeline.ingest.readers.{request['reader']}")
    importlib.import_module(_LIBRARIES[request["reader"]])
    try:
        _restrain(limits.unpacked_bytes(path.stat().st_size), float(request["seconds"]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            record: RawRecord = reader.read(path, limits)
        _try_stored(record)
    except EmaError as error:
        return {"error": str(error)}, None
    except MemoryError:
        return {
            "error": "takes more memory to read than a file of its size should: it is damaged or a trap; "
            "export it again, or allow it with --set ingest.unpack_ratio"
        }, None
    except Exception as error:  # readers raise anything on damaged files
        return {"failure": words_of(error)}, None
    return _described(record), record


def _restrain(unpacked_bytes: int, seconds: float) -> None:
    """Limit memory and processor time of this process, where the system can."""
    try:
        import resource
    except ImportError:
        return
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        return
    memory = pages * resource.getpagesize() + _SPARE_BYTES + _COPIES * unpacked_bytes
    _lower(resource.RLIMIT_AS, memory)
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = used.ru_utime + used.ru_stime
    _lower(resource.RLIMIT_CPU, int(spent + seconds) + 1)


def _lower(what: int, limit: int) -> None:
    """Set a limit for the next file, within those that the user's own system sets."""
    import resource

    _, most = resource.getrlimit(what)
    limit = limit if most == resource.RLIM_INFINITY else min(limit, most)
    resource.setrlimit(what, (limit, most))


def _try_stored(record: RawRecord) -> None:
    """Read what the caller will read itself later, so that it is this process that crashes if any does."""
    stored = [c.samples for c in record.channels.values() if isinstance(c.samples, StoredSamples)]
    if not stored:
        return
    with held_open(stored[0]):
        for samples in stored:
            for start in range(0, samples.size, _PIECE):
                samples[start : start + _PIECE]


def _described(record: RawRecord) -> dict[str, Any]:
    return {
        "channels": [
            {
                "name": name,
                "unit": c.unit,
                "dof": c.dof,
                "size": c.samples.size,
                "stored": c.samples.name if isinstance(c.samples, StoredSamples) else None,
            }
            for name, c in record.channels.items()
        ],
        "sample_rate_hz": record.sample_rate_hz,
        "notes": record.notes,
        "rate_tolerance": record.rate_tolerance,
        "seconds_assumed": record.seconds_assumed,
    }


def _send_samples(record: RawRecord | None, answers: BinaryIO) -> None:
    for channel in record.channels.values() if record is not None else ():
        if not isinstance(channel.samples, StoredSamples):
            answers.write(np.ascontiguousarray(channel.samples, dtype=np.float64).data)
