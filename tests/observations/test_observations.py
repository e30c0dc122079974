"""Measured modes as observations: what depends on what, derivatives, assignment, and data that lack something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from frequencies import from_frequencies
from imperfect_modes import EXACT, GOOD, Hidden, chain, chain_modes, planetary_modes

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.hypotheses import list_hypotheses
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import effect_library, parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality, InTurn, StruckPoint
from ema_pipeline.inference import Scatter, Unknowns, descend
from ema_pipeline.mechanics.assembly import Assembly, Damper, Gyroscopic, Mass, Spring
from ema_pipeline.mechanics.modes import complex_modes
from ema_pipeline.modal.assurance import mac
from ema_pipeline.observations import fitting
from ema_pipeline.observations.fitting import Fit, Model, fit_base, learned, model_with, wide
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.mode_problem import MIXING, ModeProblem
from ema_pipeline.observations.mode_rows import SHAPE, SHAPE_NOISE
from ema_pipeline.observations.modes import ModeObservations, scatters_of
from ema_pipeline.observations.parts import (
    DIRECTION_SCATTER,
    JOINT_DAMPING,
    MASS_SCATTER,
    MASS_STD,
    PART_SCATTER,
    STIFFNESS_STD,
    dependence,
    part_key,
    value_of,
)
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.observations.without_partner import (
    UNEXPLAINED,
    UNEXPLAINED_DOUBLE,
    UNEXPLAINED_PRODUCT,
    UNEXPLAINED_SENSOR,
    UNSEEN,
    Alone,
    unseen,
)
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.rigs.types import Parameter, Rig

SHIPPED = ("planetary", "gearbox", "frame")


def observed(rig: Rig, measured: dict[str, MeasuredModes]) -> ModeObservations:
    return ModeObservations(rig, [prepare(m) for m in measured.values()])


def chain_observations(seed: int = 0, lab=GOOD) -> ModeObservations:
    return observed(chain(), chain_modes(seed, lab))


def test_a_mode_with_a_mix_of_close_shapes_is_a_double_and_one_with_a_shape_of_its_own_is_not() -> None:
    random = np.random.default_rng(0)
    shapes = random.standard_normal((5, 8))
    shapes[2] = 0.6 * shapes[0] - 0.8 * shapes[1] + 0.05 * random.standard_normal(8)
    shapes[4] = shapes[3]  # far away, a shape may come again
    frequency = np.array([100.0, 100.3, 100.01, 150.0, 170.0])
    measured = MeasuredModes(
        "test", frequency, 1e-4 * frequency, np.full(5, 0.005), np.full(5, 1e-4), shapes.astype(complex),
        np.full((5, 8), 1e-2), tuple(Dof.parse(f"m{k}.x") for k in range(8)), band_hz=(50.0, 200.0),
    )  # fmt: skip
    assert prepare(measured).double.tolist() == [
        True,
        True,
        True,
        False,
        False,
    ]  # any two of the three make the other
    farther = replace(measured, frequency_hz=np.array([100.0, 100.3, 100.9, 150.0, 170.0]))
    assert prepare(farther).double.tolist() == [True, True, True, False, False]
    apart = replace(measured, frequency_hz=np.array([100.0, 100.3, 102.7, 150.0, 170.0]))
    assert not np.any(prepare(apart).double)
    few = replace(
        measured, shapes=measured.shapes[:, :3], shape_std=np.full((5, 3), 1e-2), dofs=measured.dofs[:3]
    )
    assert not np.any(prepare(few).double)  # three sensors cannot tell three shapes apart


def test_a_mode_that_may_share_the_frequency_of_one_known_better_needs_the_shape_of_a_partner() -> None:
    measured = chain_modes(6, EXACT)["all"]
    f, shapes = measured.frequency_hz, measured.shapes
    assert shapes is not None
    assert measured.shape_std is not None
    assert measured.damping_ratio is not None
    third = shapes[2].real
    other = np.array([0.5, 1.0, -0.5, 0.5, 1.0])
    other -= third * (other @ third) / (third @ third)
    odd = third / np.linalg.norm(third) + other / np.linalg.norm(other)  # half of the third mode's
    assert mac(odd, third)[0, 0] == pytest.approx(0.5)

    def with_one(apart: float, std: float, shape: np.ndarray) -> MeasuredModes:
        """One mode more, beside the third."""
        return replace(
            measured,
            frequency_hz=np.append(f, f[2] + apart),
            frequency_std_hz=np.append(measured.frequency_std_hz, std),
            damping_ratio=np.append(measured.damping_ratio, measured.damping_ratio[2]),
            damping_std=np.append(measured.damping_std, measured.damping_std[2]),
            shapes=np.vstack([shapes, shape]),
            shape_std=np.vstack([measured.shape_std, np.full(5, 0.05)]),
        )

    width = float(measured.damping_ratio[2] * f[2])
    own = float(measured.frequency_std_hz[2])
    assert prepare(with_one(0.3 * width, 0.4 * width, odd)).double.tolist() == [False] * 5 + [True]
    assert not np.any(prepare(with_one(0.3 * width, 0.2 * width, odd)).double)  # told apart
    assert not np.any(prepare(with_one(0.9 * own, 1.9 * own, odd)).double)  # known as well as the other
    two = with_one(0.3 * width, 0.4 * width, odd)
    two = replace(two, dofs=two.dofs[:2], shapes=two.shapes[:, :2], shape_std=two.shape_std[:, :2])  # type: ignore[index]
    assert prepare(two).double.tolist() == [False] * 5 + [True]  # whose mix it is they cannot tell
    one = replace(two, dofs=two.dofs[:1], shapes=two.shapes[:, :1], shape_std=two.shape_std[:, :1])  # type: ignore[index]
    assert not np.any(prepare(one).double)  # nor one sensor what is alike
    orthogonal = with_one(0.3 * width, 0.4 * width, other)  # as modes at one frequency are
    assert not np.any(prepare(orthogonal).double)
    problem = observed(chain(), {"all": with_one(0.3 * width, 0.4 * width, odd)}).problem((), {})
    scatters = {n: s.default for n, s in problem.observations.scatters.items()}
    found = problem.residuals(np.zeros(len(problem.unknowns)), scatters)
    assert [r.measured for r in problem.rows(found)] == [0, 1, 2, 3, 4]
    assert (found.penalty, found.unexplained) == (UNEXPLAINED_DOUBLE, 0)


def test_a_mode_that_no_sensor_reads_need_not_be_measured() -> None:
    """Half of the modes of bodies in a plane go along x; with sensors along y alone they are not missed."""
    data: Any = SimpleNamespace(complete=True, band_hz=(10.0, 1000.0))
    hz, read = (
        np.array([50.0, 51.0, 120.0, 125.0]),
        np.array([[0.0, 1.0, 1e-9, 0.7], [0.0, 1e-3, 2e-9, 0.002]]),
    )
    paired = np.array([1])
    assert unseen(data, hz, paired, read) == UNSEEN
    assert unseen(data, hz, paired, np.zeros((0, 4))) == 3 * UNSEEN  # without shapes all are
    weak = read + np.array([[0.02], [0.0]])  # a sensor reads something of all
    assert unseen(data, hz, paired, weak) == 3 * UNSEEN


def test_a_size_gives_a_mode_without_a_partner_one_of_its_frequency_and_shape() -> None:
    rig = chain()
    placed = parse_effect("spring@m3.z", rig)
    name = placed.parameter_name("stiffness")
    hidden = Hidden(added=(Spring("hidden", {"m3.z": 1.0}, 7e5),))
    measured = chain_modes(6, EXACT, hidden)["all"]
    observations = observed(rig, {"all": measured})
    problem = observations.problem((placed,), {})
    x = problem.start({name: 0.0})
    match = problem.residuals(x, {n: s.default for n, s in observations.scatters.items()}).matching
    assert isinstance(match, tuple)
    assert np.any(match[0] < 0)
    sizes = [problem.sizes[name].value(u) for u in problem.tuned(x, name)]
    assert any(size == pytest.approx(7e5, rel=1e-3) for size in sizes)
    assert len(sizes) <= 2 * int(np.sum(match[0] < 0))
    assert observed(rig, chain_modes(6, EXACT)).problem((placed,), {}).tuned(x, name) == []


def test_such_a_size_is_found_beside_an_effect_that_adds_coordinates() -> None:
    rig = planetary()
    support, torsion = (
        parse_effect(label, rig) for label in ("flexible_support@carrier", "shaft_torsion@sun")
    )
    name = torsion.parameter_name("stiffness")
    hidden = Hidden(added=(Spring("hidden", {"sun.u": 1.0}, 3e5),))
    measured = planetary_modes(rig, 3, EXACT, hidden, ("no_ring",))
    problem = observed(rig, measured).problem((support, torsion), {})
    sizes = [problem.sizes[name].value(u) for u in problem.tuned(problem.start({name: 0.0}), name)]
    assert any(size == pytest.approx(3e5, rel=0.05) for size in sizes)


def test_what_modes_are_to_each_other_stays_when_one_of_them_is_held_out() -> None:
    f = np.array([100.0, 100.5, 140.0])
    shapes = np.array([[1.0, 0, 0.5, 0.2], [1.0, 0.05, 0.5, 0.2], [0, 1.0, -0.5, 0.4]], complex)
    measured = MeasuredModes(
        "all", f, 1e-3 * f, np.full(3, 0.01), np.full(3, 1e-4), shapes, np.full((3, 4), 1e-3),
        tuple(Dof.parse(f"m{k}.x") for k in range(4)), band_hz=(10.0, 200.0),
    )  # fmt: skip
    data = prepare(measured)
    assert data.double.tolist() == [True, True, False]
    assert data.may_hide_another.tolist() == [True, True, True]
    kept = data.only(np.array([True, False, True]))
    assert kept.double.tolist() == [True, False]
    assert kept.close.tolist() == [True, False]
    assert kept.compared_std[0, 0] > 0.09  # its neighbour still mixes into it
    assert kept.may_hide_another.tolist() == [False, True]  # what is near it has been measured
    twice = kept.only(np.array([True, False]))
    assert (twice.double.tolist(), twice.may_hide_another.tolist()) == ([True], [False])
    listed = prepare(replace(measured, band_hz=None))  # does not say that there are no others
    assert not np.any(listed.may_hide_another)
    assert not np.any(listed.only(np.array([True, False, True])).may_hide_another)


def test_shapes_of_poles_that_nearly_coincide_may_hold_far_more_of_each_other() -> None:
    """Frequencies a quarter of a half-width and a whole one apart; and a quarter, but with half of the damping."""

    def share(apart: float, damping: float) -> float:
        f, zeta = np.array([100.0, 100.0 + apart]), np.array([0.01, damping])
        shapes = np.array([[1.0, 0, 0.5, 0.2], [0, 1.0, -0.5, 0.4]], complex)
        measured = MeasuredModes(
            "all", f, 1e-3 * f, zeta, np.full(2, 1e-4), shapes, np.full((2, 4), 1e-3),
            tuple(Dof.parse(f"m{k}.x") for k in range(4)),
        )  # fmt: skip
        (_, _, one), (_, _, other) = prepare(measured).mixes
        assert one == other
        return one

    assert share(0.25, 0.01) > 10 * share(1.0, 0.01)
    # unlike damping tells the poles apart, and true shapes may be mixed by it
    assert share(0.25, 0.0099) > 3 * share(0.25, 0.005)


def test_drift_of_single_parts_turns_shapes_towards_each_other_and_that_of_all_parts_does_not() -> None:
    def turns(std: list[float], hz: list[float]) -> dict[tuple[int, int], float]:
        f, shapes = np.array(hz), np.array([[1.0, 0, 0.5], [0, 1.0, -0.5], [0.7, -0.7, 1.0]], complex)
        measured = MeasuredModes(
            "all", f, np.array(std) * f, np.full(3, 1e-3), np.full(3, 1e-5), shapes, np.full((3, 3), 1e-3),
            tuple(Dof.parse(f"m{k}.x") for k in range(3)),
        )  # fmt: skip
        return {(a, b): share for a, b, share in prepare(measured).turns}

    assert turns([1e-3] * 3, [100.0, 101.0, 150.0]) == {}
    # 0.06 % besides the 0.08 % that all may share, between modes 1 % and 5 % apart: 0.06 and 0.012
    found = turns([8e-4, 1e-3, 8e-4], [100.0, 100.0 * np.exp(0.01), 100.0 * np.exp(0.06)])
    assert set(found) == {(0, 1), (1, 0), (1, 2), (2, 1)}
    assert found[0, 1] == found[1, 0] == pytest.approx(0.06, rel=0.01)
    assert found[1, 2] == pytest.approx(0.012, rel=0.01)


def test_shapes_that_hold_some_of_each_other_are_told_from_a_model_that_is_wrong() -> None:
    """A share of 8 % that identification mixed in is found, and no part bends to it."""
    rig = planetary()
    modes = planetary_modes(rig, 3, GOOD)
    name = next(iter(modes))
    clean = modes[name]
    hz = clean.frequency_hz
    a = int(np.argmin(np.where(np.diff(hz) > 1e-4 * hz[1:], np.diff(hz), np.inf)))
    shapes = clean.shapes.copy()
    shapes[a] = shapes[a] + 0.08 * shapes[a + 1] * np.abs(shapes[a]).max() / np.abs(shapes[a + 1]).max()
    observations = observed(rig, modes | {name: replace(clean, shapes=shapes)})
    data = observations.data[0]
    assert (a, a + 1) in [(i, j) for i, j, _ in data.mixes]
    found = learned(observations, fit_base(observations, Model()))
    unknowns = found.posterior.unknowns
    begins = f"shape of {hz[a]:.7g} Hz along that of {hz[a + 1]:.7g}"
    at = next(i for i, n in enumerate(unknowns.names) if n.startswith(begins))
    std = float(np.sqrt(found.posterior.covariance[at, at]))
    assert std < 0.017
    assert abs(found.posterior.x[at]) == pytest.approx(0.08, abs=3 * std)
    pure = observed(rig, modes)
    alone = learned(pure, fit_base(pure, Model()))
    assert found.posterior.error == pytest.approx(alone.posterior.error, rel=0.15)


def test_what_modes_without_a_partner_cost_is_told_from_pairs_alone() -> None:
    """At points up to several prior 1 σ away, where modes lose their partners, annealed and not."""
    rig, rng = planetary(), np.random.default_rng(2)
    observations = observed(rig, planetary_modes(rig, 3, GOOD, Hidden({"sun-planet1 mesh": 0.4})))
    problem, scatters = Model().problem(observations), wide(observations)
    std = problem.unknowns.prior_std(scatters)
    costs = set()
    for far in (0.0, 1.0, 5.0, 15.0, 15.0):
        x = problem.unknowns.clipped(far * std * rng.standard_normal(len(std)))
        for heat in (1.0, 30.0):
            told = problem.unpaired(x, scatters, heat)
            assert told == problem.residuals(x, scatters, heat=heat, derivatives=False).penalty
            costs.add(told)
    assert len(costs) > 2


# --- families and parts -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_every_element_follows_its_families_as_the_rig_builds_it(name: str) -> None:
    rig = load_rig(name)
    known = dependence(rig)
    rng = np.random.default_rng(0)
    logs = {f: 0.2 * rng.normal() for f in known.families}
    x = np.array([logs.get(n, 0.0) for n in known.unknowns.names])
    values = {f: rig.parameters[f].value * float(np.exp(v)) for f, v in logs.items()}
    for configuration in rig.configurations:
        before, after = rig.assembly(configuration), rig.assembly(configuration, values)
        for a, b in zip(before.elements, after.elements, strict=True):
            row = known.elements[configuration].get(part_key(a), np.zeros(len(x)))
            assert value_of(a) * np.exp(row @ x) == pytest.approx(value_of(b), rel=1e-9), a.name


@pytest.mark.parametrize("name", SHIPPED)
def test_every_part_of_a_rig_has_a_deviation_of_its_own(name: str) -> None:
    rig = load_rig(name)
    known = dependence(rig)
    governed = known.unknowns.governed(PART_SCATTER) | known.unknowns.governed(MASS_SCATTER)
    for configuration in rig.configurations:
        for element in rig.assembly(configuration).elements:
            if isinstance(element, Mass | Spring | Damper) and value_of(element) > 0:
                row = known.elements[configuration][part_key(element)]
                assert np.sum(row[governed] == 1.0) == 1, element.name


def test_parameters_stay_within_their_bounds() -> None:
    rig = planetary()
    name = next(iter(dependence(rig).families))
    for least, most in ((0.5, 4.0), (0.0, np.inf)):
        value = rig.parameters[name].value
        stated = replace(rig.parameters[name], minimum=least * value, maximum=most * value)
        bounded = ParametricRig(
            rig.name, rig.configurations, {**rig.parameters, name: stated}, lambda c, v: rig.assembly(c, v)
        )
        unknowns = dependence(bounded).unknowns
        i = unknowns.index[name]
        assert np.exp(unknowns.lower[i]) == pytest.approx(least)
        assert np.exp(unknowns.upper[i]) == pytest.approx(most)


def test_one_body_has_one_mass_whichever_way_it_moves() -> None:
    known = dependence(planetary())
    names = [n for n in known.unknowns.names if n.startswith("planet1 mass")]
    assert len(names) == 1
    assert (Mass, "planet1 mass") in known.elements["no_ring"]


def test_meshes_share_a_family_and_deviate_each_for_itself() -> None:
    known = dependence(planetary(3))
    rows = [known.elements["with_ring"][Spring, f"sun-planet{i} mesh"] for i in (1, 2, 3)]
    family = known.unknowns.index["sun_planet_mesh_stiffness"]
    assert [r[family] for r in rows] == [1.0, 1.0, 1.0]
    own = [set(np.flatnonzero(r)) - {family} for r in rows]
    assert len(set.union(*own)) == 3


def test_parts_scatter_by_the_default_and_by_what_is_stated() -> None:
    stated = {"carrier_mass": Parameter("carrier_mass", 1.0, "kg", 0.01, scatter=0.1),
              "sun_bearing_stiffness": Parameter("sun_bearing_stiffness", 1e6, "N/m", 0.1, scatter=0.0)}  # fmt: skip
    known = dependence(planetary(2, stated))
    scatters = {PART_SCATTER: 0.02, MASS_SCATTER: 0.005, DIRECTION_SCATTER: 0.01}
    std = dict(zip(known.unknowns.names, known.unknowns.prior_std(scatters), strict=True))
    assert std["carrier mass (mass)"] == pytest.approx(0.1)
    assert std["sun mass (mass)"] == pytest.approx(MASS_STD)
    assert std["sun-planet1 mesh (spring)"] == pytest.approx(STIFFNESS_STD)
    assert not any(n.startswith("sun bearing") for n in known.unknowns.names)


def test_directions_of_a_bearing_deviate_with_it_and_a_little_more() -> None:
    known = dependence(planetary(2))
    names, rows = known.unknowns.names, known.elements["no_ring"]
    scatters = {PART_SCATTER: 0.02, MASS_SCATTER: 0.005, DIRECTION_SCATTER: 0.01}
    std = dict(zip(names, known.unknowns.prior_std(scatters), strict=True))
    for piece, directions in (("planet2 bearing", ("radial", "tangential")), ("sun bearing", ("x", "y"))):
        assert std[f"{piece} (spring)"] == pytest.approx(0.02)
        for direction in directions:
            assert std[f"{piece} {direction} (spring)"] == pytest.approx(0.01)
            row = dict(zip(names, rows[Spring, f"{piece} {direction}"], strict=True))
            of = {n for n, x in row.items() if x and "(" in n}
            assert of == {f"{piece} (spring)", f"{piece} {direction} (spring)"}
    assert DIRECTION_SCATTER in scatters_of(planetary(2))
    assert DIRECTION_SCATTER not in scatters_of(chain())  # learned where there are bearings only


def test_a_pressure_angle_that_is_uncertain_is_no_factor_on_elements() -> None:
    angle = {"pressure_angle_deg": Parameter("pressure_angle_deg", 20.0, "deg", 0.05)}
    known = dependence(planetary(2, angle))
    assert known.geometric == ("pressure_angle_deg",)
    assert "pressure_angle_deg" not in known.families


def test_a_parameter_that_two_powers_follow_is_one_family() -> None:
    # a beam's stiffness grows with the cube of its thickness, its mass with the thickness
    def build(configuration, values):
        t = values["thickness"]
        row = {"tip.z": 1.0}
        return Assembly(("tip.z",), (Mass("tip", row, 2.0 * t), Spring("beam", row, 1e5 * t**3)))

    rig = ParametricRig("beam", ("all",), {"thickness": Parameter("thickness", 1.0, "mm", 0.05)}, build)
    known = dependence(rig)
    i = known.unknowns.index["thickness"]
    assert known.elements["all"][Spring, "beam"][i] == pytest.approx(3.0)
    assert known.elements["all"][Mass, "tip"][i] == pytest.approx(1.0)


def test_what_is_known_for_sure_is_no_family_and_dampers_scatter_more_than_springs() -> None:
    """Nor is the damping ratio of all modes, nor what is nought; what turns elements of another kind builds anew."""
    stated = {
        "k": Parameter("k", 1e5, "N/m", 0.05),
        "sure": Parameter("sure", 2.0, "kg", 0.0),
        "none": Parameter("none", 0.0, "N·s/m", 0.1),
        "spin": Parameter("spin", 3.0, "rad/s", 0.1),
        "modal_damping_ratio": Parameter("modal_damping_ratio", 0.01, "1", 0.3),
    }

    def build(configuration, values):
        a, b = {"a.x": 1.0}, {"b.x": 1.0}
        factor = 1.0 + (values["modal_damping_ratio"] if values["none"] == 0.0 else 0.0)
        elements = (
            Mass("a", a, values["sure"]), Mass("b", b, 1.0 * factor), Spring("k", a, values["k"]),
            Spring("l", b, 1e4), Damper("c", a, 5.0), Gyroscopic("g", a, b, values["spin"]),
        )  # fmt: skip
        return Assembly(("a.x", "b.x"), elements)

    known = dependence(ParametricRig("two", ("all",), stated, build))
    assert known.families == ("k",)
    assert known.geometric == ("spin",)
    assert value_of(Gyroscopic("g", {}, {}, 3.0)) == 0.0
    std = dict(
        zip(
            known.unknowns.names,
            known.unknowns.prior_std({PART_SCATTER: 0.02, MASS_SCATTER: 0.005}),
            strict=True,
        )
    )
    assert std["c (damper)"] == pytest.approx(0.3)
    assert std["l (spring)"] == pytest.approx(0.02)
    assert (Gyroscopic, "g") not in known.elements["all"]


def test_a_fit_begins_a_decade_to_either_side_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the first two families that are loose; not of parts, nor of sizes."""
    names = ("close", "part", "one", "a@x.s", "two", "three")
    std = np.array([0.39, 1.0, 0.4, 1.0, 2.0, 2.0])
    many = np.full(6, np.inf)
    unknowns = Unknowns(names, std, ("", "part_scatter", "", "", "", ""), -many, many)
    problem = SimpleNamespace(unknowns=unknowns, sizes={"a@x.s": None}, start=lambda: np.full(6, 0.1))
    model = SimpleNamespace(problem=lambda data: problem)
    monkeypatch.setattr(fitting, "annealed", lambda data, model, starts, schedule: starts)
    monkeypatch.setattr(fitting, "freed", lambda data, starts: starts)
    starts = np.array(fitting.fit_base(None, model)) - 0.1  # type: ignore[arg-type]
    assert starts.shape == (9, 6)
    np.testing.assert_allclose(starts[:, [0, 1, 3, 5]], 0.0)
    steps = (0.0, 1.2, -1.2)
    np.testing.assert_allclose(starts[:, [2, 4]], [(a, b) for a in steps for b in steps], atol=1e-12)
    before = SimpleNamespace(
        posterior=SimpleNamespace(unknowns=Unknowns.plain(("two",), 1.0), x=np.array([0.7]))
    )
    (only,) = fitting.fit_base(None, model, before)  # type: ignore[arg-type]
    np.testing.assert_allclose(only, [0.1, 0.1, 0.1, 0.1, 0.7, 0.1])


