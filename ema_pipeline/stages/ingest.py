"""Raw folder → records in SI units."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import TestDescription, read_campaign
from ema_pipeline.ingest.load import load_record
from ema_pipeline.ingest.records import Record
from ema_pipeline.stages.base import Progress, Run

NAME = "ingest"
NEEDS: tuple[str, ...] = ()
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Hashes of the description and of every record file."""
    return json.dumps(file_hashes(_test(run, configuration)))


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Read every record, check it against the description, and scale it to SI."""
    test = _test(run, configuration)
    return {
        "sources": file_hashes(test),
        "title": test.title,
        "records": read_records(test, progress),
    }


def read_records(test: TestDescription, progress: Progress) -> Iterator[Record]:
    """Records of one test, one after the other; all must have one sample rate."""
    rate = None
    for index, entry in enumerate(test.records):
        progress(index / len(test.records), entry.file)
        record = load_record(test, entry)
        if rate is not None and abs(record.sample_rate_hz / rate - 1) > 1e-4:
            raise EmaError(
                f"{test.path_of(entry)}: is sampled at {record.sample_rate_hz:g} Hz but "
                f"{test.records[0].file} at {rate:g} Hz; put them into folders of their own"
            )
        rate = rate or record.sample_rate_hz
        yield record


def file_hashes(test: TestDescription) -> dict[str, str]:
    """SHA-256 of the description and of every record file, by file name."""
    files = [test.file, *(test.path_of(entry) for entry in test.records)]
    return {str(path.relative_to(test.folder)): _sha256(path) for path in files}


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({error.strerror})") from None


def _test(run: Run, configuration: str) -> TestDescription:
    tests = read_campaign(Path(run.info.raw)).tests
    return next(t for t in tests if (t.configuration or run.info.configurations[0]) == configuration)
