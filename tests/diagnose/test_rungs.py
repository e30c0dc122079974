"""The ladder's rungs: sizes with their σ, gains, scatters, and where the fit of the next rung begins."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imperfect_modes import EXACT, chain, chain_modes

from ema_pipeline.diagnose import rungs
from ema_pipeline.diagnose.heldout import HeldOut
from ema_pipeline.diagnose.rungs import (
    _best_of,
    fits_of,
    ladder_of,
    learned_scatters,
    noise,
    parameter_sizes,
    rung_at,
    with_gains,
)
from ema_pipeline.diagnose.types import EffectSize, LearnedScatter, Rung
from ema_pipeline.inference import Scatter, Unknowns
from ema_pipeline.observations.fitting import Fit, Model, fit_base
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations

diagnosis: Any = import_module("ema_pipeline.diagnose.diagnosis")

NO_DATA: Any = object()


def rung(log_evidence: float) -> Rung:
    return Rung((), 1.0, 1.0, 1.0, {}, log_evidence, 0)


def test_gains_count_from_the_first_rung() -> None:
    assert [r.log_evidence for r in with_gains([rung(-7.0), rung(-4.0), rung(3.0)])] == [0.0, 3.0, 10.0]


@pytest.mark.parametrize(("linearised", "std"), [(True, 2.5), (False, 2.0)])
def test_a_size_that_single_hits_tell_is_no_better_known_than_it_is_calculated(
    linearised: bool, std: float
) -> None:
    """Of -5 N/m a calculation that is off by 30 % has 1.5 N/m wrong, of friction of 5 N 3 N; so has its velocity."""
    effects = [
        SimpleNamespace(label="cubic@x", effect=SimpleNamespace(linear=False)),
        SimpleNamespace(label="spring@x", effect=SimpleNamespace(linear=True)),
        SimpleNamespace(label="friction@x", effect=SimpleNamespace(linear=False)),
    ]
    sizes = {name: EffectSize(-5.0, 2.0, "N/m") for name in ("cubic@x.s", "spring@x.s", "mass")}
    sizes["friction@x.s"] = EffectSize(5.0, 2.0, "N")
    sizes["friction@x.v"] = EffectSize(5.0, 2.0, "m/s")
    observations: Any = SimpleNamespace(linearised=linearised)
    model: Any = SimpleNamespace(effects=effects)
    found = rungs._stated(observations, model, sizes)
    assert {n: s.std for n, s in found.items()} == pytest.approx(
        {
            "cubic@x.s": std,
            "spring@x.s": 2.0,
            "mass": 2.0,
            "friction@x.s": np.hypot(2.0, 3.0) if linearised else 2.0,
            "friction@x.v": np.hypot(2.0, 3.0) if linearised else 2.0,
        }
    )
    assert found["cubic@x.s"].value == -5.0


@pytest.mark.parametrize(
    ("linear", "linearised", "std"), [(False, True, 1.5), (False, False, 0.0), (True, True, 0.0)]
)
def test_rivals_are_no_better_known_than_what_is_claimed(linear: bool, linearised: bool, std: float) -> None:
    found: Any = SimpleNamespace(observations=SimpleNamespace(linearised=linearised))
    effect = SimpleNamespace(effect=SimpleNamespace(linear=linear))
    judged: Any = SimpleNamespace(
        hypothesis=SimpleNamespace(placed=effect),
        named=SimpleNamespace(sizes={"stiffness": EffectSize(5.0, 0.0, "N/m")}),
    )
    assert diagnosis._stated(found, judged) == {"stiffness": EffectSize(5.0, std, "N/m")}


def test_sizes_have_the_spread_of_all_that_makes_them_up() -> None:
    """A rig's parameter is a logarithm, with its only part; a size has a slope of its own."""
    unknowns = Unknowns.plain(("stiffness", "part", "a@x.s", "mass"), 1.0)
    covariance = np.array(
        [[0.04, -0.01, 0.0, 0.0], [-0.01, 0.02, 0.0, 0.0], [0.0, 0.0, 0.09, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    x = np.array([0.1, 0.2, 0.5, 0.0])

    def of_sums(sums: list[dict[str, float]]) -> tuple[np.ndarray]:
        rows = np.array([[one.get(n, 0.0) for n in unknowns.names] for one in sums])
        return (rows @ covariance @ rows.T,)

    class Size:
        parameter = SimpleNamespace(unit="N/m")

        def slope(self, at: float) -> float:
            return -20.0 * at

        def learned(self, posterior: object, unknown: int) -> bool:
            return unknown != 2

    problem: Any = SimpleNamespace(
        sizes={"a@x.s": Size()},
        sole_parts={"stiffness": ("part", 2.0)},
        parameter_values=lambda x: {"stiffness": 1e4, "a@x.s": -7.0, "fixed": 3.0, "mass": -2.0},
    )
    posterior: Any = SimpleNamespace(x=x, unknowns=unknowns, of_sums=of_sums)
    found = parameter_sizes(problem, posterior)
    assert list(found) == ["stiffness", "a@x.s", "mass"]
    assert found["stiffness"] == EffectSize(1e4, pytest.approx(1e4 * np.sqrt(0.04 + 4 * 0.02 - 4 * 0.01)), "")
    assert found["a@x.s"] == EffectSize(-7.0, pytest.approx(0.3 * 10.0), "N/m", learned=False)
    assert found["mass"].std == 2.0


def test_scatters_are_told_by_name_and_are_nought_where_the_data_have_none() -> None:
    scatters = {"frequency_scatter": 1e-3, "shape_scatter": 0.02, "part_scatter": 0.03}
    fit: Any = SimpleNamespace(posterior=SimpleNamespace(scatters=scatters))
    assert noise(fit) == (1e-3, 0.0, 0.02)
    scatters["damping_scatter"] = 0.1
    assert noise(fit) == (1e-3, 0.1, 0.02)
    data: Any = SimpleNamespace(
        scatters={"part_scatter": Scatter("part_scatter", "of parts", 0.02, 1.0, 0.05, 9.0)}
    )
    assert learned_scatters(data, fit) == (LearnedScatter("part_scatter", "of parts", 0.02, 0.03),)


def test_a_rung_of_the_true_model_has_its_fits_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    data = ModeObservations(chain(), [prepare(chain_modes(1, EXACT)["all"])])
    fit = fit_base(data, Model())
    monkeypatch.setattr(rungs, "held_out", lambda observations, fit: HeldOut(1.25, -3.0))
    scatters = {n: 2 * s.default for n, s in data.scatters.items()}
    found = rung_at(data, fit, scatters)
    at = rungs.at_scatters(data, fit, scatters)
    assert found.log_evidence == pytest.approx(at.log_evidence)
    assert found.chi2 == pytest.approx(float(np.sum(at.posterior.residuals.values**2)))
    assert (found.error, found.heldout_error) == (pytest.approx(at.posterior.error), 1.25)
    assert (found.effects, found.unexplained) == ((), 0)
    assert found.unknowns["stiffness"] == pytest.approx(at.unknowns["stiffness"])
    assert found.parameters["stiffness"].value == pytest.approx(4e5, rel=0.01)
    averaged = rungs.averaged(data, at).posterior
    std = averaged.std[averaged.unknowns.index["stiffness"]]
    assert found.parameters["stiffness"].std == pytest.approx(
        std * found.parameters["stiffness"].value, rel=0.2
    )


def test_a_ladder_holds_nothing_out_that_has_no_partner_without_its_effects(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in the diagnosis: no fit to the rest could tell of a mode that an effect adds."""

    def fit(residuals: str) -> Any:
        return SimpleNamespace(posterior=SimpleNamespace(residuals=residuals, scatters={"of": residuals}))

    data: Any = SimpleNamespace(holding_out_explained=lambda found: f"without what is alone in {found}")
    monkeypatch.setattr(
        rungs, "rung_at", lambda data, fit, scatters: (data, fit.posterior.residuals, scatters)
    )
    monkeypatch.setattr(rungs, "with_gains", tuple)
    asked, scatters = "without what is alone in base", {"of": "last"}
    told: Any = rungs.rungs_of(data, [fit("base"), fit("last")])
    assert told == ((asked, "base", scatters), (asked, "last", scatters))


def test_a_ladder_is_measured_at_given_scatters_as_far_as_they_are_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fit(name: str, scatters: dict[str, float]) -> Any:
        return SimpleNamespace(name=name, posterior=SimpleNamespace(scatters=scatters))

    one = Scatter("frequency_scatter", "of f", 0.1, 1.0, 0.1, 9.0)
    data: Any = SimpleNamespace(scatters={one.name: one})
    monkeypatch.setattr(rungs, "at_scatters", lambda data, one, scatters: fit(f"{one.name} again", scatters))
    monkeypatch.setattr(
        rungs, "rungs_of", lambda data, fits: tuple((f.name, f.posterior.scatters) for f in fits)
    )
    fits = [
        fit("base", {"frequency_scatter": 1.0}),
        fit("one", {"frequency_scatter": 4.0}),
        fit("last", {"frequency_scatter": 2.0, "shape_scatter": 3.0}),
    ]
    told: Any = ladder_of(data, fits)
    assert told.rungs[2] == ("last", {"frequency_scatter": 2.0, "shape_scatter": 3.0})
    assert (told.frequency_noise, told.damping_noise, told.shape_noise, told.note) == (2.0, 0.0, 3.0, "")
    assert [s.learned for s in told.scatters] == [2.0]
    told = ladder_of(data, fits, {"frequency_scatter": 5.0, "other": 7.0})
    assert [name for name, _ in told.rungs] == ["base", "one", "last again"]
    assert told.rungs[2][1] == {"frequency_scatter": 5.0, "shape_scatter": 3.0}
    assert told.frequency_noise == 5.0


class Problem:
    """Of `_best_of`: one unknown that is known and two sizes, of which one starts at nought."""

    def __init__(self, *begun: np.ndarray) -> None:
        self.unknowns = Unknowns.plain(("known", "a@x.s", "a@x.t"), 1.0, "", -0.5, 0.7)
        self.sizes, self._begun = dict.fromkeys(self.unknowns.names[1:]), begun

    def start(self) -> np.ndarray:
        return np.array([0.0, 0.6, 0.0])

    def begun(self, x: np.ndarray, scatters: object) -> list[np.ndarray]:
        assert x.tolist()[1:] == [0.6, 0.0]
        return list(self._begun)


def test_a_further_effect_begins_at_several_sizes_and_the_best_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before: Any = SimpleNamespace(
        posterior=SimpleNamespace(
            unknowns=Unknowns.plain(("known",), 1.0),
            x=np.array([0.25]),
            scatters={"s": 1.0},
            residuals=SimpleNamespace(unexplained=0),
        )
    )
    model: Any = SimpleNamespace(problem=lambda data: Problem())
    tried: list[list[float]] = []

    def anneal(problem: object, scatters: object, x: np.ndarray, schedule: object) -> Any:
        tried.append(x.tolist())
        return SimpleNamespace(log_evidence=(5.0, 9.0, 7.0, 6.0)[(len(tried) - 1) % 4], x=x)

    monkeypatch.setattr(rungs, "anneal", anneal)
    best = _best_of(NO_DATA, model, before)
    np.testing.assert_allclose(tried, [[0.25, 0.6, 0.3], [0.25, 0.18, 0.09], [0.25, -0.3, -0.15]])
    assert best.log_evidence == 9.0
    led: Any = SimpleNamespace(problem=lambda data: Problem(np.array([1.0, 2.0, 3.0])))
    monkeypatch.setattr(
        rungs,
        "best_refined",
        lambda data, model, starts, scatters: (model, [x.tolist() for x in starts], scatters),
    )
    assert _best_of(NO_DATA, led, before) == (led, [[1.0, 2.0, 3.0]], {"s": 1.0})  # type: ignore[comparison-overlap]
    assert len(tried) == 3
    tried.clear()
    before.posterior.residuals.unexplained = (
        1  # a lost mode: once with a free parameter that is far off where it was
    )
    before.posterior.x[:] = 0.6
    _best_of(NO_DATA, model, before)
    np.testing.assert_allclose(tried[-1], [0.0, 0.6, 0.3])
    assert len(tried) == 4


def test_every_rung_begins_at_the_one_before_and_the_last_is_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rungs, "fit_base", lambda data, model, start: f"{model} from {start}")
    monkeypatch.setattr(rungs, "_best_of", lambda data, model, before: f"{model} on ({before})")
    monkeypatch.setattr(rungs, "learned", lambda data, fit: f"{fit}, learned")
    models: Any = ["base", "one", "two"]
    given: Any = "known"
    told: list[Fit] = fits_of(NO_DATA, models, given)
    assert told == [
        "base from known",
        "one on (base from known)",
        "two on (one on (base from known)), learned",
    ]
    assert fits_of(NO_DATA, models[:1]) == ["base from None, learned"]
