"""Force-displacement loops → stiffness, viscous damping and hysteresis of an isolator."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.loops.extract import measure_loop
    from ema_pipeline.loops.identify import identify_isolator
    from ema_pipeline.loops.read import analyse_loops
    from ema_pipeline.loops.settings import LoopSettings
    from ema_pipeline.loops.types import IsolatorResult, Loop
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "measure_loop": "extract",
            "identify_isolator": "identify",
            "analyse_loops": "read",
            "LoopSettings": "settings",
            "IsolatorResult": "types",
            "Loop": "types",
        },
    )

__all__ = [
    "IsolatorResult",
    "Loop",
    "LoopSettings",
    "analyse_loops",
    "identify_isolator",
    "measure_loop",
]
