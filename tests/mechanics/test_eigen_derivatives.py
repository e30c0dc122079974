"""Derivatives of modes against central differences, published frequencies and what theory says of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from imperfect_modes import chain
from lin_parker import LIN_PARKER, ROTATIONAL, TRANSLATIONAL

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution, ModeDerivatives
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.planetary import default_parameters, planetary
from ema_pipeline.rigs.types import Parameter


def solved(model: RigModel, configuration: str, x: np.ndarray) -> EigenSolution:
    m = model.matrices(configuration, x)
    found = EigenSolution.of(m.dense, m.skew, m.damping_ratio)
    assert found is not None
    return found


def derivatives(
    model: RigModel, configuration: str, x: np.ndarray, modes: np.ndarray
) -> tuple[EigenSolution, ModeDerivatives]:
    solution = solved(model, configuration, x)
    matrices = model.matrices(configuration, x)
    return solution, ModeDerivatives.of(matrices, solution, modes)


def placed(rig: ParametricRig, label: str) -> PlacedEffect:
    return parse_effect(label, rig)


def compare(
    model: RigModel, configuration: str, x: np.ndarray, band: tuple[float, float], close: float = 0.0
) -> None:
    """Derivatives by every unknown against central differences; `close`: of shapes that nearly coincide."""
    before = solved(model, configuration, x)
    modes = np.flatnonzero((before.frequency_hz > band[0]) & (before.frequency_hz < band[1]))
    _, slope = derivatives(model, configuration, x, modes)
    for k, r in enumerate(modes.tolist()):
        turned = before.damped is not None and before.damped.turned[r]
        # Of hardly turned shapes, derivatives are those of the undamped ones; weakly coupled poles are not exact.
        near = 0.0 if before.damped is None else 2e-3 if turned else 1e-2
        for i, name in enumerate(model.unknowns.names):
            h = np.zeros(len(x))
            h[i] = 1e-5
            ends = [solved(model, configuration, x - h), solved(model, configuration, x + h)]
            change = np.diff([np.log(s.frequency_hz[r]) for s in ends])[0] / 2e-5
            assert slope.log_frequency[k, i] == pytest.approx(
                change, rel=near + 0.6 * close, abs=2e-6 + 0.1 * near
            ), name
            change = np.diff([s.damping_ratio[r] for s in ends])[0] / 2e-5
            assert slope.damping_ratio[k, i] == pytest.approx(
                change, rel=near + 0.6 * close, abs=1e-6 + 0.03 * near
            ), name
            shapes = [shape_of(s, r, before) for s in ends]
            change, found = (shapes[1] - shapes[0]) / 2e-5, slope.shapes[:, k, i]
            if before.damped is not None:  # their scale is free
                middle = shape_of(before, r, before)
                change, found = across(change, middle), across(found, middle)
            if near and not turned:  # only the real part is read of those
                change, found = np.real(change), np.real(found)
            atol = (1.5 * near or 2e-4) * np.abs(before.shapes).max()
            np.testing.assert_allclose(found, change, rtol=1e-4 + near + close, atol=atol, err_msg=name)


def across(change: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """A change of a shape without what is in proportion to it."""
    return change - shape * np.vdot(shape, change) / np.vdot(shape, shape)


def shape_of(solution: EigenSolution, r: int, like: EigenSolution) -> np.ndarray:
    """A shape with the sign that the undamped one has in another solution."""
    sign = np.sign(np.sum(solution.shapes[:, r] * like.shapes[:, r]))
    return sign * (solution.shapes if solution.damped is None else solution.damped.shapes)[:, r]


def point(model: RigModel, seed: int = 0) -> np.ndarray:
    """A point away from every symmetry, effects at half their start."""
    rng = np.random.default_rng(seed)
    x = model.start()
    x[: model.shape_start] = 0.1 * rng.normal(size=model.shape_start)
    return x


def with_sizes(model: RigModel, sizes: dict[str, float], scatter: float = 0.1) -> np.ndarray:
    """The same with effects of these sizes, by label."""
    name = {label: next(n for n in model.sizes if n.startswith(f"{label}.")) for label in sizes}
    x = model.start({name[label]: size for label, size in sizes.items()})
    x[: model.shape_start] = scatter * np.random.default_rng(0).normal(size=model.shape_start)
    return x


@pytest.mark.parametrize(
    "labels",
    [
        ("spring@m2.z", "mass@m4.z", "damper@m1.z"),
        ("spring@m1-m3", "damper@m2-m5"),
        ("mass@m3.z",),
    ],
)
def test_derivatives_of_a_chain_with_effects_are_those_of_differences(labels: tuple[str, ...]) -> None:
    rig = chain()
    model = RigModel(rig, [placed(rig, label) for label in labels])
    compare(model, "all", point(model), (1.0, 1000.0))


@pytest.mark.parametrize(
    "labels",
    [
        (),
        ("mesh_stiffness_loss@sun-planet1", "hysteretic_damping@ring-planet"),
        ("bearing_anisotropy@sun", "shaft_torsion@carrier", "local_damper@planet2"),
    ],
)
def test_derivatives_of_the_planetary_rig_are_those_of_differences(labels: tuple[str, ...]) -> None:
    rig = planetary()
    model = RigModel(rig, [placed(rig, label) for label in labels])
    compare(model, "with_ring", point(model, 1), (20.0, 3000.0))


@pytest.mark.parametrize(
    "sizes",
    [
        {"damper@m2.z": 900.0},
        {"damper@m2.z": 150.0, "spring@m4.z": 2e4},
        {"damper@m2-m3": 400.0, "mass@m5.z": 0.2},
    ],
)
def test_strong_dampers_turn_shapes_and_derivatives_follow(sizes: dict[str, float]) -> None:
    rig = chain()
    model = RigModel(rig, [placed(rig, label) for label in sizes])
    compare(model, "all", with_sizes(model, sizes), (1.0, 1000.0))


@pytest.mark.parametrize(
    "sizes",
    [
        {"local_damper@sun": 200.0},
        {"gyroscopic@carrier": 60.0},
        {"gyroscopic@sun": 20.0, "local_damper@planet1": 60.0},
    ],
)
def test_dampers_and_gyroscopic_coupling_of_the_planetary_rig_have_exact_derivatives(
    sizes: dict[str, float],
) -> None:
    rig = planetary()
    model = RigModel(rig, [placed(rig, label) for label in sizes])
    compare(model, "with_ring", with_sizes(model, sizes, 0.03), (20.0, 3000.0), close=0.1)


@pytest.mark.parametrize("name", ["frame", "gearbox"])
def test_derivatives_of_the_other_rigs_are_those_of_differences(name: str) -> None:
    rig = load_rig(name)
    model = RigModel(rig)
    x = 0.3 * point(model, 2)
    f = solved(model, rig.configurations[0], x).frequency_hz
    compare(model, rig.configurations[0], x, (5.0, 1.001 * float(f[min(7, len(f) - 1)])))


# --- published frequencies and their sensitivities --------------------------------------------------------


def lin_parker(planets: int = 3) -> RigModel:
    """The example gear of Lin & Parker, everything but the pressure angle uncertain."""
    parameters = {}
    for name, p in default_parameters().items():
        value = LIN_PARKER.get(name, 0.0 if name == "modal_damping_ratio" else p.value)
        tolerance = 0.0 if name in ("pressure_angle_deg", "modal_damping_ratio") else 0.1
        parameters[name] = Parameter(name, value, p.unit, tolerance, scatter=0.0)
    return RigModel(planetary(planets, parameters))


def elasticities(model: RigModel) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
    """Frequencies, and d ln f/d ln p of every mode by every parameter."""
    x = np.zeros(len(model.unknowns))
    solution = solved(model, "with_ring", x)
    modes = np.flatnonzero(solution.frequency_hz > 1.0)
    _, slope = derivatives(model, "with_ring", x, modes)
    by_name = {n: slope.log_frequency[:, i] for n, i in model.unknowns.index.items()}
    return solution.frequency_hz[modes], by_name


def test_published_frequencies_are_met() -> None:
    f, _ = elasticities(lin_parker())
    expected = np.sort([*ROTATIONAL, *np.repeat(TRANSLATIONAL, 2)])
    np.testing.assert_allclose(f, expected, atol=0.05)


def test_elasticities_of_all_stiffnesses_add_up_to_one_half_and_of_all_masses_to_minus_one_half() -> None:
    # f scales with the square root of a common factor on all stiffnesses, and inversely on all masses
    _, slope = elasticities(lin_parker())
    stiff = sum(v for n, v in slope.items() if n.endswith("stiffness"))
    heavy = sum(v for n, v in slope.items() if n.endswith(("mass", "inertia")))
    np.testing.assert_allclose(stiff, 0.5, atol=1e-9)
    np.testing.assert_allclose(heavy, -0.5, atol=1e-9)


def test_planet_modes_do_not_depend_on_the_central_bodies() -> None:
    # Lin & Parker (1999): central bodies stand still in planet modes
    f, slope = elasticities(lin_parker(4))
    for published in (1808.2, 5963.8, 6981.7):
        r = int(np.argmin(np.abs(f - published)))
        assert f[r] == pytest.approx(published, abs=0.1)
        for name, values in slope.items():
            if name.startswith(("carrier", "ring_mass", "ring_bearing", "sun_mass", "sun_bearing")):
                assert abs(values[r]) < 1e-9, name
        assert slope["planet_mass"][r] < -0.01


def test_rotational_modes_do_not_depend_on_masses_and_bearings_of_the_central_bodies() -> None:
    f, slope = elasticities(lin_parker())
    for published in ROTATIONAL:
        r = int(np.argmin(np.abs(f - published)))
        for body in ("carrier", "ring", "sun"):
            assert abs(slope[f"{body}_mass"][r]) < 1e-9
            assert abs(slope[f"{body}_bearing_stiffness"][r]) < 1e-9


# --- what has no modes ------------------------------------------------------------------------------------


def test_a_mass_below_zero_has_no_modes_and_is_not_an_error() -> None:
    dense = np.zeros((4, 2, 2))
    dense[0], dense[2] = np.diag([1.0, -0.1]), np.eye(2)
    assert EigenSolution.of(dense, np.zeros((2, 2)), 0.01) is None
    dense[0] = np.array([[1.0, 2.0], [2.0, 1.0]])
    assert EigenSolution.of(dense, np.zeros((2, 2)), 0.01) is None
    dense[0, 0, 0] = np.nan
    assert EigenSolution.of(dense, np.zeros((2, 2)), 0.01) is None


def test_equal_frequencies_have_finite_derivatives() -> None:
    rig = planetary(4)
    model = RigModel(rig)
    x = np.zeros(len(model.unknowns))
    _, slope = derivatives(model, "with_ring", x, np.arange(3, 20))
    assert np.all(np.isfinite(slope.shapes))
    assert np.all(np.isfinite(slope.log_frequency))
    assert np.max(np.abs(slope.log_frequency)) < 1.0


@pytest.mark.parametrize(
    ("label", "step"),
    [
        ("gyroscopic@carrier.coefficient", 0.02),
        ("local_damper@planet1.coefficient", 0.02),
        ("hysteretic_damping@sun-planet.loss_factor", 0.5),
    ],
)
def test_what_lets_shapes_lag_has_at_no_size_the_derivatives_of_a_small_one(label: str, step: float) -> None:
    rig = planetary()
    model = RigModel(rig, [placed(rig, label.rpartition(".")[0])])
    x = point(model, 3)
    i = model.unknowns.index[label]
    x[i] = 0.0
    before = solved(model, "with_ring", x)
    hz, half = before.frequency_hz, before.damping_ratio * before.frequency_hz
    near = np.abs(np.subtract.outer(hz, hz)) <= 6 * np.maximum.outer(half, half)
    # dampers turn close modes into each other, which is no linear function of them
    alone = (np.sum(near, axis=0) == 1) | label.startswith("gyroscopic")
    modes = np.flatnonzero((hz > 20) & (hz < 2000) & alone)
    assert len(modes) >= 3
    _, slope = derivatives(model, "with_ring", x, modes)
    ends = [solved(model, "with_ring", x + h * np.eye(len(x))[i]) for h in (-step, step)]
    assert before.damped is None
    changes, found = [], []
    for k, r in enumerate(modes.tolist()):
        change = across(
            (shape_of(ends[1], r, before) - shape_of(ends[0], r, before)) / (2 * step), before.shapes[:, r]
        )
        changes.append(change)
        found.append(across(slope.shapes[:, k, i], before.shapes[:, r]))
    np.testing.assert_allclose(found, changes, rtol=1e-2, atol=1e-2 * np.abs(changes).max())
    assert np.abs(changes).max() > 1e-3 * np.abs(before.shapes).max()


def test_an_effect_of_no_size_leaves_the_derivatives_by_all_else_as_they_are() -> None:
    """Dampers of a rig that couple its modes too little to matter change damping ratios where shapes turn."""
    rig = load_rig("gearbox")
    bare, model = RigModel(rig), RigModel(rig, [placed(rig, "local_damper@carrier")])
    x = point(bare, 3)
    x[bare.unknowns.index["mesh_damping"]] = -4.0
    start = model.start({"local_damper@carrier.coefficient": 0.0})
    both = [bare.unknowns.index[n] for n in model.unknowns.names if n in bare.unknowns.index]
    at = [model.unknowns.index[n] for n in model.unknowns.names if n in bare.unknowns.index]
    start[at] = x[both]
    configuration = rig.configurations[0]
    solution = solved(bare, configuration, x)
    assert solution.damped is None
    modes = np.flatnonzero(solution.frequency_hz > 100.0)
    _, without = derivatives(bare, configuration, x, modes)
    _, with_it = derivatives(model, configuration, start, modes)
    np.testing.assert_allclose(with_it.damping_ratio[:, at], without.damping_ratio[:, both], atol=1e-12)
    np.testing.assert_allclose(with_it.log_frequency[:, at], without.log_frequency[:, both], atol=1e-9)
    np.testing.assert_allclose(with_it.shapes[..., at], without.shapes[..., both], atol=1e-9)
    assert np.abs(without.damping_ratio[:, both]).max() > 1e-5
