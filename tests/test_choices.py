"""Hits and modes excluded and included by the user: kept with the run, taken back, refused where there are none."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench import ema
from chain_rig import RIG
from simulate_levels import Case, hits_of

from ema_pipeline.choices import (
    Choices,
    HitChoice,
    ModeChoice,
    options_between,
    split_hit,
    split_mode,
)
from ema_pipeline.choosing import change_choices, excluding, including
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.job import run_on, run_raw
from ema_pipeline.levels import study_levels
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.modal.chosen import EXCLUDED, INCLUDED, wanted
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report.html import report_html
from ema_pipeline.report.moved_modes import error_words, moved_table, seen, still_words
from ema_pipeline.report.results import RunResults
from ema_pipeline.results_folder import LOCK_FILE
from ema_pipeline.run.opening import existing_run
from ema_pipeline.simulate.campaign import simulate_campaign
from ema_pipeline.stages.results import load_results

pytestmark = pytest.mark.usefixtures("without_figures")

LINEAR = Case(
    frequency_hz=np.array([80.0, 130.0, 215.0]),
    damping=np.array([0.008, 0.006, 0.01]),
    shapes=np.array([[1.0, 0.6, -0.4, 0.8], [0.7, -1.0, 0.5, 0.3], [-0.5, 0.8, 1.0, 0.6]]),
    n_points=2,
    forces_n=np.array([20.0, 60.0, 180.0]),
    hits_per_level=2,
    noise=3e-3,
    hammer_noise=1e-4,
    hand=0.1,
)


@pytest.fixture(scope="module")
def tested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Raw data, rig and results of three masses in a row, two hits on every point; no effect is missing."""
    folder = tmp_path_factory.mktemp("choices")
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    simulate_campaign(folder / "raw", str(folder / "rig.toml"), hits=2, duration_s=1.0, seed=3)
    run_raw(folder / "raw", str(folder / "rig.toml"), folder / "out")
    return folder


@pytest.fixture
def out(tested: Path, tmp_path: Path) -> Path:
    """A copy of the results that a test may change."""
    return Path(shutil.copytree(tested / "out", tmp_path / "out"))


def results(out: Path) -> RunResults:
    return load_results(existing_run(out))


def frequencies(out: Path) -> list[float]:
    modal = results(out).configurations[0].modal
    assert modal is not None
    return [m.frequency_hz for m in modal.modes]


def test_an_excluded_hit_stays_out_until_it_is_taken_back(tested: Path, out: Path) -> None:
    before = results(out)
    hit = before.configurations[0].hits[0]
    with pytest.raises(EmaError, match="is named twice"):
        change_choices(out, excluding(hits=[hit.file, hit.file]))
    change_choices(out, excluding(hits=[hit.file]))
    with pytest.raises(EmaError, match="is excluded already"):
        change_choices(out, excluding(hits=[hit.file]))
    after = results(out)
    assert [h.accepted for h in after.configurations[0].hits] == [
        h is not hit for h in before.configurations[0].hits
    ]
    assert after.configurations[0].hits[0].reason == EXCLUDED
    assert after.diagnosis_is_old
    assert after.shown_ladder is not None
    assert [r.effects for r in after.shown_ladder.rungs] == [()]
    assert after.shown_ladder.rungs[0].error != before.shown_ladder.rungs[0].error  # type: ignore[union-attr]
    assert "Hits used" in error_words(seen(before), seen(after))
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["choices"]["excluded_hits"] == [f"default/{hit.file}#1"]
    assert "Chosen by hand" in (out / "report.html").read_text(encoding="utf-8")

    run_raw(tested / "raw", str(tested / "rig.toml"), out)  # the same run again keeps the choice
    again = results(out)
    assert again.choices == after.choices
    assert not again.diagnosis_is_old
    assert len(again.shown_ladder.rungs) >= 1  # type: ignore[union-attr]
    moved = [m.frequency_hz for m in again.configurations[0].modal.modes]  # type: ignore[union-attr]
    assert moved == [m.frequency_hz for m in after.configurations[0].modal.modes]  # type: ignore[union-attr]
    assert moved != frequencies(tested / "out")

    change_choices(out, including(hits=[f"default/{hit.file}#1"]))
    assert frequencies(out) == frequencies(tested / "out")
    assert not results(out).choices


