"""Records of two bodies under a force, against the equations of motion solved by matrix functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from imperfect_modes import chain
from numpy.typing import NDArray
from two_bodies import (
    BEGIN,
    CHANNELS,
    DAMPING,
    FORCE_STD,
    LIBRARY,
    MASS,
    PERIOD,
    RATE,
    STIFFNESS,
    decaying,
    steady,
    truth,
)

from ema_pipeline.diagnose.records import record_model
from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly, Spring
from ema_pipeline.mechanics.laws import Maxwell
from ema_pipeline.observations import record_motion
from ema_pipeline.observations.parts import DAMPING as RATIO
from ema_pipeline.observations.record_data import DISCREPANCY, SHARE
from ema_pipeline.observations.record_model import loosened
from ema_pipeline.observations.record_problem import RecordProblem
from ema_pipeline.observations.records import RecordObservations, _zero_std
from ema_pipeline.rigs.types import Rig

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def both(rig: Rig) -> RecordObservations:
    return RecordObservations(rig, rig.configurations[0], [steady(), decaying(BEGIN)])


def scattered(observations: RecordObservations, seed: int = 0) -> dict[str, float]:
    random = np.random.default_rng(seed)
    return {n: s.default * float(np.exp(random.standard_normal())) for n, s in observations.scatters.items()}


def test_the_true_model_leaves_nothing_and_channels_read_what_their_unknowns_say(
    both: RecordObservations,
) -> None:
    problem = both.problem((), {})
    x, scatters = truth(problem), {n: s.default for n, s in both.scatters.items()}
    found = problem.residuals(x, scatters)
    assert len(found.values) == 2 * (2 * 31 + 1) + 2 * (2 * 49 + 1)  # the decay without its transient
    assert np.max(np.abs(found.values)) < 0.01
    wrong = problem.residuals(problem.start(), scatters)
    assert np.max(np.abs(wrong.values)) > 10.0
    # A wrong calibration, and a sensor that reads something at rest, of both records
    gain, zero, force = 1.1, 0.5, 0.9
    data = []
    for d in both.data:
        read = d.record.responses.copy()
        read[0] += DISCREPANCY * both.rms[0] * zero
        read[1] *= gain
        data.append(replace(d.record, responses=read, force=d.record.force * force))
    told = both.with_records(data, ()).problem((), {})
    index = told.unknowns.index
    x[index["zero of xa"]] = zero
    x[index["calibration of ab"]] = np.log(gain)
    x[index["calibration of f"]] = np.log(force)
    assert np.max(np.abs(told.residuals(x, scatters, derivatives=False).values)) < 0.01


def test_priors_of_the_channels_are_their_calibration_and_offsets_are_zero_by_it(
    both: RecordObservations,
) -> None:
    unknowns = both.problem((), {}).unknowns
    std = dict(zip(unknowns.names, unknowns.std, strict=True))
    assert std["calibration of f"] == FORCE_STD
    assert [std["calibration of xa"], std["calibration of ab"]] == [0.03, 0.05]
    assert std["offset of f"] == 0.3
    assert [n for n in unknowns.names if "at sample" in n] == [
        f"state {k} at sample 0 of decaying" for k in (1, 2, 3, 4)
    ]


def test_an_offset_of_the_force_moves_the_mean_by_the_flexibility(both: RecordObservations) -> None:
    whole = both.with_records([steady()], ())
    problem = whole.problem((), {})
    x = problem.start()
    (still,) = problem.motions(x) or ()
    x[problem.unknowns.index["offset of f"]] = 2.0
    (moved,) = problem.motions(x) or ()
    expected = -2.0 * whole.basis.force_rms[0] * np.linalg.inv(STIFFNESS)[0, 0]
    np.testing.assert_allclose((moved.read - still.read)[0, :, 0], expected, rtol=1e-6)
    assert whole.basis.force_rms[0] == pytest.approx(np.std(np.r_[steady().force[0], np.zeros(120)]))


def _branch(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Maxwell("branch", {place: 1.0}, values["stiffness"], values["time"]))


OWN = replace(LIBRARY["relaxation"], id="branch", find_places=lambda assembly: assembly.dofs, edit=_branch)
"""A user's own effect, which remembers a stretch, as hysteresis remembers a force."""


