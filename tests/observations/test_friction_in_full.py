"""Friction whose hits are marched: the size that equivalent linearisation finds too small."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from simulate_amplitude import RIG, observed, simulated_hits

from ema_pipeline.effects.library import parse_effect, shipped_effects
from ema_pipeline.mechanics.laws import DryFriction
from ema_pipeline.observations import in_full
from ema_pipeline.observations.amplitude import AmplitudeObservations
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    best_refined,
    fit_base,
    learned,
    model_with,
    transferred,
    wide,
)
from ema_pipeline.observations.hit_residuals import AMPLITUDE, HitResiduals

LABEL = "dry_friction@hub"
FORCE = f"{LABEL}.force"


@cache
def linearised(force: float) -> tuple[AmplitudeObservations, Fit]:
    """Hits with friction at the hub, and the fit by equivalent linearisation."""
    hits = simulated_hits([DryFriction(f"f{a}", {f"hub.{a}": 1.0}, force) for a in "xy"])
    observations = observed(hits)
    base = fit_base(observations, Model())
    observations = observations.about((), base.posterior)
    base = learned(observations, base)
    model = model_with([LABEL], RIG, shipped_effects(), with_hits=True)
    problem = model.problem(observations)
    start = transferred(base.posterior, problem.unknowns, problem.start())
    return observations, learned(
        observations, best_refined(observations, model, problem.begun(start, wide(observations)))
    )


def size(fit: Fit, observations: AmplitudeObservations) -> tuple[float, float]:
    """Force of the friction and its 1 σ, N."""
    posterior = fit.posterior
    i, told = posterior.unknowns.index[FORCE], fit.model.problem(observations).sizes[FORCE]
    x = float(posterior.x[i])
    return told.value(x), float(posterior.std[i]) * told.slope(x)


def calculated_in_full(observations: AmplitudeObservations, fit: Fit) -> AmplitudeObservations:
    both = observations.in_full(fit.model.effects, fit.posterior)
    assert both is not None
    return both[0]


@pytest.mark.slow
@pytest.mark.parametrize("force", [0.02, 0.1])
def test_friction_calculated_in_full_has_its_true_size(force: float) -> None:
    observations, fit = linearised(force)
    value, std = size(fit, observations)
    assert value < 0.75 * force
    assert value + 3 * std < force
    full = calculated_in_full(observations, fit)
    data, again = in_full.fit_in_full(observations, fit)
    assert data is not observations
    value, std = size(again, full)
    assert abs(value - force) < 1.5 * std
    assert 0.2 * force < std < 0.5 * force
    assert again.log_evidence > fit.log_evidence + 3
    _, shared = in_full.fit_in_full(observations, fit, processes=2)
    assert np.array_equal(shared.posterior.x, again.posterior.x)


@pytest.mark.slow
def test_friction_that_was_not_found_to_first_order_is_found_in_full() -> None:
    observations, fit = linearised(0.1)
    base = learned(observations, fit_base(observations, Model()))
    labels = ["cubic_spring@hub.x", "dry_friction@rim", LABEL]
    asked = [(parse_effect(label, RIG, library=shipped_effects()), {}) for label in labels]
    found = in_full.friction_in_full(observations, base, asked)
    assert found is not None
    full, label, posterior = found
    assert label == LABEL
    assert set(full.rubbing) == {LABEL}
    value, std = size(Fit(fit.model, posterior), full)
    assert abs(value - 0.1) < 2 * std
    # nothing that is asked about is friction; or what there is was calculated in full already
    assert in_full.friction_in_full(observations, base, asked[:1]) is None
    assert in_full.friction_in_full(full, base, asked[-1:]) is None


@pytest.mark.slow
def test_only_friction_is_calculated_in_full_and_once() -> None:
    observations, fit = linearised(0.1)
    cubic = parse_effect("cubic_spring@hub.x", RIG, library=shipped_effects())
    assert observations.in_full([cubic], fit.posterior) is None
    both = observations.in_full([*fit.model.effects, cubic], fit.posterior)
    assert both is not None
    full, plain = both
    assert full.cut_off
    assert plain.cut_off
    assert not plain.rubbing
    assert set(full.rubbing) == {LABEL}
    assert full.rubbing[LABEL] == {"hub friction 0", "hub friction 1"}
    assert full.in_full(fit.model.effects, fit.posterior) is None
    for kept, out in full.folds():
        assert kept.rubbing == out.rubbing == full.rubbing
        assert kept.cut_off
        assert out.cut_off
    without = AmplitudeObservations(observations.modes, [replace(h, pulses=None) for h in observations.hits])
    assert without.in_full(fit.model.effects, fit.posterior) is None
    long = [replace(h, line_hz=h.line_hz / 300) for h in observations.hits]  # records of some minutes
    endless = AmplitudeObservations(observations.modes, long)
    assert endless.in_full(fit.model.effects, fit.posterior) is None


def test_linearised_friction_is_found_once_for_all_that_is_fitted_beside_it() -> None:
    observations, fit = linearised(0.1)
    (data,), lattice = observations.hits, observations.lattice
    assert lattice is not None
    problem, sizes = fit.model.problem(observations), fit.posterior.x
    changes = lattice.changes(data, problem, sizes)
    known = len(lattice._nodes)
    x = transferred(lattice._found, problem.unknowns)
    (group,) = problem.lattice_groups
    at = list(group)
    x[at] = sizes[at]
    x[problem.unknowns.index[AMPLITUDE]] = sizes[problem.unknowns.index[AMPLITUDE]]
    paired = problem.modes.paired(data.reference, x[: len(problem.modes.unknowns)], None)
    assert paired is not None
    here = HitResiduals(problem, data, paired, x, fit.posterior.scatters, 1.0)
    exact = here.calculated(x, lambda element: True)
    assert np.max(np.abs(changes - exact)) < 3e-3 * np.max(np.abs(exact)) > 0
    cubic = parse_effect("cubic_spring@hub.x", RIG, library=shipped_effects())
    more = fit.model.plus(cubic, {}).problem(observations)
    np.testing.assert_array_equal(
        lattice.changes(data, more, transferred(fit.posterior, more.unknowns)), changes
    )
    assert len(lattice._nodes) == known


def test_larger_motions_are_as_smaller_forces_and_rates() -> None:
    observations, fit = linearised(0.1)
    full = calculated_in_full(observations, fit)
    assert full.lattice is not None
    problem, x = fit.model.problem(full), fit.posterior.x.copy()
    index = problem.unknowns.index
    names, at = full.lattice._place(problem, x, problem.lattice_groups[0])
    assert names == [FORCE, f"{LABEL}.velocity"]
    x[index["amplitude of all modes"]] += 0.3
    further = full.lattice._place(problem, x, problem.lattice_groups[0])[1]
    x[index[FORCE]] *= np.exp(0.3)
    rate = problem.sizes[f"{LABEL}.velocity"]
    x[index[f"{LABEL}.velocity"]] = rate.unknown(rate.value(x[index[f"{LABEL}.velocity"]]) * np.exp(0.3))
    assert np.all(further < at)
    np.testing.assert_allclose(full.lattice._place(problem, x, problem.lattice_groups[0])[1], at)


def test_a_calculation_in_full_that_explains_the_data_far_worse_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observations, fit = linearised(0.1)
    data, better = in_full.fit_in_full(observations, fit)
    assert data is not observations
    assert better.log_evidence > fit.log_evidence

    def behind(by: float) -> None:
        """Friction in full gains that much less than to first order, on rows that are known alike."""
        for name in ("refined", "best_refined"):
            monkeypatch.setattr(in_full, name, lambda data, *asked: Fitted(-by if data.rubbing else 0.0))

    behind(9.9)
    assert in_full.fit_in_full(observations, fit)[1].log_evidence == -9.9
    behind(10.1)
    assert in_full.fit_in_full(observations, fit) == (observations, fit)


@dataclass(frozen=True)
class Fitted:
    """Stands for a fit, and for its posterior."""

    log_evidence: float

    @property
    def posterior(self) -> Fitted:
        """Itself."""
        return self