def test_a_fit_is_led_past_barriers_as_long_as_it_gains_more_than_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the best way each time, four times at the most."""

    def stuck(cost: float) -> SimpleNamespace:
        return SimpleNamespace(cost=cost, x=cost, scatters={}, residuals=None)

    asked = []

    def past(costs: dict[float, list[float]], start: float) -> float:
        problem = SimpleNamespace(escapes=lambda x, scatters, residuals: asked.append(x) or costs.get(x, []))
        fit = Fit(SimpleNamespace(problem=lambda data: problem), stuck(start))  # type: ignore[arg-type]
        monkeypatch.setattr(fitting, "descend", lambda problem, scatters, to: stuck(to))
        return fitting.freed(None, fit).posterior.cost  # type: ignore[arg-type]

    assert past({10.0: [9.1, 12.0]}, 10.0) == 10.0
    assert past({10.0: [8.9, 8.0, 8.5], 8.0: [7.5, 9.0]}, 10.0) == 8.0
    asked.clear()
    assert past({float(k): [k - 2.0] for k in range(2, 21)}, 20.0) == 12.0
    assert asked == [20.0, 18.0, 16.0, 14.0]
    assert past({np.inf: [0.0]}, np.inf) == np.inf


def test_the_two_best_starts_that_did_not_meet_are_annealed_to_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They have met within a twentieth of the prior 1 σ in every unknown."""
    unknowns = Unknowns.plain(("a", "b"), np.array([1.0, 10.0]))
    model = SimpleNamespace(problem=lambda data: SimpleNamespace(unknowns=unknowns))
    data = SimpleNamespace(scatters={})
    asked: list[tuple[tuple[float, ...], object]] = []

    def anneal(problem: object, scatters: object, x: tuple[float, ...], schedule: object) -> SimpleNamespace:
        asked.append((tuple(x), schedule))
        cost = 10.0 * x[0] + x[1]
        return SimpleNamespace(x=np.array(x), cost=cost, log_evidence=cost, prior_std=unknowns.std)

    monkeypatch.setattr(fitting, "anneal", anneal)
    starts = [(0.9, 0.0), (0.2, 0.0), (0.25, 0.0), (0.24, 0.4), (0.2, 0.6), (0.3, 0.0)]
    schedule = ((30.0, 5), (1.0, 8))
    best = fitting.annealed(data, model, starts, schedule)  # type: ignore[arg-type]
    assert [x for x, s in asked if s == schedule[:1]] == starts
    assert [x for x, s in asked if s == schedule[1:]] == [(0.2, 0.0), (0.2, 0.6)]
    assert best.posterior.x.tolist() == [0.2, 0.6]  # the one of more evidence in the end


