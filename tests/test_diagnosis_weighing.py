"""What a fit is worth must not depend on how a solver happens to write down modes that coincide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose import DiagnoseSettings
from ema_pipeline.diagnose.fitting import Case, fit_null
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.weighing import missed_modes, mixing_volume
from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.fit.solve import Optimum
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.rigs.planetary import planetary

RIG = planetary(3)
SETTINGS = DiagnoseSettings(processes=1)
MESH = 1e7


def modes(effect: Mapping[str, float] | None = None) -> MeasuredModes:
    """Modes of the rig at its nominal values: with three planets all translational modes are pairs."""
    rng = np.random.default_rng(4)
    values = {n: MESH if p.free else p.value for n, p in RIG.parameters.items()}
    rig = rig_with_effects(RIG, [n.rpartition(".")[0] for n in effect or {}])
    system = rig.system("no_ring", {**values, **(effect or {})})
    f, phi = normal_modes(system)
    inside = (f > 5) & (f < 2000)
    dofs = tuple(
        Dof(b, d) for b in ("carrier", "sun", "planet1", "planet2", "planet3") for d in ("x", "y", "u")
    )
    shapes = (sensor_rows(system, dofs) @ phi[:, inside]).T
    shapes = shapes / np.abs(shapes).max(axis=1, keepdims=True)
    f = f[inside]
    return MeasuredModes(
        configuration="no_ring",
        frequency_hz=f * (1 + 1e-5 * rng.normal(size=f.size)),
        frequency_std_hz=1e-4 * f,
        damping_ratio=np.full(f.size, values["modal_damping_ratio"]),
        damping_std=np.full(f.size, 0.03 * values["modal_damping_ratio"]),
        shapes=shapes + 0.005 * (rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape)),
        shape_std=np.full(shapes.shape, 0.005),
        dofs=dofs,
        band_hz=(5.0, 2000.0),
    )


@pytest.fixture(scope="module")
def case() -> Case:
    return Case(RIG, {"no_ring": modes()}, SETTINGS)


@pytest.mark.parametrize(
    ("label", "size"),
    [
        ("local_damper@sun", "coefficient"),
        ("hysteretic_damping@sun", "loss_factor"),
        ("gyroscopic@carrier", "coefficient"),
    ],
)
def test_damping_that_does_nothing_leaves_the_volume_of_free_mixing_as_it_was(
    case: Case, label: str, size: str
) -> None:
    base = fit_null(case, Hypothesis(), SETTINGS.fit, None)

    def volume(hypothesis: Hypothesis, values: dict[str, float]) -> float:
        problem = case.problem(hypothesis, SETTINGS.fit)
        x = problem.space.point(values)
        n = sum(len(p) for p in problem.assignments(x))
        assert problem.modes(x)[0].shapes.dtype == (complex if hypothesis.labels else float)
        return mixing_volume(problem, Optimum(x, 0.0, np.zeros(n), np.ones(n), ""))

    plain = volume(Hypothesis(), base.values)
    assert plain > 50
    damped = volume(Hypothesis((label,)), {**base.values, f"{label}.{size}": 1e-7})
    assert damped == pytest.approx(plain, abs=0.5)


def test_motions_that_hardly_ring_are_no_modes_that_a_test_misses() -> None:
    one = modes()
    last = replace(
        one,
        **{
            n: getattr(one, n)[-1:]
            for n in (
                "frequency_hz",
                "frequency_std_hz",
                "damping_ratio",
                "damping_std",
                "shapes",
                "shape_std",
            )
        },
    )
    case = Case(RIG, {"no_ring": last}, SETTINGS)
    label = "local_damper@carrier"
    problem = case.problem(Hypothesis((label,)), SETTINGS.fit)
    values = {n: MESH if p.free else p.value for n, p in RIG.parameters.items()}
    counts = []
    for size in (0.0, 500.0):
        x = problem.space.point({**values, f"{label}.coefficient": size})
        found = problem.modes(x)[0]
        counts.append(missed_modes(problem, x))
        rings = np.abs(found.damping_ratio[0]) < 0.2
        hz = found.omega[0] / (2 * np.pi)
        dull = int(np.sum(~rings & (hz > 5) & (hz < 1900)))
        assert (dull > 0) == (size > 0)
    assert counts[0] > 10
    assert counts[1] <= counts[0] - dull


def test_a_split_pair_that_alone_knows_a_parameter_does_not_let_go_of_it() -> None:
    split = modes({"mesh_stiffness_loss@sun-planet3.fraction": 0.02})
    close = replace(split, frequency_std_hz=1e-5 * split.frequency_hz)
    base = fit_null(Case(RIG, {"no_ring": close}, SETTINGS), Hypothesis(), SETTINGS.fit, None)
    assert int(np.sum(~base.explained)) == 1  # of two that no sound rig has at this distance
    assert base.values["sun_planet_mesh_stiffness"] == pytest.approx(MESH, rel=0.01)
