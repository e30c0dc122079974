"""Circle fit: modes one at a time from Nyquist circles, independent of the pole estimators."""

from ema_pipeline.modal.circle.compare import CircleAverage, attach_circles, average
from ema_pipeline.modal.circle.fit import SdofCircle, fit_circle
from ema_pipeline.modal.circle.identify import identify_by_circle
from ema_pipeline.modal.circle.modes import circle_fits
from ema_pipeline.modal.circle.settings import CircleSettings

__all__ = [
    "CircleAverage",
    "CircleSettings",
    "SdofCircle",
    "attach_circles",
    "average",
    "circle_fits",
    "fit_circle",
    "identify_by_circle",
]
