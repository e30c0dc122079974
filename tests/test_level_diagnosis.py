"""Effects that depend on the force level: compiled responses, and their diagnosis from simulated hits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import firwin, resample

from ema_pipeline import codec
from ema_pipeline.diagnose.explain import size_text
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.levels.case import LevelCase
from ema_pipeline.diagnose.levels.data import HitWindows
from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels
from ema_pipeline.diagnose.levels.ladder import make_level_ladder
from ema_pipeline.diagnose.levels.problem import NoiseFloor, hit_misfits, whitenings
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import EffectSize, Ladder
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import get_effect, shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Spring
from ema_pipeline.mechanics.batch import Blows, batch_response
from ema_pipeline.mechanics.batch_lines import batch_lines
from ema_pipeline.mechanics.laws import BoucWen, DryFriction, Nonlinear, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.report.diagnosis import noise_words, size_words
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter

RATE = 2048.0
LEVELS = np.array([30.0, 100.0, 300.0])
TRUE = {"mass": 1.005, "bearing": 3.9e5, "link": 2.1e5, "modal_damping_ratio": 0.012}


def build(configuration: str, values: dict[str, float]) -> Assembly:
    """Two bodies in the plane, hub on a bearing and rim on the hub."""
    elements: list[Mass | Spring | Damper] = []
    for axis, factor in (("x", 1.0), ("y", 1.15)):
        hub, rim = f"hub.{axis}", f"rim.{axis}"
        elements += [
            Mass(f"hub mass {axis}", {hub: 1.0}, values["mass"]),
            Mass(f"rim mass {axis}", {rim: 1.0}, 0.5),
            Spring(f"hub bearing {axis}", {hub: 1.0}, factor * values["bearing"]),
            Spring(f"rim bearing {axis}", {rim: 1.0}, 1e4),
            Spring(f"link {axis}", {hub: 1.0, rim: -1.0}, values["link"]),
        ]
    return Assembly(("hub.x", "hub.y", "rim.x", "rim.y"), tuple(elements), {}, values["modal_damping_ratio"])


RIG = ParametricRig(
    "two bodies",
    ("test",),
    {
        "mass": Parameter("mass", 1.0, "kg", 0.01),
        "bearing": Parameter("bearing", 4e5, "N/m", 0.1),
        "link": Parameter("link", 2e5, "N/m", 0.1),
        "modal_damping_ratio": Parameter("modal_damping_ratio", 0.01, "1", 0.3),
    },
    build,
)


def pulse(n: int, peak: float, width_s: float = 2e-3) -> np.ndarray:
    t = np.arange(n) / RATE - 4e-3
    return np.where(np.abs(t) < width_s / 2, peak * np.cos(np.pi * t / width_s) ** 2, 0.0)


def plain(
    assembly: Assembly, force: np.ndarray, into: np.ndarray, out: np.ndarray, substeps: int
) -> np.ndarray:
    """The general integrator, which knows nothing of the compiled loop: a given state keeps it from there."""
    rest = np.zeros(len(assembly.dofs))
    return nonlinear_response(
        assembly, RATE, force[None], out, into[None], substeps=substeps, displacement=rest, velocity=rest
    ).acceleration


@pytest.mark.parametrize(
    "element",
    [
        PolynomialSpring("cubic", {"hub.x": 1.0}, cubic=3e11),
        PolynomialSpring("quadratic", {"hub.x": 1.0}, quadratic=-1e8),
        DryFriction("friction", {"hub.x": 1.0}, 4.0),
        PartingSpring("contact", {"hub.x": 1.0, "rim.x": -1.0}, 2e5, 0.0, 1e-5, 1e-3),
    ],
    ids=lambda e: e.name,
)
def test_the_compiled_loop_agrees_with_the_general_integrator(element: Nonlinear) -> None:
    assembly = RIG.assembly("test", TRUE).add(element)
    force = pulse(500, 150.0)
    out, into = np.eye(4), np.array([1.0, 0.0, 0.0, 0.0])
    compiled = nonlinear_response(assembly, RATE, force[None], out, into[None], substeps=4)
    expected = plain(assembly, force, into, out, 4)
    assert np.std(compiled.acceleration - expected) < 1e-6 * np.std(expected)


def test_many_models_and_blows_at_once_are_each_as_alone() -> None:
    models = [
        RIG.assembly("test", TRUE).add(PolynomialSpring("cubic", {"hub.x": 1.0}, cubic=k))
        for k in (-1e9, 2e11, 6e11)
    ]
    models.append(RIG.assembly("test", TRUE))
    force = np.stack([pulse(400, p) for p in (30.0, 200.0)])
    rows = np.eye(4)
    blows = Blows(
        RATE, force, rows[[0, 2]], rows, ("acceleration", "velocity", "displacement", "acceleration")
    )
    together = batch_response(models, blows, 3)
    for i, model in enumerate(models):
        for j in range(2):
            one = Blows(RATE, force[j : j + 1], rows[[0, 2]][j : j + 1], rows, blows.quantities)
            np.testing.assert_allclose(
                together[i, j], batch_response([model], one, 3)[0, 0], rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("substeps", [1, 3])
def test_lines_in_closed_form_are_those_of_the_simulated_signals(substeps: int) -> None:
    base = RIG.assembly("test", TRUE)
    models = [
        base,
        base.add(
            PolynomialSpring("cubic", {"hub.x": 1.0}, cubic=2e11), DryFriction("f", {"rim.x": 1.0}, 0.4)
        ),
        base.add(PartingSpring("contact", {"hub.x": 1.0, "rim.x": -1.0}, 2e5, 0.0, 2e-6, 1e-5)),
    ]
    force = np.stack([pulse(601, p) for p in (30.0, 200.0)])
    rows = np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    blows = Blows(RATE, force, np.eye(4)[[2, 0]], rows, ("acceleration", "velocity", "displacement"))
    fade, lines = 0.3 * 601 / RATE, np.array([3, 4, 50, 299])
    signals = batch_response(models, blows, substeps)
    time = np.arange(601) / RATE
    expected = np.fft.rfft(signals * np.exp(-time / fade))[..., lines]
    got = batch_lines(models, blows, substeps, fade, lines)
    scale = np.abs(expected).max(axis=-1, keepdims=True)
    # with substeps the states at the end are those of the forces before the filter
    assert np.all(np.abs(got - expected) <= (1e-7 if substeps == 1 else 1e-4) * scale)
    memory = [base.add(BoucWen("loop", {"hub.x": 1.0}, 3.0, 5e4, 0.6))]
    slow = np.fft.rfft(batch_response(memory, blows, substeps) * np.exp(-time / fade))[..., lines]
    np.testing.assert_allclose(batch_lines(memory, blows, substeps, fade, lines), slow, rtol=1e-9)


def test_strikes_shorter_than_a_sample_are_read_as_an_analyser_reads_them() -> None:
    """Against the general integrator at 16 times the rate behind another filter, a plain FIR low-pass."""
    model = RIG.assembly("test", TRUE).add(
        PartingSpring("contact", {"hub.x": 1.0, "rim.x": -1.0}, 2e7, 0.0, 2e-7, 1e-3)
    )
    force = pulse(600, 100.0)
    rows = np.eye(4)[[0, 2]]
    fine = resample(force, 600 * 16)
    exact = nonlinear_response(model, 16 * RATE, fine[None], rows, rows[:1]).acceleration
    taps = firwin(1601, 0.44 * RATE, fs=16 * RATE)
    read = np.stack([np.convolve(channel, taps, "same") for channel in exact])[:, ::16]
    blows = Blows(RATE, force[None], rows[:1], rows, ("acceleration", "acceleration"))
    simulated = batch_response([model], blows, 16)[0, 0]
    f, fade = np.fft.rfftfreq(600, 1 / RATE), np.exp(-np.arange(600) / 200)
    inside = (f > 20) & (f < 0.36 * RATE)

    def apart(signals: np.ndarray) -> float:
        a, b = (np.fft.rfft(x * fade)[:, inside] for x in (signals, read))
        return float(np.linalg.norm(a - b) / np.linalg.norm(b))

    assert apart(exact[:, ::16]) > 0.3  # the case is one in which it matters
    assert apart(simulated) < 0.01


def test_elements_with_a_memory_go_through_the_general_integrator() -> None:
    model = RIG.assembly("test", TRUE).add(BoucWen("loop", {"hub.x": 1.0}, 3.0, 5e4, 0.6))
    force = pulse(300, 60.0)
    blows = Blows(RATE, force[None], np.eye(4)[:1], np.eye(4), ("acceleration",) * 4)
    expected = plain(model, force, np.eye(4)[0], np.eye(4), 2)
    np.testing.assert_allclose(batch_response([model], blows, 2)[0, 0], expected, rtol=1e-8, atol=1e-9)


def test_motion_without_bound_is_an_error_of_one_line() -> None:
    model = RIG.assembly("test", TRUE).add(PolynomialSpring("soft", {"hub.x": 1.0}, cubic=-1e16))
    blows = Blows(RATE, pulse(400, 300.0)[None], np.eye(4)[:1], np.eye(4), ("acceleration",) * 4)
    with pytest.raises(EmaError, match="soft") as raised:
        batch_response([model], blows, 1)
    assert "\n" not in str(raised.value)


def test_asymmetric_bearing_drifts_towards_its_soft_side() -> None:
    effect = get_effect("bearing_quadratic")
    soft = effect.apply(RIG.assembly("test", TRUE), "hub", {"stiffness": 1e9})
    x = nonlinear_response(soft, RATE, pulse(800, 200.0)[None], np.eye(4)[:1], np.eye(4)[:1], substeps=8)
    assert np.mean(x.displacement) < -1e-6  # the force K2·x² pushes one way whatever the sign of x
    assert not effect.linear


def windows(*elements: Element, noise: float = 0.002, seed: int = 1) -> HitWindows:
    """Hits at three levels on two points, from the general integrator, with noise."""
    random = np.random.default_rng(seed)
    assembly = RIG.assembly("test", TRUE).add(*elements)
    n, rows = 600, np.eye(4)
    force, measured, level, points = [], [], [], []
    for point, dof in ((0, Dof("hub", "x")), (3, Dof("rim", "y"))):
        for k, peak in enumerate(LEVELS):
            f = pulse(n, peak * random.uniform(0.9, 1.1))
            force.append(f)
            measured.append(plain(assembly, f, rows[point], rows, 4))
            level.append(k)
            points.append(dof)
    signals = np.array(measured)
    return HitWindows(
        configuration="test",
        names=tuple(f"hit{i}#0" for i in range(len(level))),
        level=np.array(level),
        force_n=LEVELS,
        impacts=tuple(points),
        sensors=tuple(Dof.parse(d) for d in assembly.dofs),
        quantities=("acceleration",) * 4,
        sample_rate_hz=RATE,
        force=np.array(force),
        measured=signals + noise * random.standard_normal(signals.shape),
        present=np.ones((len(level), 4), dtype=bool),
        noise=np.full((len(level), 4), noise),
        band_hz=(30.0, 500.0),
        modes=4,
        unsure=np.zeros(len(level)),
    )


def case_of(w: HitWindows) -> LevelCase:
    settings = DiagnoseSettings(processes=1)
    only = {
        k: v
        for k, v in shipped_effects().items()
        if k in ("bearing_cubic", "bearing_quadratic", "dry_friction")
    }
    return LevelCase(RIG, (w,), settings, only, ({**TRUE, "mass": 1.0},), 140.0)


TRUTHS = {
    "bearing_cubic@hub": (
        [PolynomialSpring(f"c{a}", {f"hub.{a}": 1.0}, cubic=2e11) for a in "xy"], "stiffness", 2e11,
    ),
    "dry_friction@rim": ([DryFriction(f"f{a}", {f"rim.{a}": 1.0}, 1.5) for a in "xy"], "force", 1.5),
}  # fmt: skip


@pytest.mark.parametrize("label", list(TRUTHS))
def test_the_effect_its_place_and_its_size_are_found(label: str) -> None:
    elements, parameter, true = TRUTHS[label]
    found = diagnose_levels(case_of(windows(*elements)), (), None, "", ())
    assert found.verdict == "effect", found.summary
    assert found.candidates[0].label == label
    assert found.candidates[0].probability >= 0.9
    assert found.candidates[0].parameters[parameter].value == pytest.approx(true, rel=0.1)
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    first, last = found.ladder.rungs
    worst = int(np.nanargmax(first.heldout_misfit))
    assert last.heldout_misfit[worst] < 0.5 * first.heldout_misfit[worst]
    assert last.heldout_error < first.heldout_error


def test_a_linear_effect_beside_is_found_and_listed_with_what_it_adds() -> None:
    masses = [Mass(f"m{a}", {f"rim.{a}": 1.0}, 0.1) for a in "xy"]
    case = case_of(windows(*TRUTHS["bearing_cubic@hub"][0], *masses))
    assert case.library is not None
    case = replace(case, library={**case.library, "sensor_mass": shipped_effects()["sensor_mass"]})
    found = diagnose_levels(case, (), None, "", ())
    sizes = {c.label: c.parameters for c in found.candidates if c.claimed}
    assert set(sizes) == {"bearing_cubic@hub", "sensor_mass@rim"}, found.summary
    assert sizes["sensor_mass@rim"]["mass"].value == pytest.approx(0.1, rel=0.1)
    assert sizes["bearing_cubic@hub"]["stiffness"].value == pytest.approx(2e11, rel=0.1)


def test_effects_without_a_time_response_are_told_from_those_with_one() -> None:
    from ema_pipeline.diagnose.levels.linear_claims import without_time_response
    from ema_pipeline.rigs.planetary import planetary

    labels = ("hysteretic_damping@sun", "local_damper@sun", "mesh_stiffness_loss@sun-planet1")
    found = without_time_response(planetary(2), ["no_ring"], labels, DiagnoseSettings(), None)
    assert found == {"hysteretic_damping@sun"}


def test_a_damper_is_not_claimed_as_friction_whose_force_nobody_can_tell() -> None:
    dampers = [Damper(f"d{a}", {f"rim.{a}": 1.0}, 8.0) for a in "xy"]
    found = diagnose_levels(case_of(windows(*TRUTHS["bearing_cubic@hub"][0], *dampers)), (), None, "", ())
    assert [c.label for c in found.candidates if c.claimed] == ["bearing_cubic@hub"], found.summary


def test_linear_hits_make_no_effect_probable() -> None:
    found = diagnose_levels(case_of(windows()), (), None, "", ())
    assert not any(c.claimed for c in found.candidates)
    assert found.verdict not in ("effect", "ambiguous")
    assert found.null_probability > 0.4  # effects too small to be seen stay possible
    limits = {x.label: x.size for x in found.detection_limits}
    assert 0 < limits["bearing_cubic@hub"] < 2e11  # what the other tests hide would have been seen


def test_a_model_that_has_the_effect_already_lacks_nothing() -> None:
    elements = TRUTHS["bearing_cubic@hub"][0]
    found = diagnose_levels(case_of(windows(*elements)), ("bearing_cubic@hub",), None, "", ())
    assert found.verdict == "adequate", found.summary


def test_a_ladder_of_hits_survives_the_store(tmp_path) -> None:
    import h5py

    elements = TRUTHS["bearing_cubic@hub"][0]
    ladder = make_level_ladder(case_of(windows(*elements)), ("bearing_cubic@hub",), lambda share, text: None)
    assert [r.effects for r in ladder.rungs] == [(), ("bearing_cubic@hub",)]
    assert np.isnan(ladder.compared_s)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "ladder", ladder)
        back = codec.read(file, "ladder", Ladder)
    assert back.rungs[1].misfit == ladder.rungs[1].misfit
    assert {t.force_n for t in back.traces} == set(LEVELS)


def test_motion_that_is_lost_in_time_is_compared_as_long_as_a_model_follows_it() -> None:
    """After 45 % of each window the signals are turned round, as after strikes that come otherwise."""
    label, (elements, parameter, true) = "bearing_cubic@hub", TRUTHS["bearing_cubic@hub"]
    w = windows(*elements)
    late = int(0.45 * w.measured.shape[-1])
    turned = np.concatenate([w.measured[..., :late], -w.measured[..., late:]], axis=-1)
    case = case_of(replace(w, measured=turned))
    window_s = float(w.time_s[-1])
    found = diagnose_levels(case, (), None, "", ())
    assert found.verdict == "effect", found.summary
    assert [c.label for c in found.candidates if c.claimed] == [label]
    assert found.candidates[0].parameters[parameter].value == pytest.approx(true, rel=0.15)
    assert 0.3 * window_s < found.ladder.compared_s < 0.45 * window_s
    remark = f"Only the first {1e3 * found.ladder.compared_s:.0f} ms of each hit are compared"
    assert any(n.startswith(remark) for n in found.notes)
    ladder = make_level_ladder(case, (label,), lambda share, text: None)
    assert ladder.compared_s == found.ladder.compared_s
    assert remark in noise_words(ladder)
    assert ladder.rungs[-1].error < 1.3 < ladder.rungs[0].error


def test_an_error_alike_at_all_levels_weighs_little_and_one_at_one_level_weighs_much() -> None:
    w = windows(noise=1e-6)
    floor = NoiseFloor(0.003, 0.1)
    (weight,) = whitenings([w], floor, 2.0)
    lines = w.spectra(w.measured)
    alike = weight.applied(1.05 * lines[None])
    single = lines.copy()
    single[2] *= 1.05
    one = weight.applied(single[None])
    assert np.sum(np.abs(one) ** 2) > 20 * np.sum(np.abs(alike) ** 2)


def test_weighing_is_by_the_inverse_of_the_covariance_of_both_errors() -> None:
    w = windows()
    floor = NoiseFloor(0.01, 0.1)
    (weight,) = whitenings([w], floor, 2.0)
    simulated = 1.02 * w.spectra(np.roll(w.measured, 1, axis=-1))
    sigma, size, _ = w.sigma(floor.own)
    at = [i for i, d in enumerate(w.impacts) if str(d) == str(w.impacts[0])]
    force = w.spectra(w.force)
    sensor, line = np.unravel_index(np.argmax(weight.worth[at].min(axis=0)), weight.worth.shape[1:])
    own = sigma[at, sensor, line]
    per_newton = size[at, sensor, line].sum() / np.abs(force[at, line]).sum()
    common = floor.common * per_newton * force[at, line]
    covariance = np.diag(own**2) + np.outer(common, common.conj())
    difference = (simulated - weight.measured)[at, sensor, line]
    expected = (difference.conj() @ np.linalg.solve(covariance, difference)).real
    got = weight.applied(simulated[None])[0][at, sensor, line] / weight.worth[at, sensor, line]
    assert np.sum(np.abs(got) ** 2) == pytest.approx(expected, rel=1e-9)


def test_misfit_is_the_missed_share_of_the_signal() -> None:
    w = windows(noise=0.0)
    np.testing.assert_allclose(hit_misfits(w, 0.9 * w.measured), 0.1, rtol=1e-9)


def test_hypotheses_are_the_effects_that_are_not_linear_at_every_place() -> None:
    from ema_pipeline.diagnose.levels.case import level_hypotheses

    labels = {h.label for h in level_hypotheses(case_of(windows()), Hypothesis())}
    assert {"bearing_cubic@hub", "bearing_cubic@rim", "dry_friction@hub", "bearing_quadratic@rim"} <= labels


def test_a_false_alarm_of_the_levels_leaves_the_diagnosis_to_the_modes(tmp_path) -> None:
    from typing import cast

    from ema_pipeline.diagnose.levels.prepare import LevelTest
    from ema_pipeline.levels.types import LevelStudy
    from ema_pipeline.modal.types import ModalModel
    from ema_pipeline.stages.base import Run, RunInfo
    from ema_pipeline.stages.diagnose import linear_after_all
    from ema_pipeline.store import Store

    def seen(p_value: float) -> list[LevelTest]:
        study = LevelStudy((), (), (), (), (), level_dependent=True, p_value=p_value, summary="")
        return [LevelTest("no_ring", study, cast(ModalModel, None))]

    info = RunInfo("hammer", "", "", "planetary", "planetary", ("no_ring",), (), "", {})
    run = Run(Store(tmp_path), info, {"diagnose": DiagnoseSettings()})
    chance = diagnose_levels(case_of(windows()), (), None, "", ())
    assert linear_after_all(run, seen(0.005), chance)
    assert not linear_after_all(run, seen(1e-6), chance)  # no chance, though no effect is told
    assert not linear_after_all(run, seen(0.005), replace(chance, error=1.3))
    top = replace(chance.ladder.rungs[-1], effects=("bearing_cubic@carrier",))
    moving = replace(chance, ladder=replace(chance.ladder, rungs=(*chance.ladder.rungs, top)))
    assert not linear_after_all(run, seen(0.005), moving)


def test_friction_finer_than_a_step_stops_the_motion_without_ringing() -> None:
    """A mass on a spring, let go by a blow, under F·sign(v): stops where |k·x| < F and stays."""
    k, m, limit = 4e5, 1.0, 40.0
    assembly = Assembly(
        ("p.x",),
        (
            Mass("m", {"p.x": 1.0}, m),
            Spring("k", {"p.x": 1.0}, k),
            DryFriction("f", {"p.x": 1.0}, limit, 1e-6),
        ),
        {},
        1e-4,
    )
    force = pulse(400, 300.0)
    one = np.ones((1, 1))
    moved = nonlinear_response(assembly, RATE, force[None], one, one, substeps=16)
    x, v = moved.displacement[0], moved.velocity[0]
    peaks = [abs(x[i]) for i in range(1, 399) if v[i - 1] * v[i] < 0 and abs(x[i]) > limit / k]
    falls = -np.diff(peaks)[1:3]
    np.testing.assert_allclose(falls, 2 * limit / k, rtol=0.1)  # per half swing
    assert np.max(np.abs(v[300:])) < 1e-3 * np.max(np.abs(v))
    assert np.all(np.abs(x[300:]) <= 1.01 * limit / k)


def test_friction_of_any_transition_is_told_with_its_force() -> None:
    w = windows(*(DryFriction(f"f{a}", {f"rim.{a}": 1.0}, 1.5, 1e-4) for a in "xy"))
    found = diagnose_levels(case_of(w), (), None, "", ())
    assert found.verdict == "effect", found.summary
    size = found.candidates[0].parameters["force"]
    assert found.candidates[0].label == "dry_friction@rim"
    assert size.value == pytest.approx(1.5, rel=0.15)
    assert abs(size.value - 1.5) < 3 * size.std
    limits = {x.label: x.size for x in found.detection_limits}
    assert 0 < limits["dry_friction@rim"] < 1.5


def test_a_size_that_the_data_do_not_tell_is_not_given() -> None:
    sizes = {
        "mesh_backlash@m.preload": EffectSize(2.7e-7, 6e-9, "m"),
        "mesh_backlash@m.gap": EffectSize(1e-4, 3.2, "m"),
    }
    assert size_text(sizes) == "preload 2.7e-07 ± 6e-09 m, gap not told by these data"
    assert "gap not told by these data" in size_words(sizes)
    assert "force 0.0 ± 1.4 N" in size_words({"dry_friction@m.force": EffectSize(0.0, 1.4, "N")})
