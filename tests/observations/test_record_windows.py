"""Records in windows: what is compared, exact derivatives, and a fit that leads from far off."""

from __future__ import annotations

import importlib
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from continuous_cases import RIG, write_oscillator

import ema_pipeline as ema
from ema_pipeline.diagnose.records import in_windows, record_hypotheses, record_model, whole_ladder
from ema_pipeline.diagnose.rungs import ladder_of, make_ladder
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, Candidate, Diagnosis
from ema_pipeline.effects.library import effect_library
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.driven import load_driven
from ema_pipeline.observations.fitting import QUICK, annealed, fit_base, learned, refined, wide
from ema_pipeline.observations.record_data import SHARE
from ema_pipeline.observations.records import RecordObservations

LIBRARY = effect_library()


def _oscillator(folder: Path, cubic: float, started: str, friction: float = 0.0) -> RecordObservations:
    raw = write_oscillator(folder / "raw", lambda x, v: cubic * x**3 + friction * np.tanh(v / 0.02))
    (folder / "rig.toml").write_text(started)
    one, two = (r for r in load_driven(read_description(raw)))
    rig = ema.load_rig(folder / "rig.toml")
    return RecordObservations(rig, rig.configurations[0], [one], [two])


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> RecordObservations:
    """An oscillator whose cubic spring carries a good part of the force."""
    far_off = RIG.replace("1.0 }", "2.0 }").replace("1e4", "5e4")
    return in_windows(_oscillator(tmp_path_factory.mktemp("hardening"), 1e10, far_off))


def test_windows_lie_in_the_record_and_do_not_overlap(windows: RecordObservations) -> None:
    (data,) = windows.data
    assert np.all(np.diff(data.starts) >= data.samples)
    assert data.starts[0] > 0
    assert data.starts[-1] + data.samples < data.record.n_samples
    np.testing.assert_array_equal(
        data.responses[1, 0], data.record.responses[0, data.starts[1] :][: data.samples]
    )


def test_generic_effects_are_sought_everywhere_and_the_simplest_to_say_comes_first(
    windows: RecordObservations,
) -> None:
    new = replace(LIBRARY["quadratic_damping"], id="a_new_law", records_order=None)
    found = [h.label for h in record_hypotheses(windows, LIBRARY | {new.id: new})]
    laws = ("cubic_spring", "quadratic_spring", "dry_friction", "hysteresis", "quadratic_damping", new.id)
    assert found == [f"{law}@mass.x" for law in laws]


@pytest.mark.parametrize("label", ["cubic_spring@mass.x", "hysteresis@mass.x"])
def test_derivatives_are_those_of_the_residuals(windows: RecordObservations, label: str) -> None:
    problem = record_model(windows, LIBRARY, [label]).problem(windows)
    x = problem.start() + 0.1 * np.random.default_rng(0).standard_normal(len(problem.unknowns))
    x, scatters = problem.unknowns.clipped(x), wide(windows)
    found = problem.residuals(x, scatters)
    own = [i for i, n in enumerate(problem.unknowns.names) if "sample" in n][:3]
    sizes = [problem.unknowns.index[n] for n in problem.sizes]
    for i in (0, 1, *sizes, *own):
        ends = []
        for h in (-1e-5, 1e-5):
            moved = x.copy()
            moved[i] += h
            ends.append(problem.residuals(moved, scatters, derivatives=False).values)
        slope = (ends[1] - ends[0]) / 2e-5
        np.testing.assert_allclose(
            found.jacobian[:, i], slope, atol=1e-3 * max(float(np.max(np.abs(slope))), 1e-6)
        )


def test_a_fit_leads_from_far_off_to_a_strong_cubic_spring(windows: RecordObservations) -> None:
    model = record_model(windows, LIBRARY, ["cubic_spring@mass.x"])
    problem = model.problem(windows)
    name = "cubic_spring@mass.x.stiffness"
    starts = [problem.start({name: size}) for size in (2e9, 6e9)]
    fit = annealed(windows, model, starts, QUICK)
    assert fit.posterior.error < 1.5
    assert problem.parameter_values(fit.posterior.x)[name] == pytest.approx(1e10, rel=0.05)


