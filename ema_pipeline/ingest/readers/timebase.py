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

_FEWEST_STAMPS = 6
"""Different time stamps; fewer show no pattern."""

_UNEVEN = 1.5
"""Boards that stamp whole blocks of samples do not stamp them quite evenly: this many times the usual is no fault."""


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


def time_unit_scale(name: str, unit: str | None) -> float | None:
    """Seconds per unit of a time column, from its unit or its name (``time_ms``); None where silent."""
    for label in (unit, re.split(r"[ _-]", name.strip())[-1]):
        found = find_unit(label) if label else None
        if found is not None and found.quantity == "time":
            return found.scale
    return None


def rate_from_times(times: NDArray[np.float64]) -> tuple[float | None, float]:
    """Sample rate of a time axis (n,) in seconds, and the relative uncertainty that rounding leaves it.

    Times may be rounded, even to more than one sample. That scatters each step; over the whole span it all but
    vanishes, unless the record is short or the rounding coarse.

    Returns
    -------
    rate_hz : float or None
        None where the times are too few or too coarse to tell it.
    uncertainty : float

    Raises
    ------
    EmaError
        Where time does not rise, jumps (lost samples) or stands (repeated ones).
    """
    if times.size < 3:
        return None, 0.0
    if not np.all(np.isfinite(times)):
        raise EmaError(f"time is not a number at sample {int(np.argmin(np.isfinite(times)))}; export again")
    steps = np.diff(times)
    span = times[-1] - times[0]
    mean = span / (times.size - 1)
    if span == 0 and not steps.any():
        raise EmaError(
            f"time stands still at {times[0]:.6g} s; export again with more digits, or without time"
        )
    if mean <= 0 or np.any(steps < 0):
        raise EmaError(f"time runs backwards at sample {int(np.argmax(steps <= 0)) + 1}; export again")
    step = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - step)))
    uncertainty = float(abs(steps[worst] - step) / span)
    if np.any(steps == 0):
        return _rate_of_equal_times(times, uncertainty), uncertainty
    if abs(steps[worst] - step) > 0.5 * step:
        raise _gap(float(steps[worst]), worst + 1, step)
    return whole_rate(mean, max(1e-9, uncertainty)), uncertainty


def _rate_of_equal_times(times: NDArray[np.float64], uncertainty: float) -> float | None:
    """The rate where several samples have one time: it was rounded, or rows were written twice.

    Rounding to significant digits is coarser later in the record, so that each stamp is held against those beside it:
    it stands for as many samples as fill the step to the next one, or one more.
    """
    first = np.flatnonzero(np.diff(times, prepend=-math.inf))
    if first.size < _FEWEST_STAMPS:
        return None
    step = float(np.polyfit(np.arange(times.size), times - times[0], 1)[0])
    rows, jumps = np.diff(first, append=times.size), np.diff(times[first])
    before, after = np.append(jumps[0], jumps), np.append(jumps, jumps[-1])
    wide = jumps - step * (_UNEVEN * np.maximum(rows[:-1], rows[1:]) + 1)
    if np.any(wide > 0):
        at = int(np.argmax(wide))
        raise _gap(float(jumps[at]), int(first[at + 1]), float(np.median(jumps)))
    widest = np.maximum(before, after)
    most = np.floor(_UNEVEN * widest / step + 1)
    # Stamps a sample apart that are no round numbers are finer than a sample.
    most[(widest < _UNEVEN * step) & ~_is_power_of_ten(widest)] = 1
    least = np.minimum(before, after) / (_UNEVEN * step) - 1
    least[[0, -1]] = 0  # the record may begin and end amid the samples of a stamp
    if np.any(rows > most):
        at = int(np.argmax(rows - most))
        raise EmaError(
            f"time stands still at {times[first[at]]:.6g} s for {rows[at]} samples from sample {first[at]} on: rows "
            "are repeated; export the record again"
        )
    if np.any(rows < least):
        at = int(np.argmin(rows - least))
        raise EmaError(
            f"time {times[first[at]]:.6g} s has {rows[at]} samples where {widest[at] / step:.0f} are usual: samples "
            "are missing; export the record again without gaps"
        )
    return whole_rate(step, uncertainty)


def _is_power_of_ten(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(values / 10.0 ** np.round(np.log10(values)) - 1) < 1e-2)


def _gap(jump: float, sample: int, step: float) -> EmaError:
    return EmaError(
        f"time jumps by {jump:.6g} s at sample {sample} where {step:.6g} s is the step: "
        "samples are missing; export the record again without gaps"
    )


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
