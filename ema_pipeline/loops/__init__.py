"""Force-displacement loops → stiffness, viscous damping and hysteresis of an isolator."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.loops.diagnosis import diagnose_loops
    from ema_pipeline.loops.extract import measure_loop
    from ema_pipeline.loops.identify import identify_isolator
    from ema_pipeline.loops.ladder import make_loop_ladder
    from ema_pipeline.loops.settings import HysteresisSettings
    from ema_pipeline.loops.stage import analyse_hysteresis
    from ema_pipeline.loops.types import IsolatorResult, Loop
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "diagnose_loops": "diagnosis",
            "identify_isolator": "identify",
            "make_loop_ladder": "ladder",
            "measure_loop": "extract",
            "HysteresisSettings": "settings",
            "analyse_hysteresis": "stage",
            "IsolatorResult": "types",
            "Loop": "types",
        },
    )

__all__ = [
    "HysteresisSettings",
    "IsolatorResult",
    "Loop",
    "analyse_hysteresis",
    "diagnose_loops",
    "identify_isolator",
    "make_loop_ladder",
    "measure_loop",
]
