"""Units of rig files: any unit of the right dimension, converted to the one that the rig works in."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint

UNITS_OF: dict[str, tuple[str, ...]] = {
    "masses": ("kg", "kg*m^2"),
    "springs": ("N/m", "N*m/rad"),
    "dampers": ("N*s/m", "N*m*s/rad"),
    "gyroscopic": ("N*s/m", "N*m*s/rad"),
    "quadratic": ("N/m^2", "N*m/rad^2"),
    "cubic": ("N/m^3", "N*m/rad^3"),
    "friction": ("N", "N*m"),
    "contact": ("N/m", "N*m/rad"),
    "hysteresis": ("N", "N*m"),
    "relaxation": ("N/m", "N*m/rad"),
    "velocity": ("m/s", "rad/s"),
    "preload": ("m", "rad"),
    "gap": ("m", "rad"),
    "rho": ("1/m", "1/rad"),
    "time": ("s",),
}
"""SI units of a value by section, law or key: along a direction first, about an axis second."""

_UNIT = re.compile(r"(?!.*\d\d)[\w°µ%·⋅*/^() .²³⁴⁻-]{1,40}")
"""What a unit can look like; long numbers have no place in one."""


def factor_to(given: str, wanted: str) -> float | None:
    """Size of the unit `given` in `wanted`; None where it is no unit, or one of another dimension.

    Parameters
    ----------
    given : str
        As people type it: ``"g"``, ``"N/mm"``, ``"kN·s/m"``.
    wanted : str

    >>> factor_to("N/mm", "N/m"), factor_to("Ns/m", "N·s/m"), factor_to("kg", "N/m")
    (1000.0, 1.0, None)
    """
    if plain_unit(given) == plain_unit(wanted):
        return 1.0
    if not _UNIT.fullmatch(given):
        return None
    registry = _registry()
    try:
        found = float(registry.Quantity(1.0, _spelt(given)).to(_spelt(wanted)).magnitude)
    except Exception:  # pint has no common base for what it raises on texts that are no units
        return None
    return float(f"{found:.15g}")


def plain_unit(unit: str) -> str:
    """Units as people type them: N·s/m = N*s/m = Ns/m, deg = °, 1 = '' = '-'."""
    plain = re.sub(r"[\s·⋅*.^]", "", unit).replace("²", "2").replace("³", "3")
    return {"°": "deg", "degree": "deg", "degrees": "deg", "": "1", "-": "1"}.get(plain, plain)


def _spelt(unit: str) -> str:
    return unit.replace("·", "*").replace("⋅", "*").replace("^", "**")


@cache
def _registry() -> pint.UnitRegistry[float]:
    import pint  # loaded only where a rig file has other units than the rig: it takes as long as all the rest

    return pint.UnitRegistry()
