"""Circle fit: modes one at a time from Nyquist circles, independent of the pole estimators."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.modal.circle.compare import CircleAverage, attach_circles, average
    from ema_pipeline.modal.circle.fit import SdofCircle, fit_circle
    from ema_pipeline.modal.circle.identify import identify_by_circle
    from ema_pipeline.modal.circle.modes import circle_fits, on_circle
    from ema_pipeline.modal.circle.settings import CircleSettings
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "CircleAverage": "compare",
            "attach_circles": "compare",
            "average": "compare",
            "SdofCircle": "fit",
            "fit_circle": "fit",
            "identify_by_circle": "identify",
            "circle_fits": "modes",
            "on_circle": "modes",
            "CircleSettings": "settings",
        },
    )

__all__ = [
    "CircleAverage",
    "CircleSettings",
    "SdofCircle",
    "attach_circles",
    "average",
    "circle_fits",
    "fit_circle",
    "identify_by_circle",
    "on_circle",
]
