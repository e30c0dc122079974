"""The raw folder of a run: descriptions of its tests, and hashes of their files."""

from __future__ import annotations

from pathlib import Path

from ema_pipeline.files import file_hash
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.run.types import Run


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