@pytest.mark.parametrize(
    "labels", [(), ("cubic_spring@a.x", "hysteresis@b.x"), ("cubic_spring@b.x", "branch@a.x")]
)
@pytest.mark.parametrize("windowed", [False, True])
def test_derivatives_of_all_outputs_are_those_of_differences(
    both: RecordObservations, labels: tuple[str, ...], windowed: bool
) -> None:
    observations = both
    if windowed:
        observations = both.with_records([both.data[1].windows(64, 10**4)], ())
    problem = record_model(observations, {**LIBRARY, OWN.id: OWN}, labels).problem(observations)
    assert isinstance(problem, RecordProblem)
    x = problem.start() + 0.2 * np.random.default_rng(1).standard_normal(len(problem.unknowns))
    x, scatters = problem.unknowns.clipped(x), scattered(observations)
    found = problem.residuals(x, scatters)
    for i, name in enumerate(problem.unknowns.names):
        ends = []
        for h in (-1e-5, 1e-5):
            moved = x.copy()
            moved[i] += h
            ends.append(problem.residuals(moved, scatters, derivatives=False).values)
        slope = (ends[1] - ends[0]) / 2e-5
        close = 2e-3 * max(float(np.max(np.abs(slope))), 1e-5)
        np.testing.assert_allclose(found.jacobian[:, i], slope, atol=close, err_msg=name)


def test_an_effect_of_no_size_at_all_has_a_slope(both: RecordObservations) -> None:
    problem = record_model(both, LIBRARY, ["cubic_spring@a.x"]).problem(both)
    assert isinstance(problem, RecordProblem)
    x, scatters = truth(problem, ", cubic_spring@a.x"), {n: s.default for n, s in both.scatters.items()}
    i = problem.unknowns.index["cubic_spring@a.x.stiffness"]
    x[i] = 0.0
    assert problem.model.driven(x).kinds.shape == (1,)
    ends = []
    for h in (-1e-3, 1e-3):
        moved = x.copy()
        moved[i] = h
        ends.append(problem.residuals(moved, scatters, derivatives=False).values)
    slope = (ends[1] - ends[0]) / 2e-3
    assert np.max(np.abs(slope)) > 1.0
    found = problem.residuals(x, scatters).jacobian[:, i]
    np.testing.assert_allclose(found, slope, atol=1e-3 * np.max(np.abs(slope)))


def test_the_accelerometer_of_the_driven_body_reads_the_force_as_well(rig: Rig) -> None:
    one = steady()
    time, read = np.arange(PERIOD) / RATE, np.zeros(PERIOD)
    for line in (3, 5, 7):
        s = 2j * np.pi * line * RATE / PERIOD
        x = np.linalg.solve(s**2 * MASS + s * DAMPING + STIFFNESS, [30.0, 0.0])
        read += (s**2 * x[0] * np.exp(s * time + 1j * line)).real
    channels = (replace(CHANNELS[1], name="aa", dof=Dof("a", "x")),)
    driven = replace(one, channels=channels, responses=read[None])
    (motion,) = (
        RecordObservations(rig, rig.configurations[0], [driven]).problem((), {}).motions(np.zeros(10)) or ()
    )
    np.testing.assert_allclose(motion.read[0, :PERIOD, 0], read, atol=1e-3 * np.max(np.abs(read)))


