"""Diagnosis: which physics is missing, how sure, and what to measure next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from ema_pipeline import codec
from ema_pipeline.correlate.measured import MeasuredModes, from_frequencies
from ema_pipeline.diagnose import DiagnoseSettings, Diagnosis, diagnose, make_ladder
from ema_pipeline.diagnose.fitting import Case, fit_hypothesis, fit_null, ground
from ema_pipeline.diagnose.hypotheses import (
    Hypothesis,
    extras,
    prior_probabilities,
    single_hypotheses,
)
from ema_pipeline.diagnose.scan import scanned
from ema_pipeline.diagnose.separate import options
from ema_pipeline.diagnose.thresholds import from_null_gains
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.base import model_modes

RIG = load_rig("planetary")
BODIES = ("carrier", "sun", "planet1", "planet2")
SETTINGS = DiagnoseSettings(processes=1, folds=3)
FEW = {k: shipped_effects()[k] for k in ("mesh_stiffness_loss", "planet_bearing_mistune", "shaft_torsion")}
CRACK, TORSION = "mesh_stiffness_loss@sun-planet1", "shaft_torsion@carrier"


def true_system(
    effects: Mapping[str, float], changed: Mapping[str, float], rng: np.random.Generator
) -> tuple[LinearSystem, float]:
    """The rig without ring, drawn from its tolerances, and its damping ratio."""
    rig = rig_with_effects(RIG, [k.partition(".")[0] for k in effects])
    values = {
        n: 1e7 if p.free else p.value * (1 + p.tolerance * float(np.clip(rng.normal(), -2, 2)))
        for n, p in RIG.parameters.items()
    }
    return rig.system("no_ring", {**values, **effects, **changed}), values["modal_damping_ratio"]


def measure(
    effects: Mapping[str, float],
    changed: Mapping[str, float] | None = None,
    seed: int = 1,
    noise: float = 0.3,
) -> dict[str, MeasuredModes]:
    """Modes of a rig drawn from its tolerances, with 0.03 % of frequency scatter and so on."""
    rng = np.random.default_rng(seed)
    system, damping = true_system(effects, changed or {}, rng)
    f, phi = normal_modes(system)
    inside = (f > 5) & (f < 2000)
    dofs = tuple(Dof(b, d) for b in BODIES for d in ("x", "y", "u"))
    shapes = (sensor_rows(system, dofs) @ phi[:, inside]).T
    shapes = shapes / np.abs(shapes).max(axis=1, keepdims=True)
    f = f[inside]
    scatter = rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape)
    measured = MeasuredModes(
        configuration="no_ring",
        frequency_hz=f * (1 + 1e-3 * noise * rng.normal(size=f.size)),
        frequency_std_hz=1e-3 * noise * f,
        damping_ratio=damping * (1 + 0.1 * noise * rng.normal(size=f.size)),
        damping_std=np.full(f.size, 0.1 * noise * damping),
        shapes=shapes + 0.02 * noise * scatter,
        shape_std=np.full(shapes.shape, 0.02 * noise),
        dofs=dofs,
        band_hz=(5.0, 2000.0),
    )
    return {"no_ring": measured}


@cache
def cracked() -> Diagnosis:
    return diagnose(RIG, measure({f"{CRACK}.fraction": 0.3}), SETTINGS, FEW)


def test_a_cracked_mesh_is_named_with_its_size_and_proved_on_held_out_data() -> None:
    d = cracked()
    assert d.verdict == "effect"
    first = d.candidates[0]
    assert (first.effect, first.at) == ("mesh_stiffness_loss", "sun-planet1")
    assert first.claimed
    assert first.probability > 0.9
    size = first.parameters["fraction"]
    assert abs(size.value - 0.3) < 3 * size.std + 1e-4
    assert size.value == pytest.approx(0.3, rel=0.15)
    assert d.error > 3
    assert first.error_after < 1.3
    assert first.heldout_error_after < 0.5 * d.heldout_error
    assert [r.effects for r in d.ladder.rungs] == [(), (CRACK,)]
    assert "mesh stiffness loss at sun-planet1" in d.summary


def test_probabilities_of_all_hypotheses_and_of_nothing_add_up_to_one() -> None:
    d = cracked()
    assert sum(d.probabilities.values()) == pytest.approx(1)
    assert d.probabilities["nothing"] == d.null_probability < 1e-3


def test_a_healthy_rig_is_adequate_and_nothing_is_claimed() -> None:
    d = diagnose(RIG, measure({}, seed=2), SETTINGS, FEW)
    assert d.verdict == "adequate"
    assert not any(c.claimed for c in d.candidates)
    assert d.null_probability > 0.5
    assert d.error < 1.3
    assert len(d.ladder.rungs) == 1


def test_a_parameter_far_out_of_its_tolerance_is_named_by_its_name() -> None:
    d = diagnose(RIG, measure({}, {"sun_bearing_stiffness": 1.8 * 1.025e6}, seed=3), SETTINGS, FEW)
    first = d.candidates[0]
    assert (first.effect, first.at) == ("out_of_tolerance", "sun_bearing_stiffness")
    assert d.verdict == "effect"
    assert first.parameters["sun_bearing_stiffness"].value == pytest.approx(1.8 * 1.025e6, rel=0.05)


def test_an_effect_that_the_library_lacks_is_called_unknown_and_located() -> None:
    library = {k: v for k, v in FEW.items() if k != "shaft_torsion"}
    d = diagnose(RIG, measure({f"{TORSION}.stiffness": 6e5}, seed=4), SETTINGS, library)
    assert d.verdict == "unknown_effect"
    assert any("carrier.u" in place.place for place in d.localisation)


def test_four_frequencies_are_too_few_for_three_unknowns_and_an_effect() -> None:
    d = diagnose(RIG, {"with_ring": from_frequencies("with_ring", [47.0, 98.0, 519.0])}, SETTINGS, FEW)
    assert d.verdict == "not_enough_data"
    assert "cannot determine" in d.summary


def test_a_ladder_is_built_from_effects_that_the_user_adds() -> None:
    up = make_ladder(RIG, measure({f"{CRACK}.fraction": 0.3}), (CRACK,), SETTINGS)
    assert [r.effects for r in up.rungs] == [(), (CRACK,)]
    assert up.rungs[1].error < 1.3 < up.rungs[0].error
    assert up.rungs[1].heldout_error < up.rungs[0].heldout_error
    assert up.rungs[1].objective < up.rungs[0].objective


def test_mistakes_in_the_ladder_are_said_in_one_line() -> None:
    measured = measure({})
    with pytest.raises(EmaError, match="named twice"):
        make_ladder(RIG, measured, (CRACK, CRACK), SETTINGS)
    with pytest.raises(EmaError, match="not in the model"):
        Hypothesis((CRACK,)).without(TORSION)
    with pytest.raises(EmaError, match="no effect 'mesh_loss'"):
        make_ladder(RIG, measured, ("mesh_loss@sun-planet1",), SETTINGS)
    with pytest.raises(EmaError, match="no measured modes"):
        diagnose(RIG, {"no_ring": from_frequencies("no_ring", [])}, SETTINGS, FEW)


def test_a_diagnosis_survives_the_store(tmp_path: Path) -> None:
    d = cracked()
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "d", d)
        back = codec.read(file, "d", Diagnosis)
    assert repr(back.candidates) == repr(d.candidates)
    # NaN is not equal to itself
    assert [replace(r, frf_error=0.0) for r in back.ladder.rungs] == [
        replace(r, frf_error=0.0) for r in d.ladder.rungs
    ]
    assert back.probabilities == d.probabilities


def test_hypotheses_are_named_physics_at_places_that_were_measured() -> None:
    labels = {h.label for h in single_hypotheses(RIG, ["no_ring"], None)}
    assert CRACK in labels
    assert TORSION in labels
    assert not any(x.startswith(("spring@", "mass@", "damper@")) for x in labels)
    assert not any("ring-planet" in x for x in labels)
    assert "out_of_tolerance@sun_mass" in labels
    assert "out_of_tolerance@sun_planet_mesh_stiffness" not in labels


def test_prior_probabilities_add_up_to_one_and_leave_half_to_nothing_missing() -> None:
    prior = prior_probabilities(single_hypotheses(RIG, RIG.configurations, None), 0.5, 0.2)
    assert sum(prior.values()) == pytest.approx(1)
    assert prior["nothing"] == 0.5


def test_thresholds_follow_the_quantile_of_simulated_null_gains() -> None:
    rng = np.random.default_rng(0)
    gains = [{"a": float(g)} for g in rng.chisquare(2, 2000)]
    # the 99 % point of χ² with two degrees of freedom is -2 ln 0.01 = 9.21
    assert from_null_gains(gains)["a"] == pytest.approx(9.21, rel=0.1)
    assert from_null_gains(gains[:60])["a"] == pytest.approx(9.21, rel=0.35)


def test_a_richer_model_never_fits_worse() -> None:
    case = Case(RIG, measure({}, seed=6), SETTINGS, FEW)
    null = fit_null(case, Hypothesis(), SETTINGS.fit, None)
    below = ground(case, null, SETTINGS.fit)
    for label in (CRACK, TORSION, "planet_bearing_mistune@planet2"):
        f = fit_hypothesis(case, Hypothesis((label,)), SETTINGS.fit, below)
        assert f.objective <= null.objective + 0.01


def test_sizes_that_bring_lost_modes_back_are_found_without_a_fit_and_none_where_none_is_lost() -> None:
    library = {"hysteretic_damping": shipped_effects()["hysteretic_damping"]}
    label = "hysteretic_damping@sun-planet"
    (loss,) = extras(RIG, Hypothesis((label,)), library)

    def sizes(measured: Mapping[str, MeasuredModes]) -> list[float]:
        case = Case(RIG, measured, SETTINGS, library)
        base = fit_null(case, Hypothesis(), SETTINGS.fit, None)
        problem = case.problem(Hypothesis((label,)), SETTINGS.fit)
        start = ground(case, base, SETTINGS.fit).annealed or base.values
        return [problem.space.named(x)[loss.name] for x in scanned(problem, start, [loss])]

    healthy = measure({}, seed=8)
    assert sizes(healthy) == []
    damped = rig_with_effects(RIG, [(label, {"loss_factor": 0.06})])
    values = {n: 1e7 if p.free else p.value for n, p in RIG.parameters.items()} | {loss.name: 0.06}
    exact = {round(m.frequency_hz, 1): m.damping_ratio for m in model_modes(damped, "no_ring", values)}
    m = healthy["no_ring"]
    ratio = np.array([min(exact.items(), key=lambda f: abs(f[0] - hz))[1] for hz in m.frequency_hz])
    lossy = {"no_ring": replace(m, damping_ratio=ratio, damping_std=0.03 * ratio)}
    assert sizes(lossy)[0] == pytest.approx(0.06, rel=0.5)


def test_a_further_measurement_separates_two_effects_but_not_one_from_itself() -> None:
    case = Case(RIG, measure({f"{TORSION}.stiffness": 3e5}, seed=7), SETTINGS, FEW)
    null = fit_null(case, Hypothesis(), SETTINGS.fit, None)
    below = ground(case, null, SETTINGS.fit)
    a = fit_hypothesis(case, Hypothesis((TORSION,)), SETTINGS.fit, below)
    b = fit_hypothesis(case, Hypothesis(("shaft_torsion@sun",)), SETTINGS.fit, below)
    assert all(o.separation < 1e-6 for o in options(case, a, a, SETTINGS.fit))
    apart = options(case, a, b, SETTINGS.fit)
    assert any("clamped" in o.text for o in apart)
    assert any("with_ring" in o.text for o in apart)
    assert max(o.separation for o in apart) > 3


def test_the_number_of_processes_does_not_change_a_digit() -> None:
    measured = measure({f"{CRACK}.fraction": 0.3})
    two = diagnose(RIG, measured, SETTINGS.model_copy(update={"processes": 2}), FEW)
    assert two.probabilities == cracked().probabilities
