"""The tally of the calibration study by hand, and its cases as raw folders that the program takes."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not BENCHMARKS.is_dir():
    pytest.skip(
        "benchmarks are not at hand (an installed package does not hold them)", allow_module_level=True
    )
sys.path.insert(0, str(BENCHMARKS))

import study_cases  # noqa: E402
import study_own_rigs  # noqa: E402
import study_tally as tally  # noqa: E402

from ema_pipeline.ingest.campaign import read_campaign  # noqa: E402
from ema_pipeline.rigs import load_rig  # noqa: E402


def line(**changes: Any) -> dict[str, Any]:
    """A case in which a spring of 1e5 N/m at m2 of a chain was named rightly."""
    truth = {"label": "spring@m2.x", "parameter": "stiffness", "size": 1e5, "also": ""}
    return {
        "kind": "own",
        "level": "good",
        "number": 1,
        "without": False,
        "hidden": 1,
        "rig": "fixed chain 1",
        "truth": [truth],
        "values": {"k1": 1.0},
        "verdict": "effect",
        "claimed": ["spring@m2"],
        "groups": [],
        "candidates": [{"label": "spring@m2", "probability": 0.9, "sizes": {"stiffness": [1.1e5, 1e4]}}],
        "nothing": 0.05,
        "error": 1.0,
        "limits": [{"label": "spring@m2", "parameter": "stiffness", "size": 2e4, "unit": "N/m"}],
        "fit": {"k1": [1.1, 0.1]},
        "seconds": {"simulate": 1.0, "run": 5.0},
    } | changes


HEALTHY: dict[str, Any] = {"truth": [], "hidden": 0}
SILENT: dict[str, Any] = {"verdict": "adequate", "claimed": []}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "right"),
        ({"claimed": ["spring@m2.x"]}, "right"),
        ({"claimed": ["mass@m3"], "groups": [["mass@m3", "spring@m2"]], "verdict": "ambiguous"}, "group"),
        ({"claimed": [], "groups": [["mass@m3", "spring@m2"]], "verdict": "ambiguous"}, "group"),
        ({"claimed": ["mass@m3"]}, "wrong"),
        ({"claimed": ["spring@m2", "mass@m3"]}, "wrong"),
        ({"claimed": [], "groups": [["mass@m3", "mass@m1"]], "verdict": "ambiguous"}, "wrong"),
        (SILENT, "missed above"),
        (
            {**SILENT, "limits": [{"label": "spring@m2", "parameter": "stiffness", "size": 6e4}]},
            "missed below",
        ),
        ({**SILENT, "verdict": "unknown_effect"}, "unknown"),
        ({**HEALTHY, **SILENT}, "right"),
        ({**HEALTHY, **SILENT, "verdict": "unknown_effect"}, "unknown"),
        (HEALTHY, "false alarm"),
        ({"failed": "EmaError: no hit"}, "failed"),
    ],
)
def test_outcomes(changes: dict[str, Any], expected: str) -> None:
    assert tally.outcome(line(**changes)) == expected


def test_one_of_two_effects_is_not_right() -> None:
    two = [*line()["truth"], {"label": "mass@m3.x", "parameter": "mass", "size": 0.2, "also": ""}]
    assert tally.outcome(line(truth=two, hidden=2)) == "missed above"
    assert tally.outcome(line(truth=two, hidden=2, claimed=["spring@m2", "sensor_mass@m3"])) == "right"


def test_names_of_one_change() -> None:
    assert tally.same("sensor_mass@planet1", "planet_mass_mistune@planet1")
    assert tally.same("shaft_torsion@sun", "spring@sun.u")
    assert tally.same("spring@a.x-b.x", "spring@b.x-a.x")
    assert not tally.same("spring@sun.x", "spring@sun.y")
    assert not tally.same("mesh_stiffness_loss@sun-planet1", "mesh_stiffness_loss@ring-planet1")
    beside = line(truth=[{**line()["truth"][0], "also": "k3"}], claimed=["out_of_tolerance@k3"])
    assert tally.outcome(beside) == "right"


def test_coverage_ranks_and_calibration_of_known_draws() -> None:
    z = np.random.default_rng(0).standard_normal(4000)
    assert tally.coverage(z) == pytest.approx(0.9, abs=0.01)
    assert tally.coverage(2 * z) < 0.65
    assert min(tally.ranks(z)) > 340
    assert tally.sizes([line()]) == [pytest.approx(1.0)]
    assert tally.parameters([line(truth=[])]) == [pytest.approx(1.0)]
    assert tally.parameters([line()]) == []  # fitted without what is hidden
    assert tally.calibration_error([(0.75, True)] * 3 + [(0.75, False)]) == pytest.approx(0.0)
    assert tally.calibration_error([(0.95, False)] * 4) == pytest.approx(0.95)
    assert tally.statements([line()]) == [(0.9, True)]
    assert tally.statements([line(**HEALTHY, nothing=0.97)]) == [(0.97, True)]


def test_a_results_file_cut_short_is_read_and_tabled(tmp_path: Path) -> None:
    import json

    file = tmp_path / "study.jsonl"
    lines = [line(), line(verdict="adequate", claimed=[]), line(number=2, **HEALTHY, **SILENT)]
    file.write_text("\n".join(json.dumps(x) for x in lines) + '\n{"kind": "own", "le', encoding="utf-8")
    read = tally.read(file)
    assert [x["number"] for x in read] == [1, 2]
    page = tally.table(read)
    assert "own, good: healthy | 1 | 1" in page
    assert "missed above: adequate, claimed nothing" in page


@pytest.mark.parametrize("number", range(12))
def test_own_rigs_are_valid_and_truly_a_little_off(tmp_path: Path, number: int) -> None:
    own = study_own_rigs.draw_rig(np.random.default_rng(number), number)
    assert 2 <= len(own.masses) <= 8
    for true in (False, True):
        (tmp_path / "rig.toml").write_text(own.toml(true), encoding="utf-8")
        rig = load_rig(tmp_path / "rig.toml")
        assert set(rig.assembly("default").dofs) == set(own.dofs)
    off = [abs(np.log(s.true / s.stated)) for s in own.springs]
    assert 0 < max(off) < 0.25


@pytest.mark.parametrize("kind", ["own", "gearbox"])
def test_a_case_is_a_raw_folder_with_the_rig_as_stated(tmp_path: Path, kind: study_cases.Kind) -> None:
    case = study_cases.Case(kind, "normal", 1)
    made = study_cases.make(case, tmp_path / "raw")
    assert len(made.truth) == 1
    campaign = read_campaign(tmp_path / "raw")
    assert campaign.rig_file is not None
    load_rig(campaign.rig_file)
    assert all(t.rig is None for t in campaign.tests)
    again = study_cases.make(case, tmp_path / "again" / "raw")
    assert again == made
    text = (tmp_path / "raw" / "test.toml").read_text(encoding="utf-8")
    assert "calibration_std" not in text
    assert tomllib.loads(text)["records"]


def test_a_library_without_an_effect_lacks_its_other_names_too() -> None:
    assert study_cases.lacking([study_cases.Truth("sensor_mass@sun", "mass", 0.1)]) >= {"mass", "sensor_mass"}
    assert study_cases.lacking([study_cases.Truth("gyroscopic@sun", "c", 1.0)]) == {"gyroscopic"}


def test_the_true_value_of_a_parameter_with_one_part_is_that_of_the_part(tmp_path: Path) -> None:
    made = study_cases.make(study_cases.Case("planetary", "normal", 0), tmp_path / "raw")
    truth = json.loads((tmp_path / "raw" / "truth.json").read_text(encoding="utf-8"))
    parts = truth["imperfections"]["parts"]
    assert made.values["sun_mass"] == pytest.approx(truth["values"]["sun_mass"] * parts["sun mass"])
    assert parts["sun mass"] != 1.0
    assert made.values["planet_mass"] == truth["values"]["planet_mass"]  # of several parts


@pytest.mark.parametrize(("size", "true"), [(0.5, True), (1.5, False)])
def test_nothing_is_missing_that_could_show_where_all_that_is_hidden_is_below_its_limit(
    size: float, true: bool
) -> None:
    silent = {"claimed": [], "verdict": "adequate", "nothing": 0.8, "visible": 0.97, "candidates": []}
    limit = {"label": "mass@m1.x", "parameter": "mass", "size": 1.0}
    hidden = {
        "truth": [{"label": "mass@m1.x", "parameter": "mass", "size": size, "also": ""}],
        "limits": [limit],
    }
    own = line(**(silent | hidden))
    assert tally.statements([own]) == [(0.8, False)]
    assert tally.visible([own]) == [(0.97, true)]
    assert tally.visible([line(**(silent | hidden | {"limits": []}))]) == [(0.97, False)]
    assert tally.visible([line(**(silent | HEALTHY)), line()]) == [(0.97, True)]
    assert tally.visible([line(**(own | {"visible": None})), line(**(own | {"failed": "ended"}))]) == []
