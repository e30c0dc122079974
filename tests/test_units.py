"""Units: known numbers, and spellings that must not be mistaken."""

from __future__ import annotations

import re

import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.units import UNITS, Unit, find_unit, parse_unit


@pytest.mark.parametrize(
    ("text", "quantity", "scale"),
    [
        ("N", "force", 1.0),
        ("kN", "force", 1e3),
        ("mN", "force", 1e-3),
        ("MN", "force", 1e6),
        ("lbf", "force", 4.4482216152605),
        ("m/s^2", "acceleration", 1.0),
        ("m/s²", "acceleration", 1.0),
        ("m/s2", "acceleration", 1.0),
        ("m s⁻²", "acceleration", 1.0),
        ("g", "acceleration", 9.80665),
        ("gn", "acceleration", 9.80665),
        ("cm/s2", "acceleration", 0.01),
        ("Gal", "acceleration", 0.01),
        ("mm/s^2", "acceleration", 1e-3),
        ("in/s^2", "acceleration", 0.0254),
        ("ft/s^2", "acceleration", 0.3048),
        ("m/s", "velocity", 1.0),
        ("mm/s", "velocity", 1e-3),
        ("in/s", "velocity", 0.0254),
        ("µm", "displacement", 1e-6),
        ("μm", "displacement", 1e-6),
        ("um", "displacement", 1e-6),
        ("in", "displacement", 0.0254),
        ("mil", "displacement", 25.4e-6),
        ("mV", "voltage", 1e-3),
        ("volts", "voltage", 1.0),
        ("[N]", "force", 1.0),
    ],
)
def test_a_unit_has_the_size_that_the_standards_give_it(text: str, quantity: str, scale: float) -> None:
    unit = parse_unit(text)
    assert unit.quantity == quantity
    assert unit.scale == pytest.approx(scale, rel=1e-12)


ALL_SCALES = {
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "nm": 1e-9, "in": 0.0254, "ft": 0.3048, "mil": 2.54e-5,
    "m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "um/s": 1e-6, "nm/s": 1e-9, "in/s": 0.0254, "ft/s": 0.3048,
    "m/s^2": 1.0, "mm/s^2": 1e-3, "cm/s^2": 1e-2, "um/s^2": 1e-6, "nm/s^2": 1e-9, "in/s^2": 0.0254, "ft/s^2": 0.3048,
    "g": 9.80665, "mg": 9.80665e-3, "gal": 1e-2,
    "N": 1.0, "mN": 1e-3, "kN": 1e3, "MN": 1e6, "lbf": 4.4482216152605, "kgf": 9.80665,
    "V": 1.0, "mV": 1e-3, "uV": 1e-6, "s": 1.0, "ms": 1e-3, "us": 1e-6, "Hz": 1.0, "kHz": 1e3,
}  # fmt: skip
"""Every unit that is known, in SI; written apart from the program's own table."""


def test_every_known_unit_has_the_scale_of_a_table_written_apart() -> None:
    assert {symbol: unit.scale for symbol, unit in UNITS.items()} == pytest.approx(ALL_SCALES, rel=1e-12)


def test_one_unit_spelt_two_ways_is_the_same_but_a_near_one_is_not() -> None:
    assert parse_unit("gal").same_as(parse_unit("cm/s^2"))
    assert not parse_unit("m/s").same_as(parse_unit("m"))
    assert not parse_unit("g").same_as(Unit("g almost", "acceleration", 9.80665 * (1 + 2e-6)))


def test_velocity_is_not_taken_for_acceleration() -> None:
    assert parse_unit("m/s").quantity != parse_unit("m/s2").quantity


def test_letter_case_decides_between_milli_and_mega() -> None:
    assert parse_unit("mN").scale != parse_unit("MN").scale
    assert find_unit("Mv") is None
    assert find_unit("Mg") is None


@pytest.mark.parametrize("text", ["", "EU", "furlong", "Nm", "m/s3", "N/m", "kg"])
def test_an_unknown_unit_is_never_guessed(text: str) -> None:
    assert find_unit(text) is None
    with pytest.raises(EmaError, match="unknown unit"):
        parse_unit(text)


def test_only_units_of_what_is_measured_are_named_for_an_unknown_one() -> None:
    with pytest.raises(EmaError) as caught:
        parse_unit("furlong/h", ("acceleration", "voltage"))
    (known,) = re.findall(r"\(known: (.*)\)$", str(caught.value))
    assert {UNITS[symbol].quantity for symbol in known.split(", ")} == {"acceleration", "voltage"}


def test_the_same_unit_in_two_spellings_is_the_same() -> None:
    assert parse_unit("gal").same_as(parse_unit("cm/s²"))
    assert not parse_unit("g").same_as(parse_unit("m/s^2"))
