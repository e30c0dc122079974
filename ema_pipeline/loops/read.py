"""From a test description with ``kind = "hysteresis"`` to averaged loops."""

from __future__ import annotations

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.ingest.load import load_channels
from ema_pipeline.loops.extract import measure_loop, share_noise
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import Loop


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
