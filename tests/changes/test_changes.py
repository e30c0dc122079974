"""What changed from one test to another: one rig, one set of sensors, an effect in B or none."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from bench import ema, write_bench

from ema_pipeline.changes.matrices import MacMatrix
from ema_pipeline.changes.modes import mode_changes
from ema_pipeline.changes.physics import pair_observations
from ema_pipeline.changes.tables import mac_table, notes, short_modes_table, verdict_text
from ema_pipeline.changes.two_tests import Changes
from ema_pipeline.commands.screen import show
from ema_pipeline.correlate.matching import match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.types import EffectSize
from ema_pipeline.dof import Dof
from ema_pipeline.job import run_raw
from ema_pipeline.loops.simulate import PRINTED, write_sine_tests
from ema_pipeline.observations.fitting import Model, fit_base
from ema_pipeline.observations.mode_rows import Rows
from ema_pipeline.observations.pair import _conditional
from ema_pipeline.report.terminal import matrix_table, text_table

TESTS = {"before": (1, ()), "again": (2, ()), "after": (3, ("mass@m2:mass=0.06",))}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three tests of one imperfect rig with one set of sensors; the last one with a mass added."""
    root = tmp_path_factory.mktemp("changes")
    for name, (seed, effects) in TESTS.items():
        write_bench(root, name, seed=seed, rig_seed=11, effects=effects, imperfection="normal")
    return root


