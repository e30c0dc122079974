"""Units as they are written in test descriptions and record files, and their size in SI.

A unit is looked up in a table, never inferred: an unknown spelling is an error (or ``None``), not a guess.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from ema_pipeline.errors import EmaError, did_you_mean

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of free fall, m/s² (3rd CGPM, 1901; exact)."""

POUND_FORCE = 4.4482216152605
"""One pound-force, N (NIST SP 811, B.8; exact)."""

INCH = 0.0254
"""One inch, m (exact)."""

SI_SYMBOL = {
    "force": "N",
    "acceleration": "m/s^2",
    "velocity": "m/s",
    "displacement": "m",
    "voltage": "V",
    "time": "s",
    "frequency": "Hz",
}
"""The SI unit of every quantity that a unit can have."""


@dataclass(frozen=True)
class Unit:
    """A unit of measurement.

    Attributes
    ----------
    symbol : str
        Plain ASCII spelling, e.g. ``"m/s^2"``.
    quantity : str
        One of the keys of `SI_SYMBOL`.
    scale : float
        Size in SI: a value in this unit times `scale` is the value in SI.
    """

    symbol: str
    quantity: str
    scale: float

    def same_as(self, other: Unit) -> bool:
        """True where both are the same unit, however it is spelt (``gal`` and ``cm/s^2``)."""
        return self.quantity == other.quantity and abs(self.scale / other.scale - 1) < 1e-6


def _table() -> dict[str, Unit]:
    lengths = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "nm": 1e-9, "in": INCH, "ft": 12 * INCH}
    units = [
        *(Unit(s, "displacement", k) for s, k in lengths.items()),
        *(Unit(f"{s}/s", "velocity", k) for s, k in lengths.items()),
        *(Unit(f"{s}/s^2", "acceleration", k) for s, k in lengths.items()),
        Unit("mil", "displacement", 1e-3 * INCH),
        Unit("g", "acceleration", STANDARD_GRAVITY),
        Unit("mg", "acceleration", 1e-3 * STANDARD_GRAVITY),
        Unit("gal", "acceleration", 1e-2),
        Unit("N", "force", 1.0),
        Unit("mN", "force", 1e-3),
        Unit("kN", "force", 1e3),
        Unit("MN", "force", 1e6),
        Unit("lbf", "force", POUND_FORCE),
        Unit("kgf", "force", STANDARD_GRAVITY),
        Unit("V", "voltage", 1.0),
        Unit("mV", "voltage", 1e-3),
        Unit("uV", "voltage", 1e-6),
        Unit("s", "time", 1.0),
        Unit("ms", "time", 1e-3),
        Unit("us", "time", 1e-6),
        Unit("Hz", "frequency", 1.0),
        Unit("kHz", "frequency", 1e3),
    ]
    return {u.symbol: u for u in units}


UNITS = _table()
"""All known units by their plain symbol."""

_ALIASES = {
    "gn": "g",
    "g0": "g",
    "gal.": "gal",
    "newton": "N",
    "newtons": "N",
    "lb": "lbf",
    "lbs": "lbf",
    "lb_f": "lbf",
    "volt": "V",
    "volts": "V",
    "millivolt": "mV",
    "millivolts": "mV",
    "meter": "m",
    "metre": "m",
    "meters": "m",
    "metres": "m",
    "micron": "um",
    "inch": "in",
    "inches": "in",
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "hertz": "Hz",
}
_PLAIN = str.maketrans("²µμ·⋅*", "2uu  ^")
# Symbols whose meaning depends on letter case (mN and MN, nm and Nm): these are never folded.
_CASE_MATTERS = {"mn", "mv", "mg", "nm"}


def find_unit(text: str) -> Unit | None:
    """Return the unit that `text` spells, or None where it spells none.

    Brackets, blanks, ``²``, ``^2``, ``**2``, ``sec`` and ``/s/s`` are read as what they mean;
    upper and lower case are told apart only where it matters (``mN``, ``MN``).

    >>> find_unit("[m/s²]").symbol
    'm/s^2'
    """
    plain = text.strip().strip("[](){}").strip()
    plain = plain.translate(_PLAIN)
    plain = plain.replace("⁻2", "-2").replace("⁻¹", "-1").replace("^^", "^").replace("^", "")
    plain = re.sub(r"\s+", "", plain)
    plain = re.sub(r"(?<=/)sec", "s", plain, flags=re.IGNORECASE)
    plain = re.sub(r"^([a-zA-Z]+)/s/s$", r"\1/s2", plain)
    plain = re.sub(r"^([a-zA-Z]+)s-([12])$", lambda m: f"{m[1]}/s" + ("2" if m[2] == "2" else ""), plain)
    plain = re.sub(r"(?<=/[sS])2$", "^2", plain)
    if plain in UNITS:
        return UNITS[plain]
    folded = plain.casefold()
    if folded in _ALIASES:
        return UNITS[_ALIASES[folded]]
    if folded in _CASE_MATTERS:
        return None
    return next((u for symbol, u in UNITS.items() if symbol.casefold() == folded and symbol != "MN"), None)


def parse_unit(text: str, quantities: Collection[str] = tuple(SI_SYMBOL)) -> Unit:
    """Return the unit that `text` spells.

    Parameters
    ----------
    text : str
    quantities : collection of str, optional
        Those of which one is meant: a message names no units of others.

    Raises
    ------
    EmaError
        Where no known unit is spelt like this; the message lists what is known.
    """
    unit = find_unit(text)
    if unit is None:
        known = [symbol for symbol, u in UNITS.items() if u.quantity in quantities]
        raise EmaError(f"unknown unit '{text}'{did_you_mean(text, known)}")
    return unit
