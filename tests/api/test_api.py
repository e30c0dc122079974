"""The Python interface: the eight lines of the README, what they give, and what they say when something is wrong."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import shutil
import subprocess
import sys
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

import ema_pipeline as ema
from ema_pipeline import cli
from ema_pipeline.loops.simulate import PRINTED, write_sine_tests
from ema_pipeline.simulate import simulate_campaign

EFFECT = "spring@storey2"
MODULES = ("arguments", "diagnosis", "fits", "frfs", "ladder", "modes", "records", "results", "rigs")


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame of three storeys with a spring that its model does not know, and its rig file beside the folder."""
    folder = tmp_path_factory.mktemp("api") / "raw"
    folder.mkdir()
    rig = folder.parent / "three_storeys.toml"
    rig.write_text('base = "frame"\n[geometry]\nstoreys = 3\n', encoding="utf-8")
    simulate_campaign(
        folder, str(rig), effects=[f"{EFFECT}:stiffness=60000"], imperfection="good", format="hdf5", seed=3
    )
    return folder


@pytest.fixture(scope="module")
def lines(raw: Path) -> SimpleNamespace:
    """The eight lines."""
    rig = ema.load_rig(raw.parent / "three_storeys.toml")
    test = ema.read(raw)
    frfs = test.frfs()
    modes = ema.identify(frfs)
    fit = ema.fit(rig, modes)
    found = ema.diagnose(rig, modes, frfs)
    better = found.add(EFFECT)
    return SimpleNamespace(
        raw=raw, rig=rig, test=test, frfs=frfs, modes=modes, fit=fit, found=found, better=better
    )