def test_friction_is_smoothed_at_the_step_of_the_simulation(
    both: RecordObservations, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, steps, smoothed = both.problem((), {}), [], record_motion.resolved
    problem.motions(problem.start())  # what is found once takes simulations of its own
    monkeypatch.setattr(
        record_motion,
        "resolved",
        lambda system, step, slopes: steps.append(step) or smoothed(system, step, slopes),
    )
    problem.motions(problem.start())
    assert both.substeps > 1
    assert steps == pytest.approx([1 / (RATE * both.substeps)] * 2)


def test_a_mean_of_a_displacement_is_arbitrary_from_a_tenth_of_its_motion() -> None:
    wave = np.tile([1.0, -1.0], 50)
    found = _zero_std(np.stack([wave + 0.09, wave - 0.11, 1e3 * (wave + 2.0), np.zeros(100)]))
    np.testing.assert_allclose(found, [1e-9, 0.11 / DISCREPANCY, 2.0 / DISCREPANCY, 1e-9])


@pytest.mark.parametrize("free", [False, True])
def test_values_that_nothing_is_stated_for_are_loose_and_parts_scatter_as_they_do(free: bool) -> None:
    """A chain of five masses and six springs, each kind of one family."""
    _, shared, loose = loosened(chain(free=free), "all")
    std = dict(zip(shared.unknowns.names, shared.unknowns.std, strict=True))
    assert shared.families == ("mass", "stiffness")
    assert loose == (("stiffness",) if free else ())
    assert (std["mass"], std["stiffness"]) == (0.01, 0.35 if free else 0.03)
    assert (std["mass 2 (mass)"], std["spring 3 (spring)"]) == (0.005, 0.02)
    assert len(std) == 2 + 5 + 6
    row = shared.elements["all"][Spring, "spring 3"]
    names = [n for n, v in zip(shared.unknowns.names, row, strict=True) if v]
    assert names == ["stiffness", "spring 3 (spring)"]
    alone = loosened(chain(masses=1), "all")[1].unknowns.names
    assert "mass 1 (mass)" not in alone  # the only mass deviates from no other
    assert "spring 1 (spring)" in alone


def test_a_damping_ratio_without_dampers_is_known_only_roughly() -> None:
    given = chain()
    loose = loosened(given, "all")[0].parameters[RATIO]
    assert (loose.value, loose.tolerance, loose.free) == (0.01, 0.35, False)
    none = replace(given, parameters={**given.parameters, RATIO: replace(given.parameters[RATIO], value=0.0)})
    assert loosened(none, "all")[0].parameters[RATIO].value == 0.01


def test_dampers_leave_the_stated_damping_ratio_as_it_is(rig: Rig) -> None:
    assert loosened(rig, rig.configurations[0])[0] is rig


def test_variance_of_a_line_is_noise_of_its_band_and_a_share_of_the_response(
    both: RecordObservations,
) -> None:
    problem = both.problem((), {})
    x, scatters = problem.start(), scattered(both)
    found = problem.residuals(x, scatters)
    level = {n: s.default for n, s in both.scatters.items()}
    assert problem.residuals(x, level).log_scale == pytest.approx(0.0, abs=1e-3)
    (one, two), rms = both.data, both.rms
    np.testing.assert_allclose(rms, np.sqrt((one.rms**2 + two.rms**2) / 2))
    lines = problem._predicted(x, False)
    assert lines is not None
    sigma, relative = [], []
    for d in both.data:
        for o, dof in enumerate(("a.x", "b.x")):
            noise = np.array([scatters[f"noise of {dof} in band {b + 1}"] for b in d.band])
            unit, share = DISCREPANCY * rms[o], DISCREPANCY * d.level[o]
            sigma.append(np.hypot(noise * unit, scatters[SHARE] * share))
            relative.append(sigma[-1] / np.hypot(unit, 0.3 * share))
    gap = np.concatenate([(d.measured - mine).ravel() for d, (mine, _) in zip(both.data, lines, strict=True)])
    np.testing.assert_allclose(found.values, gap / np.concatenate(sigma), rtol=1e-6)
    np.testing.assert_allclose(found.relative, np.concatenate(relative), rtol=1e-6)
    assert found.log_scale == pytest.approx(np.sum(np.log(np.concatenate(relative))))
    np.testing.assert_allclose(problem.residuals(x, scatters, heat=3.0).values, found.values / 3.0)
    big = np.abs(found.values) > 1e-6
    for name, step in ((SHARE, 1e-4), ("noise of b.x in band 3", 1e-4), ("noise of a.x in band 1", 1e-4)):
        wider = problem.residuals(x, scatters | {name: scatters[name] * np.exp(step)}, derivatives=False)
        falls = -np.log(wider.values[big] / found.values[big]) / step
        np.testing.assert_allclose(found.share[name][big], falls, atol=1e-3, err_msg=name)


def test_noise_over_periods_counts_beside_what_is_learned(rig: Rig) -> None:
    one = steady()
    noise = (
        0.2
        * np.std(one.responses, axis=1)[:, None]
        * np.random.default_rng(2).standard_normal((2, 6 * PERIOD))
    )
    six = replace(one, force=np.tile(one.force, 6), responses=np.tile(one.responses, 6) + noise)
    observations = RecordObservations(rig, rig.configurations[0], [six])
    problem = observations.problem((), {})
    tiny = dict.fromkeys(observations.scatters, 1e-09)
    found = problem.residuals(problem.start(), tiny)
    (data,) = observations.data
    assert np.all(data.noise > 0)
    rows = found.values.reshape(2, -1)
    (lines, _), *_ = problem._predicted(problem.start(), False) or ()
    sigma = np.stack([data.noise[o][data.band] for o in range(2)])
    np.testing.assert_allclose(rows, ((data.measured - lines)[0]) / sigma, rtol=1e-9)
    assert 0.6 < np.sqrt(np.mean(rows[:, 1:] ** 2)) < 1.4


def test_a_motion_without_bounds_is_impossible(both: RecordObservations) -> None:
    problem = record_model(both, LIBRARY, ["cubic_spring@a.x"]).problem(both)
    assert isinstance(problem, RecordProblem)
    x = problem.start({"cubic_spring@a.x.stiffness": -1e14})
    scatters = {n: s.default for n, s in both.scatters.items()}
    assert problem.motions(x) is None
    assert problem.residuals(x, scatters).cost == np.inf


def test_the_state_at_the_start_is_found_from_the_first_samples(both: RecordObservations) -> None:
    other = both.with_records(both.data, ())
    other.finds_states = True
    problem = other.problem((), {})
    x = problem.settled(problem.start())
    np.testing.assert_allclose(x, truth(problem), atol=0.01)
    scatters = {n: s.default for n, s in other.scatters.items()}
    assert np.max(np.abs(problem.residuals(problem.start(), scatters, derivatives=False).values)) < 0.05
    windows = both.with_records([both.data[1].windows(64, 10**4)], ())
    mine = windows.problem((), {})
    (motion,) = mine.motions(mine.settled(mine.start())) or ()
    np.testing.assert_allclose(
        motion.read.transpose(0, 2, 1) / both.rms[:, None],
        windows.data[0].responses / both.rms[:, None],
        atol=0.01,
    )


def test_a_response_that_shooting_does_not_find_is_that_which_it_settles_to(
    both: RecordObservations, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = both.with_records([steady()], ())
    problem = whole.problem((), {})
    x = problem.start() + 0.1
    (shot,) = problem.motions(x, derivatives=True) or ()
    monkeypatch.setattr(record_motion, "steady_response", lambda *given: None)
    (settled,) = problem.motions(x, derivatives=True) or ()
    close = 1e-4 * np.max(np.abs(shot.read), axis=(0, 1))
    assert np.all(np.abs(settled.read - shot.read[:, :PERIOD]) < close)
    assert settled.states.shape[1] == PERIOD
    size = np.max(np.abs(shot.change), axis=1, keepdims=True)
    assert np.all(np.abs(settled.change - shot.change[:, :PERIOD]) < 1e-3 * size + close[:, None])


def test_what_a_linear_model_does_tells_what_to_expect(both: RecordObservations) -> None:
    squares = scipy.linalg.eigh(STIFFNESS, MASS, eigvals_only=True)
    assert both.lowest_hz == pytest.approx(np.sqrt(squares[0]) / (2 * np.pi))
    inverse = np.linalg.inv(MASS)
    first_order = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ STIFFNESS, -inverse @ DAMPING]])
    decay = np.min(np.abs(np.linalg.eigvals(first_order).real))
    assert both.slowest_rad_s == pytest.approx(0.5 * decay)
    states = both._linear_motion[0]
    np.testing.assert_allclose(both.begin_scale, np.std(states, axis=0))
    np.testing.assert_allclose(both.begin_scale[0], both.data[0].rms[0], rtol=1e-3)
    told = both.typical("a.x")
    x, v = both.begin_scale[0], both.begin_scale[2]
    assert told.amplitude_m == pytest.approx(np.sqrt(2) * x)
    assert told.omega == pytest.approx(v / x)
    assert told.force_n == pytest.approx(np.sqrt(2) * 2.0 * (v / x) ** 2 * x)
