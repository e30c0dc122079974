"""Sample rates from time columns and from rounded steps."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.units import find_unit

_TIME_NAME = re.compile(
    r"(time|t|zeit|temps|tiempo|x_value|timestamp|seconds?|secs?)"
    r"([ _-]*[\[(]?(s|ms|us|µs|secs?|seconds?|axis|vector|stamps?|data|values?|channel)[\])]?)?",
    re.IGNORECASE,
)
_INDEX_NAME = re.compile(
    r"(index|samples?|no\.?|nr\.?|n|#|points?|scans?)([ _-]?(no\.?|nr\.?|number|index))?", re.IGNORECASE
)


_SHORTEST_STEP = 1e-300
"""s; one divided by less is no number."""


def is_time_name(name: str) -> bool:
    """True for the usual names of a time column."""
    return _TIME_NAME.fullmatch(name.strip()) is not None


def is_index_name(name: str) -> bool:
    """True for the usual names of a running sample number."""
    return _INDEX_NAME.fullmatch(name.strip()) is not None


def is_uniform_ramp(values: NDArray[np.float64]) -> bool:
    """True where `values` (n,) rise in equal steps, as a time axis does and no measured signal can."""
    if values.size < 3 or not np.all(np.isfinite(values)):
        return False
    step = (values[-1] - values[0]) / (values.size - 1)
    if step <= 0:
        return False
    line = values[0] + step * np.arange(values.size)
    return bool(np.all(np.diff(values) > 0) and np.max(np.abs(values - line)) < 0.1 * step)


def time_unit_scale(name: str, unit: str | None) -> float:
    """Seconds per unit of a time column, from its unit or its name (``time_ms``); seconds where silent."""
    for label in (unit, re.split(r"[ _-]", name.strip())[-1]):
        found = find_unit(label) if label else None
        if found is not None and found.quantity == "time":
            return found.scale
    return 1.0


def rate_from_times(times: NDArray[np.float64]) -> float | None:
    """Sample rate of a time axis (n,) in seconds.

    Times may be rounded, even to more than one sample; then the axis is too coarse and None is returned.

    Raises
    ------
    EmaError
        Where time does not rise, or jumps (lost samples).
    """
    if times.size < 3:
        return None
    if not np.all(np.isfinite(times)):
        raise EmaError(f"time is not a number at sample {int(np.argmin(np.isfinite(times)))}; export again")
    steps = np.diff(times)
    span = times[-1] - times[0]
    mean = span / (times.size - 1)
    if mean <= 0 or np.any(steps < 0):
        raise EmaError(f"time runs backwards at sample {int(np.argmax(steps <= 0)) + 1}; export again")
    if np.any(steps == 0):
        return None
    step = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - step)))
    if abs(steps[worst] - step) > 0.5 * step:
        raise EmaError(
            f"time jumps by {steps[worst]:.6g} s at sample {worst + 1} where {step:.6g} s is the step: "
            "samples are missing; export the record again without gaps"
        )
    return whole_rate(mean, max(1e-9, time_rounding(times)))


def time_rounding(times: NDArray[np.float64]) -> float:
    """Relative uncertainty of the rate of a time axis (n,) whose values were rounded when written.

    Rounding scatters each step; over the whole span it all but vanishes, unless the record is short.
    """
    if times.size < 3 or times[-1] <= times[0]:
        return 0.0
    steps = np.diff(times)
    return float(np.max(np.abs(steps - np.median(steps))) / (times[-1] - times[0]))


def whole_rate(step: float, relative_rounding: float) -> float:
    """Sample rate of a time step that was rounded: the whole number of Hz that it rounds from, if any.

    Parameters
    ----------
    step : float
        Seconds.
    relative_rounding : float
        Relative size of the rounding error of `step`.
    """
    rate = 1.0 / step if step >= _SHORTEST_STEP else math.inf
    if not math.isfinite(rate) or rate <= 0:
        raise EmaError(f"states a time step of {step:.4g} s, which no recorder has; correct the file")
    whole = round(rate)
    return float(whole) if whole > 0 and abs(rate / whole - 1) <= relative_rounding else float(rate)
