"""What is made of the table of a series: limits, judgements, comparison, trend, the page."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from bench import ema, write_bench

from ema_pipeline.errors import EmaError
from ema_pipeline.series.acceptance_limits import Range, learn_limits, read_limits
from ema_pipeline.series.compare import Comparison
from ema_pipeline.series.database import SeriesDatabase
from ema_pipeline.series.features import features_of_series, modes_of_tests
from ema_pipeline.series.judge import judged_value
from ema_pipeline.series.rows import COLUMNS, Row, TestRow, failed_row
from ema_pipeline.series.screens import comparison_table
from ema_pipeline.series.trend import order_of, trends_of
from ema_pipeline.significance import holm, tolerance_factor

SHAPES = np.array([[1.0, 0.8, 0.3], [0.5, -0.6, 1.0]])
FREQUENCY_STD = 0.01


def _row(
    name: str, frequencies: list[float], date: str = "", effect: tuple[str, str, float] | None = None
) -> TestRow:
    test: Row = dict.fromkeys(COLUMNS["tests"], "")
    test |= {
        "test": name,
        "state": "ok",
        "verdict": "effect" if effect else "adequate",
        "date": date,
        "key": "k",
    }
    test |= {"error": 0.9, "hits_used": 4, "hits_rejected": 0, "modes": len(frequencies), "serial_number": ""}
    modes = tuple(
        {
            "test": name, "configuration": "default", "mode": k + 1, "frequency_hz": f,
            "frequency_std_hz": FREQUENCY_STD, "damping_ratio": 0.01, "damping_std": 1e-4, "mac": None, "mpc": 1.0,
            "shape": json.dumps({"dofs": ["a.x", "b.x", "c.x"], "re": list(SHAPES[k]), "im": [0.0] * 3}),
        }
        for k, f in enumerate(frequencies)
    )  # fmt: skip
    effects: tuple[Row, ...] = ()
    if effect:
        size = {"name": "mass", "value": effect[2], "std": 0.01, "unit": "kg", "probability": 0.98}
        effects = ({"test": name, "effect": effect[0], "at": effect[1], **size},)
    return TestRow(test, modes, (), effects)


def _series(folder: Path, count: int = 20, step: float = 0.0) -> SeriesDatabase:
    """Tests whose first mode scatters by 0.1 Hz; `step` is added to it from the middle on."""
    random = np.random.default_rng(8)
    folder.mkdir(exist_ok=True)
    database = SeriesDatabase(folder)
    database.set_fact("tree", "tree")
    for i in range(count):
        first = 30.0 + 0.1 * random.standard_normal() + (step if i >= count // 2 else 0.0)
        second = 50.0 + 0.2 * random.standard_normal()
        database.write(_row(f"unit{i + 1}", [first, second]))
    return database


def test_tolerance_factors() -> None:
    """Well-known values of the tables, and the share of simulated samples whose interval holds the content."""
    assert tolerance_factor(10, 0.95, 0.95, sides=1) == pytest.approx(2.911, abs=5e-4)
    assert tolerance_factor(10, 0.95, 0.95) == pytest.approx(3.393, abs=1e-3)
    random = np.random.default_rng(0)
    for count, content, confidence in ((5, 0.9, 0.95), (20, 0.99, 0.9)):
        samples = random.standard_normal((40_000, count))
        half = tolerance_factor(count, content, confidence) * samples.std(axis=1, ddof=1)
        ends = samples.mean(axis=1)[:, None] + half[:, None] * np.array([-1, 1])
        held = np.diff(scipy.stats.norm.cdf(ends), axis=1) >= content
        assert float(held.mean()) == pytest.approx(confidence, abs=0.006)


def test_holm() -> None:
    """Adjusted values keep their order; NaN stays NaN."""
    assert holm([0.01, 0.04, np.nan, 0.03]) == pytest.approx([0.03, 0.06, np.nan, 0.06], nan_ok=True)


def test_learnt_limits_hold_what_they_state() -> None:
    """Of 500 simulated good lots, 95 % have limits that hold 95 % of all good tests."""
    random = np.random.default_rng(3)
    k = tolerance_factor(15, 0.95, 0.95)
    lots = random.standard_normal((500, 15))
    centre, half = lots.mean(axis=1), k * lots.std(axis=1, ddof=1)
    held = scipy.stats.norm.cdf(centre + half) - scipy.stats.norm.cdf(centre - half) >= 0.95
    assert scipy.stats.binomtest(int(held.sum()), 500, 0.95).pvalue > 0.01


def test_limits_of_several_features_hold_together(tmp_path: Path) -> None:
    """Content and confidence are divided among the features."""
    database = _series(tmp_path / "S")
    features, named = features_of_series(database)
    limits, notes = learn_limits(features, modes_of_tests(database)[named], 0.9, 0.95)
    first = limits.modes[0].frequency
    assert first is not None
    values = features.values["mode 1 frequency"]
    k = tolerance_factor(20, 1 - 0.1 / 2, 1 - 0.05 / 2)  # frequencies: damping does not scatter at all
    assert first.max == pytest.approx(values.mean() + k * values.std())
    assert any("mode 1 damping" in n for n in notes)
    with pytest.raises(EmaError, match="limits need 5"):
        learn_limits(features.__class__(features.values[:3], features.stds[:3], features.about), {})


@pytest.mark.parametrize(
    ("value", "outcome"),
    [(10.0, "pass"), (9.0, "fail"), (9.505, "undecided"), (10.49, "undecided"), (np.nan, "undecided")],
)
def test_a_value_is_undecided_where_its_interval_holds_a_limit(value: float, outcome: str) -> None:
    """Two-sided 95 %."""
    assert judged_value("f", value, 0.01, Range(min=9.5, max=10.5)).outcome == outcome


def test_judge_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Learnt limits, a reject with its effect, one without results, one on the line, one without a mode."""
    folder = tmp_path / "S"
    database = _series(folder)
    with pytest.raises(EmaError, match=r"there are no limits yet; 'ema series limits' learns them"):
        read_limits(folder / "limits.toml")
    assert ema(capsys, "series", "limits", folder)[0] == 0
    limits = read_limits(folder / "limits.toml")
    edge = limits.modes[0].frequency
    assert edge is not None
    assert edge.max is not None
    database.write(_row("heavy", [27.0, 50.0], effect=("mass", "a", 0.5)))
    database.write(_row("edge", [edge.max, 50.0]))
    database.write(_row("short", [30.0]))
    database.write(failed_row("broken", "raw", "k", "no such file"))
    code, said, _ = ema(capsys, "series", "judge", folder, "--json")
    judged = {t["test"]: t for t in json.loads(said)["tests"]}
    assert code == 0
    assert judged["unit1"]["outcome"] == "pass"
    assert judged["heavy"]["outcome"] == "fail"
    assert judged["heavy"]["why"].startswith(
        "mass at a, mass 0.500 ± 0.010 kg (probability 98 %); mode 1 frequency"
    )
    assert judged["edge"]["outcome"] == "undecided"
    assert judged["broken"]["why"] == "no results: no such file"
    assert judged["short"]["outcome"] == "undecided"
    assert "mode 2 frequency not found" in judged["short"]["why"]
    assert "1 fail" in ema(capsys, "series", "judge", folder)[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[modes]]\nfrequency_hz = 30\nfrequency = { min = 3, max = 2 }", "min 3 is above max 2"),
        ("[[modes]]\nfrequency_hz = 30\nfrequncy = { min = 3 }", "did you mean 'frequency'"),
        ("[[modes]]\nfrequency_hz = 30\nshape = { dofs = ['a.x'], re = [1, 2] }", "one number for each"),
        ('effects = "ignore"', "holds no limit"),
    ],
)
def test_wrong_limits_are_said_in_one_line(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """File, key and remedy."""
    _series(tmp_path / "S", 2).close()
    file = tmp_path / "limits.toml"
    file.write_text(text, encoding="utf-8")
    code, _, err = ema(capsys, "series", "judge", tmp_path / "S", "--limits", file)
    assert code == 1
    assert said in err
    assert len(err.splitlines()) == 1


def test_hand_written_limits_need_no_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A mode is found by its frequency alone."""
    _series(tmp_path / "S", 3).close()
    file = tmp_path / "limits.toml"
    file.write_text("[[modes]]\nfrequency_hz = 50\nfrequency = { min = 45 }\n", encoding="utf-8")
    _, said, _ = ema(capsys, "series", "judge", tmp_path / "S", "--limits", file)
    assert "3 pass, 0 fail, 0 undecided" in said


def test_modes_are_matched_where_one_is_missing(tmp_path: Path) -> None:
    """The second mode of a test that lacks the first is still mode 2 of the series."""
    database = _series(tmp_path / "S", 4)
    row = _row("odd", [30.0, 50.2])
    database.write(TestRow(row.test, (row.modes[1] | {"mode": 1},)))
    features, _ = features_of_series(database)
    assert features.values.loc["odd", "mode 2 frequency"] == pytest.approx(50.2)
    assert np.isnan(features.values.loc["odd", "mode 1 frequency"])


def test_compare_shows_outliers_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One value far out is named; the others are not."""
    database = _series(tmp_path / "S")
    database.write(_row("odd", [31.5, 50.0]))
    _, said, _ = ema(capsys, "series", "compare", tmp_path / "S", "--json")
    found = json.loads(said)["outliers"]
    assert [(o["test"], o["feature"]) for o in found] == [("odd", "mode 1 frequency")]
    table = {r["feature"]: r for r in json.loads(said)["features"]}
    assert table["mode 2 frequency"]["tests"] == 21
    assert ema(capsys, "series", "compare", tmp_path / "S")[0] == 0


def test_a_row_of_the_comparison_has_one_unit() -> None:
    """Uncertainty, least and largest have the prefix of the mean; damping is in per cent."""
    rows = {
        "k1": ("N/m", 3, 202.6e3, 2.4e3, 1.8e3, 199.9e3, 204.5e3),
        "mode 1 damping": ("1", 3, 0.01, 0.0002, 1e-4, 0.0098, 0.0102),
    }
    names = ["unit", "tests", "mean", "std_between", "std_of_one", "min", "max"]
    found = Comparison(pd.DataFrame.from_dict(rows, orient="index", columns=names), pd.DataFrame())
    columns = [list(column.cells) for column in comparison_table(found).columns]
    assert [column[0] for column in columns] == ["k1", "3", "202.6 ± 2.4 kN/m", "1.8", "199.900", "204.500"]
    assert [column[1] for column in columns[2:]] == ["1.000 ± 0.020 %", "0.010", "0.980000", "1.02000"]


def test_trend_finds_a_step_and_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A step of four standard deviations; names are in the order in which people count."""
    _series(tmp_path / "S", 24, step=0.4).close()
    _, said, _ = ema(capsys, "series", "trend", tmp_path / "S", "--json")
    told = json.loads(said)
    assert told["tests"][:3] == ["unit1", "unit2", "unit3"]
    first, second = (f for f in told["features"] if f["feature"].endswith("frequency"))
    assert first["steps"] == ["unit13"]
    assert not first["drifts"]
    assert not second["steps"]
    assert not second["drifts"]
    assert ema(capsys, "series", "trend", tmp_path / "S")[0] == 0


def test_trend_finds_a_drift_by_date(tmp_path: Path) -> None:
    """0.01 Hz a day, tests in no order of their names."""
    (tmp_path / "S").mkdir()
    database = SeriesDatabase(tmp_path / "S")
    random = np.random.default_rng(1)
    for i in range(20):
        frequency = 30.0 + 0.01 * i + 0.02 * random.standard_normal()
        database.write(_row(f"t{(7 * i) % 20}", [frequency, 50.0], date=f"2025-03-{i + 1:02d}"))
    order = order_of(database.table("tests"))
    assert (order.by, order.unit) == ("date", "day")
    found = trends_of(features_of_series(database)[0], order)[0]
    assert found.drifts
    assert not found.steps
    assert abs(found.slope - 0.01) < 3 * found.slope_std


def test_false_alarms_of_trends_are_rare() -> None:
    """White series: a drift in 1 % of them and a step in less, over all features together."""
    import pandas as pd

    from ema_pipeline.series.features import Features
    from ema_pipeline.series.trend import Order

    random = np.random.default_rng(5)
    about = pd.DataFrame({"quantity": "frequency", "unit": "Hz"}, index=["a", "b", "c"])
    tests = [f"t{i}" for i in range(30)]
    alarms = 0
    for _ in range(300):
        values = pd.DataFrame(random.standard_normal((30, 3)), index=tests, columns=about.index)
        found = trends_of(
            Features(values, values * 0, about), Order(tuple(tests), np.arange(30.0), "test", "name")
        )
        alarms += any(t.drifts or t.steps for t in found)
    assert scipy.stats.binomtest(alarms, 300, 0.02, alternative="greater").pvalue > 0.01, alarms


def test_export_replaces_files_in_the_folder_of_the_series_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _series(tmp_path / "S", count=2)
    mine = tmp_path / "modes.csv"
    mine.write_text("mine", encoding="utf-8")
    code, _, err = ema(capsys, "series", "export", tmp_path / "S", "--to", tmp_path)
    assert (code, err.count("\n")) == (1, 1), err
    assert f"{mine}: exists already and is kept; name another folder with --to" in err
    assert mine.read_text(encoding="utf-8") == "mine"
    assert not (tmp_path / "tests.csv").exists()
    for _ in range(2):
        assert ema(capsys, "series", "export", tmp_path / "S")[0] == 0


def test_page_is_self_contained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every test is a row, the reject says why, names cannot become markup, nothing is loaded."""
    database = _series(tmp_path / "S")
    assert ema(capsys, "series", "limits", tmp_path / "S")[0] == 0
    database.write(_row("<b>x", [27.0, 50.0], effect=("mass", "a", 0.5)))
    assert ema(capsys, "series", "report", tmp_path / "S")[0] == 0
    text = (tmp_path / "S" / "report.html").read_text(encoding="utf-8")
    assert "&lt;b&gt;x" in text
    assert "<b>x" not in text
    assert "mass at a, mass 0.500 ± 0.010 kg" in text
    assert text.count('data-sort="4.0"') >= 21
    assert "://" not in text.replace("http://www.w3.org", "")
    assert text.count("data:image/png") == 2


def test_page_of_a_series_without_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only reasons."""
    (tmp_path / "S").mkdir()
    database = SeriesDatabase(tmp_path / "S")
    database.write(failed_row("broken", "raw", "k", "no such file"))
    assert ema(capsys, "series", "report", tmp_path / "S")[0] == 0
    assert "no such file" in (tmp_path / "S" / "report.html").read_text(encoding="utf-8")
    code, _, err = ema(capsys, "series", "compare", tmp_path / "S")
    assert code == 1
    assert "no test has modes" in err


@pytest.mark.slow
def test_learned_limits_take_the_place_of_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The database, a note and limits by hand are kept."""
    folder = tmp_path / "S"
    _series(folder).close()
    assert ema(capsys, "series", "limits", folder)[0] == 0
    assert ema(capsys, "series", "limits", folder)[0] == 0
    (tmp_path / "note.txt").write_text("mine", encoding="utf-8")
    (tmp_path / "own.toml").write_text("[[modes]]\nfrequency_hz = 30\n", encoding="utf-8")
    for kept in (folder / "series.db", tmp_path / "note.txt", tmp_path / "own.toml"):
        before = kept.read_bytes()
        code, _, err = ema(capsys, "series", "limits", folder, "--to", kept)
        assert code == 1
        assert f"{kept}: holds something else than learned limits and is kept" in err
        assert kept.read_bytes() == before
    assert "is a folder" in ema(capsys, "series", "limits", folder, "--to", tmp_path)[2]


FOREIGN = {
    "empty": ((), "was not run"),
    "another_program": (("CREATE TABLE customers (name TEXT)",), "table 'customers' is not that of a series"),
    "other_columns": (("ALTER TABLE tests DROP COLUMN reason",), "table 'tests' is not that of a series"),
    "text_for_a_number": (
        ("UPDATE modes SET frequency_hz = 'abc'",),
        "holds 'abc' in the column 'frequency_hz'",
    ),
    "no_shape": (("UPDATE modes SET shape = '{'",), "the modes of test 'unit1' are damaged"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_database_that_is_none_of_a_series_is_said_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes, said = FOREIGN[case]
    folder = tmp_path / "S"
    if case in ("empty", "another_program"):
        folder.mkdir()
        (folder / "series.db").touch()
    else:
        _series(folder, 2).close()
    connection = sqlite3.connect(folder / "series.db")
    with connection:
        for text in changes:
            connection.execute(text)
    connection.close()
    for verb in ("compare", "trend", "report"):
        code, _, err = ema(capsys, "series", verb, folder)
        assert code == 1
        assert said in err
        assert len(err.splitlines()) == 1


def test_a_series_takes_the_place_of_no_other_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = write_bench(tmp_path / "tree")
    for name, said in (
        ("ema.h5", "results of a test"),
        ("changes.json", "comparison"),
        ("test.toml", "raw data"),
    ):
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).touch()
        code, _, err = ema(capsys, "series", "run", tmp_path / "tree", "--out", out)
        assert code == 1
        assert said in err
        assert [path.name for path in out.iterdir()] == [name]
    (tmp_path / "S").mkdir()
    (tmp_path / "S" / "series.db").touch()
    assert "holds a series of tests" in ema(capsys, "run", raw, "--out", tmp_path / "S")[2]
