"""The examples of the pages on rigs and effects run as they are printed."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner

from ema_pipeline import cli
from ema_pipeline.effects.checks import check_on_rig
from ema_pipeline.effects.library import effect_library
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics import laws
from ema_pipeline.mechanics.assembly import Damper, Gyroscopic, Mass, Nonlinear, Spring
from ema_pipeline.mechanics.modes import complex_modes
from ema_pipeline.mechanics.nonlinear import force_along
from ema_pipeline.rigs import Rig, load_rig, model_modes
from ema_pipeline.rigs.element_entries import SECTIONS, Law
from ema_pipeline.run.opening import existing_run
from ema_pipeline.stages.results import load_results

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.mark.parametrize("index", [0, 1])
def test_rig_files_of_the_page_on_rigs_load(tmp_path: Path, index: int) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(blocks("adding_a_rig.md", "toml")[index], encoding="utf-8")
    rig = load_rig(file)
    assert rig.name in ("my gearbox", "two blocks")
    for configuration in rig.configurations:
        assert model_modes(rig, configuration)


def test_the_page_on_rigs_names_every_section_and_law() -> None:
    page = (DOCS / "adding_a_rig.md").read_text(encoding="utf-8")
    for section in SECTIONS:
        assert f"[[{section}]]" in page
    for law in get_args(Law):
        assert f'"{law}"' in page


def test_python_rig_of_the_page_on_rigs_runs() -> None:
    (code,) = blocks("adding_a_rig.md", "python")
    exec(code, {"__name__": "example"})


def test_effect_of_the_page_on_effects_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    effect, use, _ = blocks("adding_an_effect.md", "python")
    (tmp_path / "oil_film.py").write_text(effect, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(use, {"__name__": "example"})
    assert capsys.readouterr().out == "400000.0\n"


@pytest.mark.slow
def test_effect_of_the_page_is_diagnosed_and_laddered_by_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oil_film.py").write_text(blocks("adding_an_effect.md", "python")[0], encoding="utf-8")
    Path("rig.toml").write_text('base = "frame"\n[geometry]\nstoreys = 4\n', encoding="utf-8")
    truth = {"stiffness": 1e5, "coefficient": 40.0}
    library = effect_library(["oil_film.py"])
    rig = rig_with_effects(load_rig("rig.toml"), [("oil_film@storey2", truth)], library)
    Path("modes.toml").write_text(_table(rig, seed=0), encoding="utf-8")
    stages = 'stages=["modal", "ladder", "fit", "correlate", "diagnose"]'

    ema("run", "--modes", "modes.toml", "--rig", "rig.toml", "--out", "out", "--effect-file", "oil_film.py",
        "--set", stages, "--set", "diagnose.most_effects=1")  # fmt: skip
    found = load_results(existing_run(Path("out"))).diagnosis
    assert found is not None
    first = found.candidates[0]
    assert first.label == "oil_film@storey2"
    assert first.probability > 0.7

    ema("add", "out", "oil_film@storey2", "--effect-file", "oil_film.py")
    ladder = load_results(existing_run(Path("out"), ["oil_film.py"])).ladder
    assert ladder is not None
    base, added = ladder.rungs
    assert added.effects == ("oil_film@storey2",)
    assert added.heldout_error < 1.5 < base.heldout_error / 3
    for name, value in truth.items():
        size = added.parameters[f"oil_film@storey2.{name}"]
        assert abs(size.value - value) < 3 * size.std


def test_a_test_is_simulated_with_the_effect_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oil_film.py").write_text(blocks("adding_an_effect.md", "python")[0], encoding="utf-8")
    sized = ("--effect", "oil_film@sun:stiffness=3e7,coefficient=20")
    test = ("--configuration", "no_ring", "--impact", "sun.x", "--sensor", "sun.x", "--set", "duration_s=1.0")
    ema("simulate", "plain", *test)
    ema("simulate", "filmed", *sized, "--effect-file", "oil_film.py", *test)
    truth = {n: json.loads(Path(n, "truth.json").read_text(encoding="utf-8")) for n in ("plain", "filmed")}
    assert truth["filmed"]["values"]["oil_film@sun.stiffness"] == 3e7
    f = {n: [m["frequency_hz"] for m in t["configurations"]["no_ring"]["modes"]] for n, t in truth.items()}
    assert max(b / a for a, b in zip(f["plain"], f["filmed"], strict=True) if a > 1) > 1.001


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("EFFECT = Effect(", "effect = Effect(", 19, "the effect is called effect; call it EFFECT"),
        (
            'values["coefficient"]',
            'values["damping"]',
            15,
            "asks for 'damping', its parameters are 'stiffness'",
        ),
        (
            '"N/m", 0.0, 1e5',
            '"N/m", 7.0, 1e5',
            10,
            "changes the stiffness although all is null (stiffness = 7",
        ),
        ("return assembly.add(", "return assembly.ad(", 13, "does not work: AttributeError"),
        ("1e5, 3e5, 0.0, 1e9", "1e5, 0.0, 0.0, 1e9", 24, "'stiffness': scale 0 must be above 0"),
        ("1e5, 3e5, 0.0, 1e9", "1e5, 3e5, 2e5, 1e9", 24, "start 100000 lies outside"),
        (
            "def edit(assembly, place, values):",
            "def edit(assembly, place, values",
            10,
            "does not run: SyntaxError",
        ),
        ('id="oil_film"', "id=5", 19, "id '5' is no name"),
        ("1e5, 3e5, 0.0, 1e9", '"a", 3e5, 0.0, 1e9', 24, "'stiffness': start = 'a' must be a number"),
        (
            "1e5, 3e5, 0.0, 1e9",
            "1e5, 3e300, 0.0, 1e9",
            24,
            "'stiffness': scale = 3e+300 must not exceed 1e+30",
        ),
        (
            "    return assembly.add(",
            "    raise SystemExit(7)\n    return assembly.add(",
            13,
            "SystemExit: 7",
        ),
        ('values["stiffness"]', '1e300 * values["stiffness"]', 10, "makes the stiffness 1e+305 at its start"),
        (
            'values["stiffness"]',
            '-1e9 * values["stiffness"]',
            10,
            "at its start values the model's stiffness is",
        ),
    ],
)
def test_mistakes_in_an_effect_file_are_told_with_line_and_remedy_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, line: int, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    text = blocks("adding_an_effect.md", "python")[0]
    assert old in text
    Path("oil_film.py").write_text(text.replace(old, new), encoding="utf-8")
    Path("rig.toml").write_text('base = "frame"\n', encoding="utf-8")
    Path("modes.toml").write_text(_table(load_rig("rig.toml"), seed=0), encoding="utf-8")
    file = ("--effect-file", "oil_film.py")
    for command in (
        ("effects", "--rig", "rig.toml", *file),
        ("run", "--modes", "modes.toml", "--rig", "rig.toml", "--out", "out", *file),
    ):
        done = CliRunner().invoke(cli.app, list(command))
        assert isinstance(done.exception, EmaError)
        assert f"oil_film.py, line {line}: " in str(done.exception).replace(str(tmp_path) + "/", "")
        assert words in str(done.exception)
    assert not Path("out").exists()


def test_an_effect_that_adds_coordinates_cannot_be_null_within_its_range(tmp_path: Path) -> None:
    """A tuned absorber: without its mass there is one mode less, and nothing that is compared stays the same."""
    file = tmp_path / "absorber.py"
    text = """
