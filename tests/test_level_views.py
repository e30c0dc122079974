"""Hits whose motion hangs on the last thousandth of the force: which they are, and a diagnosis without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_level_diagnosis import RATE, RIG, TRUE, TRUTHS, build, case_of, plain, pulse, windows

from ema_pipeline import codec
from ema_pipeline.diagnose.explain import compared_text
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, error_of, judged
from ema_pipeline.diagnose.levels.data import HitWindows
from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels
from ema_pipeline.diagnose.levels.ladder import make_level_ladder, sizes_of
from ema_pipeline.diagnose.levels.problem import NoiseFloor, fit, residuals
from ema_pipeline.diagnose.levels.rungs import climb
from ema_pipeline.diagnose.levels.views import foretold_hits, holds, sensitivity, unforeseen
from ema_pipeline.diagnose.types import Ladder
from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Element
from ema_pipeline.mechanics.batch import Blows, batch_response
from ema_pipeline.mechanics.laws import PartingSpring
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter

LABEL, TRUE_PRELOAD = "rattle@link", 5e-7
STIFF = {**TRUE, "link": 1e7}
RATTLING = ParametricRig(
    "two bodies in stiff contact",
    ("test",),
    {**RIG.parameters, "link": Parameter("link", 1e7, "N/m", 0.05)},
    build,
)


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if np.isinf(values["preload"]):
        return assembly

    def let_part(e: Element) -> Element:
        return PartingSpring(e.name, e.row, e.stiffness, e.loss_factor, values["preload"], 1e-2)

    return assembly.edit([f"{place} x"], let_part)


RATTLE = Effect(
    id="rattle",
    title="a contact that parts",
    parameters=(
        EffectParameter("preload", "m", float("inf"), 1e-5, 1e-5, 0.0, 1e-2, "deflection under preload"),
    ),
    find_places=lambda assembly: ("link",),
    edit=_edit,
    signs="rattling",
    reference="",
    linear=False,
)


TRUTH = _edit(RATTLING.assembly("test", STIFF), "link", {"preload": TRUE_PRELOAD})
FORCES = (24.0, 30.0, 300.0)
HITS = [(k, "hub.x", share) for k in range(3) for share in (0.95, 1.1)] + [
    (k, "rim.y", 1.0) for k in range(3)
]
ROWS = {"hub.x": np.eye(4)[0], "rim.y": np.eye(4)[3]}


def rattling_windows() -> HitWindows:
    """Hits on the hub make the contact rattle, those across on the rim do not."""
    level = np.array([k for k, _, _ in HITS])
    force = np.array([pulse(600, share * FORCES[k]) for k, _, share in HITS])
    into = np.array([ROWS[at] for _, at, _ in HITS])
    blows = Blows(RATE, force, into, np.eye(4), ("acceleration",) * 4)
    noise = 0.002 * np.random.default_rng(5).standard_normal((len(HITS), 4, 600))
    return replace(
        windows(),
        names=tuple(f"hit{i}#0" for i in range(len(HITS))),
        level=level,
        force_n=np.array(FORCES),
        impacts=tuple(Dof.parse(at) for _, at, _ in HITS),
        force=force,
        measured=batch_response([TRUTH], blows, 64)[0] + noise,
        present=np.ones((len(HITS), 4), dtype=bool),
        noise=np.full((len(HITS), 4), 0.002),
        band_hz=(30.0, 700.0),
        unsure=np.zeros(len(HITS)),
    )


def rattling_case() -> LevelCase:
    case = case_of(rattling_windows())
    known = {"rattle": RATTLE, "bearing_cubic": shipped_effects()["bearing_cubic"]}
    fine = case.settings.levels.model_copy(update={"points_per_period": 40.0})
    settings = case.settings.model_copy(update={"levels": fine})
    return replace(case, rig=RATTLING, library=known, starts=(STIFF,), top_hz=870.0, settings=settings)


def model_of(case: LevelCase, labels: tuple[str, ...], values: Mapping[str, float]) -> Simulated:
    """A model at given values."""
    hypothesis = Hypothesis(labels)
    sizes = {n: v for n, v in values.items() if "@" in n}
    problem = case.problem(hypothesis, sizes)
    at = fit(problem, case.weights(case.floor), problem.space.point(values), 0)
    return judged(problem, hypothesis, sizes, at)


def test_a_linear_model_foretells_every_hit() -> None:
    case = rattling_case()
    base = model_of(case, (), STIFF)
    assert np.max(sensitivity(case, base)[0]) < 1e-4
    view = foretold_hits(case, base)
    assert view is not None
    assert not view.left_out


def test_what_a_thousandth_of_the_force_decides_is_that_of_the_general_integrator() -> None:
    case = rattling_case()
    (w,) = case.windows
    (got,) = sensitivity(case, model_of(case, (LABEL,), {**STIFF, f"{LABEL}.preload": TRUE_PRELOAD}))
    for force, impact, level, share in zip(w.force, w.impacts, w.level, got, strict=True):
        into = ROWS[str(impact)]
        one, other = (w.in_band(plain(TRUTH, k * force, into, np.eye(4), 64) / k) for k in (1.0, 1.001))
        expected = float(np.linalg.norm(other - one) / np.linalg.norm(one))
        if str(impact) == "hub.x" and level == 2:
            assert min(share, expected) > 0.03  # where chance rules, no two integrators agree on more
        else:
            assert share == pytest.approx(expected, abs=0.01)


def test_hits_that_chance_rules_are_left_out_and_the_others_weigh_as_far_as_they_are_foretold() -> None:
    case = rattling_case()
    view = foretold_hits(case, model_of(case, (LABEL,), {**STIFF, f"{LABEL}.preload": TRUE_PRELOAD}))
    assert view is not None
    assert set(view.left_out) <= {"hit4#0", "hit5#0"}  # the hard ones on the hub
    assert view.left_out
    assert len(view.windows[0].names) == len(HITS) - len(view.left_out)
    unsure = view.windows[0].unsure
    assert 0 < np.max(unsure) < 0.1
    floor = case.floor
    plainly = replace(view, windows=tuple(replace(w, unsure=0 * w.unsure) for w in view.windows))
    known, doubted = (x.weights(floor)[0].scale for x in (plainly, view))
    worst = int(np.argmax(unsure))
    there = view.windows[0].present[worst]
    expected = floor.own / np.hypot(floor.own, unsure[worst])
    assert np.median(doubted[worst, there] / known[worst, there]) == pytest.approx(expected, rel=0.05)


def test_a_model_that_rattles_in_most_hits_is_not_held_against_the_rest() -> None:
    case = rattling_case()
    (w,) = case.windows
    on_hub = np.array([str(d) == "hub.x" for d in w.impacts])
    hard = replace(case, windows=(w.only(on_hub & (w.level >= 1)),))
    loud = replace(hard, windows=tuple(replace(w, force=10 * w.force) for w in hard.windows))
    model = model_of(loud, (LABEL,), {**STIFF, f"{LABEL}.preload": TRUE_PRELOAD})
    assert np.mean(sensitivity(loud, model)[0] > 0.1) > 0.5
    assert foretold_hits(loud, model) is None


def test_hits_are_left_out_only_by_the_model_that_says_why() -> None:
    case = rattling_case()
    true = {**STIFF, f"{LABEL}.preload": TRUE_PRELOAD}
    view = foretold_hits(case, model_of(case, (LABEL,), true))
    assert view is not None
    calm = case.only([np.array([at == "rim.y" for _, at, _ in HITS])])
    base = climb(calm, (), case.floor, lambda share, text: None)[0]
    assert error_of(calm, base) < case.settings.error_limit
    assert not holds(case, calm, base, case.floor)
    assert holds(case, view, model_of(view, (LABEL,), true), case.floor)


def test_an_effect_is_found_without_the_hits_that_it_cannot_foretell(monkeypatch: pytest.MonkeyPatch) -> None:
    """One hit came out otherwise, and any model that depends on the level is told to be unsure of it."""
    (elements, parameter, true), label = TRUTHS["bearing_cubic@hub"], "bearing_cubic@hub"
    w = windows(*elements)
    turned = np.where(np.array(w.names)[:, None, None] == "hit2#0", -1.0, 1.0)
    case = case_of(replace(w, measured=turned * w.measured))

    def told(case: LevelCase, model: Simulated) -> list[np.ndarray]:
        unsure = 0.5 if model.hypothesis.labels else 0.0
        return [np.where(np.array(w.names) == "hit2#0", unsure, 1e-3) for w in case.windows]

    monkeypatch.setattr("ema_pipeline.diagnose.levels.views.sensitivity", told)
    found = diagnose_levels(case, (), None, "", ())
    assert found.verdict == "effect", found.summary
    assert [c.label for c in found.candidates if c.claimed] == [label]
    assert found.candidates[0].parameters[parameter].value == pytest.approx(true, rel=0.1)
    assert found.ladder.left_out == ("hit2#0",)
    assert compared_text(found.ladder) in found.notes
    ladder = make_level_ladder(case, (label,), lambda share, text: None)
    assert ladder.left_out == ("hit2#0",)
    assert ladder.rungs[-1].error < 1.3 < ladder.rungs[0].error
    monkeypatch.setattr(
        "ema_pipeline.diagnose.levels.views.sensitivity",
        lambda case, model: [0 * w.unsure for w in case.windows],
    )
    assert not make_level_ladder(case, (label,), lambda share, text: None).left_out


def test_a_size_is_known_no_better_than_the_motion_is_foretold() -> None:
    case = rattling_case()
    preload = f"{LABEL}.preload"
    model = model_of(case, (LABEL,), {**STIFF, preload: TRUE_PRELOAD})
    exact = NoiseFloor(1e-3, 0.1)
    shares = np.minimum(sensitivity(case, model)[0], 0.1)
    assert unforeseen(case, model) == pytest.approx(np.sqrt(np.mean(shares**2)))
    assert unforeseen(case, model) > 0.02
    assert sizes_of(case, model, exact)[preload].std > 0.02 * TRUE_PRELOAD
    smooth = replace(case, rig=RIG, starts=(TRUE,))
    cubic = model_of(smooth, ("bearing_cubic@hub",), {**TRUE, "bearing_cubic@hub.stiffness": 2e11})
    assert unforeseen(smooth, cubic) < 2e-3


def test_hits_left_out_are_named() -> None:
    ladder = Ladder((), 0.0, 0.0, 0.0, "", left_out=tuple(f"a.uff#{k}" for k in range(6)))
    said = compared_text(ladder)
    assert said.startswith("6 hits are left out (a.uff#0, a.uff#1, a.uff#2, a.uff#3, 2 more)")
    assert compared_text(replace(ladder, left_out=())) == ""


def test_hits_left_out_survive_the_store(tmp_path: Path) -> None:
    ladder = Ladder((), 0.0, 0.0, 0.0, "", left_out=("a.uff#0", "b.uff#1"))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "ladder", ladder)
        assert codec.read(file, "ladder", Ladder).left_out == ladder.left_out


def test_motion_without_bound_in_one_configuration_is_no_solution() -> None:
    """The soft hits have a motion, the hard ones of a second configuration have none."""
    case = replace(rattling_case(), rig=RIG, starts=(TRUE,))
    (w,) = case.windows
    hard = replace(w.only(w.level == 2), force=20 * w.force[w.level == 2])
    both = replace(case, windows=(w.only(w.level == 0), hard))
    label = "bearing_cubic@hub"
    values = {**TRUE, f"{label}.stiffness": -2e12}
    problem = both.problem(Hypothesis((label,)), {f"{label}.stiffness": -2e12})
    with pytest.raises(EmaError, match="without bound"):
        residuals(problem, both.weights(both.floor), problem.space.point(values)[None])
    found = model_of(both, (label,), values)
    assert found.fit.objective == np.inf
