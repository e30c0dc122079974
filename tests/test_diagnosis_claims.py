"""Detection limits, left-out modes, further measurements, and sets of effects."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_diagnose import CRACK, FEW, RIG, SETTINGS, TORSION, measure

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose import Diagnosis, diagnose
from ema_pipeline.diagnose.advice import next_measurement
from ema_pipeline.diagnose.fitting import Case, Fitted, fit_hypothesis, fit_null, ground
from ema_pipeline.diagnose.heldout import HeldOut, subset
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ladder import Yardstick
from ema_pipeline.diagnose.predict import predict_left_out
from ema_pipeline.diagnose.ranking import Ranking
from ema_pipeline.diagnose.separate import options
from ema_pipeline.diagnose.witness import Witness
from ema_pipeline.dof import Dof

ONE = {"shaft_torsion": FEW["shaft_torsion"]}


@cache
def healthy() -> Diagnosis:
    return diagnose(RIG, measure({}, seed=2), SETTINGS, ONE)


def limit(d: Diagnosis, label: str) -> float:
    (found,) = [x.size for x in d.detection_limits if x.label == label]
    return found


def test_an_effect_above_the_stated_limit_is_found_and_one_far_below_is_not() -> None:
    least = limit(healthy(), TORSION)
    assert 0 < least < 1e6
    strong = diagnose(RIG, measure({f"{TORSION}.stiffness": 1.5 * least}, seed=2), SETTINGS, ONE)
    assert [c.label for c in strong.candidates if c.claimed] == [TORSION]
    weak = diagnose(RIG, measure({f"{TORSION}.stiffness": 0.15 * least}, seed=2), SETTINGS, ONE)
    assert not any(c.claimed for c in weak.candidates)


def test_every_frequency_is_predicted_from_the_others_as_well_as_it_says() -> None:
    modes = healthy().heldout_modes
    measured = measure({}, seed=2)["no_ring"].frequency_hz
    np.testing.assert_allclose([m.measured_hz for m in modes], measured)
    z = np.array([m.z for m in modes])
    assert np.abs(z).max() < 4
    assert 0.3 < np.sqrt(np.mean(z**2)) < 1.6


def test_four_modes_are_left_out_one_by_one() -> None:
    m = measure({}, seed=2)["no_ring"]
    few = subset(m, np.isin(np.arange(len(m)), (3, 4, 5, 6)))
    case = Case(RIG, {"no_ring": few}, SETTINGS, ONE)
    found = predict_left_out(case, fit_null(case, Hypothesis(), SETTINGS.fit, None), SETTINGS.fit)
    assert len(found) == 4
    # a mode that was left out is known worse than one that was measured, and no worse than bearings allow
    for mode in found:
        assert mode.predicted
        assert 0 < mode.predicted_std_hz < 0.1 * mode.measured_hz


def two_fits(measured: dict[str, MeasuredModes]) -> tuple[Case, Fitted, Fitted, Fitted]:
    case = Case(RIG, measured, SETTINGS, FEW)
    null = fit_null(case, Hypothesis(), SETTINGS.fit, None)
    below = ground(case, null, SETTINGS.fit)
    a, b = (
        fit_hypothesis(case, Hypothesis((x,)), SETTINGS.fit, below) for x in (TORSION, "shaft_torsion@sun")
    )
    return case, null, a, b


def test_the_next_measurement_is_told_with_what_it_would_show() -> None:
    measured = measure({f"{TORSION}.stiffness": 3e5}, seed=7)
    m = measured["no_ring"]
    assert m.shapes is not None
    at_sun_y = np.abs(m.shapes[:, [d.point for d in m.dofs].index("sun.y")])
    hidden = int(np.argmin(at_sun_y))  # a test that strikes the sun alone does not see this mode
    struck = replace(subset(m, np.arange(len(m)) != hidden), references=(Dof("sun", "y"),))
    case, null, a, b = two_fits({"no_ring": struck})
    found = options(case, a, b, SETTINGS.fit)
    kinds = ("clamped", "known mass", "configuration with_ring", "times as hard", "hits at ")
    for kind in kinds:
        assert any(kind in o.text for o in found), kind
    ranking = Ranking(null, (a, b), {"nothing": 0.0, a.hypothesis.label: 0.5, b.hypothesis.label: 0.5})
    text = next_measurement(case, "ambiguous", ranking, [a, b], SETTINGS.fit)
    assert "would tell shaft torsion at carrier from shaft torsion at sun" in text
    assert "Hz with shaft torsion at carrier" in text
    assert "{" not in text


def test_what_lacks_for_a_diagnosis_is_named() -> None:
    m = measure({}, seed=2)["no_ring"]
    keep = [i for i, d in enumerate(m.dofs) if d.point.startswith("carrier")]
    bare = replace(
        m,
        dofs=tuple(m.dofs[i] for i in keep),
        shapes=None if m.shapes is None else m.shapes[:, keep],
        shape_std=None,
        damping_ratio=np.full(len(m), np.nan),
        frequency_std_hz=np.full(len(m), np.nan),
    )
    case = Case(RIG, {"no_ring": bare}, SETTINGS, ONE)
    text = next_measurement(case, "not_enough_data", None, [], SETTINGS.fit)  # type: ignore[arg-type]
    assert text.startswith("Put sensors on sun, planet1, planet2 (no_ring)")
    for part in (
        "state the standard deviations",
        "measure damping ratios",
        "test in configuration with_ring",
    ):
        assert part in text


def test_held_out_modes_that_stay_lost_do_not_veto_what_mends_the_others() -> None:
    stick = Yardstick(SETTINGS.fit, np.ones(3, dtype=bool), np.full(3, 40.0), 0)
    before = HeldOut(np.array([900.0, 1e4, 1e4]), {})
    after = HeldOut(np.array([2.0, 3.0, 1e6]), {})  # one mode mended twice over, the third further off
    assert stick.heldout_score(after) == pytest.approx(45.0)
    assert stick.heldout_score(before) == pytest.approx(120.0)


def test_two_effects_are_claimed_with_their_sizes_in_the_claimed_set() -> None:
    effects = {f"{CRACK}.fraction": 0.3, f"{TORSION}.stiffness": 3e5}
    d = diagnose(RIG, measure(effects, seed=5), SETTINGS, FEW)
    sizes = {c.label: next(iter(c.parameters.values())) for c in d.candidates if c.claimed}
    assert set(sizes) == {CRACK, TORSION}
    for label, true in ((CRACK, 0.3), (TORSION, 3e5)):
        assert abs(sizes[label].value - true) < 4 * sizes[label].std
        assert sizes[label].value == pytest.approx(true, rel=0.15)
    errors = [r.error for r in d.ladder.rungs]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1.3
    assert all(c.probability > 0.9 for c in d.candidates if c.claimed)


def test_without_frfs_the_witness_says_nothing() -> None:
    case = Case(RIG, measure({}, seed=2), SETTINGS, ONE)
    null = fit_null(case, Hypothesis(), SETTINGS.fit, None)
    assert np.isnan(Witness(case).error(null).error)
    assert not Witness(case).prefers(null, null)
