"""Isolator identification on loops of known parameters, on printed energies and on a real friction device."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from ema_pipeline import codec
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.isolator import analyse_loops, identify_isolator
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.loops.closed_form import bouc_wen_steps, damping_from_energies, hysteresis_force
from ema_pipeline.loops.extract import measure_loop
from ema_pipeline.loops.simulate import PRINTED, simulate_sine_test, write_sine_tests
from ema_pipeline.loops.types import IsolatorResult, Loop
from ema_pipeline.report.figures.loops import isolator_figures

TRUE = {**PRINTED, "hysteresis_stiffness": PRINTED["hysteresis_force"] * PRINTED["hysteresis_rho"]}


def loop(values: dict[str, float], frequency_hz: float = 12.0, amplitude_m: float = 1e-3, **kwargs) -> Loop:
    x, force = simulate_sine_test(values, frequency_hz, amplitude_m, **kwargs)
    return measure_loop(x, force, 5120.0, frequency_hz, amplitude_m, name=f"{frequency_hz:g}Hz")


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> IsolatorResult:
    folder = tmp_path_factory.mktemp("isolator")
    assert write_sine_tests(folder, PRINTED, seed=4) == 9
    return analyse_loops(read_campaign(folder).tests[0])


def test_parameters_come_back_from_nine_noisy_loops_with_intervals_that_cover(
    identified: IsolatorResult,
) -> None:
    limits = dict.fromkeys(
        ("stiffness", "quadratic_stiffness", "hysteresis_stiffness", "viscous_damping"), 0.03
    ) | {"hysteresis_sigma": 0.10, "hysteresis_force": 0.10, "hysteresis_rho": 0.10}
    for name, limit in limits.items():
        e = identified.parameters[name]
        assert abs(e.value / TRUE[name] - 1) < limit, name
        assert abs(e.value - TRUE[name]) < 3 * e.std, name
        assert e.std < (limit + 0.03) * abs(TRUE[name]), name  # two channels, 2 % each
        assert e.identified, name
    cubic = identified.parameters["cubic_stiffness"]  # 2 mN at 2 mm: far below the noise
    assert not cubic.identified
    assert cubic.note
    assert identified.flags == ()
    assert identified.misfit_scale < 1.1


def test_energy_slopes_agree_with_the_damper(identified: IsolatorResult) -> None:
    assert len(identified.energy) == 3
    for line in identified.energy:
        assert line.possible
        assert abs(line.damping.value - PRINTED["viscous_damping"]) < 3 * line.damping.std


def test_energy_of_a_viscous_and_cubic_loop_is_its_closed_form() -> None:
    values = {"stiffness": 9e4, "cubic_stiffness": 5e9, "viscous_damping": 40.0}
    one = loop(values, noise=0.0)
    assert one.energy_j == pytest.approx(np.pi * 40.0 * 2 * np.pi * 12.0 * 1e-6, rel=1e-4)
    assert one.amplitude_m == pytest.approx(1e-3, rel=1e-5)
    assert one.frequency_hz == pytest.approx(12.0, rel=1e-6)


def test_standard_deviation_of_the_energy_is_that_of_repeated_tests() -> None:
    loops = [loop(dict(PRINTED), random=np.random.default_rng(s)) for s in range(40)]
    spread = np.std([one.energy_j for one in loops], ddof=1)
    stated = np.mean([one.energy_std_j for one in loops])
    assert 0.7 < stated / spread < 1.5


def test_loss_factor_is_energy_over_stored_energy(identified: IsolatorResult) -> None:
    p = identified.parameters
    for one, eta in zip(identified.loops, identified.loss, strict=True):
        k = p["stiffness"].value + p["hysteresis_stiffness"].value
        x = one.amplitude_m
        stored = 0.5 * k * x**2 + 0.25 * p["cubic_stiffness"].value * x**4
        assert eta.value == pytest.approx(one.energy_j / (2 * np.pi * stored), rel=1e-9)
        assert 0 < eta.std < 0.03 * eta.value


def test_printed_energies_mean_a_negative_damper_and_are_flagged() -> None:
    line = damping_from_energies([10, 12, 15], [4.67e-2, 4.57e-2, 4.30e-2], 1e-3)
    assert line.damping.value == pytest.approx(-38.1, abs=0.5)
    assert not line.possible
    assert "relaxation" in line.reason


def test_loss_that_falls_with_frequency_is_flagged_and_a_relaxation_mends_it() -> None:
    values = {**PRINTED, "viscous_damping": 0.0, "relaxation_stiffness": 4e4, "relaxation_time": 0.05}
    random = np.random.default_rng(2)
    loops = [
        loop(values, f, a, noise=0.003, random=random) for f in (6.0, 10.0, 15.0, 25.0) for a in (1e-3, 2e-3)
    ]
    result = identify_isolator(loops)
    assert any("negative damper cannot be" in flag for flag in result.flags)
    assert result.relaxation["relaxation_stiffness"].value == pytest.approx(4e4, rel=0.1)
    assert result.relaxation["relaxation_time"].value == pytest.approx(0.05, rel=0.15)


def test_closed_form_steps_give_bouc_wen_once_stiffness_is_known() -> None:
    one = loop(dict(PRINTED), amplitude_m=2e-3, noise=0.0)
    found = bouc_wen_steps(one, hysteresis_force(one, dict(PRINTED)))
    for name in ("hysteresis_force", "hysteresis_rho"):
        assert found[name] == pytest.approx(PRINTED[name], rel=0.05)
    assert found["hysteresis_sigma"] == pytest.approx(PRINTED["hysteresis_sigma"], abs=0.05)


def test_one_frequency_does_not_part_viscous_from_hysteretic_loss() -> None:
    random = np.random.default_rng(3)
    result = identify_isolator([loop(dict(PRINTED), amplitude_m=a, random=random) for a in (1e-3, 2e-3)])
    damping = result.parameters["viscous_damping"]
    assert not damping.identified
    assert "one frequency" in damping.note
    assert result.energy == ()


def test_force_with_its_sign_the_wrong_way_round_is_flagged() -> None:
    loops = []
    for a in (1e-3, 2e-3):
        x, force = simulate_sine_test(dict(PRINTED), 12.0, a)
        loops.append(measure_loop(x, -force, 5120.0, 12.0, a))
    assert any("check the sign" in flag for flag in identify_isolator(loops).flags)


def test_run_up_and_run_down_are_left_out() -> None:
    x, force = simulate_sine_test(dict(PRINTED), 12.0, 1e-3, noise=0.0)
    n = len(x)
    ramp = np.concatenate([np.linspace(0, 1, n // 3), np.ones(n - 2 * (n // 3)), np.linspace(1, 0, n // 3)])
    one = measure_loop(x * ramp, force * ramp, 5120.0, 12.0, 1e-3)
    assert one.amplitude_m == pytest.approx(1e-3, rel=0.02)
    assert 8 <= one.cycles <= 14


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"amplitude_m": 2e-3}, r"amplitude is (1|0.999\d?) mm, amplitude_m says 2 mm.*correct"),
        ({"frequency_hz": 400.0}, r"samples per cycle.*raise sample_rate_hz"),
        ({"frequency_hz": 9.0}, r"does not repeat at 9 Hz.*correct frequency_hz"),
        ({"displacement": np.zeros(5000)}, r"does not move"),
        ({"force": np.zeros(12800)}, r"force does not change"),
        ({"displacement": np.zeros(100), "force": np.arange(100.0)}, r"shorter than one cycle"),
    ],
)
def test_records_without_a_loop_are_refused_in_one_line(change: dict[str, object], message: str) -> None:
    x, force = simulate_sine_test(dict(PRINTED), 12.0, 1e-3)
    given = {
        "displacement": x, "force": force, "sample_rate_hz": 5120.0, "frequency_hz": 12.0, "amplitude_m": 1e-3
    }  # fmt: skip
    with pytest.raises(EmaError, match=message):
        measure_loop(**(given | change))  # type: ignore[arg-type]
    with pytest.raises(EmaError, match="no loops"):
        identify_isolator([])


def test_result_survives_the_store_and_its_figures_are_drawn(
    identified: IsolatorResult, tmp_path: Path
) -> None:
    import h5py

    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "isolator", identified)
        again = codec.read(file, "isolator", IsolatorResult)
    assert again.parameters == identified.parameters
    np.testing.assert_array_equal(again.loops[3].force, identified.loops[3].force)
    for figure in isolator_figures(identified).values():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        assert buffer.tell() > 10_000


def test_friction_device_is_fitted_and_its_play_is_named(test_data: Path) -> None:
    test = read_campaign(test_data / "realdata" / "friction_device_loops").tests[0]
    chosen = [r for r in test.records if r.file in ("ds2_1Hz_36lb_1in.h5", "ds1_1Hz_80lbtension.h5")]
    result = analyse_loops(test.model_copy(update={"records": tuple(chosen)}))
    for one, fit in zip(result.loops, result.alone, strict=True):
        assert one.cycles >= 2
        assert abs(fit.energy_error) < 0.03
        # By hand: ∮F dx of the third cycle of each record.
        assert one.energy_j == pytest.approx({"ds1": 1023.0, "ds2": 1274.0}[one.name[:3]], rel=0.03)
    words = " ".join(result.notes)
    assert "play (backlash)" in words
    assert "2 of 2 loops" in words
    assert "energy per cycle" in words  # two tensions are two devices


def test_summary_is_plain_json_and_the_terminal_says_what_was_found(identified: IsolatorResult) -> None:
    import json

    from ema_pipeline.loops.summary import summary, terminal_lines

    numbers = json.loads(json.dumps(summary(identified), allow_nan=False))
    assert numbers["parameters"]["viscous_damping"]["value"] == identified.parameters["viscous_damping"].value
    assert len(numbers["loops"]) == 9
    text = "\n".join(terminal_lines(identified))
    assert "9 loops" in text
    assert "cubic stiffness" in text
    assert "not distinguishable from zero" in text