@pytest.fixture(scope="module")
def results(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands make of the same test: `ema run`, then `ema add`."""
    out = tmp_path_factory.mktemp("api_out") / "results"
    stages = 'stages=["ingest", "hits", "frf", "modal", "levels", "ladder", "diagnose", "fit", "correlate"]'
    rig = str(raw.parent / "three_storeys.toml")
    words = ["run", str(raw), "--rig", rig, "--out", str(out), "--set", stages, "--quiet"]
    assert CliRunner().invoke(cli.app, words).exit_code == 0
    return out


def test_the_eight_lines_give_what_the_commands_give_to_the_last_digit(
    lines: SimpleNamespace, results: Path
) -> None:
    opened = ema.open(results)
    pd.testing.assert_frame_equal(opened.modes.table(), lines.modes.table(), check_exact=True)
    assert np.array_equal(opened.frfs.h, lines.frfs.h)
    assert np.array_equal(opened.modes.shapes, lines.modes.shapes)
    pd.testing.assert_frame_equal(opened.fit.table(), lines.fit.table(), check_exact=True)
    assert opened.fit.error == lines.fit.error
    pd.testing.assert_frame_equal(opened.diagnosis.table(), lines.found.table(), check_exact=True)
    assert opened.diagnosis.probabilities == lines.found.probabilities
    assert opened.diagnosis.summary == lines.found.summary


def test_the_diagnosis_names_the_spring_and_its_rung_explains_the_data(lines: SimpleNamespace) -> None:
    assert lines.found.verdict == "effect"
    first = lines.found.candidates[0]
    assert (first.label, first.claimed) == (EFFECT, True)
    before, after = lines.better.ladder().rungs
    assert (before.effects, after.effects) == ((), (EFFECT,))
    assert after.error < 1.5 < before.error
    size = lines.better.parameters[f"{EFFECT}.stiffness"]
    assert size.value == pytest.approx(60000, abs=4 * size.std)


def test_a_result_stays_what_it_was_when_more_is_computed_from_it(lines: SimpleNamespace) -> None:
    before = lines.fit.table()
    assert lines.fit.effects == ()
    assert lines.fit.add(EFFECT).remove(EFFECT).effects == ()
    other = lines.test.frfs({"frf.estimator": "H2"})
    assert not np.array_equal(other.h, lines.frfs.h)
    pd.testing.assert_frame_equal(ema.fit(lines.rig, lines.modes).table(), before, check_exact=True)
    assert np.array_equal(ema.identify(lines.frfs).frequency_hz, lines.modes.frequency_hz)
    with pytest.raises(FrozenInstanceError):
        lines.fit.effects = ("x",)
    with pytest.raises(ema.EmaError, match="no added effects"):
        lines.fit.ladder()


def test_every_result_prints_shows_html_gives_a_table_and_draws_on_given_axes(lines: SimpleNamespace) -> None:
    words = {
        "test": "6 of 6 used",
        "frfs": "3 responses × 3 impact points",
        "modes": "plscf",
        "rig": "storey1_stiffness",
        "fit": "error",
        "found": "Missing: spring at storey2",
        "better": EFFECT,
    }
    for name, word in words.items():
        result = getattr(lines, name)
        assert word in repr(result)
        assert "<table" in result._repr_html_()
        assert len(result.table())
    for result in (lines.test, lines.frfs, lines.modes, lines.fit, lines.found, lines.better.ladder()):
        ax = Figure().subplots()
        assert result.plot(ax) is ax
        assert ax.lines or ax.patches


def test_names_from_files_steer_neither_notebook_nor_terminal() -> None:
    evil = ema.Rig.of_elements("<script>[red]\x1b[2Jx</script>", masses=[{"at": "a.x", "value": 1.0}])
    assert "<script>" not in evil._repr_html_()
    assert "[red]" in repr(evil)
    assert "\x1b" not in repr(evil)


def test_the_examples_of_the_docstrings_are_true(lines: SimpleNamespace) -> None:
    names = {**vars(lines), "ema": ema}
    runner = doctest.DocTestRunner(optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    for module in ("ema_pipeline", *(f"ema_pipeline.api.{m}" for m in MODULES)):
        for example in doctest.DocTestFinder().find(importlib.import_module(module), extraglobs=names):
            runner.run(example)
    tried = runner.summarize(verbose=False)
    assert tried.failed == 0
    assert tried.attempted >= 20


def test_importing_is_cheap_and_brings_neither_pyplot_nor_the_numerical_libraries() -> None:
    code = (
        "import sys, ema_pipeline as ema; assert not {'numpy', 'pandas', 'matplotlib'} & set(sys.modules);"
        "dir(ema); ema.read, ema.identify, ema.load_rig, ema.fit, ema.diagnose, ema.run, ema.open;"
        "assert 'matplotlib.pyplot' not in sys.modules;"
        "import ema_pipeline.fit.types, ema_pipeline.diagnose.types;"
        "assert callable(ema.fit) and callable(ema.diagnose)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_without_axes_a_plot_makes_a_figure_of_its_own(lines: SimpleNamespace) -> None:
    from matplotlib import pyplot

    mpl.use("Agg")
    ax = lines.modes.plot()
    assert ax.figure.number in pyplot.get_fignums()
    pyplot.close(ax.figure)


def test_a_rig_built_in_python_is_fitted_like_one_from_a_file(lines: SimpleNamespace) -> None:
    stiffness = {"value": 2e5, "unit": "N/m", "tolerance": 0.10}
    mass = {"value": 5.0, "unit": "kg", "tolerance": 0.01}
    plain = ema.Rig.of_elements("r", parameters={"m": 5.0}, masses=[{"at": "a.x", "value": "m"}])
    assert plain.parameters["m"].value == 5.0
    built = ema.Rig.of_elements(
        "my frame",
        parameters={**{f"k{n}": stiffness for n in (1, 2, 3)}, **{f"m{n}": mass for n in (1, 2, 3)}},
        masses=[{"at": f"storey{n}.x", "value": f"m{n}"} for n in (1, 2, 3)],
        springs=[
            {"at": "storey1.x", "value": "k1"},
            {"between": ("storey1.x", "storey2.x"), "value": "k2"},
            {"between": ("storey2.x", "storey3.x"), "value": "k3"},
        ],
    )
    assert built.table()["frequency_hz"].tolist() == pytest.approx(lines.rig.table()["frequency_hz"].tolist())
    better = ema.fit(built, lines.modes, effects=["spring@storey2.x"])
    assert better.error < 1.5
    assert better.parameters["k2"].value == pytest.approx(2e5, rel=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: ema.read(x.raw / "nothing"), "nothing"),
        (lambda x: ema.load_rig("planetery"), "did you mean 'planetary'"),
        (lambda x: ema.fit("planetary", x.modes), "has no configuration 'default'"),
        (lambda x: ema.fit(ema.Rig.of_elements("r", masses=[{"at": "a.x", "value": 1.0}]), x.modes), "has no dof"),
        (lambda x: x.found.add("sprig@storey1"), "did you mean"),
        (lambda x: x.found.add("spring@storey9"), "storey9"),
        (lambda x: x.frfs["with_ring"], "no configuration 'with_ring'"),
        (lambda x: x.frfs.plot(pairs=[("a.x", "storey1.x")]), "'a.x' was not measured"),
        (lambda x: x.test.frfs({"frf.estimater": "H2"}), "did you mean 'frf.estimator'|estimator"),
        (lambda x: ema.run(x.raw, rig=x.rig), "rig file"),
        (lambda x: ema.Rig.of_elements("r", masses=[{"at": "a.x", "valu": 1.0}]), "valu"),
        (lambda x: ema.Rig.of_elements("r", parameters={"m": "2 kg"}, masses=[]), "give a number, or a table such as"),
        (lambda x: ema.open(x.raw), "holds no ema.h5"),
        (lambda _: ema.read(None), "raw: give a path, not None"),
        (lambda x: ema.run(x.raw, out=5), "out: give a path, not 5"),
        (lambda _: ema.open(None), "out: give a path, not None"),
        (lambda _: ema.load_rig(None), "name_or_path: give the name of a rig or the path"),
        (lambda x: ema.read_modes("modes.csv", x.rig), "rig: give the name of a rig or the path of a rig file, not"),
        (lambda _: ema.identify(None), "frfs: give FRFs, as test.frfs.. gives them, not None"),
        (lambda x: ema.fit(None, x.modes), "rig: give a rig, .* not None"),
        (lambda x: ema.fit(x.rig, x.frfs), "modes: give modes, as ema.identify.frfs. gives them, not Frfs"),
        (lambda x: ema.fit(x.rig, x.modes, effects="spring@base"), "effects: give texts .* not 'spring@base'"),
        (lambda x: ema.fit(x.rig, x.modes, effect_files="a.py"), "effect_files: give a list of paths, not 'a.py'"),
        (lambda x: ema.diagnose(x.rig, None, x.frfs), "modes: give modes"),
        (lambda x: ema.diagnose(x.rig, x.modes, x.modes), "frfs: give FRFs, .* not Modes"),
        (lambda x: x.found.add(None), "effects: give texts such as 'spring@base', not None"),
        (lambda x: x.found.add([EFFECT]), "effects: give texts such as 'spring@base', not ..spring@storey2"),
        (lambda x: x.fit.remove(None), "effects: give texts"),
        (lambda x: x.frfs[0], "configuration: give the name of a configuration, e.g. 'default', not 0"),
        (lambda x: x.modes[0], "configuration: give the name"),
        (lambda x: x.test.frfs(settings="x"), "settings: give settings by their dotted name, .* not 'x'"),
        (
            lambda x: ema.identify(x.frfs, settings={"frf.estimator": "H2"}),
            r"'frf.estimator' cannot change what is there already; give it to Test.frfs.settings=",
        ),
        (
            lambda x: ema.diagnose(x.rig, x.modes, settings={"modal.identify.low_hz": 20}),
            r"'modal.identify.low_hz' cannot change .* give it to ema.identify",
        ),
        (lambda x: x.test.frfs({"frf.estimator": object()}), "settings: a value is no number, text or list"),
        (lambda _: ema.Parameter("k", float("nan"), "N/m"), "parameter 'k': value = nan: give a number"),
        (lambda _: ema.Parameter("k", "1", "N/m"), "parameter 'k': value = '1': give a number"),
        (lambda _: ema.Parameter("k", float("inf"), "N/m"), "give a finite number"),
        (lambda _: ema.Parameter("k", 1.0, "N/m", tolerance=-0.1), "tolerance = -0.1: give 0 or more"),
        (lambda _: ema.Parameter("k", 1.0, "N/m", minimum=3.0, maximum=2.0), "exchange them"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_clear_line(lines: SimpleNamespace, call: object, message: str) -> None:
    assert callable(call)
    with pytest.raises(ema.EmaError, match=message) as told:
        call(lines)
    assert "\n" not in str(told.value)


def test_hits_and_modes_to_exclude_are_lists_of_texts(results: Path) -> None:
    opened = ema.open(results)
    with pytest.raises(ema.EmaError, match=r"hits: give a list of texts .* not 'default/a.h5#1'"):
        opened.exclude(hits="default/a.h5#1")
    with pytest.raises(ema.EmaError, match="modes: give a list of texts 'configuration:hertz', not 5"):
        opened.exclude(modes=[5])
    with pytest.raises(ema.EmaError, match="modes: give a list of texts"):
        opened.include(modes=None)


def test_numbers_of_numpy_are_numbers() -> None:
    def block(mass: object, stiffness: object) -> float:
        rig = ema.Rig.of_elements(
            "block",
            parameters={"k": {"value": stiffness}},
            masses=[{"at": "b.x", "value": mass}],
            springs=[{"at": "b.x", "value": "k"}],
        )
        return float(rig.table()["frequency_hz"].iloc[0])

    assert block(np.int64(2), np.float32(8e4)) == block(2, 8e4)
    assert ema.Parameter("k", np.float32(2.0), "N/m", minimum=np.int64(1)).value == 2.0


def test_a_campaign_is_asked_by_configuration() -> None:
    sample = Path(__file__).parents[2] / "sample_data" / "healthy"
    frfs = ema.read(sample).frfs()
    assert frfs.configurations == ("no_ring", "with_ring")
    assert frfs["no_ring"].h.shape[1] == 4
    with pytest.raises(ema.EmaError, match=r"choose one, e.g. frfs\['no_ring'\]"):
        _ = frfs.h
    ax = frfs.plot(Figure().subplots())
    assert {line.get_label().partition(":")[0] for line in ax.lines} == {"no_ring", "with_ring"}


def test_a_test_without_a_model_says_what_its_results_do_not_hold(raw: Path, tmp_path: Path) -> None:
    stages = ["ingest", "hits", "frf", "modal"]
    done = ema.run(raw, out=tmp_path / "out", settings={"stages": stages})
    assert done.modes.frequency_hz.size == done.table().shape[0] == 3
    for name in ("fit", "diagnosis", "ladder"):
        with pytest.raises(ema.EmaError, match=f"out: holds no {'fitted model' if name == 'fit' else name}"):
            getattr(done, name)


def test_loops_are_run_and_opened_but_have_no_frfs(tmp_path: Path) -> None:
    write_sine_tests(tmp_path / "loops", PRINTED, (10.0, 15.0), (1e-3, 2e-3))
    with pytest.raises(ema.EmaError, match=r"loops, which have no FRFs; use ema\.run"):
        ema.read(tmp_path / "loops")
    done = ema.run(tmp_path / "loops", out=tmp_path / "out", settings={"stages": ["loops", "ladder"]})
    added = done.add("hysteresis@isolator")
    assert added.effects == ("hysteresis@isolator",)
    assert added.ladder.rungs[1].error < added.ladder.rungs[0].error
    assert added.remove("hysteresis@isolator").effects == ()
    with pytest.raises(ema.EmaError, match="out: holds no modes"):
        _ = done.modes


def test_a_table_of_modes_is_fitted_like_identified_ones(tmp_path: Path) -> None:
    table = tmp_path / "modes.toml"
    table.write_text("[default]\nfrequency_hz = [14.2, 39.5, 57.0]\n", encoding="utf-8")
    modes = ema.read_modes(table, "frame")
    assert modes.frequency_hz.tolist() == [14.2, 39.5, 57.0]
    ax = Figure().subplots()
    assert modes.plot(ax) is ax


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": None}, "name: give a text, not None"),
        ({"configurations": "default"}, "configurations: give a list of names"),
        ({"configurations": ()}, "has no configuration; give at least one name"),
        ({"parameters": None}, "parameters: give ema.Parameter by name"),
        ({"parameters": {"k": 1e4}}, r"parameter 'k': give ema.Parameter\('k', value, unit\), not 10000.0"),
        ({"build": None}, "build: give a function, not None"),
        ({"modal_damping_scatter": float("nan")}, "modal_damping_scatter = nan: give 0 or more"),
        (
            {"parameters": {"modal_damping_ratio": ema.Parameter("modal_damping_ratio", -1.0, "1")}},
            "modal_damping_ratio = -1: a damping ratio lies from 0 to below 1",
        ),
    ],
)
def test_a_rig_built_in_python_is_checked(changes: dict, message: str) -> None:
    with pytest.raises(ema.EmaError, match=message):
        dataclasses.replace(ema.load_rig("frame"), **changes)


def test_a_rig_whose_function_gives_no_assembly_says_so() -> None:
    rig = dataclasses.replace(ema.load_rig("frame"), build=lambda configuration, values: None)
    with pytest.raises(ema.EmaError, match="build gives NoneType for 'default'; let it return an Assembly"):
        rig.table()


def test_a_rig_whose_function_asks_for_a_parameter_that_it_lacks_says_so() -> None:
    rig = dataclasses.replace(ema.load_rig("frame"), build=lambda configuration, values: values["k9"])
    with pytest.raises(
        ema.EmaError, match=r"rig 'frame': build asks for 'k9', the parameters are '.*name them alike"
    ):
        rig.table()


def test_axes_that_are_none_and_a_summary_that_is_gone_are_said(
    lines: SimpleNamespace, results: Path, tmp_path: Path
) -> None:
    with pytest.raises(ema.EmaError, match=r"ax: give axes of Matplotlib, .* not 3"):
        lines.fit.plot(3)
    shutil.copytree(results, tmp_path / "copy")
    (tmp_path / "copy" / "summary.json").unlink(missing_ok=True)
    with pytest.raises(
        ema.EmaError, match=r"summary\.json: cannot be read .*; write it again with 'ema report"
    ):
        _ = ema.open(tmp_path / "copy").summary
