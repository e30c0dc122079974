"""Rig files: what they can say, and what is said where they are wrong."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import ema

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Gyroscopic, Mass
from ema_pipeline.mechanics.laws import (
    BoucWen,
    DryFriction,
    Maxwell,
    Nonlinear,
    PartingSpring,
    PolynomialSpring,
)
from ema_pipeline.mechanics.modes import complex_modes
from ema_pipeline.observations.parts import dependence
from ema_pipeline.rigs import Rig, load_rig, model_modes
from ema_pipeline.toml_lines import key_lines, line_of

RIG_FILE = """\
base = "planetary"
name = "mine"
[geometry]
planets = 3
[parameters]
carrier_mass = { value = 1.50, unit = "kg", tolerance = 0.02 }
sun_planet_mesh_stiffness = { value = 2e7, unit = "N/m", min = 1e6, max = 1e9, free = true }
planet2_mass = 0.5
sun_mass = 2.2
"""


def frequencies(rig: Rig, configuration: str) -> list[float]:
    return [m.frequency_hz for m in model_modes(rig, configuration)]


def write(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_rig_file_specialises_a_shipped_rig(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, RIG_FILE))
    assert rig.name == "mine"
    assert rig.parameters["carrier_mass"].value == 1.5
    assert rig.parameters["carrier_mass"].tolerance == 0.02
    assert rig.parameters["sun_mass"].value == 2.2
    assert rig.parameters["sun_mass"].tolerance == 0.01
    system = rig.system("no_ring")
    mass = dict(zip(system.dofs, np.diag(system.mass), strict=True))
    assert mass["planet1.zeta"] == 0.43
    assert mass["planet2.zeta"] == 0.5
    assert "planet3.u" in mass


def test_tolerance_on_a_free_parameter_makes_it_a_known_one(tmp_path: Path) -> None:
    text = 'base = "planetary"\n[parameters]\nsun_planet_mesh_stiffness = { value = 2e7, tolerance = 0.1 }\n'
    assert not load_rig(write(tmp_path, text)).parameters["sun_planet_mesh_stiffness"].free


def test_viscous_coefficients_take_the_place_of_modal_damping(tmp_path: Path) -> None:
    # Table I prints c = 2·0.01·√(k·m) for the sun bearing as 28.57: one percent of the bare sun.
    text = (
        'base = "planetary"\n[parameters]\nsun_bearing_damping = { value = 28.57, unit = "Ns/m" }\n'
        "planet_bearing_damping = 2.56\n"
    )
    rig = load_rig(write(tmp_path, text))
    assert rig.parameters["modal_damping_ratio"].value == 0.0
    ratios = complex_modes(rig.system("no_ring")).damping_ratio
    assert 0.003 < ratios.max() < 0.02


ELEMENTS = """\
name = "two blocks"
configurations = ["free", "clamped"]
[parameters]
link = { value = 1e5, unit = "N/m", tolerance = 0.1 }
[[masses]]
at = "top.x"
value = 1.0
[[masses]]
at = "base.x"
value = 3.0
[[springs]]
name = "link"
between = ["top.x", "base.x"]
value = "link"
[[springs]]
at = "base.x"
value = 1e6
configurations = ["clamped"]
[[dampers]]
row = { "top.x" = 1.0, "base.x" = -1.0 }
value = 5.0
[[sensors]]
dof = "middle.x"
row = { "top.x" = 0.5, "base.x" = 0.5 }
"""


def test_rig_from_scratch_is_made_of_elements(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, ELEMENTS))
    free = frequencies(rig, "free")
    assert free[0] == 0.0
    assert free[1] == pytest.approx(np.sqrt(1e5 * (1 / 1.0 + 1 / 3.0)) / (2 * np.pi), rel=1e-9)
    assert frequencies(rig, "clamped")[0] > 10.0
    assert rig.knows("free", Dof("middle", "x"))
    assert set(rig.used("free")) == {"link", "modal_damping_ratio"}
    soft = rig.system("free", {"link": 5e4}).stiffness
    np.testing.assert_allclose(soft, rig.system("free").stiffness / 2)


def test_a_parameter_of_a_rig_from_scratch_may_be_a_bare_number(tmp_path: Path) -> None:
    stated = load_rig(write(tmp_path, ELEMENTS.replace(', unit = "N/m", tolerance = 0.1', "")))
    bare = load_rig(
        write(tmp_path, ELEMENTS.replace('{ value = 1e5, unit = "N/m", tolerance = 0.1 }', "1e5"))
    )
    assert bare.parameters == stated.parameters
    assert bare.parameters["link"].value == 1e5


def test_a_body_that_moves_in_two_directions_has_one_mass_that_deviates_as_one(tmp_path: Path) -> None:
    more = """
