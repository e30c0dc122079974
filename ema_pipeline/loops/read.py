"""From a test description with ``kind = "hysteresis"`` to an identified isolator."""

from __future__ import annotations

from collections.abc import Callable

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.ingest.load import load_channels
from ema_pipeline.loops.extract import measure_loop, share_noise
from ema_pipeline.loops.identify import identify_isolator
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import IsolatorResult, Loop


def analyse_loops(
    test: TestDescription,
    settings: LoopSettings | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> IsolatorResult:
    """Read all records of a hysteresis test and identify the isolator.

    Raises
    ------
    EmaError
        Names file, channel or record and what is wrong with it.
    """
    tell = progress or (lambda share, text: None)
    loops = load_loops(test, settings)
    tell(0.3, "the published model on all loops")
    return identify_isolator(loops, settings)


def load_loops(test: TestDescription, settings: LoopSettings | None = None) -> tuple[Loop, ...]:
    """Averaged loops of all records."""
    if test.kind != "hysteresis":
        raise EmaError(f'{test.file}: is a hammer test; loops need kind = "hysteresis"')
    displacement = next(c for c in test.responses if c.quantity == "displacement")
    loops = []
    for record in test.records:
        data = load_channels(test, record)
        assert record.frequency_hz is not None  # checked with the description
        try:
            loop = measure_loop(
                data.samples[displacement.name],
                data.samples[test.force.name],
                data.sample_rate_hz,
                record.frequency_hz,
                record.amplitude_m,
                name=record.file,
                settings=settings,
            )
        except EmaError as error:
            raise EmaError(f"{test.path_of(record).parent}/{error}") from None
        loops.append(loop)
    return share_noise(loops)
