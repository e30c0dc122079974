"""A rig of two bodies, and records of it from the equations of motion solved by matrix functions."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

import ema_pipeline as ema
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import effect_library
from ema_pipeline.ingest.driven import DrivenRecord, ForceChannel
from ema_pipeline.ingest.records import ResponseChannel
from ema_pipeline.observations.record_problem import RecordProblem
from ema_pipeline.rigs.types import Rig

Array = NDArray[np.float64]
LIBRARY = effect_library()
RATE, PERIOD = 512.0, 64
TEXT = """modal_damping_ratio = 0.0
masses = [{ at = "a.x", value = 2.0 }, { at = "b.x", value = 1.0 }]
springs = [{ at = "a.x", value = 5e4 }, { between = ["a.x", "b.x"], value = 2e4 }]
dampers = [{ at = "a.x", value = 40.0 }, { between = ["a.x", "b.x"], value = 10.0 }]
"""
MASS = np.diag([2.0, 1.0])
STIFFNESS = np.array([[7e4, -2e4], [-2e4, 2e4]])
DAMPING = np.array([[50.0, -10.0], [-10.0, 10.0]])
CHANNELS = (
    ResponseChannel("xa", Dof("a", "x"), "displacement", calibration_std=0.03),
    ResponseChannel("ab", Dof("b", "x"), "acceleration", calibration_std=0.05),
)
FORCE_STD = 0.04


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(TEXT)
    return ema.load_rig(path)


def record(name: str, force: Array, responses: Array, period: int = 0, transient: int = 0) -> DrivenRecord:
    channel = ForceChannel("f", Dof("a", "x"), FORCE_STD, 0.0)
    return DrivenRecord(
        name,
        f"{name}.h5",
        "",
        "fit",
        RATE,
        (channel,),
        force[None],
        CHANNELS,
        responses,
        period,
        transient=transient,
    )


def steady(lines: tuple[int, ...] = (3, 5, 7)) -> DrivenRecord:
    """One period under a few sines, by the receptance."""
    time, force, read = np.arange(PERIOD) / RATE, np.zeros(PERIOD), np.zeros((2, PERIOD))
    for line in lines:
        s = 2j * np.pi * line * RATE / PERIOD
        x = np.linalg.solve(s**2 * MASS + s * DAMPING + STIFFNESS, [30.0, 0.0])
        wave = np.exp(s * time + 1j * line)
        force += 30.0 * wave.real
        read += np.stack([(x[0] * wave).real, (s**2 * x[1] * wave).real])
    return record("steady", force, read, PERIOD)


def decaying(begin: Array, samples: int = 120, transient: int = 20) -> DrivenRecord:
    """Free motion from a state (displacements, velocities), by the matrix exponential."""
    inverse = np.linalg.inv(MASS)
    first_order = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ STIFFNESS, -inverse @ DAMPING]])
    step = scipy.linalg.expm(first_order / RATE)
    states = [begin]
    for _ in range(samples - 1):
        states.append(step @ states[-1])
    motion = np.array(states)
    read = np.stack([motion[:, 0], (motion @ first_order.T)[:, 3]])
    return record("decaying", np.zeros(samples), read, transient=transient)


BEGIN = np.array([1e-3, -5e-4, 0.1, 0.2])


def truth(problem: RecordProblem, effects: str = "") -> Array:
    """Unknowns of the true model: the rig's own values, and the state that the decay begins at."""
    x = problem.start()
    for k, value in enumerate(BEGIN / problem.observations.begin_scale):
        x[problem.unknowns.index[f"state {k + 1} at sample 0 of decaying{effects}"]] = value
    return x