[[masses]]
at = "top.y"
value = 1.0
[[masses]]
at = "base.y"
value = 3.1
[[masses]]
at = "top.u"
value = 1.0
[[springs]]
row = { "top.y" = 1.0, "top.u" = 1.0, "base.y" = 1.0 }
value = 1e5
"""
    rig = load_rig(write(tmp_path, ELEMENTS + more))
    masses = [e for e in rig.assembly("free").elements if isinstance(e, Mass)]
    assert [m.part for m in masses] == ["top mass", "", "top mass", "", ""]
    assert {"top mass (mass)", "base mass x (mass)", "base mass y (mass)"} <= set(
        dependence(rig).unknowns.names
    )


def test_elements_without_a_name_are_named_by_their_place(tmp_path: Path) -> None:
    text = """
configurations = ["soft", "hard"]
[[masses]]
at = "b1.x"
value = 1.0
[[masses]]
at = "b2.x"
value = 2.0
[[masses]]
name = "block"
at = "b2.y"
value = 2.5
[[masses]]
row = { "b1.x" = 1.0, "b2.x" = -1.0 }
value = 0.1
[[springs]]
at = "b1.x"
value = 1e5
configurations = ["soft"]
[[springs]]
at = "b1.x"
value = 1e6
configurations = ["hard"]
[[springs]]
between = ["b1.x", "b2.x"]
value = 1e5
[[springs]]
between = ["b1.x", "b2.x"]
value = 1e4
[[springs]]
name = "b2 spring y"
at = "b2.y"
value = 1e5
[[springs]]
at = "b2.y"
value = 1e4
[[dampers]]
row = { "b1.x" = 1.0, "b2.y" = -1.0 }
value = 5.0
"""
    rig = load_rig(write(tmp_path, text))
    expected = [
        "b1 mass", "b2 mass x", "block", "b1-b2 mass x", "b1 spring x", "b1-b2 spring x", "b1-b2 spring x 2",
        "b2 spring y", "b2 spring y 2", "b1 x-b2 y damper",
    ]  # fmt: skip
    for configuration in rig.configurations:
        assert [e.name for e in rig.assembly(configuration).elements] == expected


def test_a_row_may_name_its_dofs_with_or_without_quotes(tmp_path: Path) -> None:
    plain = ELEMENTS.replace('{ "top.x" = 1.0, "base.x" = -1.0 }', "{ top.x = 1.0, base.x = -1.0 }")
    assert plain != ELEMENTS
    rigs = [load_rig(write(tmp_path, text)) for text in (ELEMENTS, plain)]
    np.testing.assert_array_equal(rigs[0].system("free").damping, rigs[1].system("free").damping)


ROTOR = """\
name = "rotor on a mount"
modal_damping_ratio = 0.0
[parameters]
hardening = { value = -1e10, unit = "N/m³", min = -1e12, tolerance = 0.2 }
[[masses]]
at = "rotor.x"
value = 2.0
[[masses]]
at = "rotor.y"
value = 2.0
[[springs]]
at = "rotor.x"
value = 8e4
loss_factor = 0.04
[[springs]]
at = "rotor.y"
value = 8e4
[[gyroscopic]]
between = ["rotor.x", "rotor.y"]
value = 30.0
[[nonlinear]]
law = "cubic"
at = "rotor.x"
value = "hardening"
[[nonlinear]]
law = "quadratic"
at = "rotor.x"
value = 1e7
[[nonlinear]]
law = "friction"
at = "rotor.x"
value = 2.0
[[nonlinear]]
law = "contact"
at = "rotor.y"
value = 1e4
preload = 1e-5
gap = 1e-4
[[nonlinear]]
name = "mesh pad"
law = "hysteresis"
at = "rotor.y"
value = 100.0
rho = 600.0
sigma = 0.5
[[nonlinear]]
law = "relaxation"
at = "rotor.y"
value = 3e4
time = 0.01
"""


def test_rig_from_scratch_may_hold_every_law_of_the_mechanics(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, ROTOR))
    assembly = rig.assembly("default")
    x, y = {"rotor.x": 1.0}, {"rotor.y": 1.0}
    assert assembly.nonlinear == (
        PolynomialSpring("nonlinear 1", x, cubic=-1e10),
        PolynomialSpring("nonlinear 2", x, quadratic=1e7),
        DryFriction("nonlinear 3", x, 2.0),
        PartingSpring("nonlinear 4", y, 1e4, preload=1e-5, gap=1e-4),
        BoucWen("mesh pad", y, 100.0, 600.0, 0.5),
        Maxwell("nonlinear 6", y, 3e4, 0.01),
    )
    shipped = {k for k in Nonlinear.__subclasses__() if k.__module__ == Nonlinear.__module__}
    assert {type(n) for n in assembly.nonlinear} == shipped
    assert assembly.named("gyroscopic 1") == Gyroscopic("gyroscopic 1", x, y, 30.0)
    system = rig.system("default")
    np.testing.assert_allclose(np.diag(system.stiffness), [8e4, 8e4 + 1e4 + 6e4 + 3e4])
    np.testing.assert_allclose(system.structural, [[0.04 * 8e4, 0], [0, 0]])
    np.testing.assert_allclose(system.damping, [[0, 30.0], [-30.0, 0]])
    assert set(rig.used("default")) == {"hardening", "modal_damping_ratio"}


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('law = "cubic"', 'law = "qubic"', 22, "nonlinear.0.law = 'qubic'"),
        (
            'law = "cubic"',
            'low = "cubic"',
            21,
            "unknown key 'nonlinear.0.low' of 'rotor.x' (did you mean 'law'?)",
        ),
        ("preload = 1e-5\n", "", 33, "key 'preload' is missing"),
        ("sigma = 0.5", 'sigma = "sigma"', 45, "sigma 'sigma' is no parameter"),
        ("rho = 600.0", "rho = -600.0", 39, "'mesh pad': a Bouc-Wen element needs rho > 0"),
        (
            "value = 2.0\n[[nonlinear]]",
            "value = -2.0\n[[nonlinear]]",
            32,
            "value = -2 N: friction cannot be negative",
        ),
        ("value = 3e4", "value = -3e4", 49, "value = -30000 N/m: a relaxation cannot be negative"),
        ("time = 0.01", "time = 0", 46, "a relaxation needs a time above 0 s"),
        ('between = ["rotor.x", "rotor.y"]', 'at = "rotor.x"', 18, "key 'between' is missing"),
        (
            "value = 30.0",
            "value = -1e30",
            20,
            "'gyroscopic 1' = -1e+30 is so large that the model's lowest modes",
        ),
        ("loss_factor = 0.04", "loss_factor = 15", 14, "no material has one above 10; 15 % is 0.15"),
        ("min = -1e12, ", "", 4, "'hardening' = -1e+10 N/m³ lies outside its bounds 0 … inf"),
    ],
)
def test_mistakes_in_laws_name_file_line_and_key(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    _expect(tmp_path, ROTOR, old, new, line, words)


MISTAKES = [
    ("planets = 3", 'planets = "three"', 4, "geometry.planets = 'three'"),
    ("planets = 3", "planets = 3.5", 4, "geometry.planets = 3.5"),
    ("planets = 3", "planets = 1", 4, "at least 2 planets"),
    ("planets = 3", "planets = 100000", 4, "200 at most"),
    ("planets = 3", "planet = 3", 4, "'geometry.planet' (did you mean 'planets'?)"),
    ("[geometry]", "[geometri]", 3, "'geometri' (did you mean 'geometry'?)"),
    ("[parameters]", "[parameter]", 5, "'parameter' (did you mean 'parameters'?)"),
    ('"planetary"', '"planetery"', 1, "did you mean 'planetary'?"),
    ('"planetary"', "planetary", 1, "not valid TOML: Invalid value in 'base = planetary'"),
    ('base = "planetary"\n', "", 1, "key 'base'"),
    ("carrier_mass", "carier_mass", 6, "'parameters.carier_mass' (did you mean 'carrier_mass'?)"),
    ('"kg"', '"N"', 6, "'carrier_mass' has unit 'N', which is not one of 'kg' or its multiples"),
    ('"kg"', '"kgg"', 6, "'carrier_mass' has unit 'kgg', which is not one of 'kg'"),
    ("tolerance = 0.02", "tolerence = 0.02", 6, "did you mean 'tolerance'?"),
    ("tolerance = 0.02", "tolerance = -0.02", 6, "carrier_mass.tolerance = -0.02"),
    ("tolerance = 0.02", 'tolerance = "2 %"', 6, "carrier_mass.tolerance = '2 %'"),
    ("tolerance = 0.02", "tolerance = 10", 6, "'carrier_mass' has tolerance 10, which is 1000 %"),
    ("value = 1.50", 'value = "heavy"', 6, "carrier_mass.value = 'heavy'"),
    ("value = 1.50", "value = nan", 6, "finite"),
    ("value = 1.50", "value = -1.5", 6, "'carrier_mass' = -1.5 kg lies outside its bounds 0 … inf"),
    ("value = 2e7", "value = 2e3", 7, "outside its bounds 1e+06 … 1e+09"),
    ("min = 1e6, max = 1e9", "min = 1e9, max = 1e6", 7, "has min 1e+09 N/m above max 1e+06 N/m"),
    ("free = true", 'free = "yes"', 7, "sun_planet_mesh_stiffness.free = 'yes'"),
    ("planet2_mass", "planet9_mass", 8, "'parameters.planet9_mass'"),
    (
        "sun_mass = 2.2",
        'sun_mass = "2.2"',
        9,
        "parameters.sun_mass = '2.2': give a number, or a table such as { value = 2.0",
    ),
    ("sun_mass = 2.2", "sun_mass = 0", 9, "'sun_mass' = 0 kg: give a mass above 0"),
    ("sun_mass = 2.2", "carrier_mass = 2.2", 9, "not valid TOML: Cannot overwrite a value in 'carrier_mass"),
    (
        "sun_mass = 2.2",
        "sun_mass = 1e-20",
        9,
        "'sun mass y' = 1e-20 is so small that the model's lowest modes",
    ),
    ("sun_mass = 2.2", "modal_damping_ratio = 1.5", 9, "'modal_damping_ratio' = 1.5 lies outside"),
    ("sun_mass = 2.2", "modal_damping_ratio = { value = 1.5, max = 2 }", 9, "from 0 to below 1"),
    ("sun_mass = 2.2", "modal_damping_ratio = { min = -1e30 }", 9, "a damping ratio lies from 0 to below 1"),
    (
        "sun_mass = 2.2",
        "sun_bearing_damping = { value = -1e30, min = -1e30 }",
        9,
        "has min -1e+30 N·s/m: a damper cannot be negative; give min = 0 or more",
    ),
]


@pytest.mark.parametrize(("old", "new", "line", "words"), MISTAKES)
def test_mistakes_in_a_rig_file_name_file_line_and_key(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    _expect(tmp_path, RIG_FILE, old, new, line, words)


ELEMENT_MISTAKES = [
    ('["free", "clamped"]', "[]", 2, "configurations = []"),
    ('["free", "clamped"]', '["free", "free"]', 2, "configuration 'free' is named twice"),
    ("[[masses]]", "[[mases]]", 5, "'mases' (did you mean 'masses'?)"),
    ('at = "base.x"\nvalue = 3', 'att = "base.x"\nvalue = 3', 9, "did you mean 'at'?"),
    ('at = "base.x"\nvalue = 3', 'at = "base"\nvalue = 3', 9, "dof 'base' is not of the form"),
    ("value = 3.0", "", 8, "key 'masses.1.value' of 'base.x' is missing"),
    ("value = 3.0", "value = 0", 10, "value = 0 kg: give a mass above 0"),
    (
        'name = "link"\n',
        'name = "link"\nat = "top.x"\n',
        14,
        "needs one of at, between or row, it has at and between",
    ),
    ('"top.x", "base.x"]', '"top.x", "bas.x"]', 13, "dof 'bas.x' has no mass"),
    ('"top.x", "base.x"]', '"top.x"]', 13, "springs.0.between = ['top.x']: name two DOFs"),
    ('"top.x", "base.x"]', '"top.x", "top.x"]', 13, "no stretch"),
    ('"top.x", "base.x"]', '"top.x", "-top.x"]', 13, "between 'top.x' and '-top.x' there is no stretch"),
    (
        "value = 1e6",
        "value = 1e6\nloss_factor = -1",
        18,
        "loss_factor = -1: a loss factor cannot be negative",
    ),
    (
        "[parameters]\n",
        "modal_damping_ratio = 0.02\n[parameters]\nmodal_damping_ratio = { value = 0.9 }\n",
        5,
        "modal_damping_ratio = 0.02 is given at the top as well; keep one of the two",
    ),
    ('value = "link"', 'value = "lnk"', 14, "value 'lnk' is no parameter (did you mean 'link'?)"),
    ("value = 1e6", 'value = "1e6"', 17, "without quotes: value = 1e+06"),
    ("value = 1e6", "value = -1e9", 17, "stiffness is negative around 'base.x'"),
    ("value = 1e6", 'name = "link"\nvalue = 1e6', 17, "two elements are named 'link'"),
    ('["clamped"]', '["clampd"]', 18, "unknown configuration 'clampd' (did you mean 'clamped'?)"),
    ('["clamped"]', '"clamped"', 18, "configurations = 'clamped': Input should be a list"),
    ('"top.x" = 1.0', '"tip.x" = 1.0', 20, "dof 'tip.x' has no mass in configuration 'free'"),
    ("value = 5.0", "value = -5.0", 21, "a damper cannot be negative"),
    ('dof = "middle.x"', 'dof = "top.x"', 23, "'top.x' has mass and so is a coordinate already"),
    ('"top.x" = 0.5', '"tip.x" = 0.5', 24, "dof 'tip.x' has no mass"),
    ('row = { "top.x" = 1.0, "base.x" = -1.0 }', "row = {}", 20, "dampers.0.row = {}: name at least one dof"),
    ('"top.x" = 0.5, "base.x" = 0.5', "", 24, "sensors.0.row = {}: name at least one dof"),
    ('"top.x" = 0.5, "base.x" = 0.5', '"top.x" = 0.0', 24, "with a coefficient other than 0"),
    ('"base.x" = -1.0', '"base.x" = {}', 20, "dampers.0.row.base.x = {}: Input should be a valid number"),
    ('"base.x" = -1.0', "top.x = -1.0", 20, "'top.x' has two coefficients; give it one"),
    ('"top.x" = 0.5', '"top.x" = true', 24, "sensors.0.row.top.x = true: Input should be a valid number"),
    ("value = 1e6", "value = true", 17, "springs.1.value = true: give a number, or the name of a parameter"),
    ("value = 1e6", "value = 1e300", 17, "value = 1e+300: give 0, or a number from 1e-30 to 1e+30 in size"),
    ("value = 1e6", "value = 1e6\nloss_factor = true", 18, "springs.1.loss_factor = true: give a number"),
    ("value = 1e5", "value = 1e300", 4, "parameters.link.value = 1e+300: give 0"),
    ("value = 1e5", "value = 1e20", 4, "'link' = 1e+20 is so large that the model's lowest modes are lost"),
    ('value = "link"', "value = 1e18", 14, "'link' = 1e+18 is so large"),
    (
        "value = 3.0",
        "value = 1e-20",
        10,
        "'base mass' = 1e-20 is so small that the model's lowest modes are lost",
    ),
    ('"top.x" = 1.0', '"top.x" = 1e300', 20, "dampers.0.row.top.x = 1e+300: give 0"),
    ("[parameters]", "modal_damping_scatter = true\n[parameters]", 3, "modal_damping_scatter = true"),
    (
        '{ value = 1e5, unit = "N/m", tolerance = 0.1 }',
        "[1e5]",
        4,
        "parameters.link = [100000.0]: give a number, or",
    ),
    (
        "[parameters]\nlink",
        "parameters = 3\n#",
        3,
        "parameters = 3: Input should be a table of keys and values",
    ),
    ("[parameters]", '[parameters]\n"" = { value = 1.0 }', 4, "parameter '' has no name; give it one"),
]


@pytest.mark.parametrize(("old", "new", "line", "words"), ELEMENT_MISTAKES)
def test_mistakes_in_a_rig_from_scratch_name_file_line_and_key(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    _expect(tmp_path, ELEMENTS, old, new, line, words)


def _expect(folder: Path, text: str, old: str, new: str, line: int, words: str) -> None:
    assert old in text
    path = write(folder, text.replace(old, new) if old.startswith("[[") else text.replace(old, new, 1))
    with pytest.raises(EmaError) as caught:
        load_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line {line}: "), message
    assert words in message, message


TOML = """\
base = "x" # base = 1
[geometry]
planets = 3
[parameters]
a.b = 1
c = { value = 1.5, unit = "k]g#", list = [1,
  2] }