from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.mechanics.assembly import Mass, Spring


def places(assembly):
    return assembly.bodies


def edit(assembly, place, values):
    if values["mass"] == 0.0:
        return assembly
    dof = f"{place}_absorber.x"
    spring = Spring(f"{place} absorber spring", {**assembly.row(f"{place}.x"), dof: -1.0}, 5e5 * values["mass"])
    return assembly.add(Mass(f"{place} absorber", {dof: 1.0}, values["mass"]), spring, dofs=(dof,))


EFFECT = Effect(
    id="absorber",
    title="a tuned absorber",
    parameters=(EffectParameter("mass", "kg", 0.0, 0.03, 0.05, MINIMUM, 10.0, "its mass"),),
    find_places=places,
    edit=edit,
    signs="a mode splits in two",
    reference="Den Hartog",
)
"""
    rig = load_rig("frame")
    file.write_text(text.replace("MINIMUM", "0.0"), encoding="utf-8")
    with pytest.raises(
        EmaError, match=r"adds coordinates, which cannot be where 'mass' is 0; .* to 5e-05 for"
    ):
        check_on_rig(effect_library([str(file)])["absorber"], rig, file)
    file.write_text(text.replace("MINIMUM", "5e-5"), encoding="utf-8")
    check_on_rig(effect_library([str(file)])["absorber"], rig, file)


def test_effects_of_a_file_are_listed_with_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("oil_film.py").write_text(blocks("adding_an_effect.md", "python")[0], encoding="utf-8")
    done = CliRunner().invoke(cli.app, ["effects", "--effect-file", "oil_film.py", "--json"])
    assert done.exit_code == 0
    listed = {e["id"]: e for e in json.loads(done.output)["effects"]}
    assert "sun" in listed["oil_film"]["places"]
    assert "mesh_stiffness_loss" in listed


def _table(rig: Rig, seed: int) -> str:
    """Modes of a rig with noise, as a table."""
    rng = np.random.default_rng(seed)
    system = rig.system("default")
    modes = complex_modes(system)
    count = len(modes.poles)
    f = modes.frequency_hz * (1 + 2e-4 * rng.standard_normal(count))
    z = modes.damping_ratio * (1 + 0.02 * rng.standard_normal(count))
    shape = modes.shapes / np.array([v[np.argmax(np.abs(v))] for v in modes.shapes.T])
    shape = shape + 0.003 * (rng.standard_normal(shape.shape) + 1j * rng.standard_normal(shape.shape))
    columns = {
        "frequency_hz": f,
        "frequency_std_hz": 2e-4 * f,
        "damping_ratio": z,
        "damping_std": 0.02 * z,
        "shape": shape.real,
        "shape_imag": shape.imag,
    }
    lines = [f"{name} = {values.tolist()}" for name, values in columns.items()]
    return "\n".join(["[default]", f"dofs = {json.dumps(system.dofs)}", "shape_std = 0.003", *lines])


def ema(*arguments: str) -> None:
    done = CliRunner().invoke(cli.app, list(arguments))
    assert done.exit_code == 0, (done.output, done.exception)


def test_own_law_of_the_page_dissipates_as_drag_does(tmp_path: Path) -> None:
    file = tmp_path / "drag.py"
    file.write_text(blocks("adding_an_effect.md", "python")[2], encoding="utf-8")
    library = effect_library([file])
    base = load_rig("planetary").assembly("no_ring")
    effect = library["drag"]
    assert effect.edit(base, "sun", effect.values()) is base
    (element, _) = effect.apply(base, "sun", {"coefficient": 30.0}).nonlinear
    n, amplitude, f = 2048, 1e-3, 20.0
    phase = 2 * np.pi * np.arange(n) / n
    x, v = amplitude * np.sin(phase), amplitude * 2 * np.pi * f * np.cos(phase)
    force = force_along((element,), x, v, 1 / (f * n))
    # Energy per cycle 8/3·c·ω²·A³.
    expected = 8 / 3 * 30.0 * (2 * np.pi * f) ** 2 * amplitude**3
    assert float(np.mean(force * v)) / f == pytest.approx(expected, rel=1e-6)


def test_the_page_names_every_element() -> None:
    page = (DOCS / "adding_an_effect.md").read_text(encoding="utf-8")
    for kind in (Mass, Spring, Damper, Gyroscopic, *_kinds(Nonlinear)):
        assert f"`{kind.__name__}(" in page, kind.__name__


def _kinds(kind: type) -> set[type]:
    found: set[type] = set()
    inner: type
    for inner in kind.__subclasses__():
        found |= {inner, *_kinds(inner)} if inner.__module__ == laws.__name__ else set()
    return found
