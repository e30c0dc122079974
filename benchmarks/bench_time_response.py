"""Speed and accuracy of the time response with nonlinear elements, against scipy's adaptive integrator.

Run: python benchmarks/bench_time_response.py
"""

from __future__ import annotations

import time

import numpy as np
import scipy.integrate

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import DryFriction, PartingSpring, PolynomialSpring
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.mechanics.time_response import state_space, time_response
from ema_pipeline.rigs import load_rig
from ema_pipeline.threads import single_blas_thread

RATE_HZ = 25600.0


def blow(seconds: float) -> np.ndarray:
    """A hammer blow of 300 N and 1 ms, (1, n_samples)."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.where(t < 1e-3, 300 * np.sin(np.pi * t / 1e-3) ** 2, 0.0)[None]


def reference(assembly: Assembly, force: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Displacement by solve_ivp at a tight tolerance, (n_samples,)."""
    system = assembly.system()
    n = len(system.dofs)
    elements = assembly.nonlinear
    rows = np.zeros((len(elements), n))
    for i, e in enumerate(elements):
        for dof, value in e.row.items():
            rows[i, system.dofs.index(dof)] = value
    a, b = state_space(system, np.vstack([row, -rows]))
    t = np.arange(force.shape[1]) / RATE_HZ

    def slope(now: float, z: np.ndarray) -> np.ndarray:
        d, v = rows @ z[:n], rows @ z[n:]
        deviations = [
            e.step(x, x, y, 0.0, 1.0)[0] for e, x, y in zip(elements, d.tolist(), v.tolist(), strict=True)
        ]
        return a @ z + b @ np.array([np.interp(now, t, force[0]), *deviations])

    solution = scipy.integrate.solve_ivp(
        slope, (0, t[-1]), np.zeros(2 * n), t_eval=t, rtol=1e-9, atol=1e-14, max_step=1 / RATE_HZ
    )
    return row[0] @ solution.y[:n]


def main() -> None:
    rig = load_rig("planetary").assembly("with_ring")
    row = sensor_rows(rig.system(), (Dof("sun", "x"),))
    mesh = rig.named("sun-planet1 mesh")
    cases = {
        "cubic and friction": rig.add(
            PolynomialSpring("cubic", {"sun.x": 1.0}, 0.0, 1e13),
            DryFriction("friction", {"carrier.y": 1.0}, 5.0),
        ),
        "cubic and parting mesh": rig.edit(
            [mesh.name], lambda e: PartingSpring(e.name, e.row, e.stiffness, preload=1e-6)
        ).add(PolynomialSpring("cubic", {"sun.x": 1.0}, 0.0, 1e13)),
    }
    with single_blas_thread():
        force = blow(1.0)
        start = time.perf_counter()
        time_response(rig.system(), RATE_HZ, force, row, row)
        print(f"linear, 1 s at 25.6 kHz, {len(rig.dofs)} DOFs: {time.perf_counter() - start:.2f} s")
        for name, assembly in cases.items():
            start = time.perf_counter()
            nonlinear_response(assembly, RATE_HZ, force, row, row)
            ours = time.perf_counter() - start
            short = blow(0.05)
            start = time.perf_counter()
            exact = reference(assembly, short, row)
            theirs = (time.perf_counter() - start) / 0.05
            errors = []
            for substeps in (1, 4):
                got = nonlinear_response(assembly, RATE_HZ, short, row, row, substeps=substeps).displacement[
                    0
                ]
                errors.append(np.max(np.abs(got - exact)) / np.max(np.abs(exact)))
            print(
                f"{name}: {ours:.2f} s per second of signal "
                f"(solve_ivp: {theirs:.0f} s, {theirs / ours:.0f}×); error {errors[0]:.1e}, "
                f"with 4 substeps {errors[1]:.1e}"
            )


if __name__ == "__main__":
    main()