"quoted.key" = 'it''s'
long = \"\"\"
fake = 3
\"\"\"
[[masses]]
value = 1
[[masses]]
row = { "t.x" = 1.0 }
[masses.more]
z = 2020-01-01
""".replace("it''s", "its")


def test_lines_of_keys_are_found_in_every_form_of_toml() -> None:
    lines = key_lines(TOML)

    def paths(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
        items = (
            value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        )
        return [path, *(p for key, inner in items for p in paths(inner, (*path, key)))]

    assert set(lines) == set(paths(tomllib.loads(TOML))) - {()}
    text = TOML.splitlines()
    for path, line in lines.items():
        if isinstance(path[-1], str):
            assert path[-1] in text[line - 1]
    assert lines["parameters", "c", "list", 1] == 7
    assert lines["masses", 1, "row", "t.x"] == 15
    assert line_of(lines, ("masses", 0, "at")) == lines["masses", 0] == 12
    assert line_of(lines, ("nowhere",)) is None


UNITS = """
name = "bench"
[parameters]
m = { value = 2600, unit = "g" }
k = { value = 110, unit = "N/mm", tolerance = 0.05, min = 10, max = 1000 }
[[masses]]
at = "m1.x"
value = "m"
[[masses]]
at = "m2.x"
value = 1200
unit = "g"
[[springs]]
at = "m1.x"
value = "k"
[[springs]]
between = ["m1.x", "m2.x"]
value = 0.4
unit = "kN/mm"
[[dampers]]
at = "m2.x"
value = 5e-3
unit = "N·s/mm"
"""


def test_any_unit_of_the_right_dimension_is_converted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_si = UNITS
    for old, new in (
        ('value = 2600, unit = "g"', "value = 2.6"),
        ('value = 110, unit = "N/mm"', 'value = 1.1e5, unit = "N/m"'),
        ("min = 10, max = 1000", "min = 1e4, max = 1e6"),
        ('value = 1200\nunit = "g"', "value = 1.2"),
        ('value = 0.4\nunit = "kN/mm"', "value = 4e5"),
        ('value = 5e-3\nunit = "N·s/mm"', "value = 5.0"),
    ):
        assert old in in_si
        in_si = in_si.replace(old, new)
    shown = []
    for number, text in enumerate((UNITS, in_si)):
        file = tmp_path / f"rig{number}.toml"
        file.write_text(text, encoding="utf-8")
        code, out, err = ema(capsys, "model", "--rig", file, "--json")
        assert code == 0, err
        shown.append(json.loads(out))
    assert shown[0] == shown[1]
    rig = load_rig(str(tmp_path / "rig0.toml"))
    k = rig.parameters["k"]
    assert (k.value, k.unit, k.minimum, k.maximum) == (1.1e5, "N/m", 1e4, 1e6)
    assert rig.parameters["m"].unit == "kg"


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('unit = "N/mm"', 'unit = "N*mm"', 5, "'k' has unit 'N*mm', but [[springs]] takes N/m"),
        ('unit = "g" }', 'unit = "N/mm" }', 4, "'m' has unit 'N/mm', but [[masses]] takes kg"),
        ('unit = "kN/mm"', 'unit = "mm"', 19, "unit 'mm' is not one of N/m"),
        ('value = "k"', 'value = "k"\nunit = "N/m"', 16, "whose own unit counts"),
    ],
)
def test_a_unit_of_another_dimension_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, line: int, words: str
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(UNITS.replace(old, new), encoding="utf-8")
    code, _, err = ema(capsys, "model", "--rig", file)
    assert code == 1
    assert f"line {line}: " in err
    assert words in err


def test_a_gyroscopic_coupling_may_have_either_sign_and_be_strong(tmp_path: Path) -> None:
    for value in ("-30.0", "-1e6", "1e6"):
        text = ROTOR.replace("value = 30.0", f"value = {value}")
        found = load_rig(write(tmp_path, text)).assembly("default").named("gyroscopic 1")
        assert isinstance(found, Gyroscopic)
        assert found.coefficient == float(value)


def test_the_bound_of_a_dampers_parameter_is_not_negative(tmp_path: Path) -> None:
    text = """
