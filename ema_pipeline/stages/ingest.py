"""Raw folder → records in SI units."""

from __future__ import annotations

import json

from ema_pipeline.ingest.load import transducers_of
from ema_pipeline.kinds import kind_of
from ema_pipeline.run.sources import file_hashes, tests_of
from ema_pipeline.run.types import Progress, Run

NAME = "ingest"
NEEDS: tuple[str, ...] = ()
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Hashes of the description and of every record file."""
    return json.dumps(_hashes(run, configuration))


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Read every record, check it against the description, and scale it to SI."""
    tests = tests_of(run, configuration)
    return {
        "sources": _hashes(run, configuration),
        "title": tests[0].title,
        "transducers": transducers_of(tests),
        **kind_of(run.info).read(run, configuration, progress),
    }


def _hashes(run: Run, configuration: str) -> dict[str, str]:
    """As `file_hashes`; every file is read for them once in a run."""
    at = ("file hashes", configuration)
    if at not in run.memory:
        run.memory[at] = file_hashes(*tests_of(run, configuration))
    return dict(run.memory[at])
