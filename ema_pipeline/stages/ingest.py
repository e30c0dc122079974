"""Raw folder → records in SI units."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar, cast

from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.description import ChannelDescription, TestDescription
from ema_pipeline.ingest.driven import DrivenRecord, load_driven
from ema_pipeline.ingest.limits import ReadLimits
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import Record, Transducer
from ema_pipeline.stages.base import Progress, Run, file_hash
from ema_pipeline.store import Store

R = TypeVar("R", Record, DrivenRecord)

NAME = "ingest"
DRIVEN = "driven"
NEEDS: tuple[str, ...] = ()
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Hashes of the description and of every record file."""
    return json.dumps(_hashes(run, configuration))


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Read every record, check it against the description, and scale it to SI."""
    tests = tests_of(run, configuration)
    test = tests[0]
    limits = cast(ReadLimits, run.settings[NAME])
    common: dict[str, object] = {
        "sources": _hashes(run, configuration),
        "title": test.title,
        "transducers": tuple({repr(x): x for t in tests for x in map(_transducer, t.channels)}.values()),
    }
    if test.kind == "continuous":
        return common | {
            DRIVEN: tuple(_with_progress(load_driven(test, limits), len(test.records), progress))
        }
    count = sum(len(t.records) for t in tests)
    return common | {"records": _with_progress(load_records(*tests, limits=limits), count, progress)}


def driven_records(store: Store, configuration: str) -> tuple[DrivenRecord, ...]:
    """Records of a continuous test of one configuration."""
    return store.load(NAME, configuration, DRIVEN, tuple[DrivenRecord, ...])


def _transducer(channel: ChannelDescription) -> Transducer:
    return Transducer(
        channel.name,
        channel.quantity,
        channel.unit,
        "" if channel.dof is None else str(channel.dof),
        float("nan") if channel.sensitivity_mv is None else channel.sensitivity_mv,
        channel.sensor_mass_kg,
        channel.calibration_std,
        channel.transverse,
    )


def _with_progress(records: Iterator[R], count: int, progress: Progress) -> Iterator[R]:
    for index, record in enumerate(records):
        progress(index / count, record.file)
        yield record


def _hashes(run: Run, configuration: str) -> dict[str, str]:
    """As `file_hashes`; every file is read for them once in a run."""
    at = ("file hashes", configuration)
    if at not in run.memory:
        run.memory[at] = file_hashes(*tests_of(run, configuration))
    return dict(run.memory[at])


def file_hashes(*tests: TestDescription) -> dict[str, str]:
    """SHA-256 of the description and of every record file, by file name; ``part/file`` in tests of several parts."""
    return {
        str(Path(test.part) / path.relative_to(test.folder)): file_hash(path)
        for test in tests
        for path in (test.file, *(test.path_of(entry) for entry in test.records))
    }


def tests_of(run: Run, configuration: str) -> tuple[TestDescription, ...]:
    """Descriptions of the test of one configuration: one, or one per part."""
    tests = read_campaign(Path(run.info.raw)).tests
    return tuple(t for t in tests if (t.configuration or run.info.configurations[0]) == configuration)


def test_of(run: Run, configuration: str) -> TestDescription:
    """Description of the test of one configuration that has no parts."""
    return tests_of(run, configuration)[0]