[parameters]
loss = { value = 1.0, min = -1e30, unit = "N*s/m" }
[[masses]]
at = "m.x"
value = 1.0
[[springs]]
at = "m.x"
value = 1e4
[[dampers]]
at = "m.x"
value = "loss"
"""
    with pytest.raises(
        EmaError, match=r"line 3: parameter 'loss' has min -1e\+30 .*a damper cannot be negative"
    ):
        load_rig(write(tmp_path, text))


def test_a_mass_that_is_listed_twice_is_taken_for_a_slip(tmp_path: Path) -> None:
    mass = '[[masses]]\nat = "m.x"\nvalue = 1.0\n'
    spring = '[[springs]]\nat = "m.x"\nvalue = 1e4\n'
    with pytest.raises(EmaError, match="line 4: the same mass is listed twice"):
        load_rig(write(tmp_path, mass + mass + spring))
    named = load_rig(write(tmp_path, mass + 'name = "plate"\n' + mass + spring))
    assert named.system("default").mass[0, 0] == 2.0


def test_a_model_without_a_mode_that_vibrates_says_what_to_correct(tmp_path: Path) -> None:
    text = '[[masses]]\nat = "m.x"\nvalue = 1.0\n[[springs]]\nat = "m.x"\nvalue = 1e4\n'
    rig = load_rig(write(tmp_path, text + '[[dampers]]\nat = "m.x"\nvalue = 1e6\n'))
    with pytest.raises(EmaError, match="its damping lets no mode vibrate; correct dampers"):
        model_modes(rig, "default")
