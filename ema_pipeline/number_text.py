"""Numbers as people read them: rounded to their uncertainty, with a prefix that keeps them short."""

from __future__ import annotations

import math

_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
_PREFIXED_UNITS = frozenset({"N", "N/m", "N·s/m", "N*s/m", "N s/m", "N/m^3", "N/m³", "m"})

_GRAMS_BELOW_KG = 0.1
"""Masses of bodies are given in kg, those of sensors and of added masses in g."""


def counted(n: int, noun: str) -> str:
    """``"1 hit"`` or ``"3 hits"``."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def prefixed(magnitude: float, unit: str) -> tuple[float, str]:
    """Factor and unit that bring `magnitude` between 1 and 1000, e.g. ``(1e-6, "MN/m")`` for 1e7 N/m.

    Masses below 0.1 kg are in g. Units that are not usually written with a prefix (Hz, %) are left alone.

    >>> prefixed(0.0123, "kg")
    (1000.0, 'g')
    """
    if unit == "kg" and 0 < abs(magnitude) < _GRAMS_BELOW_KG:
        return 1e3, "g"
    if unit not in _PREFIXED_UNITS or not math.isfinite(magnitude) or magnitude == 0:
        return 1.0, unit
    power = 3 * math.floor(math.log10(abs(magnitude)) / 3 + 1e-12)
    power = min(max(power, -9), 9)
    return 10.0**-power, _PREFIXES[power] + unit


def prefixed_as(value: float, std: float, unit: str) -> tuple[float, str]:
    """Factor and unit with which `format_value` shows a value and its standard deviation.

    >>> prefixed_as(202.6e3, 2.4e3, "N/m")
    (0.001, 'kN/m')
    """
    return prefixed(max(abs(value), std if math.isfinite(std) else 0.0), unit)


def format_value(value: float, std: float, unit: str = "") -> str:
    """Value and standard deviation, both rounded to two figures of the deviation.

    Without a usable deviation (0, NaN, infinite) the value stands alone, with four figures.

    >>> format_value(9.981e6, 3.06e5, "N/m")
    '9.98 ± 0.31 MN/m'
    >>> format_value(45.7034, 0.0212, "Hz")
    '45.703 ± 0.021 Hz'
    >>> format_value(1.0, float("nan"), "kg")
    '1.000 kg'
    """
    if not math.isfinite(value):
        return "not determined"
    known = math.isfinite(std) and std > 0
    scale, shown_unit = prefixed_as(value, std, unit)
    tail = f" {shown_unit}" if shown_unit not in ("", "1") else ""
    value *= scale
    if not known:
        return plain(value) + tail
    std *= scale
    exponent = math.floor(math.log10(float(f"{std:.1e}")))
    decimals = 1 - exponent
    power = math.floor(math.log10(max(abs(value), std)))
    if 0 <= decimals <= 6 or (decimals > 6 and power in (-1, 0)):
        return f"{_minus(f'{value:.{decimals}f}')} ± {std:.{decimals}f}{tail}"
    if -4 <= decimals < 0:
        return f"{_minus(f'{round(value, decimals):.0f}')} ± {round(std, decimals):.0f}{tail}"
    decimals += power
    mantissa = (
        f"{_minus(f'{value / 10**power:.{max(decimals, 0)}f}')} ± {std / 10**power:.{max(decimals, 0)}f}"
    )
    return f"({mantissa}) × 10^{power}{tail}"


def format_percent(ratio: float, std: float) -> str:
    """A ratio and its standard deviation in per cent.

    >>> format_percent(0.00981, 0.00042)
    '0.981 ± 0.042 %'
    """
    return format_value(100 * ratio, 100 * std, "%")


def plain(value: float, figures: int = 4) -> str:
    """A number without uncertainty, with `figures` significant figures.

    >>> plain(1097.0), plain(0.00123456), plain(2.5e-7)
    ('1097', '0.001235', '2.5e-07')
    """
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return _minus("inf" if value > 0 else "-inf")
    if value == 0:
        return "0"
    power = math.floor(math.log10(abs(float(f"{value:.{figures - 1}e}"))))
    if -4 <= power < 7:
        return _minus(f"{value:.{max(figures - 1 - power, 0)}f}")
    return _minus(f"{value:.{figures}g}")


def below(value: float, limit: float) -> str:
    """A value under a limit with as many decimals as show that it is under it, two at least.

    >>> below(0.6512, 0.8), below(0.7987, 0.8)
    ('0.65', '0.799')
    """
    for decimals in range(2, 6):
        text = f"{value:.{decimals}f}"
        if float(text) < limit:
            return text
    return f"just under {limit:g}"


def signed(value: float, decimals: int = 1) -> str:
    """A number with its sign; a dash where it is NaN.

    >>> signed(-1.234), signed(float("nan"))
    ('−1.2', '–')
    """
    if math.isnan(value):
        return "–"
    text = f"{value:+.{decimals}f}"
    return text[1:] if float(text) == 0 else _minus(text)


def _minus(text: str) -> str:
    """With a true minus sign, and none before zero."""
    if "e" not in text and float(text) == 0:
        text = text.removeprefix("-")
    return text.replace("-", "−") if "e" not in text else text
