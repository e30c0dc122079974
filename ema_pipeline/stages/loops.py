"""Force-displacement loops → stiffness, damping and hysteresis of an isolator."""

from __future__ import annotations

import json

from ema_pipeline.run.sources import file_hashes, test_of
from ema_pipeline.run.types import Progress, Run

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
    result = analyse_loops(test, run.settings.loops, progress)
    return {"sources": file_hashes(test), "isolator": result}
