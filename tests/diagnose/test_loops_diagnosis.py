"""Which effect an isolator's model is missing: verdicts on loops with known truth, on real loops, and the commands."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ema_pipeline import codec
from ema_pipeline.cli import app
from ema_pipeline.diagnose.hypotheses import Name, put_among
from ema_pipeline.diagnose.loops import (
    Fitted,
    _extreme,
    _next_loop,
    _setting_words,
    diagnose_loops,
    furthest,
    loop_hypotheses,
    loop_model,
    loop_models,
    placed_effects,
)
from ema_pipeline.diagnose.rungs import make_ladder
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder, Rung
from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.inference import descend
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.loops.extract import measure_loop, share_noise
from ema_pipeline.loops.read import load_loops
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.simulate import simulate_sine_test, write_sine_tests
from ema_pipeline.loops.types import Loop, LoopModel
from ema_pipeline.observations.loops import LoopObservations
from ema_pipeline.report.html import bokeh_script
from ema_pipeline.rigs.isolator import isolator

module = importlib.import_module("ema_pipeline.diagnose.loops")
SPRING = {"stiffness": 9e4}
COARSE = LoopSettings(points_per_cycle=96)
LIBRARY = shipped_effects()


def loops(
    values: dict[str, float],
    frequencies: tuple[float, ...] = (10.0, 16.0),
    seed: int = 1,
    noise: float = 0.01,
) -> list[Loop]:
    random = np.random.default_rng(seed)
    found = []
    for f in frequencies:
        for a in (1e-3, 2e-3):
            x, force = simulate_sine_test(values, f, a, cycles=20, random=random, noise=noise)
            found.append(
                measure_loop(x, force, 5120.0, f, a, name=f"{f:g} Hz {1e3 * a:g} mm", settings=COARSE)
            )
    return found


def observed(data: list[Loop], **kwargs: bool) -> LoopObservations:
    return LoopObservations(isolator(), data, **kwargs)


def diagnosed(data: list[Loop]) -> Diagnosis:
    return diagnose_loops(observed(data), LIBRARY)


def test_hypotheses_are_what_loops_show_with_identical_physics_as_one() -> None:
    found = loop_hypotheses(observed(loops(SPRING)), LIBRARY)
    names = {h.label: {n.label for n in h.names} for h in found}
    assert set(names) >= {
        "quadratic_stiffness@isolator", "cubic_stiffness@isolator", "viscous_damping@isolator",
        "hysteresis@isolator", "relaxation@isolator", "backlash@isolator", "backlash@isolator.mount",
    }  # fmt: skip
    assert "damper@mass.x" in names["viscous_damping@isolator"]
    every = set().union(*names.values())
    assert not any(
        label.startswith(("mass@", "spring@")) for label in every
    )  # unseen, or the stiffness itself


def test_linear_spring_is_adequate_and_the_limits_are_stated() -> None:
    found = diagnosed(loops(SPRING))
    assert found.verdict == "adequate"
    assert found.null_probability > 0.9
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.error == pytest.approx(1.0, abs=0.12)
    assert [r.effects for r in found.ladder.rungs] == [()]
    limits = {limit.label for limit in found.detection_limits}
    assert {"viscous_damping@isolator", "cubic_stiffness@isolator"} <= limits


def test_hidden_effects_are_found_exactly_with_sizes_that_cover(tmp_path: Path) -> None:
    import h5py

    values = SPRING | {"quadratic_stiffness": -2e6, "viscous_damping": 40.0}
    data = observed(loops(values))
    found = diagnose_loops(data, LIBRARY)
    assert found.verdict == "effect"
    top = found.ladder.rungs[-1]
    assert set(top.effects) == {"quadratic_stiffness@isolator", "viscous_damping@isolator"}
    truth = {
        "stiffness": 9e4,
        "quadratic_stiffness@isolator.stiffness": -2e6,
        "viscous_damping@isolator.coefficient": 40.0,
    }
    for name, value in truth.items():
        size = top.parameters[name]
        assert abs(size.value - value) < 3 * size.std, name
        assert 0.025 < size.std / abs(value) < 0.06, name  # no finer than the calibration of both channels
    errors = [r.error for r in found.ladder.rungs]
    heldout = [r.heldout_error for r in found.ladder.rungs]
    assert errors == sorted(errors, reverse=True)
    assert heldout == sorted(heldout, reverse=True)
    assert heldout[-1] == pytest.approx(1.0, abs=0.15)
    models = loop_models(data, LIBRARY, found.ladder)
    assert models[-1].effects == top.effects
    assert all(abs(f.energy_error) < 0.01 for f in models[-1].fits)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "models", models)
        again = codec.read(file, "models", tuple[LoopModel, ...])
    assert [m.effects for m in again] == [m.effects for m in models]


def test_loss_that_falls_with_frequency_is_a_relaxation() -> None:
    values = SPRING | {"relaxation_stiffness": 2e4, "relaxation_time": 0.03}
    found = diagnosed(loops(values, (6.0, 12.0, 24.0), noise=0.003))
    assert found.ladder.rungs[-1].effects == ("relaxation@isolator",)
    time = found.ladder.rungs[-1].parameters["relaxation@isolator.time"]
    assert abs(time.value - 0.03) < 3 * time.std


def test_damper_and_relaxation_cannot_be_told_apart_at_one_frequency() -> None:
    found = diagnosed(loops(SPRING | {"viscous_damping": 40.0}, (12.0,)))
    assert found.verdict == "ambiguous"
    assert {"viscous_damping@isolator", "relaxation@isolator"} <= set(found.indistinguishable[0])


def test_effects_that_the_user_added_are_not_found_again() -> None:
    data = observed(loops(SPRING | {"viscous_damping": 40.0}))
    known = loop_model(data, LIBRARY, ("viscous_damping@isolator",))
    found = diagnose_loops(data, LIBRARY, known)
    assert found.verdict == "adequate"
    assert "viscous_damping" not in {c.effect for c in found.candidates}


def test_ladder_keeps_the_users_order_and_refuses_what_loops_do_not_show() -> None:
    data = observed(loops(SPRING | {"viscous_damping": 40.0}))
    labels = ("cubic_stiffness@isolator", "viscous_damping@isolator")
    ladder: Ladder = make_ladder(data, [loop_model(data, LIBRARY, labels[:k]) for k in range(3)])
    assert [r.effects for r in ladder.rungs] == [(), labels[:1], labels]
    assert ladder.rungs[2].error < 0.3 * ladder.rungs[1].error
    assert (
        ladder.rungs[1].heldout_error >= 0.99 * ladder.rungs[0].heldout_error
    )  # there is no cubic stiffness
    with pytest.raises(EmaError, match=r"sensor_mass@mass.*cannot be judged by force-displacement loops"):
        loop_model(data, LIBRARY, ("sensor_mass@mass",))


def test_cycles_that_differ_make_the_loop_less_certain() -> None:
    x, force = simulate_sine_test(SPRING, 12.0, 1e-3)
    drifting = force * (1 + 0.1 * np.sin(np.linspace(0, 20, len(force))))
    calm, uneasy = (measure_loop(x, f, 5120.0, 12.0, 1e-3) for f in (force, drifting))
    assert uneasy.force_std_n > 3 * calm.force_std_n
    short = measure_loop(x[:430], force[:430], 5120.0, 12.0, 1e-3)
    assert short.cycles == 1
    shared = share_noise([uneasy, short])[1]
    assert shared.force_std_n == pytest.approx(uneasy.force_std_n * np.sqrt(uneasy.cycles), rel=0.3)


@pytest.mark.slow
def test_friction_device_shows_hysteresis_and_the_report_says_what_is_missing(test_data: Path) -> None:
    test = read_campaign(test_data / "realdata" / "friction_device_loops").tests[0]
    chosen = (
        "ds1_1Hz_35lbtension.h5",
        "ds1_1Hz_80lbtension.h5",
        "ds2_1Hz_36lb_1in.h5",
        "ds2_1Hz_36lb_0.5in.h5",
    )
    records = tuple(r for r in test.records if r.file in chosen)
    data = load_loops(test.model_copy(update={"records": records}), COARSE)
    observations = observed(list(data), own_scales=True)
    found = diagnose_loops(observations, LIBRARY)
    assert found.verdict == "unknown_effect"  # stick-slip and unequal sides are in no model
    first, second = found.ladder.rungs[:2]
    assert second.effects == ("hysteresis@isolator",)
    assert second.error < 0.3 * first.error
    assert second.heldout_error < 0.3 * first.heldout_error
    (model,) = loop_models(observations, LIBRARY, Ladder((found.ladder.rungs[-1],), 0.0, 0.0, 0.0, ""))
    assert all(abs(f.energy_error) < 0.08 for f in model.fits)
    assert len(model.scales) == 4
    words = " ".join(found.notes)
    assert "tensions" in words
    assert "stick-slip" in words
    assert found.localisation


@pytest.mark.usefixtures("all_cores")
def test_commands_and_report_tell_the_story_of_the_loops(tmp_path: Path) -> None:
    raw, out = tmp_path / "raw", tmp_path / "out"
    write_sine_tests(raw, SPRING | {"viscous_damping": 40.0}, (10.0, 16.0), (1e-3, 2e-3))

    def ema(*words: str) -> str:
        result = CliRunner().invoke(app, list(words))
        assert result.exit_code == 0, (result.output, result.exception)
        return result.output

    ema("run", str(raw), "--out", str(out), "--set", 'stages=["loops"]')
    auto = " ".join(ema("diagnose", str(out), "--auto").split())
    assert "Missing: viscous damping at isolator" in auto
    assert "Ladder of models" in auto
    assert "modes" not in auto  # words of hammer tests have no place here
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["rig"] == "isolator"
    assert summary["diagnosis"]["verdict"] == "effect"
    assert [r["effects"] for r in summary["ladder"]] == [[], ["viscous_damping@isolator"]]
    assert summary["ladder"][1]["heldout_error"] < 0.3 * summary["ladder"][0]["heldout_error"]
    assert summary["configurations"]["default"]["parameters"]["stiffness"]["value"] == pytest.approx(
        9e4, rel=0.05
    )
    assert "linear spring + viscous damping at isolator" in ema("compare", str(out))
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.index("In the model: viscous damping at isolator") < page.index('data-figure="loops"')
    assert "<img" not in page
    own = page.replace(bokeh_script(), "")
    assert "http:" not in own.replace("http://www.w3.org", "")
    assert "https:" not in own
    data = json.loads(re.findall(r'id="ema-data">(.*?)</script>', own, re.S)[0])
    (loop, *_), names = data["model"]["loops"], data["model"]["models"]
    assert len(data["model"]["loops"]) == 4
    assert names == ["linear spring", "with viscous damping at isolator"]
    left = [max(abs(m - f) for m, f in zip(loop["measured"], model, strict=True)) for model in loop["models"]]
    assert left[1] < 0.3 * left[0]
    assert loop["x"][0] == pytest.approx(min(loop["x"]), abs=0.01)
    ema("remove", str(out), "viscous_damping@isolator")
    assert "linear spring + " not in ema("compare", str(out))
    for label in ("viscous_dampin@isolator", "sensor_mass@mass"):  # no such effect; none that a loop shows
        refused = CliRunner().invoke(app, ["add", str(out), label])
        assert isinstance(refused.exception, EmaError)
    assert "sensor mass" not in ema("compare", str(out))


def test_play_of_the_spring_alone_is_told_from_play_of_the_whole_isolator() -> None:
    random, data = np.random.default_rng(4), []
    for f in (10.0, 16.0):
        for amplitude in (1e-3, 2e-3):
            phase = f * np.arange(round(20 * 5120 / f)) / 5120
            x, v = (
                amplitude * np.sin(2 * np.pi * phase),
                2 * np.pi * f * amplitude * np.cos(2 * np.pi * phase),
            )
            force = 9e4 * (x - np.clip(x, -1e-4, 1e-4)) + 40.0 * v
            force += 0.005 * np.ptp(force) * random.standard_normal(len(x))
            x = x + 0.01 * amplitude * random.standard_normal(len(x))
            data.append(measure_loop(x, force, 5120.0, f, amplitude, name=f"{f} {amplitude}"))
    found = diagnosed(data)
    top = found.ladder.rungs[-1]
    assert set(top.effects) == {"backlash@isolator", "viscous_damping@isolator"}
    assert top.parameters["backlash@isolator.gap"].value == pytest.approx(2e-4, rel=0.02)
    assert top.error == pytest.approx(1.0, abs=0.12)


# --- the further loop ----------------------------------------------------------------------------------------------


def test_the_further_loop_is_the_one_in_which_the_models_forces_differ_most() -> None:
    """A damper's force beside a spring's grows with the frequency, whatever the amplitude."""
    data = observed(loops(SPRING, (8.0, 16.0)))
    scatters = {n: s.default for n, s in data.scatters.items()}
    fits = []
    for labels in ((), ("viscous_damping@isolator",)):
        problem = data.problem(placed_effects(data, LIBRARY, labels), {})
        sizes = {f"{label}.coefficient": 40.0 for label in labels}
        x = np.zeros(len(problem.unknowns))
        for name, value in sizes.items():
            x[problem.unknowns.index[name]] = problem.sizes[name].unknown(value)
        fits.append(Fitted(problem, descend(problem, scatters, x, steps=0)))
    found = furthest(data, *fits)
    assert found.text == "at 64 Hz and 1.5 mm"
    stiffness = data.rig.parameters["stiffness"].value
    share = np.median([loop.force_std_n / np.ptp(loop.force) for loop in data.loops])
    swing = 2 * np.cos(np.pi / 128)  # of a sine at 128 points, none of them at its peak
    expected = 40.0 * 2 * np.pi * 64.0 * np.sqrt(64) / (share * swing * stiffness)
    assert found.separation == pytest.approx(expected, rel=1e-4)
    back = furthest(data, *fits[::-1])  # counted by the first one's swing
    assert back.separation == pytest.approx(
        expected / np.hypot(1, 40.0 * 2 * np.pi * 64.0 / stiffness), rel=1e-3
    )


def test_a_further_loop_is_outside_what_was_measured_or_in_its_middle() -> None:
    assert [_extreme([3.0, 1.0, 8.0], f) for f in (0.5, 1.0, 1.5)] == [0.5, 3.0, 12.0]


def test_what_to_record_next_depends_on_whether_frequencies_differ() -> None:
    def told(*frequencies: float) -> str:
        given: Any = SimpleNamespace(loops=[SimpleNamespace(frequency_hz=f) for f in frequencies])
        return _next_loop(given)

    assert told(10.0, 10.01).startswith("Repeat the loops at 5 and at 20 Hz: ")
    assert told(10.0, 12.0).startswith("Repeat one loop about another mean position")


def test_settings_are_told_with_their_scales_and_range() -> None:
    def told(scales: dict[str, float]) -> tuple[str, ...]:
        problem: Any = SimpleNamespace(force_scales=lambda x: scales)
        none: Any = None
        return _setting_words(none, problem, np.zeros(1))

    assert told({}) == ()
    (text,) = told({"one": 0.5, "two": 1.25})
    assert text.endswith("over a range of 1 : 2.5 (one 0.50, two 1.25)")


def test_effects_of_the_same_force_are_names_of_one_with_their_relative_size() -> None:
    groups: Any = []
    row = np.array([1.0, 2.0, 0.0])
    other = np.array([1.0, 2.0, 1e-3])
    names = [Name(parse_effect("damper@mass.x", isolator()), {}) for _ in range(5)]
    for name, change in zip(names, (row, 3 * row, None, -row, other), strict=True):
        put_among(groups, name, change)
    assert [[n.relative for n in mine] for _, mine in groups] == [
        [1.0, pytest.approx(3.0)],
        [1.0],
        [1.0],
        [1.0],
    ]


def told_apart(monkeypatch: pytest.MonkeyPatch, behind: float, separations: dict[str, float]) -> Diagnosis:
    """What is left of a group of three, the claimed one `behind` above its rivals, a loop telling them apart so far."""
    labels = ("a@x", "b@x", "c@x")
    sizes = {"s": EffectSize(3.0, 0.1, "N")}
    candidates = tuple(
        Candidate(*one.split("@"), "", 0.5, sizes, 9.0, 1.0, 9.0, 1.0, 9.0, 3.5, one == "b@x", "")
        for one in labels
    )
    rungs = tuple(
        Rung(given, 1.0, 1.0, 1.0, {"b@x.s": sizes["s"]}, 0.0, 0) for given in ((), ("w@x",), ("w@x", "b@x"))
    )
    group = ((*labels,), ("w@x", "v@x"))
    ladder = Ladder(rungs, 0.0, 0.0, 0.0, "")
    found = Diagnosis("ambiguous", "as it was", 0.1, candidates, group, "", (), {}, 9.0, 9.0, ladder)

    def near(data: object, effects: tuple[str, ...], values: dict[str, float]) -> Any:
        assert values["b@x.s"] == 3.0
        assert effects[0] == "w@x"
        assert f"{effects[1]}.s" in values
        value = 0.0 if effects[1] == "b@x" else -behind
        return SimpleNamespace(label=effects[1], posterior=SimpleNamespace(log_evidence=value))

    monkeypatch.setattr(module, "_learned_near", near)
    monkeypatch.setattr(module, "placed_effects", lambda data, library, labels: tuple(labels))
    monkeypatch.setattr(
        module,
        "furthest",
        lambda data, one, other: module.Further(f"of {other.label}", separations[other.label]),
    )
    none: Any = None
    return module._told_apart(none, {}, found, DiagnoseSettings(alike=3.0))


def test_rivals_stay_that_are_near_in_evidence_and_that_a_further_loop_would_tell_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = told_apart(monkeypatch, 2.9, {"a@x": 2.1, "c@x": 7.0})
    assert both.verdict == "ambiguous"
    assert both.indistinguishable == (("b@x", "a@x", "c@x"), ("w@x", "v@x"))
    assert both.next_measurement.startswith(
        "A loop of c@x would distinguish b at x from a at x: a difference of 7 "
    )
    one = told_apart(monkeypatch, 2.9, {"a@x": 2.0, "c@x": 7.0})
    assert one.indistinguishable[0] == ("b@x", "c@x")
    for behind, far in ((3.0, 7.0), (2.9, 2.0)):
        none = told_apart(monkeypatch, behind, {"a@x": far, "c@x": far})
        assert none.verdict == "effect"
        assert none.indistinguishable == (("w@x", "v@x"),)
        assert none.summary.startswith("Missing from the model: b at x")
