"""The measurement that tells two models apart best: expected differences by hand, and what is said of them."""

from __future__ import annotations

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from imperfect_modes import EXACT, chain, chain_modes, planetary_modes

from ema_pipeline.diagnose.types import NOTHING
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.inference import descend
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.observations.fitting import Fit, Model
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.planetary import planetary

next_test = importlib.import_module("ema_pipeline.diagnose.next_test")


def system(mass: list[float], wall: float) -> LinearSystem:
    stiffness = np.array([[wall + 1e4, -1e4], [-1e4, 3e4]])
    none = np.zeros((2, 2))
    tip = {"tip.x": np.array([0.5, 2.0])}
    return LinearSystem(("a.x", "b.x"), np.diag(mass), stiffness, none, none, 0.01, tip)


PAIR = system([1.0, 2.0], 1e4), system([1.0, 2.0], 2e4)


def modes(of: LinearSystem, added: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    squares, shapes = scipy.linalg.eigh(of.stiffness, of.mass + np.diag([added, 0.0]))
    return np.sqrt(squares) / (2 * np.pi), shapes


def test_shapes_are_compared_at_the_place_relative_to_their_largest_entry() -> None:
    band = (5.0, 100.0)
    for place, row in (("b.x", [0.0, 1.0]), ("tip.x", [0.5, 2.0])):
        one, two = (np.abs(row @ s) / np.max(np.abs(s), axis=0) for _, s in map(modes, PAIR))
        assert next_test._shape_gap(PAIR, band, place) == pytest.approx(np.linalg.norm(one - two))
    upper = (float(np.mean(modes(PAIR[0])[0])), 100.0)  # of both models the upper mode only
    assert next_test._shape_gap(PAIR, upper, "tip.x") == pytest.approx(abs(one - two)[1])


def test_frequencies_are_compared_by_what_an_added_mass_shifts_them() -> None:
    band, mass = (5.0, 100.0), 0.3
    one, two = (np.log(modes(p, mass)[0]) - np.log(modes(p)[0]) for p in PAIR)
    assert next_test._frequency_gap(PAIR, band, "a.x", mass) == pytest.approx(np.linalg.norm(one - two))
    upper = (np.mean(modes(PAIR[0])[0]), 100.0)
    assert next_test._frequency_gap(PAIR, upper, "a.x", mass) == pytest.approx(abs((one - two)[1]))
    assert next_test._frequency_gap(PAIR, (100.0, 200.0), "a.x", mass) == 0.0


def test_models_without_modes_of_their_own_are_not_told_apart() -> None:
    fallen = replace(PAIR[1], stiffness=-PAIR[1].stiffness)
    assert next_test._shape_gap((PAIR[0], fallen), (5.0, 100.0), "b.x") == 0.0
    assert next_test._frequency_gap((PAIR[0], fallen), (5.0, 100.0), "a.x", 0.3) == 0.0


def fitted(observations: ModeObservations, label: str) -> Fit:
    model = Model().plus(parse_effect(label, observations.rig), {})
    problem = observations.problem(model.effects, model.scales)
    scatters = {n: s.default for n, s in observations.scatters.items()}
    (name,) = problem.sizes
    return Fit(model, descend(problem, scatters, problem.start({name: 2e5}), steps=0))


def test_every_place_without_a_sensor_and_a_tenth_of_every_mass_is_tried() -> None:
    rig = chain()
    measured = chain_modes(1, EXACT)["all"]
    assert measured.shapes is not None
    assert measured.shape_std is not None
    few = replace(
        measured, dofs=measured.dofs[:3], shapes=measured.shapes[:, :3], shape_std=measured.shape_std[:, :3]
    )
    observations = ModeObservations(rig, [prepare(few)])
    fits = [fitted(observations, label) for label in ("spring@m2.z", "spring@m4.z")]
    options = next_test._options(observations, *fits)
    assert {o.text for o in options} == {
        "A sensor at m4.z (all)", "A sensor at m5.z (all)",
        *(f"A mass of 0.2 kg added at m{k}.z (all)" for k in range(1, 6)),
    }  # fmt: skip
    assert [o.separation for o in options] == sorted((o.separation for o in options), reverse=True)
    told = {o.text: o.separation for o in options}
    systems = tuple(
        m.system("all", f.posterior.x[: len(m.unknowns)])
        for m, f in zip((observations.problem(f.model.effects, {}).model for f in fits), fits, strict=True)
    )
    band = few.band_hz
    shape_std = max(fits[0].posterior.scatters["shape_scatter"], 0.02)
    frequency_std = max(fits[0].posterior.scatters["frequency_scatter"], 1e-3)
    assert told["A sensor at m4.z (all)"] == pytest.approx(
        next_test._shape_gap(systems, band, "m4.z") / shape_std
    )
    expected = next_test._frequency_gap(systems, band, "m1.z", 0.2) / frequency_std
    assert told["A mass of 0.2 kg added at m1.z (all)"] == pytest.approx(expected, rel=1e-6)
    assert told["A mass of 0.2 kg added at m1.z (all)"] > 1.0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_places_that_only_one_model_knows_and_turning_are_not_tried(order: tuple[int, int]) -> None:
    """A support that one model adds cannot be measured in the other."""
    rig = planetary()
    measured = planetary_modes(rig, 2, EXACT, configurations=("no_ring",))["no_ring"]
    assert measured.shapes is not None
    assert measured.shape_std is not None
    seen = [k for k, d in enumerate(measured.dofs) if d.point != "sun.y"]
    few = replace(
        measured,
        dofs=tuple(measured.dofs[k] for k in seen),
        shapes=measured.shapes[:, seen],
        shape_std=measured.shape_std[:, seen],
    )
    observations = ModeObservations(rig, [prepare(few)])
    scatters = {n: s.default for n, s in observations.scatters.items()}
    fits = []
    for label in ("flexible_support@sun", "mass@sun"):
        model = Model().plus(parse_effect(label, rig), {})
        problem = observations.problem(model.effects, model.scales)
        start = problem.start({"mass@sun.mass": 5.0})
        fits.append(Fit(model, descend(problem, scatters, start, steps=0)))
    told = [o.text for o in next_test._options(observations, *(fits[k] for k in order))]
    assert any(t.startswith("A sensor at sun.y") for t in told)
    assert not any(t.startswith("A sensor at sun.x") for t in told)
    masses = [t for t in told if t.startswith("A mass")]
    known = rig.system("no_ring")
    own = float(known.mass[known.dofs.index("sun.x"), known.dofs.index("sun.x")])
    tenth = 0.1 * (own + 5.0 * (order[0] == 1))  # of the body as the first model has it
    assert f"A mass of {tenth:.2g} kg added at sun.x (no_ring)" in masses
    assert not any(".u (" in t for t in masses)
    assert not any("support" in t for t in told)


def asked(
    monkeypatch: pytest.MonkeyPatch,
    verdict: str,
    separation: float | None = 2.0,
    nothing: float = 0.5,
    labels: tuple[str, ...] = ("spring@m2", "mass@m3"),
    observations: object = None,
) -> str:
    """What is proposed where the best measurement tells two models apart by `separation`; None: none was tried."""
    seen = [
        SimpleNamespace(named=SimpleNamespace(label=label), ranked=SimpleNamespace(fit=f"fit of {label}"))
        for label in labels
    ]
    base = SimpleNamespace(base="fit of the base")
    found = SimpleNamespace(
        rounds=[SimpleNamespace(probabilities={NOTHING: nothing}, judged=seen, ranking=base)]
    )

    def options(observations: object, first: str, second: str) -> list[object]:
        told = [
            next_test.Option(f"A sensor ({first}, {second})", separation or 0.0),
            next_test.Option("Else", 0.1),
        ]
        return told if separation is not None else []

    monkeypatch.setattr(next_test, "_options", options)
    given = observations or ModeObservations(chain(), [])
    return str(next_test.next_measurement(given, found, seen, verdict))


def test_rivals_are_told_apart_by_the_best_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    told = asked(monkeypatch, "ambiguous", 2.34)
    assert told == (
        "A sensor (fit of spring@m2, fit of mass@m3) would distinguish spring at m2 from mass at m3: "
        "a difference of 2.3 standard deviations is expected."
    )
    assert "would distinguish" in asked(monkeypatch, "ambiguous", 1.0)
    for weak in (0.9, None):
        told = asked(monkeypatch, "ambiguous", weak)
        assert (
            told
            == "No single further measurement that was tried would distinguish spring at m2 from mass at m3."
        )
    assert asked(monkeypatch, "ambiguous", labels=("spring@m2",)) == ""


def test_an_adequate_model_that_is_not_sure_is_told_from_its_best_rival(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = asked(monkeypatch, "adequate", 3.0)
    assert told.startswith(
        "A sensor (fit of spring@m2, fit of the base) would distinguish spring at m2 from nothing missing"
    )
    assert asked(monkeypatch, "adequate", 0.9) == ""
    assert asked(monkeypatch, "adequate", None) == ""
    assert asked(monkeypatch, "adequate", nothing=0.9) == ""
    assert asked(monkeypatch, "adequate", labels=()) == ""


def test_other_verdicts_and_other_data_propose_no_measurement_of_modes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert asked(monkeypatch, "effect") == ""
    assert asked(monkeypatch, "ambiguous", observations=object()) == ""


def test_beyond_the_library_the_rig_file_is_checked_first_and_no_test_is_proposed_that_was_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain = asked(monkeypatch, "unknown_effect")
    assert plain.startswith(
        "Check values and units in the rig file; if they are right, hit at three force levels"
    )
    still, moving = (
        asked(
            monkeypatch,
            "unknown_effect",
            observations=SimpleNamespace(linearised=True, level_dependent=moves),
        )
        for moves in (False, True)
    )
    assert still.endswith("if they are right, put further sensors where measurement and model differ most.")
    assert "hit more softly, until no mode moves" in moving
