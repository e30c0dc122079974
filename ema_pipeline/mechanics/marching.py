"""Response of an assembly with elements that have a memory, marched step by step."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, row_matrix
from ema_pipeline.mechanics.laws import Nonlinear, check_element
from ema_pipeline.mechanics.time_response import TimeResponse, recursion, state_space

_SWEEPS = 60
_TOLERANCE = 1e-10


def marched_response(
    assembly: Assembly,
    sample_rate_hz: float,
    forces: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
    substeps: int,
    displacement: NDArray[np.float64] | None = None,
    velocity: NDArray[np.float64] | None = None,
) -> TimeResponse:
    """See `mechanics.nonlinear.nonlinear_response`, whose arguments these are."""
    system = assembly.system()
    if np.any(system.structural):
        raise EmaError(
            "a loss factor holds at steady state only and has no time response; use the frequency domain"
        )
    elements = assembly.nonlinear
    for element in elements:
        check_element(element)
    n, m = len(assembly.dofs), len(elements)
    rows = element_rows(assembly, elements)
    inputs = len(in_rows)
    a, b = state_space(system, np.vstack([in_rows, -rows]))
    rate = sample_rate_hz * substeps
    transition, step, ramp = recursion(a, b, rate)

    fine = interpolated(forces, substeps)
    stretch = np.zeros((2 * m, 2 * n))
    stretch[:m, :n] = stretch[m:, n:] = rows
    push = step[:, :inputs] @ fine[:, :-1] + ramp[:, :inputs] @ fine[:, 1:]
    begin = np.concatenate([np.zeros(n) if p is None else p for p in (displacement, velocity)])
    states, deviations = _march(
        elements,
        np.block([[transition, step[:, inputs:]], [stretch @ transition, stretch @ step[:, inputs:]]]),
        np.vstack([push, stretch @ push]).T,
        ramp[:, inputs:],
        stretch @ ramp[:, inputs:],
        begin,
        (stretch @ begin).tolist(),
        1 / rate,
        substeps,
    )
    rates = states @ a.T + np.vstack([forces, deviations.T]).T @ b.T
    return TimeResponse(
        displacement=out_rows @ states[:, :n].T,
        velocity=out_rows @ states[:, n:].T,
        acceleration=out_rows @ rates[:, n:].T,
    )


def _march(
    elements: Sequence[Nonlinear],
    advance: NDArray[np.float64],
    push: NDArray[np.float64],
    ramp: NDArray[np.float64],
    reach: NDArray[np.float64],
    begin: NDArray[np.float64],
    stretches: list[float],
    time_step: float,
    keep_every: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """States (n_kept, 2n) and deviation forces (n_kept, m) at every `keep_every`-th step.

    `advance` and `push` give state, stretches and rates after a step but for the new deviation forces;
    `ramp` and `reach` are what these add to the state and to stretches and rates.
    """
    m, size = len(elements), len(begin)
    kept = len(push) // keep_every + 1
    states, deviations = np.empty((kept, size)), np.empty((kept, m))
    memory = [e.start for e in elements]
    before = stretches[:m]
    start = [
        e.step(d, d, v, s, time_step)
        for e, d, v, s in zip(elements, before, stretches[m:], memory, strict=True)
    ]
    force = [s[0] for s in start]
    now = np.concatenate([begin, force])
    states[0], deviations[0] = begin, force
    by_stretch, by_rate = reach[:m].tolist(), reach[m:].tolist()
    scale = 0.0
    for k in range(len(push)):
        ahead = advance @ now
        ahead += push[k]
        predicted = ahead[size:].tolist()
        before, force, memory, scale = _solve(
            elements, predicted, by_stretch, by_rate, before, force, memory, time_step, scale, k
        )
        now[size:] = force
        now[:size] = ahead[:size]
        now[:size] += ramp @ now[size:]
        if (k + 1) % keep_every == 0:
            states[(k + 1) // keep_every] = now[:size]
            deviations[(k + 1) // keep_every] = now[size:]
    return states, deviations


def _solve(
    elements: Sequence[Nonlinear],
    predicted: list[float],
    by_stretch: list[list[float]],
    by_rate: list[list[float]],
    before: list[float],
    force: list[float],
    memory: list[float],
    time_step: float,
    scale: float,
    number: int,
) -> tuple[list[float], list[float], list[float], float]:
    """Deviation forces at the end of a step by Gauss-Seidel over the elements with Newton steps in each."""
    m = len(elements)
    force, after, stretches = list(force), list(memory), list(before)
    for _ in range(_SWEEPS):
        worst = 0.0
        for i in range(m):
            d, v = predicted[i], predicted[m + i]
            row, speed = by_stretch[i], by_rate[i]
            for j in range(m):
                d += row[j] * force[j]
                v += speed[j] * force[j]
            f, fd, fv, after[i] = elements[i].step(before[i], d, v, memory[i], time_step)
            stretches[i] = d
            error = f - force[i]
            force[i] += error / max(1.0 - fd * row[i] - fv * speed[i], 0.1)
            scale = max(scale, abs(f))
            worst = max(worst, abs(error))
        if not isfinite(sum(force)):
            break
        if worst <= _TOLERANCE * scale:
            return stretches, force, after, scale
    names = ", ".join(e.name for e in elements)
    raise EmaError(
        f"no solution at step {number} of {time_step:.3g} s with {names}: the motion grows without bound, "
        "or the step is too long; check the elements' values, or raise the sample rate"
    )


def element_rows(assembly: Assembly, elements: Sequence[Nonlinear]) -> NDArray[np.float64]:
    """Rows of elements over the coordinates, (m, n)."""
    return row_matrix([e.row for e in elements], {d: i for i, d in enumerate(assembly.dofs)})


def interpolated(forces: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
    """Straight lines between samples at `substeps` points per sample."""
    count = forces.shape[1]
    at = np.arange((count - 1) * substeps + 1) / substeps
    return np.stack([np.interp(at, np.arange(count), f) for f in forces])