def test_a_parameter_is_made_up_of_its_family_and_its_only_part() -> None:
    problem = SimpleNamespace(sole_parts={"k": ("k (spring)", 0.5)})
    assert fitting.made_up_of(problem, "k") == {"k": 1.0, "k (spring)": 0.5}  # type: ignore[arg-type]
    assert fitting.made_up_of(problem, "m") == {"m": 1.0}  # type: ignore[arg-type]


def test_sizes_of_an_added_effect_are_those_of_the_diagnosis_that_found_it() -> None:
    """Another scale would read the same unknown as another size, and no mass may take more than there is."""
    rig, library = planetary(), effect_library()
    labels = ("mass@sun", "spring@carrier", "damper@carrier-sun")
    model = model_with(labels, rig, library)
    listed = {n.label: n for h in list_hypotheses(rig, library) for n in h.names}
    for placed in model.effects:
        name = listed[placed.label]
        assert placed.effect.parameters == name.placed.effect.parameters
        for short, scale in name.scales.items():
            assert model.scales[placed.parameter_name(short)] == scale
    (sun, *_) = model.effects
    assert sun.effect.parameters[0].minimum == pytest.approx(-rig.parameters["sun_mass"].value)


def test_effects_that_depend_on_the_level_are_added_where_hits_show_them() -> None:
    rig, library = planetary(), effect_library()
    labels = ["mass@sun", "bearing_cubic@sun"]
    assert model_with(labels, rig, library).labels == ("mass@sun",)
    both = model_with(labels, rig, library, with_hits=True)
    assert both.labels == tuple(labels)
    (placed, *_) = both.effects
    scales = placed.effect.scales(rig.assembly("no_ring"), "sun")
    assert {n.rpartition(".")[2]: v for n, v in both.scales.items() if n.startswith("mass@sun")} == scales


