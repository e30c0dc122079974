"""Which effect an isolator's model is missing: engine against stepping, verdicts on loops with known truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ema_pipeline.loops.diagnosis import diagnose_loops
from ema_pipeline.loops.effects import Structure
from ema_pipeline.loops.fitting import fit, predict
from ema_pipeline.loops.heldout import folds, settings_differ
from ema_pipeline.loops.ladder import make_loop_ladder
from ema_pipeline.loops.loop_set import LoopSet
from typer.testing import CliRunner

from ema_pipeline import codec
from ema_pipeline.cli import app
from ema_pipeline.diagnose.types import Diagnosis
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import read_campaign
from ema_pipeline.loops.extract import measure_loop, share_noise
from ema_pipeline.loops.model import Motion, loop_force
from ema_pipeline.loops.read import load_loops
from ema_pipeline.loops.simulate import simulate_sine_test, steady_force, write_sine_tests
from ema_pipeline.loops.types import Loop, LoopModel
from ema_pipeline.mechanics.limit_cycle import LimitCycle

SPRING = {"stiffness": 9e4}
BOUC_WEN = {"hysteresis_force": 80.0, "hysteresis_rho": 900.0, "hysteresis_sigma": 0.6}


def loop(values: dict[str, float], frequency_hz: float, amplitude_m: float, **kwargs) -> Loop:
    x, force = simulate_sine_test(values, frequency_hz, amplitude_m, cycles=20, **kwargs)
    name = f"{frequency_hz:g} Hz {1e3 * amplitude_m:g} mm"
    return measure_loop(x, force, 5120.0, frequency_hz, amplitude_m, name=name)


def loops(
    values: dict[str, float], frequencies: tuple[float, ...] = (10.0, 16.0), seed: int = 1
) -> list[Loop]:
    random = np.random.default_rng(seed)
    return [loop(values, f, a, random=random) for f in frequencies for a in (1e-3, 2e-3)]


@pytest.mark.parametrize("exponent", [1.0, 2.0, 6.0])
def test_tabulated_hysteresis_is_that_of_the_mechanics_stepped_along_the_cycle(exponent: float) -> None:
    values = SPRING | BOUC_WEN | {"hysteresis_exponent": exponent}
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    fast, _ = Motion([one]).force(values, ("stiffness", "hysteresis_force"))
    stepped = loop_force(values, one.series, one.frequency_hz, one.phase)
    assert np.abs(fast - stepped).max() < 1e-4 * np.ptp(stepped)


def test_limit_cycle_meets_its_closed_form() -> None:
    # n = 1, σ = ½: unloading is a straight line, loading is 1 - exp(-x), so that W - ln(1 - W) = ρ·2X.
    cycle, top = LimitCycle(0.5, 1.0), 0.7
    span = np.array([top - np.log(1 - top)])
    assert cycle.along(span, span) == pytest.approx([top], abs=1e-5)
    assert cycle.along(np.array([0.2]), span) == pytest.approx([-(top - 0.2)], abs=1e-5)


def test_play_before_a_spring_is_a_dead_zone() -> None:
    one = loop(SPRING, 12.0, 1e-3, noise=0.0)
    force, _ = Motion([one]).force(SPRING | {"backlash_gap": 4e-4}, ("stiffness",))
    x = one.displacement
    expected = 9e4 * np.sign(x) * np.maximum(np.abs(x) - 2e-4, 0.0)
    assert np.abs(force - expected).max() < 1e-6 * np.ptp(expected)


def test_play_before_spring_damper_and_hysteresis_is_that_of_a_simulation_in_time() -> None:
    values = SPRING | BOUC_WEN | {"viscous_damping": 30.0, "backlash_gap": 3e-4}
    one = loop(values, 12.0, 1e-3, noise=0.0)
    force, _ = Motion([one]).force(values, ("stiffness", "viscous_damping", "hysteresis_force"))
    stepped = steady_force(values, one.frequency_hz, 1e-3, (one.phase))
    assert np.sqrt(np.mean((force - stepped) ** 2)) < 2e-3 * np.ptp(stepped)
    assert np.mean(np.abs(force) < 1e-9) > 0.05  # the play is there


def test_scatter_of_the_residuals_is_one_with_the_true_effects() -> None:
    values = SPRING | {"cubic_stiffness": 3e9, "viscous_damping": 40.0}
    data = LoopSet(loops(values))
    found = fit(data, Structure(("cubic_stiffness", "viscous_damping")))
    assert found.chi2 / data.freedom == pytest.approx(1.0, abs=0.12)
    std = np.sqrt(np.diag(found.covariance()))
    for name, s in zip(found.names, std, strict=True):
        assert abs(found.values[name] - values[name]) < 4 * s, name
    assert np.sqrt(np.mean(predict(data, found) ** 2)) == pytest.approx(1.0, abs=0.1)


def test_loops_are_left_out_by_amplitude_frequency_and_setting() -> None:
    nine = [loop(SPRING, f, a) for f in (10.0, 12.0, 15.0) for a in (1e-3, 1.5e-3, 2e-3)]
    assert folds(nine, 3) == (
        (0, 3, 6), (1, 4, 7), (2, 5, 8),  # amplitudes
        (0, 1, 2), (3, 4, 5), (6, 7, 8),  # frequencies
    )  # fmt: skip
    assert folds(nine[:1], 3) == ()
    assert folds(nine[:2], 3) == ((0,), (1,))
    soft, stiff = (loop({"stiffness": 9e4, "viscous_damping": c}, 10.0, 1e-3) for c in (40.0, 80.0))
    assert settings_differ([soft, stiff], 2.0)
    assert not settings_differ(nine, 2.0)
    assert folds([soft, stiff, nine[5]], 3, settings_differ=True)[-2:] == ((0,), (1,))


def test_linear_spring_is_adequate_and_the_limits_are_stated() -> None:
    found, models = diagnose_loops(loops(SPRING))
    assert found.verdict == "adequate"
    assert found.null_probability > 0.9
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.probabilities["nothing"] == found.null_probability
    assert found.error == pytest.approx(1.0, abs=0.12)
    assert [m.effects for m in models] == [()]
    (limits,) = (n for n in found.notes if "smallest further effects" in n)
    assert "viscous damping" in limits
    assert "backlash" in limits


def test_hidden_effects_are_found_exactly_with_sizes_that_cover(tmp_path: Path) -> None:
    import h5py

    values = SPRING | {"quadratic_stiffness": -2e6, "viscous_damping": 40.0, "backlash_gap": 1e-4}
    found, models = diagnose_loops(loops(values))
    assert found.verdict == "effect"
    top = found.ladder.rungs[-1]
    wanted = {"quadratic_stiffness@isolator", "viscous_damping@isolator", "backlash@isolator"}
    assert set(top.effects) == wanted
    truth = {
        "stiffness": 9e4,
        "quadratic_stiffness@isolator.stiffness": -2e6,
        "viscous_damping@isolator.coefficient": 40.0,
        "backlash@isolator.gap": 1e-4,
    }
    assert set(top.parameters) == set(truth)
    for name, size in top.parameters.items():
        assert abs(size.value - truth[name]) < 4 * size.std, name
        assert size.std < 0.05 * abs(truth[name])
    errors = [r.error for r in found.ladder.rungs]
    heldout = [r.heldout_error for r in found.ladder.rungs]
    assert errors == sorted(errors, reverse=True)
    assert heldout == sorted(heldout, reverse=True)
    assert heldout[-1] == pytest.approx(1.0, abs=0.2)
    assert {c.label for c in found.candidates if c.claimed} == wanted
    assert all(c.probability > 0.9 for c in found.candidates if c.claimed)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "diagnosis", found)
        codec.write(file, "models", models)
        stored = codec.read(file, "diagnosis", Diagnosis)
        assert stored.ladder.rungs[-1].parameters == top.parameters
        again = codec.read(file, "models", tuple[LoopModel, ...])
    assert [m.effects for m in again] == [m.effects for m in models]


def test_damper_and_relaxation_cannot_be_told_apart_at_one_frequency() -> None:
    found, _ = diagnose_loops(loops(SPRING | {"viscous_damping": 40.0}, (12.0,)))
    assert found.verdict == "ambiguous"
    assert set(found.indistinguishable[0]) == {"viscous_damping@isolator", "relaxation@isolator"}
    assert "Hz" in found.next_measurement
    assert "12 Hz" not in found.next_measurement  # another frequency, not the same


def test_effects_that_the_user_added_are_not_found_again() -> None:
    data = loops(SPRING | {"viscous_damping": 40.0})
    found, models = diagnose_loops(data, ("viscous_damping@isolator",))
    assert found.verdict == "adequate"
    assert "viscous_damping" not in {c.effect for c in found.candidates}
    assert models[0].effects == ("viscous_damping@isolator",)


def test_ladder_keeps_the_users_order_and_refuses_what_loops_do_not_show() -> None:
    data = loops(SPRING | {"viscous_damping": 40.0})
    ladder, models = make_loop_ladder(data, ("cubic_stiffness@isolator", "viscous_damping@isolator"))
    assert [r.effects for r in ladder.rungs] == [m.effects for m in models]
    assert ladder.rungs[1].effects == ("cubic_stiffness@isolator",)
    assert ladder.rungs[2].error < 0.3 * ladder.rungs[1].error
    assert (
        ladder.rungs[1].heldout_error >= 0.99 * ladder.rungs[0].heldout_error
    )  # there is no cubic stiffness
    with pytest.raises(EmaError, match=r"'bearing_cubic@sun' cannot be judged by force-displacement loops"):
        make_loop_ladder(data, ("bearing_cubic@sun",))
    with pytest.raises(EmaError, match="no loops"):
        make_loop_ladder((), ())


def test_cycles_that_differ_make_the_loop_less_certain() -> None:
    x, force = simulate_sine_test(SPRING, 12.0, 1e-3)
    drifting = force * (1 + 0.1 * np.sin(np.linspace(0, 20, len(force))))
    calm, uneasy = (measure_loop(x, f, 5120.0, 12.0, 1e-3) for f in (force, drifting))
    assert uneasy.force_std_n > 3 * calm.force_std_n
    short = measure_loop(x[:430], force[:430], 5120.0, 12.0, 1e-3)
    assert short.cycles == 1
    shared = share_noise([uneasy, short])[1]
    assert shared.force_std_n == pytest.approx(uneasy.force_std_n * np.sqrt(uneasy.cycles), rel=0.3)


def test_friction_device_climbs_to_hysteresis_and_backlash_and_says_what_is_missing(test_data: Path) -> None:
    test = read_campaign(test_data / "realdata" / "friction_device_loops").tests[0]
    chosen = (
        "ds1_1Hz_35lbtension.h5",
        "ds1_1Hz_80lbtension.h5",
        "ds2_1Hz_36lb_1in.h5",
        "ds2_1Hz_36lb_0.5in.h5",
    )
    records = tuple(r for r in test.records if r.file in chosen)
    found, models = diagnose_loops(load_loops(test.model_copy(update={"records": records})))
    assert found.verdict == "unknown_effect"  # stick-slip and unequal sides are in no model
    assert found.ladder.rungs[-1].effects == ("hysteresis@isolator", "backlash@isolator")
    heldout = [r.heldout_error for r in found.ladder.rungs]
    assert heldout[1] < 0.3 * heldout[0]
    assert heldout[2] < heldout[1]
    assert all(abs(f.energy_error) < 0.08 for f in models[-1].fits)
    assert len(models[-1].scales) == 4
    words = " ".join(found.notes)
    assert "tensions" in words
    assert "stick and slip" in words
    assert "larger one way" in words
    assert found.localisation


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
    assert page.index("Missing: viscous damping at isolator") < page.index("<img")
    assert "http" not in page.replace("http://www.w3.org", "")
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
            data.append(measure_loop(x, force, 5120.0, f, amplitude))
    found, _ = diagnose_loops(data)
    top = found.ladder.rungs[-1]
    assert set(top.effects) == {"backlash@isolator", "viscous_damping@isolator"}
    assert top.parameters["backlash@isolator.gap"].value == pytest.approx(2e-4, rel=0.02)
    assert top.error == pytest.approx(1.0, abs=0.12)
    assert any("spring alone" in note for note in found.notes)
