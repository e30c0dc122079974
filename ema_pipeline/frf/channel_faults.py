"""Sentences on wrong sensitivities and reversed channels: what the factor suggests, and what to check."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SENSITIVITY = "sensitivity"
EXCHANGED = "exchanged channels"
"""Names of the checks."""

REVERSED = 0.9
"""Share of a driving point's resonances that point the wrong way, above which all do: of two modes one may."""

SUSPECT_FACTOR = 3.0
"""Factor against a model from which on a sensitivity is suspected. Rigs whose parts, channels and blows are off as in a
common laboratory stay within 1.4, hidden effects within 2; mV/lbf for mV/N is 4.4, mV/g for mV/(m/s²) 9.8."""

RECIPROCAL_FACTOR = 1.5
"""The same between two channels by reciprocity, which no model takes part in, where their FRF is as strong as those of
the driving points: what oblique blows and transverse sensitivity add to it weighs the more the weaker it is."""

SAME_FACTOR = 1.3
"""Factors within this of each other are taken for the same."""

_G = 9.80665
_POUND = 4.44822


def factor_words(factor: float) -> str:
    """How far a channel is off, e.g. ``9.8 times too high``.

    >>> factor_words(9.81), factor_words(0.1)
    ('9.8 times too high', '10 times too low')
    """
    side, size = ("high", factor) if factor >= 1 else ("low", 1 / factor)
    return f"{size:.2g} times too {side}" if size < 100 else f"{size:.3g} times too {side}"


def likely_cause(factor: float, quantity: str) -> str:
    """The usual slip behind a factor, as a phrase to end a sentence with; empty where there is none.

    Parameters
    ----------
    factor : float
        Reading over truth: a sensitivity stated too large makes it small.
    quantity : str
        Quantity of the channel.

    >>> likely_cause(1 / 9.7, "acceleration")
    ' (mV/g stated as mV/(m/s²), or a gain of 10)'
    """
    size, low = max(factor, 1 / factor), factor < 1
    if quantity == "acceleration" and _near(size, _G):
        slip = "mV/g stated as mV/(m/s²)" if low else "mV/(m/s²) stated as mV/g"
        return f" ({slip}, or a gain of 10)"
    if quantity == "force" and _near(size, _POUND):
        return f" ({'mV/lbf stated as mV/N' if low else 'mV/N stated as mV/lbf'})"
    power = round(math.log10(size))
    return f" (a gain of {10.0**power:g})" if power > 0 and _near(size, 10.0**power) else ""


def channels_words(names: Sequence[str]) -> str:
    """``channel 'a'`` or ``channels 'a' and 'b'``."""
    quoted = [f"'{n}'" for n in names]
    if len(quoted) == 1:
        return f"channel {quoted[0]}"
    return f"channels {', '.join(quoted[:-1])} and {quoted[-1]}"


def reciprocal_factor(
    one: NDArray[np.complex128], other: NDArray[np.complex128], least: float = RECIPROCAL_FACTOR
) -> float:
    """The real constant between two reciprocal FRFs, 1 where a constant does not explain their difference.

    Parameters
    ----------
    one, other : complex ndarray, (n_lines,)
        Accelerances H_ij and H_ji where they are large.
    least : float
        Factor from which on it is far from 1.

    Returns
    -------
    float
        ``one / other`` where it is far from 1 and the same at most lines; negative for opposite signs.
    """
    product = one * other.conj()
    cosine = float(np.mean(product.real / np.maximum(np.abs(product), np.finfo(float).tiny)))
    if abs(cosine) < 0.7:
        return 1.0
    ratio = np.log(
        np.maximum(np.abs(one), np.finfo(float).tiny) / np.maximum(np.abs(other), np.finfo(float).tiny)
    )
    low, middle, high = np.percentile(ratio, (25, 50, 75))
    far = abs(middle) > math.log(least) and high - low < abs(middle)
    factor = math.exp(middle) if far else 1.0
    return -factor if cosine < 0 else factor


def _near(size: float, factor: float) -> bool:
    return factor / SAME_FACTOR < size < factor * SAME_FACTOR