def test_scatters_are_learned_from_what_is_stated_where_none_was_learned_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = {"a": Scatter("a", "", 0.1, 1.0, 0.5, 9.0), "b": Scatter("b", "", 0.2, 1.0, 0.6, 9.0)}
    begun = []
    monkeypatch.setattr(
        fitting, "descend", lambda problem, scatters, x, steps: begun.append(scatters) or "begun"
    )
    monkeypatch.setattr(fitting, "learn", lambda problem, start, scatters: (start, scatters))
    monkeypatch.setattr(fitting, "freed", lambda data, fit: fit)
    fit = Fit(
        SimpleNamespace(problem=lambda data: None), SimpleNamespace(scatters={"a": 0.5, "b": 0.7}, x=None)
    )  # type: ignore[arg-type]
    told = fitting.learned(SimpleNamespace(scatters=known), fit)  # type: ignore[arg-type]
    assert begun == [{"a": 0.1, "b": 0.7}]
    assert told.posterior == ("begun", known)


# --- sizes of effects -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "label", ["mesh_stiffness_loss@sun-planet1", "shaft_torsion@sun", "flexible_support@sun", "mass@sun"]
)
def test_sizes_stay_within_their_range_and_their_slopes_are_those_of_differences(label: str) -> None:
    effect = parse_effect(label, planetary()).effect
    for p in effect.parameters:
        size = SizeMap.of(p, p.scale)
        assert size.value(size.unknown(p.start)) == pytest.approx(p.start)
        for x in (-50.0, 50.0):
            assert p.minimum <= size.value(x) <= p.maximum
        at = size.unknown(p.start)
        assert size.slope(at) == pytest.approx(
            (size.value(at + 1e-6) - size.value(at - 1e-6)) / 2e-6, rel=1e-4
        )


def test_an_effect_of_no_size_leaves_the_system_as_it_is() -> None:
    rig = planetary()
    effect = parse_effect("mesh_stiffness_loss@sun-planet1", rig)
    with_it = RigModel(rig, [effect])
    x = np.zeros(len(with_it.unknowns))
    got, expected = with_it.system("with_ring", x), rig.system("with_ring")
    np.testing.assert_allclose(got.stiffness, expected.stiffness, atol=1e-6)
    np.testing.assert_allclose(got.mass, expected.mass)
    assert with_it.size_values(x) == {"mesh_stiffness_loss@sun-planet1.fraction": 0.0}