def test_answers_as_json_are_printed_when_quiet_and_the_ladder_says_how_old_it_is(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told, err = ema(capsys, "diagnose", out, "--quiet", "--json")
    assert code == 0, err
    sizes = json.loads(told)["ladder"][0]["parameters"]
    units = {name: p["unit"] for name, p in sizes.items()}
    assert units
    assert set(units.values()) == {"N/m", "1"}
    assert json.loads(ema(capsys, "ladder", out, "--json")[1])["ladder"][0]["parameters"] == sizes
    code, told, _ = ema(capsys, "ladder", out)
    assert told == "The model has no added effects. The diagnosis found nothing missing.\n"

    hit = f"default/{results(out).configurations[0].hits[0].file}#1"
    code, told, err = ema(capsys, "exclude", out, "--hit", hit, "--quiet", "--json")
    assert code == 0, err
    assert json.loads(told)["choices"]["excluded_hits"] == [hit]
    assert "says what it may be missing" in ema(capsys, "ladder", out)[1]
    code, told, err = ema(capsys, "include", out, "--hit", hit, "--quiet", "--json")
    assert code == 0, err
    assert json.loads(told)["choices"]["excluded_hits"] == []


def test_a_ladder_that_is_older_than_a_choice_says_so(
    out: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = results(out)
    assert found.diagnosis is not None
    base = found.diagnosis.ladder.rungs[0]
    proposed = replace(found.diagnosis.ladder, rungs=(base, replace(base, effects=("spring@m1",))))
    diagnosed = replace(found, diagnosis=replace(found.diagnosis, verdict="effect", ladder=proposed))
    older = replace(diagnosed, choices=Choices((HitChoice("default", "x.uff", 1),)))
    for known, said in ((diagnosed, False), (older, True)):
        monkeypatch.setattr("ema_pipeline.stages.results.load_results", lambda run, known=known: known)
        code, told, _ = ema(capsys, "ladder", out)
        assert code == 0
        assert "What the diagnosis proposes" in told
        again = f"The diagnosis is older than the last change; repeat it: ema diagnose {out}\n"
        assert told.endswith(again) == said


def test_the_last_good_hit_of_a_point_cannot_be_excluded(out: Path) -> None:
    hits = results(out).configurations[0].hits
    pair = [h.file for h in hits if h.impact.point == hits[0].impact.point]
    before = (out / "ema.h5").read_bytes()
    with pytest.raises(EmaError, match="last good one"):
        change_choices(out, excluding(hits=pair))
    assert (out / "ema.h5").read_bytes() == before


def test_the_last_modes_of_a_configuration_cannot_be_excluded(out: Path) -> None:
    before, every = results(out), [f"default:{f:.6g}" for f in frequencies(out)]
    with pytest.raises(EmaError, match="no mode of 'default' would be left to fit; keep one"):
        change_choices(out, excluding(modes=every))
    assert results(out).choices == before.choices
    assert len(frequencies(out)) == len(every)


@pytest.mark.parametrize("stopped_by", [EmaError("it does not work"), KeyboardInterrupt()])
def test_a_choice_that_fails_or_is_interrupted_leaves_results_and_report_as_they_were(
    out: Path, stopped_by: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stops(*_: object) -> None:
        raise stopped_by

    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != LOCK_FILE}
    every_hz = frequencies(out)
    monkeypatch.setattr("ema_pipeline.stages.fit.work", stops)
    with pytest.raises(type(stopped_by)):
        change_choices(out, excluding(modes=[f"{every_hz[1]:.1f}"]))
    after = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != LOCK_FILE}
    assert after == before


def test_results_whose_fit_failed_have_no_pairs_of_modes_that_are_gone(out: Path) -> None:
    run = existing_run(out)
    modal = run.store.load("modal", "default", "modal", ModalModel)
    run.store.save("modal", "default", "other", "{}", 0.1, modal=replace(modal, modes=()))
    run.store.save("levels", "default", "other", "{}", 0.1)
    left = results(out)
    assert left.configurations[0].pairing is None
    assert "<html" in report_html(left)


def test_an_excluded_mode_is_not_compared_and_the_others_stay(out: Path) -> None:
    before = results(out)
    all_hz = frequencies(out)
    with pytest.raises(EmaError, match="is named twice"):
        change_choices(out, excluding(modes=[f"{all_hz[1]:.1f}"] * 2))
    change_choices(out, excluding(modes=[f"{all_hz[1]:.1f}"]))
    after = results(out)
    found = after.configurations[0]
    assert found.modal is not None
    assert found.pairing is not None
    assert frequencies(out) == [all_hz[0], all_hz[2]]
    assert [x.reason for x in found.modal.left_out if abs(x.frequency_hz - all_hz[1]) < 1e-9] == [EXCLUDED]
    assert found.modal.chart.selected.max() == 1
    assert len(found.pairing.pairs) == 2
    table = moved_table(seen(before), seen(after))
    assert [row.cells[-1] for row in table.rows] == ["gone"]
    assert still_words(seen(before), seen(after)) == "2 modes stayed within a twentieth of their uncertainty."
    with pytest.raises(EmaError, match="no mode within 1 %"):
        change_choices(out, excluding(modes=[f"{all_hz[1]:.1f}"]))
    run_on(out, ["diagnose"])
    assert not results(out).diagnosis_is_old
    change_choices(out, including(modes=[f"default:{all_hz[1]:.1f}"]))
    assert frequencies(out) == all_hz


def test_a_mode_is_taken_from_the_chart_though_the_tests_on_candidates_leave_it_out() -> None:
    frfs = estimate_frfs(hits_of(LINEAR, np.random.default_rng(2)))
    plain = identify(frfs, ModalSettings())
    asked = wanted([ModeChoice("default", 170.0, 0.01)], frfs.response_decay_rad_s)
    more = identify(frfs, ModalSettings(), wanted=asked)
    assert len(more.modes) == len(plain.modes) + 1
    extra = min(more.modes, key=lambda m: abs(m.frequency_hz - 170.0))
    assert abs(extra.frequency_hz - 170.0) < 0.01 * 170.0
    kept = [m.frequency_hz for m in more.modes if m is not extra]
    assert kept == pytest.approx([m.frequency_hz for m in plain.modes], rel=1e-3)


def test_an_included_pole_becomes_a_flagged_mode(out: Path) -> None:
    modal = results(out).configurations[0].modal
    assert modal is not None
    free = np.flatnonzero((modal.chart.selected < 0) & (modal.chart.damping_ratio > 0))
    far = [
        k
        for k in free
        if all(abs(modal.chart.frequency_hz[k] / m.frequency_hz - 1) > 0.03 for m in modal.modes)
    ]
    if not far:
        pytest.skip("every pole of this chart stands for a mode")
    hertz = float(modal.chart.frequency_hz[far[0]])
    change_choices(out, including(modes=[f"{hertz:.4f}"]))
    after = results(out).configurations[0].modal
    assert after is not None
    assert len(after.modes) == len(modal.modes) + 1
    flagged = [m for m in after.modes if INCLUDED in m.flags]
    assert len(flagged) == 1
    assert abs(flagged[0].frequency_hz / hertz - 1) < 0.01
    change_choices(out, excluding(modes=[f"{hertz:.4f}"]))
    assert frequencies(out) == [m.frequency_hz for m in modal.modes]
    assert not results(out).choices


def test_a_mode_of_the_list_is_not_included_twice(out: Path) -> None:
    with pytest.raises(EmaError, match="represents these poles already"):
        change_choices(out, including(modes=[f"{frequencies(out)[0]:.2f}"]))
    with pytest.raises(EmaError, match="no pole within 1 %"):
        change_choices(out, including(modes=["0.5"]))


@pytest.mark.parametrize(
    ("hit", "words"),
    [
        ("nothing.uff", "there is no record"),
        ("default/x", "there is no record"),
        ("{}#7", "none is number 7"),
    ],
)
def test_a_hit_that_is_not_there_is_refused(out: Path, hit: str, words: str) -> None:
    file = results(out).configurations[0].hits[0].file
    with pytest.raises(EmaError, match=words):
        change_choices(out, excluding(hits=[hit.format(file)]))


def test_a_hit_that_was_not_excluded_is_not_included(out: Path) -> None:
    file = results(out).configurations[0].hits[0].file
    with pytest.raises(EmaError, match="it is in use"):
        change_choices(out, including(hits=[file]))


def test_levels_follow_the_choice_of_modes() -> None:
    hits = hits_of(replace(LINEAR, mode=1, frequency_shift=0.01), np.random.default_rng(1))
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    gone = modal.modes[2]
    choices = Choices(excluded_modes=(ModeChoice("default", gone.frequency_hz, gone.damping_ratio),))
    study = study_levels(
        lambda: hits, frfs, replace(modal, modes=modal.modes[:2]), LevelSettings(), FrfSettings(), ModalSettings(),
        lambda done, text: None, choices,
    )  # fmt: skip
    for level in study.levels:
        assert level.modal is not None
        assert all(abs(m.frequency_hz / gone.frequency_hz - 1) > 0.01 for m in level.modal.modes)


def test_names_on_the_command_line() -> None:
    two = ("with_ring", "no_ring")
    assert split_hit("no_ring/a/b.uff#2", two) == ("no_ring", "a/b.uff", 2)
    assert split_hit("a/b.uff", ("default",)) == ("default", "a/b.uff", None)
    assert split_hit("odd#name.uff", ("default",)) == ("default", "odd#name.uff", None)
    assert split_mode("no_ring:45.17", two) == ("no_ring", 45.17)
    assert split_mode("45.17", ("default",)) == ("default", 45.17)
    for wrong in ("45.17", "ring:45.17"):
        with pytest.raises(EmaError, match="with_ring"):
            split_mode(wrong, two)
    with pytest.raises(EmaError, match="by its frequency"):
        split_mode("no_ring:nan", two)
    with pytest.raises(EmaError, match="CONFIGURATION/FILE"):
        split_hit("a.uff", two)


def test_what_leads_from_one_choice_to_another_leads_back() -> None:
    some = Choices(
        (HitChoice("a", "x.uff", 1),), (ModeChoice("a", 45.17, 0.01),), (ModeChoice("b", 60.0, 0.02),)
    )
    there, back = options_between(Choices(), some), options_between(some, Choices())
    assert there == [
        ("exclude", "--hit", "a/x.uff#1"), ("exclude", "--mode", "a:45.17"), ("include", "--mode", "b:60")
    ]  # fmt: skip
    assert [verb for verb, _, _ in back] == ["include", "include", "exclude"]
