"""Force-displacement loops → stiffness, damping and hysteresis of an isolator."""

from __future__ import annotations

import json
from typing import cast

from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.ingest import file_hashes, test_of

NAME = "loops"
NEEDS: tuple[str, ...] = ()
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Hashes of the description and of every record file."""
    return json.dumps(file_hashes(test_of(run, configuration)))


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Measure the loops and identify the isolator that makes them."""
    from ema_pipeline.fit.isolator import analyse_loops

    test = test_of(run, configuration)
    result = analyse_loops(test, cast(LoopSettings, run.settings[NAME]), progress)
    return {"sources": file_hashes(test), "isolator": result}