# --- residuals --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "labels", [(), ("spring@m2.z",), ("mass@m4.z", "damper@m1-m3"), ("damper@m2.z",), ("damper@m1-m4",)]
)
def test_derivatives_of_the_residuals_are_those_of_differences(labels: tuple[str, ...]) -> None:
    observations = chain_observations(1)
    problem = observations.problem([parse_effect(x, observations.rig) for x in labels], {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    strong = {n: 300.0 for n in problem.sizes if "damper" in n}
    x = problem.start(strong) + 0.02 * np.random.default_rng(1).normal(size=len(problem.unknowns))
    here = problem.residuals(x, scatters)
    for i, name in enumerate(problem.unknowns.names):
        h = np.zeros(len(x))
        h[i] = 1e-6
        low, high = (problem.residuals(x + s * h, scatters, matching=here.matching) for s in (-1, 1))
        change = (high.stated - low.stated) / 2e-6
        # Where damping hardly turns a shape, that it does is left out of the derivatives.
        close = max(0.05, 3e-3 * np.max(np.abs(change))) if any("damper" in x for x in labels) else 2e-3
        slope = here.jacobian[:, i]
        np.testing.assert_allclose(slope, change, atol=close, err_msg=name)
        values, jacobian = here.weighted
        gradient = float(jacobian[:, i] @ values)
        fall = (high.cost - low.cost) / 2e-6
        assert gradient == pytest.approx(fall, rel=1e-3, abs=20 * close), name


def test_derivatives_of_the_residuals_hold_for_two_configurations_with_transverse_sensors() -> None:
    rig = planetary()
    observations = observed(rig, planetary_modes(rig, 2, GOOD))
    problem = observations.problem([parse_effect("mesh_stiffness_loss@ring-planet2", rig)], {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    x = problem.start() + 0.02 * np.random.default_rng(2).normal(size=len(problem.unknowns))
    here = problem.residuals(x, scatters)
    slopes = here.jacobian
    scale = np.abs(slopes).max()
    for i, name in enumerate(problem.unknowns.names):
        h = np.zeros(len(x))
        h[i] = 1e-6
        low, high = (problem.residuals(x + s * h, scatters, matching=here.matching).stated for s in (-1, 1))
        np.testing.assert_allclose(slopes[:, i], (high - low) / 2e-6, atol=1e-4 * scale, err_msg=name)


def test_a_sensor_reads_across_what_others_of_its_body_measure_and_one_that_turns_reads_both() -> None:
    """Anew in every configuration, for which sensors are mounted anew."""
    rig = planetary()
    told, across = "transverse sensitivity at sun.", ["u along x", "u along y", "x along y", "y along x"]
    modes = planetary_modes(rig, 2, GOOD)
    for measured, places in (
        ({"with_ring": modes["with_ring"]}, [""]),
        (modes, [", no_ring", ", with_ring"]),
    ):
        names = observed(rig, measured).problem((), {}).unknowns.names
        found = sorted(n.removeprefix(told) for n in names if n.startswith(told))
        assert found == [direction + place for direction in across for place in places]


def test_a_point_that_was_struck_is_read_as_its_blows_were_aimed() -> None:
    """Derivatives included; a sensor that stays where it is has no aim. Blows are aimed anew in every configuration."""
    rig = planetary()
    struck, moved, still = StruckPoint("hammer", 0.02, 0.03), InTurn("a", 0.02, 0.03), ChannelQuality("b")
    channels = {"sun.x": struck, "sun.y": moved, "carrier.x": still}
    measured = observed(rig, planetary_modes(rig, 2, GOOD))
    problem = ModeObservations(rig, measured.data, channels).problem((), {})
    std = dict(zip(problem.unknowns.names, problem.unknowns.std, strict=True))
    assert {n: s for n, s in std.items() if n.startswith("aim")} == {
        f"aim at sun.{d}, {c}": pytest.approx(0.0141, rel=0.01)
        for d in "xy"
        for c in ("no_ring", "with_ring")
    }
    across = [std[f"transverse sensitivity at sun.{d}, no_ring"] for d in ("x along y", "y along x")]
    assert across == pytest.approx([np.hypot(0.03, 0.1), 0.03])
    scatters = {n: s.default for n, s in measured.scatters.items()}
    x, i = problem.start(), problem.unknowns.index["aim at sun.x, no_ring"]
    here = problem.residuals(x, scatters)
    x[i] = 1e-4
    there = problem.residuals(x, scatters, matching=here.matching)
    np.testing.assert_allclose(there.stated - here.stated, 1e-4 * here.jacobian[:, i], rtol=0.01, atol=1e-5)
    assert np.max(np.abs(here.jacobian[:, i])) > 1


def test_a_rig_that_is_as_drawn_has_residuals_of_nothing_but_noise() -> None:
    observations = chain_observations(3, EXACT)
    problem = observations.problem((), {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    found = problem.residuals(np.zeros(len(problem.unknowns)), scatters)
    assert np.max(np.abs(found.values)) < 0.1
    assert found.penalty == 0.0
    assert found.projected == 5 + np.sum(
        observations.data[0].lagging
    )  # factors, and phases of imaginary parts


def test_shapes_are_compared_up_to_a_factor_and_a_phase() -> None:
    observations = chain_observations(4)
    measured = chain_modes(4, GOOD)["all"]
    assert measured.shapes is not None
    turned = replace(measured, shapes=measured.shapes * np.array([2.0, -1.0, 3j, 0.1, 1 + 1j])[:, None])
    assert measured.shape_std is not None
    turned = replace(turned, shape_std=measured.shape_std * np.array([2, 1, 3, 0.1, np.sqrt(2)])[:, None])
    scatters = {n: s.default for n, s in observations.scatters.items()}
    values = [
        np.abs(o.problem((), {}).residuals(np.zeros(len(o.problem((), {}).unknowns)), scatters).values)
        for o in (observations, observed(chain(), {"all": turned}))
    ]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-6, atol=1e-9)


def test_a_reversed_sensor_reads_what_it_should() -> None:
    measured = chain_modes(5, GOOD)["all"]
    assert measured.shapes is not None
    sign = np.array([1, 1, -1, 1, 1])
    dofs = tuple(replace(d, sign=int(s)) for d, s in zip(measured.dofs, sign, strict=True))
    reversed_one = replace(measured, dofs=dofs, shapes=measured.shapes * sign)
    fits = [fit_base(observed(chain(), {"all": m}), Model()) for m in (measured, reversed_one)]
    assert fits[0].posterior.error == pytest.approx(fits[1].posterior.error, rel=1e-6)


def test_a_shape_is_left_with_the_least_of_all_factors() -> None:
    """σ of an entry: the test's own, and a share of the entry, of 0.3 at the least."""
    observations = chain_observations(8)
    (data,) = observations.data
    problem = observations.problem((), {})
    scatters = {n: s.default for n, s in observations.scatters.items()} | {"shape_scatter": 0.2}
    x = np.zeros(len(problem.unknowns))
    found = problem.residuals(x, scatters)
    shapes = RigModel(chain()).sensor_rows("all", data.dofs) @ problem.solution("all", x).shapes
    for row in problem.rows(found):
        y, p = data.known_shapes[row.measured], shapes[:, row.model]
        own = np.hypot(data.compared_std[row.measured], data.broad_std[row.measured])
        sigma = np.hypot(own, 0.2 * np.maximum(0.3, np.abs(y)))
        factor, (left, *_) = np.linalg.lstsq((p / sigma)[:, None], y / sigma, rcond=None)[:2]
        assert np.sum(((y - factor[0] * p) / sigma) ** 2) == pytest.approx(left)
        assert np.sum(row.shape**2) == pytest.approx(left, rel=1e-6), row.measured


def test_a_mode_that_the_model_lacks_and_one_that_was_not_measured_cost_what_they_cost() -> None:
    measured = chain_modes(6, EXACT)["all"]
    scatters = {n: s.default for n, s in chain_observations(6).scatters.items()}
    keep = np.array([0, 1, 3, 4])
    missed = replace(
        measured,
        frequency_hz=measured.frequency_hz[keep],
        frequency_std_hz=measured.frequency_std_hz[keep],
        damping_ratio=measured.damping_ratio[keep],
        damping_std=measured.damping_std[keep],
        shapes=measured.shapes[keep],  # type: ignore[index]
        shape_std=measured.shape_std[keep],  # type: ignore[index]
    )
    problem = observed(chain(), {"all": missed}).problem((), {})
    assert problem.residuals(np.zeros(len(problem.unknowns)), scatters).penalty == UNSEEN

    def more(a: np.ndarray, value: np.ndarray | float) -> np.ndarray:
        return np.concatenate([a, np.atleast_2d(value) if a.ndim > 1 else np.atleast_1d(value)])

    odd = np.array([1.0, -1.0, -0.2, 1.0, 0.5])
    twice = replace(
        measured,
        frequency_hz=more(measured.frequency_hz, 2.5 * measured.frequency_hz[-1]),
        frequency_std_hz=more(measured.frequency_std_hz, 0.1),
        damping_ratio=more(measured.damping_ratio, 0.01),
        damping_std=more(measured.damping_std, 0.001),
        shapes=more(measured.shapes, odd),  # type: ignore[arg-type]
        shape_std=more(measured.shape_std, np.full(5, 0.01)),  # type: ignore[arg-type]
        band_hz=(10.0, 2000.0),
    )
    problem = observed(chain(), {"all": twice}).problem((), {})
    found = problem.residuals(np.zeros(len(problem.unknowns)), scatters)
    # five sensors read it
    assert (found.penalty, found.unexplained, found.split) == (UNEXPLAINED + 3 * UNEXPLAINED_SENSOR, 1, 0.0)
    assert [r.measured for r in problem.rows(found)] == [0, 1, 2, 3, 4]
    marked = [replace(d, product=np.arange(len(d)) == 5) for d in problem.observations.data]
    of_levels = problem.observations.with_data(marked).problem((), {})
    found = of_levels.residuals(np.zeros(len(of_levels.unknowns)), scatters)
    assert (found.penalty, found.unexplained, found.split) == (UNEXPLAINED_PRODUCT, 0, UNEXPLAINED_PRODUCT)
    assert list(marked[0].only(np.arange(6) > 3).product) == [False, True]
    assert twice.shapes is not None
    split = replace(
        twice,
        frequency_hz=more(measured.frequency_hz, 1.0001 * measured.frequency_hz[-1]),
        shapes=np.vstack([twice.shapes[:-1], twice.shapes[-2:-1]]),
    )
    problem = observed(chain(), {"all": split}).problem((), {})
    for narrow in (1.0, 0.1):
        found = problem.residuals(
            np.zeros(len(problem.unknowns)), scatters | {SHAPE: narrow * scatters[SHAPE]}
        )
        assert found.penalty == UNEXPLAINED_DOUBLE


def test_a_mode_without_a_partner_is_not_credited_with_how_well_the_shapes_of_others_agree() -> None:
    """Shapes that agree ten times better than usual would lower its cost by ln 10 per entry; that much is added."""
    measured = chain_modes(7, GOOD)["all"]
    observations = observed(chain(), {"all": measured})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    problem = observations.problem((), {})
    x = np.zeros(len(problem.unknowns))
    (match,) = problem.residuals(x, scatters).matching  # type: ignore[misc]
    without = match.copy()
    without[4] = -1
    narrow = scatters | {SHAPE: 0.1 * scatters[SHAPE], SHAPE_NOISE: 1e-6}
    usual, now = (problem.residuals(x, s, matching=(without,)) for s in (scatters, narrow))
    (data,) = observations.data
    own, unit, broad = data.compared_std[4], np.maximum(0.3, np.abs(data.shapes[4])), data.broad_std[4]
    widths = [np.hypot(np.hypot(s[SHAPE_NOISE] * own, s[SHAPE] * unit), broad) for s in (scatters, narrow)]
    assert now.penalty - usual.penalty == pytest.approx(float(np.sum(np.log(widths[0] / widths[1]))))
    assert now.penalty - usual.penalty > 5 * np.log(9)
    wide = scatters | {SHAPE: 3.0 * scatters[SHAPE]}
    assert problem.residuals(x, wide, matching=(without,)).penalty == usual.penalty


def test_costs_that_are_kept_are_those_of_the_modes_and_scatters_asked_for() -> None:
    (data,) = chain_observations(7).data
    defaults = {n: s.default for n, s in chain_observations(7).scatters.items()}
    some = [np.array([4]), np.array([1, 4])]
    asked = [(some[k % 2], defaults | {SHAPE: 1e-3 * (1 + k // 2)}) for k in range(100)]
    for alone, scatters in [*asked, asked[0], asked[-1]]:
        fresh = Alone.of(replace(data), alone, scatters, defaults)
        assert Alone.of(data, alone, scatters, defaults) == fresh
    assert Alone.of(data, *asked[-1], defaults) is Alone.of(data, *asked[-1], defaults)
    assert len({one.usual for one in data.costs_alone.values()}) == len(data.costs_alone) < 100


def test_modes_that_the_test_hardly_knows_stay_so_where_all_others_agree_better_than_stated() -> None:
    """Most shapes agree a hundred times better than their hits scatter; three per configuration are known to 30 %."""
    rig, rng, modes = planetary(), np.random.default_rng(3), {}
    for name, measured in planetary_modes(rig, 3, EXACT).items():
        assert measured.shapes is not None
        largest = np.max(np.abs(measured.shapes), axis=1)[:, None]
        std = np.full(measured.shapes.shape, 0.01)
        std[2:5] = 0.3
        off = rng.normal(size=std.shape) * np.where(std > 0.1, 0.3, 1e-4)
        modes[name] = replace(measured, shapes=measured.shapes + largest * off, shape_std=largest * std)
    observations = observed(rig, modes)
    found = learned(observations, fit_base(observations, Model())).posterior
    assert found.scatters[SHAPE_NOISE] == pytest.approx(0.1, rel=0.01)
    assert found.error < 1.0


def test_rows_of_the_residuals_stand_by_their_mode_and_sensor() -> None:
    measured = chain_modes(7, GOOD)["all"]
    assert measured.shapes is not None
    shapes = measured.shapes.copy()
    shapes[2, 1] = np.nan
    damping = measured.damping_ratio.copy()
    damping[3] = np.nan
    observations = observed(chain(), {"all": replace(measured, shapes=shapes, damping_ratio=damping)})
    problem = observations.problem((), {})
    scatters = {n: s.default for n, s in observations.scatters.items()}
    found = problem.residuals(np.zeros(len(problem.unknowns)), scatters)
    rows = problem.rows(found)
    assert len(rows) == 5
    assert np.isnan(rows[3].damping)
    assert not np.isnan(rows[2].damping)
    assert [bool(np.any(np.isnan(r.shape))) for r in rows] == [False, False, True, False, False]
    told = np.concatenate([[r.frequency, r.damping, *r.shape] for r in rows])
    (data,) = observations.data
    end = len(found.stated) - int(np.sum(data.seen[data.lagging]))  # then come imaginary parts
    assert end < len(found.stated)
    assert np.nansum(told**2) == pytest.approx(float(np.sum(found.stated[:end] ** 2)))


def test_folds_hold_every_mode_out_once() -> None:
    rig = planetary()
    observations = observed(rig, planetary_modes(rig, 8, GOOD))
    total = sum(len(d) for d in observations.data)
    out = [np.concatenate([d.log_frequency for d in o.data]) for _, o in observations.folds()]
    assert sorted(np.concatenate(out)) == pytest.approx(
        sorted(np.concatenate([d.log_frequency for d in observations.data]))
    )
    for kept, held in observations.folds():
        assert sum(map(len, kept.data)) + sum(map(len, held.data)) == total
        one, other = (
            [n for n, s in zip(u.names, u.scatter, strict=True) if s != MIXING]
            for u in (kept.problem((), {}).unknowns, held.problem((), {}).unknowns)
        )
        assert one == other


def test_what_has_no_partner_in_a_fit_is_not_held_out_where_that_is_asked() -> None:
    rig = planetary()
    observations = observed(rig, planetary_modes(rig, 8, GOOD))
    matching = [np.arange(len(d)) for d in observations.data]
    found: Any = SimpleNamespace(matching=tuple(matching))
    assert observations.holding_out_explained(found) is observations
    matching[0][3] = -1
    lone = observations.data[0].log_frequency[3]
    kept = observations.holding_out_explained(found)
    assert isinstance(kept, ModeObservations)
    for held, rest in ((o, k) for k, o in kept.folds()):
        assert lone not in np.concatenate([d.log_frequency for d in held.data])
        assert lone in rest.data[0].log_frequency
    total = sum(len(d) for _, o in observations.folds() for d in o.data)
    assert sum(len(d) for _, o in kept.folds() for d in o.data) == total - 1
    nothing: Any = SimpleNamespace(matching=tuple(np.full(len(d), -1) for d in observations.data))
    assert observations.holding_out_explained(nothing).folds() == []


# --- data that lack something -----------------------------------------------------------------------------


def fitted(observations: ModeObservations):
    found = learned(observations, fit_base(observations, Model()))
    assert np.all(np.isfinite(found.posterior.x))
    assert np.isfinite(found.log_evidence)
    assert np.isfinite(found.posterior.error)
    return found.posterior


def test_frequencies_alone_can_be_fitted() -> None:
    f = chain_modes(9, GOOD)["all"].frequency_hz
    found = fitted(observed(chain(), {"all": from_frequencies("all", f)}))
    assert found.error < 1.5


def test_a_single_mode_no_mode_and_equal_modes_can_be_fitted() -> None:
    one = from_frequencies("all", [18.0])
    fitted(observed(chain(), {"all": one}))
    none = observed(chain(), {"all": from_frequencies("all", [])})
    assert none.data == ()
    found = fit_base(none, Model())
    assert np.all(found.posterior.x == 0.0)
    twice = from_frequencies("all", [37.0, 37.0, 37.0])
    fitted(observed(chain(), {"all": twice}))


def test_a_sensor_that_was_dead_all_along_can_be_fitted() -> None:
    measured = chain_modes(10, GOOD)["all"]
    assert measured.shapes is not None
    for value in (np.nan, 0.0):
        shapes = measured.shapes.copy()
        shapes[:, 2] = value
        fitted(observed(chain(), {"all": replace(measured, shapes=shapes)}))


def test_modes_of_quite_another_rig_are_contradicted_and_raise_nothing() -> None:
    measured = chain_modes(11, GOOD)["all"]
    far = replace(measured, frequency_hz=measured.frequency_hz * np.array([3.0, 0.2, 1.0, 5.0, 0.7]))
    found = fitted(observed(chain(), {"all": far}))
    assert found.error > 2


def test_a_mass_that_is_taken_away_beyond_what_is_there_raises_nothing() -> None:
    observations = chain_observations(12)
    effect = parse_effect("mass@m3.z", observations.rig)
    problem = observations.problem([effect], {"mass@m3.z.mass": 1.0})
    x = problem.start()
    x[problem.unknowns.index["mass@m3.z.mass"]] = -5.0
    scatters = {n: s.start for n, s in observations.scatters.items()}
    found = descend(problem, scatters, problem.unknowns.clipped(x))
    assert np.all(np.isfinite(found.x))
    assert not np.isnan(found.log_evidence)


def test_what_was_put_in_is_found_within_its_uncertainty() -> None:
    z = []
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        factor = float(np.exp(0.8 * rng.normal()))
        rig = chain(free=True)
        hidden = Hidden({f"spring {i}": factor for i in range(6)})
        found = fitted(observed(rig, chain_modes(200 + seed, GOOD, hidden)))
        z.append((found.value("stiffness") - np.log(factor)) / found.std[found.unknowns.index["stiffness"]])
    assert np.max(np.abs(z)) < 3.5


def test_sensors_of_another_rig_are_refused_in_one_line() -> None:
    measured = chain_modes(13, GOOD)["all"]
    dofs = (*measured.dofs[:-1], Dof("m9", "z"))
    problem = observed(chain(), {"all": replace(measured, dofs=dofs)}).problem((), {})
    with pytest.raises(EmaError, match=r"m9\.z"):
        problem.residuals(np.zeros(len(problem.unknowns)), {})


def whirling(frequency: np.ndarray) -> MeasuredModes:
    """Three modes of which the second whirls."""
    shapes = np.random.default_rng(4).standard_normal((3, 8)).astype(complex)
    shapes[1, 4:] *= 1j
    return MeasuredModes(
        "test", frequency, 1e-4 * frequency, np.full(3, 0.005), np.full(3, 1e-4), shapes,
        np.full((3, 8), 1e-2), tuple(Dof.parse(f"m{k}.x") for k in range(8)), band_hz=(50.0, 200.0),
    )  # fmt: skip


def test_a_scatter_of_nothing_is_taken_for_one_that_is_not_known() -> None:
    measured = whirling(np.array([100.0, 130.0, 160.0]))
    assert measured.shape_std is not None
    none, nan = (
        prepare(replace(measured, frequency_std_hz=v * np.ones(3), damping_std=v * np.ones(3),
                        shape_std=v * measured.shape_std))
        for v in (0.0, np.nan)
    )  # fmt: skip
    for name in ("log_frequency_std", "log_damping_std", "shape_std"):
        assert np.all(getattr(none, name) > 0)
        assert np.array_equal(getattr(none, name), getattr(nan, name))


def test_a_plainly_complex_shape_is_compared_as_one_and_others_as_real_ones() -> None:
    data = prepare(whirling(np.array([100.0, 130.0, 160.0])))
    assert data.whirling.tolist() == [False, True, False]
    assert np.max(np.abs(data.complex_shapes[1].imag)) > 0.3
    assert not np.any(data.complex_shapes[[0, 2]].imag)
    assert np.all(data.compared_std[1] > 0.1)
    assert np.all(data.compared_std[[0, 2]] < 0.1)
    assert data.only(np.array([False, True, True])).whirling.tolist() == [True, False]


def chain_with_damper(coefficient: float) -> MeasuredModes:
    """Poles and shapes of the chain with a damper at its first mass, all else damped in proportion to masses."""
    system = chain().system("all")
    damping = 2 * np.pi * system.mass
    damping[0, 0] += coefficient
    exact = complex_modes(replace(system, damping=damping, modal_damping_ratio=0.0))
    shapes, f = exact.shapes.T, exact.frequency_hz
    return MeasuredModes(
        "all", f, 1e-5 * f, np.full(len(f), np.nan), np.full(len(f), np.nan), shapes,
        1e-4 * np.max(np.abs(shapes), axis=1, keepdims=True) + np.zeros(shapes.shape),
        tuple(Dof.parse(d) for d in system.dofs), band_hz=(1.0, 1.1 * float(np.max(f))),
    )  # fmt: skip


def test_imaginary_parts_of_shapes_tell_a_damper_without_damping_ratios() -> None:
    rig = chain()
    effect, label = parse_effect("damper@m1.z", rig), "damper@m1.z.coefficient"
    observations = ModeObservations(rig, [prepare(chain_with_damper(20.0))])
    (data,) = observations.data
    assert not np.any(data.whirling)
    assert np.count_nonzero(data.lagging) >= 3
    scatters = {n: s.default for n, s in observations.scatters.items()} | {"uneven_damping": 0.02}
    sizes = []
    for one in (observations, ModeObservations(rig, [data.without_lag()])):
        problem = one.problem([effect], {})
        found = descend(problem, scatters, problem.start({label: 5.0}), steps=40)
        i = problem.unknowns.index[label]
        sizes.append((problem.parameter_values(found.x)[label], float(found.std[i] / abs(found.x[i]))))
        _derivatives_are_exact(problem, found.x, scatters)
    assert sizes[0][0] == pytest.approx(20.0, rel=0.02)
    assert sizes[0][1] < 0.1 * sizes[1][1]


@pytest.mark.parametrize("kind", ["damping", "structural"])
def test_uneven_damping_of_two_equal_masses_makes_shapes_lag_as_expected(kind: str) -> None:
    """Both modes hold as much of each other as the damping of half the structure says: a relative difference of 1.

    Of the lower mode this is so for hysteretic losses, of the upper one for viscous ones; the other kind makes less.
    """
    stiffness, on_one = 1e4 * np.array([[2.0, -1.0], [-1.0, 2.0]]), np.diag([1.0, 0.0])
    losses = {"damping": np.zeros((2, 2)), "structural": np.zeros((2, 2)), kind: on_one}
    if kind == "structural":
        losses[kind] = 200.0 * on_one
    exact = complex_modes(
        replace(chain().system("all"), mass=np.eye(2), stiffness=stiffness, dofs=("m1.z", "m2.z"),
                modal_damping_ratio=0.0, **losses)
    )  # fmt: skip
    measured = MeasuredModes(
        "all", exact.frequency_hz, 1e-5 * exact.frequency_hz, exact.damping_ratio, 0.01 * exact.damping_ratio,
        exact.shapes.T, np.full((2, 2), 1e-5), (Dof.parse("m1.z"), Dof.parse("m2.z")), band_hz=(1.0, 100.0),
    )  # fmt: skip
    data = prepare(measured)
    assert data.imaginary is not None
    less = 3**-0.25  # root of the ratio of both frequencies
    part = [[less], [1.0]] if kind == "damping" else [[1.0], [less]]
    np.testing.assert_allclose(np.abs(data.imaginary), data.lag_unit * part, rtol=0.05)


def test_close_modes_and_those_of_one_sensor_are_compared_by_real_shapes_alone() -> None:
    measured = replace(chain_with_damper(20.0), damping_ratio=np.full(5, 0.01))
    assert measured.shapes is not None
    assert measured.shape_std is not None
    data, without_second = prepare(measured), np.arange(5) != 1
    assert np.all(data.lagging)
    assert np.all(data.only(without_second).lagging)
    near = np.array(measured.frequency_hz)
    near[1] = 1.04 * near[0]
    assert prepare(replace(measured, frequency_hz=near)).lagging.tolist() == [False, False, True, True, True]
    one = replace(
        measured, shapes=measured.shapes[:, :1], shape_std=measured.shape_std[:, :1], dofs=measured.dofs[:1]
    )
    assert not np.any(prepare(one).lagging)
    real = prepare(replace(measured, shapes=measured.shapes.real.astype(complex)))
    assert not np.any(real.lagging)


def test_rows_of_a_second_configuration_stand_by_its_own_modes() -> None:
    rig = planetary()
    both = observed(rig, planetary_modes(rig, 2, GOOD))
    assert all(np.any(d.lagging) for d in both.data)
    problem = both.problem((), {})
    scatters = {n: s.default for n, s in both.scatters.items()}
    of_both = problem.rows(problem.residuals(problem.start(), scatters))
    for data in both.data:
        alone = both.with_data([data]).problem((), {})
        of_one = alone.rows(alone.residuals(alone.start(), scatters))
        mine = [r for r in of_both if r.configuration == data.configuration]
        for a, b in zip(mine, of_one, strict=True):
            assert (a.measured, a.model) == (b.measured, b.model)
            np.testing.assert_allclose(a.shape, b.shape)


def test_shapes_of_broad_resonances_are_known_no_better_than_a_fit_tells_them_apart() -> None:
    """Whatever the factor on what single hits differ by is learned to be."""
    measured = chain_modes(7, GOOD)["all"]
    broad = measured.damping_ratio.copy()
    broad[2] = 0.08
    largest = []
    for ratios in (measured.damping_ratio, broad):
        observations = observed(chain(), {"all": replace(measured, damping_ratio=ratios)})
        problem = observations.problem((), {})
        scatters = {n: s.default for n, s in observations.scatters.items()} | {SHAPE: 1e-4, SHAPE_NOISE: 0.01}
        rows = problem.rows(problem.residuals(problem.start(), scatters))
        largest.append([r.shape_off for r in rows])
    assert observations.data[0].broad_std[2] == pytest.approx(0.5 * 0.08**2)
    assert largest[1][2] < 0.2 * largest[0][2]
    assert np.delete(largest[1], 2) == pytest.approx(np.delete(largest[0], 2), rel=1e-6)


def test_gyroscopic_coupling_explains_modes_that_whirl() -> None:
    """Poles and complex shapes of the true rig; the base model's shapes are real."""
    rig = planetary()
    truth = RigModel(rig, [parse_effect("gyroscopic@carrier", rig)])
    x = truth.start({"gyroscopic@carrier.coefficient": 80.0})
    exact = complex_modes(truth.system("with_ring", x))
    on = (exact.frequency_hz > 20) & (exact.frequency_hz < 400)
    dofs = tuple(Dof.parse(d) for b in ("carrier", "sun", "ring") for d in (f"{b}.x", f"{b}.y", f"{b}.u"))
    read = RigModel(rig).sensor_rows("with_ring", dofs)
    shapes = (read @ exact.shapes[: read.shape[1], on]).T
    f = exact.frequency_hz[on]
    measured = MeasuredModes(
        "with_ring", f, 1e-4 * f, exact.damping_ratio[on], np.full(len(f), 1e-4), shapes,
        1e-3 * np.abs(shapes), dofs, band_hz=(20.0, 400.0),
    )  # fmt: skip
    observations = ModeObservations(rig, [prepare(measured)])
    assert np.sum(observations.data[0].whirling) >= 2
    scatters = {n: s.default for n, s in observations.scatters.items()}
    base = observations.problem([], {})
    with_it = observations.problem([parse_effect("gyroscopic@carrier", rig)], {})
    at = with_it.start({"gyroscopic@carrier.coefficient": 80.0})
    true = with_it.residuals(at, scatters)
    assert np.max(np.abs(true.values)) < 0.05
    data = observations.data[0]
    assert true.projected == len(f) + np.sum(data.whirling | data.lagging)  # two parts of complex factors
    assert base.residuals(base.start(), scatters).cost > true.cost + 100
    _derivatives_are_exact(with_it, at, scatters)


def test_damping_ratios_that_differ_turn_the_shapes_of_coupled_modes() -> None:
    """Complex modes of the true rig, each undamped mode with a damping ratio of its own and a damper besides."""
    rig = planetary()
    effect, label = parse_effect("local_damper@planet1", rig), "local_damper@planet1.coefficient"
    truth = RigModel(rig, [effect])
    x = truth.start({label: 30.0})
    bare = truth.system("with_ring", x)
    values, phi = scipy.linalg.eigh(bare.stiffness, bare.mass)
    factor = np.exp(0.4 * np.random.default_rng(3).standard_normal(len(values)))
    modal = 2 * bare.modal_damping_ratio * factor * np.sqrt(np.maximum(values, 0.0))
    damping = bare.damping + bare.mass @ (phi * modal) @ phi.T @ bare.mass
    exact = complex_modes(replace(bare, damping=damping, modal_damping_ratio=0.0))
    on = (exact.frequency_hz > 20) & (exact.frequency_hz < 400)
    dofs = tuple(
        Dof.parse(f"{b}.{d}") for b in ("carrier", "sun", "ring", "planet1", "planet2") for d in "xyu"
    )
    read = RigModel(rig).sensor_rows("with_ring", dofs)
    shapes = (read @ exact.shapes[: read.shape[1], on]).T
    f = exact.frequency_hz[on]
    measured = MeasuredModes(
        "with_ring", f, 1e-5 * f, exact.damping_ratio[on], np.full(len(f), 1e-5), shapes,
        1e-3 * np.abs(shapes) + 1e-4 * np.max(np.abs(shapes), axis=1, keepdims=True), dofs, band_hz=(20.0, 400.0),
    )  # fmt: skip
    observations = ModeObservations(rig, [prepare(measured)])
    assert observations.suited([]) is observations
    own = observations.suited([effect])
    assert own.suited([effect]) is own
    scatters = {n: s.default for n, s in own.scatters.items()}
    # mixed shapes and, beside dampers, uneven joints would explain turned ones as well
    scatters |= {"shape_scatter": 1e-3, MIXING: 1e-6, JOINT_DAMPING: 1e-3}
    costs, sizes = [], []
    for data in (observations, own):
        problem = data.problem([effect], {})
        found = descend(problem, scatters, problem.start({label: 30.0}), steps=40)
        costs.append(found.cost)
        sizes.append(problem.parameter_values(found.x)[label])
    assert costs[1] < costs[0] - 20
    assert abs(sizes[1] - 30.0) < 0.5
    solution = problem.solution("with_ring", found.x)
    to = problem.paired(own.data[0], found.x).match
    told = [found.value(f"damping of undamped mode {k + 1} of with_ring") for k in to]
    above = np.log(np.sqrt(solution.eigenvalues[to]) / (2 * np.pi * own.middle_hz))
    common = found.value("modal_damping_ratio") + found.value("damping_power") * above
    assert np.array(told) + common == pytest.approx(np.log(factor)[to], abs=0.03)
    assert len(solution.frequency_hz) == len(factor)
    # what joints turn of close modes is followed from where they have turned them a little
    of_joints = problem.unknowns.governed(JOINT_DAMPING)
    names = [n for n, one in zip(problem.unknowns.names, of_joints, strict=True) if not one]
    _derivatives_are_exact(problem, found.x, scatters, names)


@pytest.mark.parametrize("effects", [(), ("damper@m1.z",)])
def test_damping_that_grows_with_the_frequency_is_no_scatter(effects: tuple[str, ...]) -> None:
    """As viscous joints make it. The common ratio is meant at the same frequency whatever modes are held out."""
    rig = chain()
    measured = chain_modes(4, GOOD)["all"]
    f = measured.frequency_hz
    assert measured.damping_ratio is not None
    ratio = measured.damping_ratio * f / f[2]
    observations = observed(rig, {"all": replace(measured, damping_ratio=ratio, damping_std=0.02 * ratio)})
    placed = [parse_effect(e, rig) for e in effects]
    one = observations.suited(placed)
    scatters = {n: s.default for n, s in one.scatters.items()} | {"damping_scatter": 0.2}
    assert bool(one.own_damping) == bool(effects)
    problem = one.problem(placed, {})
    start = problem.start({f"{e}.coefficient": 10.0 for e in effects})
    found = descend(problem, scatters, start, steps=40)
    assert found.value("damping_power") == pytest.approx(1.0, abs=0.3)
    start[problem.unknowns.index["damping_power"]] = 0.8
    _derivatives_are_exact(problem, start, scatters)
    assert all(kept.middle_hz == out.middle_hz == observations.middle_hz for kept, out in one.folds())
    assert (
        "damping_power"
        not in ModeObservations(rig, [prepare(replace(measured, damping_ratio=np.full(len(f), np.nan)))])
        .problem([], {})
        .unknowns.index
    )


UNEVEN = np.log([2.2, 0.7, 1.3, 0.5, 1.0, 0.8])


def uneven_chain(loss: str, coefficient: float) -> MeasuredModes:
    """Exact complex modes of the chain whose springs lose some 1 % times `UNEVEN`, by dampers or by loss factors, with
    a damper at its third mass.
    """
    rig = chain()
    system = rig.system("all")
    springs = [e for e in rig.assembly("all").elements if isinstance(e, Spring)]
    losses = {"damping": np.zeros_like(system.stiffness), "structural": np.zeros_like(system.stiffness)}
    for spring, log in zip(springs, UNEVEN, strict=True):
        row = np.array([spring.row.get(d, 0.0) for d in system.dofs])
        losses[loss] += np.exp(log) * 0.02 * spring.stiffness * np.outer(row, row)
    if loss == "damping":
        losses[loss] /= np.sqrt(scipy.linalg.eigvalsh(system.stiffness, system.mass)[2])
    losses["damping"][2, 2] += coefficient
    exact = complex_modes(replace(system, modal_damping_ratio=0.0, **losses))
    f, shapes = exact.frequency_hz, exact.shapes.T
    return MeasuredModes(
        "all", f, 1e-5 * f, exact.damping_ratio, 0.01 * exact.damping_ratio, shapes,
        1e-4 * np.max(np.abs(shapes), axis=1, keepdims=True) + np.zeros(shapes.shape),
        tuple(Dof.parse(d) for d in system.dofs), band_hz=(1.0, 1.1 * float(np.max(f))),
    )  # fmt: skip


@pytest.mark.parametrize("loss", ["damping", "structural"])
def test_what_every_joint_loses_is_told_from_phases_and_ratios(loss: str) -> None:
    """Though the model knows of one ratio only, of viscous joints and hysteretic ones; and no damper is claimed for
    them, nor one that there is missed.
    """
    rig, label = chain(), "damper@m3.coefficient"
    damper = Model((parse_effect("damper@m3", rig),))
    for coefficient in (0.0, 40.0):
        observations = ModeObservations(rig, [prepare(uneven_chain(loss, coefficient))]).suited(
            damper.effects
        )
        nothing, more = (learned(observations, fit_base(observations, m)) for m in (Model(), damper))
        gain, fit = more.log_evidence - nothing.log_evidence, more if coefficient else nothing
        assert gain > 10 if coefficient else gain < 0
        found, problem = fit.posterior, fit.model.problem(observations)
        if coefficient:
            size = problem.parameter_values(found.x)[label]
            std = size * found.std[found.unknowns.index[label]] / found.x[found.unknowns.index[label]]
            assert size == pytest.approx(coefficient, abs=2.5 * std)
            assert std < 0.2 * coefficient
        at = np.flatnonzero(found.unknowns.governed(JOINT_DAMPING))
        assert len(at) == len(UNEVEN)
        off = found.x[at] - UNEVEN
        off -= np.mean(off)  # what all have in common is the damping of the rig
        assert np.all(np.abs(off) < np.minimum(3 * found.std[at], 0.15))
        assert found.scatters[JOINT_DAMPING] == pytest.approx(np.std(UNEVEN), rel=0.5)
        _derivatives_are_exact(problem, found.x, found.scatters)


def test_damping_that_scatters_takes_the_rigs_own_dampers_along() -> None:
    """As a gearbox is damped by its meshes: that its modes differ is no sign of another damper."""
    rig = load_rig("gearbox")
    configuration = rig.configurations[0]
    system = rig.system(configuration)
    values, phi = scipy.linalg.eigh(system.stiffness, system.mass)
    # which shapes two modes of one frequency have is arbitrary: they are damped alike
    number = np.unique(np.round(np.log(np.maximum(values, 1.0)), 6), return_inverse=True)[1]
    factor = np.exp(0.6 * np.random.default_rng(5).standard_normal(len(values)))[number]
    own = phi.T @ system.damping @ phi + np.diag(
        2 * system.modal_damping_ratio * np.sqrt(np.maximum(values, 0.0))
    )
    scaled = np.sqrt(factor)[:, None] * own * np.sqrt(factor)
    back = system.mass @ phi
    exact = complex_modes(replace(system, damping=back @ scaled @ back.T, modal_damping_ratio=0.0))
    on = exact.frequency_hz > 100.0
    dofs = tuple(Dof.parse(d) for d in system.dofs)
    f, shapes = exact.frequency_hz[on], exact.shapes[: len(dofs), on].T
    measured = MeasuredModes(
        configuration, f, 1e-5 * f, exact.damping_ratio[on], 1e-4 * exact.damping_ratio[on], shapes,
        1e-3 * np.abs(shapes) + 1e-4 * np.max(np.abs(shapes), axis=1, keepdims=True), dofs,
        band_hz=(100.0, 1.1 * float(f[-1])),
    )  # fmt: skip
    observations = ModeObservations(rig, [prepare(measured)]).suited([])
    assert observations.own_damping
    scatters = {n: s.default for n, s in observations.scatters.items()}
    problem = observations.problem([], {})
    found = descend(problem, scatters, problem.start(), steps=60)
    assert found.error < 0.85
    at = found.x.copy()  # how two modes turn whose poles coincide is bounded: a little apart it is exact
    at[problem.unknowns.index[f"damping of undamped mode 3 of {configuration}"]] += 0.1
    _derivatives_are_exact(problem, at, scatters, [n for n in problem.unknowns.names if "damp" in n])


def _derivatives_are_exact(
    problem: ModeProblem, at: np.ndarray, scatters: dict[str, float], names: Sequence[str] = ()
) -> None:
    """Those of the residuals by some unknowns, or all, against central differences with the same pairs of modes."""
    true = problem.residuals(at, scatters)
    for name in names or problem.unknowns.names:
        i = problem.unknowns.index[name]
        h = np.zeros(len(at))
        h[i] = 1e-5
        low, high = (problem.residuals(at + s * h, scatters, matching=true.matching).stated for s in (-1, 1))
        np.testing.assert_allclose(
            true.jacobian[:, i],
            (high - low) / 2e-5,
            atol=2e-2 * max(1.0, np.abs(true.jacobian[:, i]).max()),
            err_msg=name,
        )