def _told(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    code, said, err = ema(capsys, "changes", *arguments, "--json")
    assert code == 0, err
    return json.loads(said)  # type: ignore[no-any-return]


def _results(root: Path, name: str) -> Path:
    """The test run up to its modes, once."""
    from ema_pipeline.changes.two_tests import MEASURING

    run_raw(root / name, str(root / "bench.toml"), root / "out" / name, None, [MEASURING])
    return root / "out" / name


def test_two_tests_share_rig_and_sensors(root: Path) -> None:
    """The same parts, damping and gains, other noise and other hits."""
    truths = [json.loads((root / n / "truth.json").read_text())["imperfections"] for n in ("before", "again")]
    for what in ("parts", "damping_factors", "channels"):
        assert truths[0][what] == truths[1][what]
    records = [json.loads((root / n / "truth.json").read_text())["configurations"]["default"] for n in TESTS]
    assert records[0]["records"][0]["aim_deg"] != records[1]["records"][0]["aim_deg"]


@pytest.mark.slow
def test_an_added_mass_is_found_with_its_size(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command, and back again by the function behind it: what B has, A has not."""
    from ema_pipeline.changes.two_tests import changes_content, compare_runs
    from ema_pipeline.run.opening import existing_run

    out = root / "changed"
    before, after = _results(root, "before"), _results(root, "after")
    found = _told(capsys, before, after, "--rig", root / "bench.toml", "--out", out)
    assert found == json.loads((out / "changes.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "changed"
    (change,) = found["changes"]
    assert (change["effect"], change["at"]) == ("mass", "m2")
    assert "sensor_mass@m2" in change["also_called"]
    assert abs(change["value"] - 0.06) < 3 * change["std"] < 0.02
    assert change["probability"] > 0.9
    assert found["modes"][0]["frequency_change"] < 0
    assert "mass" in (out / "report.html").read_text(encoding="utf-8")

    back = changes_content(compare_runs(existing_run(after), existing_run(before)))
    assert back["verdict"] == "changed"
    value = back["changes"][0]["value"]
    assert abs(value + 0.06) < 4 * back["changes"][0]["std"]


@pytest.mark.usefixtures("all_cores")
def test_an_unchanged_rig_is_the_same_with_limits(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No change is claimed, and the least mass that would show is far below what one test shows."""
    monkeypatch.setattr("ema_pipeline.changes.page._figures", lambda a, b: [])  # drawn for the added mass
    before, again = _results(root, "before"), _results(root, "again")
    code, said, err = ema(
        capsys, "changes", before, again, "--rig", root / "bench.toml", "--out", root / "same"
    )
    assert code == 0, err
    found = json.loads((root / "same" / "changes.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "same"
    assert found["changes"] == []
    limits = {x["label"]: x["size"] for x in found["diagnosis"]["limits"]}
    assert 0 < limits["mass@m2"] < 0.03
    assert "The same within what these tests can show" in said
    assert "These tests would show, nine times in ten: " in said
    assert max(len(line) for line in said.splitlines() if not line.startswith("Report: ")) <= 80
    assert re.search(r"[ ;]mass from [\d.]+ g\b", " ".join(said.split()))
    assert "mass mass" not in " ".join(said.split())


def test_the_rig_of_the_tests_is_left_out_on_request(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both results have a rig; with none, modes are compared one by one."""
    before, after = _results(root, "before"), _results(root, "after")
    found = _told(capsys, before, after, "--rig", "none", "--out", root / "by_modes")
    assert found["verdict"] == "changed"
    assert found["changes"] == []
    assert "diagnosis" not in found


def test_derivatives_of_the_pair_are_exact(root: Path) -> None:
    """By all unknowns, against differences; the sum of the log scale is that of the joint covariance."""
    from ema_pipeline.effects.library import parse_effect
    from ema_pipeline.run.opening import existing_run

    runs = [existing_run(_results(root, name)) for name in ("before", "after")]
    observations = pair_observations(*runs)
    assert runs[0].rig is not None
    problem = observations.problem([parse_effect("mass@m2", runs[0].rig)], {})
    random = np.random.default_rng(0)
    scatters = {n: s.default * 1.3 for n, s in observations.scatters.items()}
    x = 0.3 * problem.unknowns.prior_std(scatters) * random.standard_normal(len(problem.unknowns))
    x[problem.unknowns.index["mass@m2.mass"]] = 0.2
    here = problem.residuals(x, scatters)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-6
        ends = [problem.residuals(x + s, scatters, matching=here.matching).values for s in (step, -step)]
        assert here.jacobian[:, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3, abs=2e-2)
    drifts = [n for n in problem.unknowns.names if n.startswith("drift")]
    assert drifts == ["drift of default in B", "drift of default in A"]


@pytest.mark.parametrize("noise", ["frequency_noise", ""])
def test_what_one_test_tells_of_the_other_is_the_conditional_normal_distribution(noise: str) -> None:
    """One deviation in both tests, noise and repetition in each: the covariance written out, mode by mode."""
    unit, own = (np.array([[1.0, 0.5, 2.0], [0.8, 0.5, 3.0]]), np.array([[0.3, 0.2, 0.1], [0.1, 0.4, 0.2]]))
    a, b = (
        Rows(np.zeros(3), own[k], unit[k], "frequency_scatter", 1.0, np.arange(3), noise=noise)
        for k in (0, 1)
    )
    scatters = {"frequency_scatter": 0.7, "frequency_noise": 1.5, "repeat": 0.25}
    found = _conditional(a, b, scatters, "repeat")
    factor = 1.5 if noise else 1.0
    for k in range(3):
        u = unit[:, k]
        joint = 0.7**2 * np.outer(u, u) + np.diag((factor * own[:, k]) ** 2 + (0.25 * u) ** 2)
        assert found.slope[k] == pytest.approx(joint[0, 1] / joint[0, 0])
        assert found.variance[k] == pytest.approx(np.linalg.det(joint) / joint[0, 0])
    assert ("frequency_noise" in found.shares) == bool(noise)
    for name, share in found.shares.items():  # of the variance, as it grows with each scatter's square
        more = _conditional(a, b, scatters | {name: scatters[name] * np.exp(1e-5)}, "repeat")
        assert np.log(more.variance / found.variance) / 2e-5 == pytest.approx(share, rel=1e-3)


def test_held_out_pairs_stay_together(root: Path) -> None:
    """What is left out of A is left out of B; nothing is lost."""
    from ema_pipeline.run.opening import existing_run

    observations = pair_observations(*(existing_run(_results(root, n)) for n in ("before", "again")))
    folds = observations.folds()
    assert sum(len(d) for _, out in folds for d in out.a.data) == 3
    for kept, out in folds:
        assert sum(len(d) for d in kept.a.data) + sum(len(d) for d in out.a.data) == 3
        for part in (kept, out):
            for data in part.a.data:
                pairs = part.pairs[data.configuration]
                other = next(d for d in part.b.data if d.configuration == data.configuration)
                assert np.allclose(data.log_frequency, other.log_frequency[pairs], atol=0.01)
    base = fit_base(observations, Model())
    assert base.posterior.error < 1.5


def _modes(
    frequencies: list[float], shapes: list[list[float]], std: float = 1e-3, sign: float = 1.0
) -> MeasuredModes:
    count = len(frequencies)
    dofs = tuple(Dof.parse(n) for n in ("a.x", "b.x", "c.x"))
    return MeasuredModes(
        "default", np.array(frequencies), std * np.array(frequencies), np.full(count, 0.01), np.full(count, 1e-4),
        sign * np.array(shapes, complex), np.full((count, 3), 0.01), dofs,
    )  # fmt: skip


SHAPES = [[1.0, 0.8, 0.3], [0.5, -0.6, 1.0], [0.9, -0.2, -0.7]]


def test_modes_that_cross_are_matched_by_shape() -> None:
    """The order of frequencies is another one in B."""
    a = _modes([10.0, 20.0, 21.0], SHAPES)
    b = _modes([10.1, 20.2, 20.8], [SHAPES[0], SHAPES[2], SHAPES[1]], sign=-2.0)
    assert list(match_modes(a, b)) == [0, 2, 1]
    found = mode_changes({"default": a}, {"default": b})
    assert [(m.mode_a, m.mode_b) for m in found.modes] == [(1, 1), (2, 3), (3, 2)]
    assert found.modes[0].mac == pytest.approx(1.0)


def test_a_mode_of_one_test_alone_is_said() -> None:
    """It has no partner."""
    found = mode_changes(
        {"default": _modes([10.0, 20.0], SHAPES[:2])},
        {"default": _modes([10.0, 30.0], [SHAPES[0], SHAPES[2]])},
    )
    assert [m.mode_a for m in found.modes] == [1]
    assert found.only_a == (("default", 2, 20.0),)
    assert found.only_b == (("default", 2, 30.0),)


def test_modes_that_changed_although_no_effect_explains_it_are_said_beside_the_answer() -> None:
    before = {"default": _modes([10.0, 20.0], SHAPES[:2], std=1e-7)}
    diagnosis = SimpleNamespace(
        verdict="adequate", null_probability=0.99, ladder=SimpleNamespace(rungs=[SimpleNamespace(error=1.0)])
    )
    physics = SimpleNamespace(claimed=(), diagnosis=diagnosis)

    def said(hz: list[float]) -> tuple[str, str]:
        modes = mode_changes(before, {"default": _modes(hz, SHAPES[:2], std=1e-7)})
        found = cast("Changes", SimpleNamespace(modes=modes, physics=physics))
        return verdict_text(found), notes(found)[0]

    changed, shift = said([10.0001, 19.9995])
    assert changed.endswith(
        "2 of 2 modes in common changed beyond their intervals (p < 0.01 over all that was compared). Temperature, "
        "mounting or another scatter explains that; no effect does."
    )
    assert shift == "default: frequencies changed by less than 0.005 %, not all by the same share."
    assert said([10.0, 20.0])[0].endswith("(probability that nothing changed: 99.0 %).")


@pytest.mark.parametrize("explained", [True, False])
def test_a_change_of_tests_that_the_model_does_not_explain_is_called_provisional(explained: bool) -> None:
    claim = SimpleNamespace(
        label="mass@m2", parameters={"mass": EffectSize(0.06, 0.004, "kg")}, equivalents=(), probability=0.97
    )
    diagnosis = SimpleNamespace(
        verdict="effect" if explained else "unknown_effect",
        ladder=SimpleNamespace(rungs=[SimpleNamespace(error=7.31), SimpleNamespace(error=4.126)]),
    )
    physics = SimpleNamespace(claimed=(claim,), reverse=False, diagnosis=diagnosis)
    said = verdict_text(cast("Changes", SimpleNamespace(physics=physics)))
    changed = "Changed: mass at m2, mass 60.0 ± 4.0 g (probability 97 %)."
    provisional = (
        "The rig's model does not explain both tests (error 7.31 → 4.13); what it finds is provisional. "
    )
    assert said == (changed if explained else provisional + changed)


@pytest.mark.parametrize(
    ("hz", "said"),
    [
        ([9.97, 19.94, 29.92], "all frequencies moved by the same share, −0.289"),  # warmer
        ([10.0, 19.4, 29.9], "frequencies changed by −3.00 to 0.00 %, not all by the same share"),  # a mass
        ([10.0002, 19.9997, 30.0003], "no shift common to all frequencies ("),
    ],
)
def test_only_a_shift_that_all_modes_share_is_called_common(hz: list[float], said: str) -> None:
    found = mode_changes({"default": _modes([10.0, 20.0, 30.0], SHAPES)}, {"default": _modes(hz, SHAPES)})
    assert found.common_shift["default"].alike == ("not all" not in said)
    assert f"default: {said}" in notes(cast("Changes", SimpleNamespace(modes=found)))[0]


def test_table_of_changes_keeps_values_whole_on_80_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = (
        _modes([21.5694, 49.451, 108.465], SHAPES, 3e-4),
        _modes([21.42, 49.41, 107.4], SHAPES[::-1][:3], 3e-4),
    )
    found = mode_changes({"with_ring": a, "no_ring": a}, {"with_ring": b, "no_ring": b})
    table = short_modes_table(cast("Changes", SimpleNamespace(modes=found)))
    monkeypatch.setenv("COLUMNS", "80")
    show(text_table(table, "Modes: A and B"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert table.rows
    for row in table.rows:
        assert re.search(r" +".join(map(re.escape, row.cells[:5])), text)


def test_false_changes_are_as_rare_as_stated() -> None:
    """200 pairs of tests of one structure, noise as stated: changes in 1 % of them, over all that is compared."""
    random = np.random.default_rng(2)
    false = 0
    true = _modes([10.0, 20.0, 30.0], SHAPES)
    assert true.shapes is not None
    for _ in range(200):
        tests = []
        for _ in "ab":
            frequency = true.frequency_hz + true.frequency_std_hz * random.standard_normal(3)
            damping = true.damping_ratio + true.damping_std * random.standard_normal(3)
            noise = random.standard_normal((3, 3)) + 1j * random.standard_normal((3, 3))
            tests.append(
                MeasuredModes(
                    "default", frequency, true.frequency_std_hz, damping, true.damping_std,
                    true.shapes + 0.01 * noise, true.shape_std, true.dofs,
                )
            )  # fmt: skip
        false += mode_changes({"default": tests[0]}, {"default": tests[1]}).changed
    assert false <= 7


@pytest.mark.parametrize("what", ["frequency", "damping", "shape"])
def test_a_true_change_of_a_mode_is_told(what: str) -> None:
    """Each by itself, well beyond its interval."""
    a = _modes([10.0, 20.0, 30.0], SHAPES)
    b = _modes([10.0, 20.3 if what == "frequency" else 20.0, 30.0], SHAPES)
    if what == "damping":
        b.damping_ratio[1] = 0.012
    if what == "shape":
        assert b.shapes is not None
        b.shapes[1, 0] += 0.15
    changed = [m.changed for m in mode_changes({"default": a}, {"default": b}).modes]
    assert changed == [(), (what,), ()]


def test_mac_of_tests_and_of_the_model(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Near 1 on the diagonal."""
    before, after = _results(root, "before"), _results(root, "after")
    for arguments in ((before, after), (before,)):
        code, said, _ = ema(capsys, "mac", *arguments, "--json")
        assert code == 0
        values = np.array(json.loads(said)["configurations"][0]["mac"])
        assert values.shape == (3, 3)
        assert np.diag(values).min() > 0.95
        assert ema(capsys, "mac", *arguments)[0] == 0


def test_mac_of_many_modes_is_whole_on_80_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In blocks of columns, each with the frequencies of A."""
    hz = np.linspace(1401.25, 1434.5, 23)
    values = np.eye(23)
    values[:, 0] = np.nan
    monkeypatch.setenv("COLUMNS", "80")
    show(matrix_table(mac_table(MacMatrix("no_ring", "B", hz, hz, values)), "MAC"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert text.count(" 1.00") == 22
    assert text.count(" –") == 23
    titles = re.findall(r"MAC, columns (\d+) to (\d+) of 23", text)
    assert len(titles) == 3
    assert [int(a) for a, _ in titles] == [1, *(int(b) + 1 for _, b in titles[:-1])]
    assert titles[-1][1] == "23"


def test_wrong_tests_are_said_in_one_line(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No folder, no model, another rig."""
    before = _results(root, "before")
    assert (
        "there is no such folder" in ema(capsys, "changes", before, tmp_path / "x", "-o", tmp_path / "o")[2]
    )
    code, _, err = ema(capsys, "changes", before, before, "--rig", "planetary", "-o", tmp_path / "o")
    assert code == 1
    assert "is not one of rig 'planetary'" in err


def test_the_answer_does_not_take_the_place_of_a_tests_own_report(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _results(root, "before")
    (tmp_path / "note.txt").write_text("mine", encoding="utf-8")
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "test.toml").touch()
    for out, why in (
        (before, "holds the results of a test"),
        (raw, "holds raw data"),
        (tmp_path / "note.txt", "is no folder"),
    ):
        code, _, err = ema(capsys, "changes", before, before, "--rig", "none", "--out", out)
        assert code == 1
        assert why in err
        assert err.endswith("name another with --out\n")
    assert not (before / "changes.json").exists()


def test_loops_have_no_modes_to_compare_or_export(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw, out = tmp_path / "loops", tmp_path / "out"
    write_sine_tests(raw, PRINTED)
    code, _, err = ema(capsys, "changes", _results(root, "before"), raw, "--out", tmp_path / "answer")
    assert code == 1
    assert "force-displacement loops have no modes; compare hammer tests" in err
    assert ema(capsys, "run", raw, "--out", out, "--set", 'stages=["loops"]')[0] == 0
    code, _, err = ema(capsys, "export", out)
    assert code == 1
    assert "force-displacement loops have neither FRFs nor modes to export" in err