def test_where_derivatives_are_known_they_are_not_made_again(
    windows: RecordObservations, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = record_model(windows, LIBRARY, ["cubic_spring@mass.x"]).problem(windows)
    fresh = record_model(windows, LIBRARY, ["cubic_spring@mass.x"]).problem(windows)
    here, there, scatters = problem.start(), problem.start() + 0.01, wide(windows)
    calls = []
    motions = type(problem).motions
    monkeypatch.setattr(type(problem), "motions", lambda *given: calls.append(1) or motions(*given))
    narrow = {name: 0.5 * value for name, value in scatters.items()}
    first = problem.residuals(here, scatters)
    again = problem.residuals(here, narrow)
    assert len(calls) == 1
    problem.residuals(there, scatters, derivatives=False)
    assert len(calls) == 2
    assert not np.array_equal(problem.residuals(there, scatters).values, first.values)
    np.testing.assert_array_equal(fresh.residuals(here, narrow).values, again.values)
    np.testing.assert_array_equal(fresh.residuals(here, narrow).jacobian, again.jacobian)
    assert len(calls) == 4


def test_a_ladder_of_whole_records_does_not_depend_on_the_number_of_processes(tmp_path: Path) -> None:
    whole = _oscillator(tmp_path, 1e9, RIG.replace("1.0 }", "2.0 }").replace("1e4", "5e4"))
    windows = in_windows(whole)
    models = [record_model(whole, LIBRARY, labels) for labels in ((), ("cubic_spring@mass.x",))]
    fits = [refined(windows, m, m.problem(windows).start()) for m in models]
    searched = ladder_of(windows, fits)
    alone, shared = (whole_ladder(whole, LIBRARY, searched, processes) for processes in (1, 2))
    np.testing.assert_equal(asdict(alone), asdict(shared))  # holds NaN, which no comparison finds equal
    assert "windows" not in alone.note
    assert alone.rungs[-1].error < 0.2 * alone.rungs[0].error
    assert np.isfinite(alone.rungs[-1].heldout_error)


def test_the_only_claim_is_taken_back_where_whole_records_do_not_support_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The verdict, its words and all probabilities follow."""
    whole = _oscillator(tmp_path, 0.0, RIG, 0.0)
    label = "dry_friction@mass.x"
    searched = make_ladder(
        in_windows(whole), [record_model(whole, LIBRARY, given) for given in ((), (label,))]
    )
    claim = Candidate(*label.split("@"), "", 0.9, {}, 1.0, 0.9, 1.0, 0.9, 5.0, 3.5, True, "Its signs.")
    odds = {label: 0.9, NOTHING: 0.1}
    told = Diagnosis("effect", "", 0.1, (claim,), (), "", (), odds, 1.0, 1.0, searched)
    records = importlib.import_module("ema_pipeline.diagnose.records")
    monkeypatch.setattr(records, "diagnose", lambda *given, **named: told)
    found = records.diagnose_records(whole, LIBRARY, settings=DiagnoseSettings(processes=1))
    assert found.verdict == "adequate"
    assert not any(c.claimed for c in found.candidates)
    assert found.summary.startswith("The model explains the data")
    assert found.probabilities[NOTHING] == found.null_probability > 0.2
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.candidates[0].probability == found.probabilities[label]
    assert len(found.ladder.rungs) == 1


def test_noise_in_the_force_is_learned_as_a_share_of_the_response(tmp_path: Path) -> None:
    """It is the larger the nearer a resonance; noise of the sensor is not."""
    whole = _oscillator(tmp_path, 0.0, RIG, 0.0)
    (data, *_) = whole.data
    assert data.level.shape == data.measured.shape[1:]
    count = (data.level.shape[-1] - 1) // 2
    np.testing.assert_array_equal(data.level[:, 1 : count + 1], data.level[:, count + 1 :])
    assert np.mean(data.level**2) == pytest.approx(np.mean(data.measured**2), rel=0.1)
    wrong = np.random.default_rng(5).standard_normal(data.measured.shape)
    learned_shares = []
    for noise in (0.02 * data.level * wrong, 0.02 * float(data.rms[0]) * wrong):
        lines = replace(data)
        lines.__dict__.update(measured=data.measured + noise, level=data.level)
        noisy = whole.with_records([lines], ())
        model = record_model(noisy, LIBRARY, ())
        learned_shares.append(learned(noisy, fit_base(noisy, model)).posterior.scatters[SHARE])
    assert learned_shares[0] == pytest.approx(2.0, rel=0.15)
    assert learned_shares[1] < 1.0


@pytest.mark.parametrize("friction", [0.0, pytest.param(8.0, marks=pytest.mark.slow)])
def test_a_further_claim_that_whole_records_do_not_support_is_withdrawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, friction: float
) -> None:
    whole = _oscillator(tmp_path, 1e9, RIG.replace("1.0 }", "2.0 }").replace("1e4", "5e4"), friction)
    windows = in_windows(whole)
    labels = ("cubic_spring@mass.x", "dry_friction@mass.x")
    searched = make_ladder(windows, [record_model(whole, LIBRARY, labels[:k]) for k in range(3)])
    candidates = tuple(
        Candidate(*label.split("@"), "", 0.99, {}, 9.0, 1.0, 9.0, 1.0, 90.0, 3.5, True, "Its signs.")
        for label in labels
    )
    told = Diagnosis("effect", "", 0.0, candidates, (labels,), "", (), {}, 9.0, 9.0, searched)
    records = importlib.import_module("ema_pipeline.diagnose.records")
    monkeypatch.setattr(records, "diagnose", lambda *given, **named: told)
    found = records.diagnose_records(whole, LIBRARY, settings=DiagnoseSettings(processes=1))
    kept = labels if friction else labels[:1]
    assert tuple(c.label for c in found.candidates if c.claimed) == kept
    assert found.ladder.rungs[-1].effects == kept
    if not friction:
        assert "Not claimed: its gain in log evidence over whole records" in found.candidates[1].why
        assert "dry friction at mass.x" in found.ladder.note
        assert "dry friction" not in found.summary
        assert found.indistinguishable == ()
        told = replace(told, verdict="ambiguous")  # the group of which one was claimed goes with it
        found = records.diagnose_records(whole, LIBRARY, settings=DiagnoseSettings(processes=1))
        assert found.verdict == "effect"
        assert found.summary.startswith("Missing from the model: cubic spring")
