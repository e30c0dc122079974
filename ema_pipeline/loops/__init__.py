"""Force-displacement loops, measured: extraction, energy, closed-form estimates."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.loops.extract import measure_loop
    from ema_pipeline.loops.settings import LoopSettings
    from ema_pipeline.loops.types import IsolatorResult, Loop
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "measure_loop": "extract",
            "LoopSettings": "settings",
            "IsolatorResult": "types",
            "Loop": "types",
        },
    )

__all__ = [
    "IsolatorResult",
    "Loop",
    "LoopSettings",
    "measure_loop",
]
