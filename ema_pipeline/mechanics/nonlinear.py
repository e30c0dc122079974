"""Response of an assembly with nonlinear elements to a sampled force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Spring
from ema_pipeline.mechanics.laws import Nonlinear, check_element
from ema_pipeline.mechanics.time_response import TimeResponse, recursion, state_space

_SWEEPS = 60
_TOLERANCE = 1e-10


def nonlinear_response(
    assembly: Assembly,
    sample_rate_hz: float,
    forces: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
    *,
    substeps: int = 1,
    displacement: NDArray[np.float64] | None = None,
    velocity: NDArray[np.float64] | None = None,
) -> TimeResponse:
    """Response from rest or from a given state.

    Parameters
    ----------
    assembly : Assembly
    sample_rate_hz : float
    forces : ndarray, (n_inputs, n_samples)
        N; taken to run straight from sample to sample.
    out_rows, in_rows : ndarray, (n_outputs, n), (n_inputs, n)
    substeps : int
        Steps per sample. The error falls with the square of the step.
    displacement, velocity : ndarray, (n,), optional
        Motion at the first sample; at rest where left out.

    Returns
    -------
    TimeResponse

    Raises
    ------
    EmaError
        For structural damping, and where the step is too long for a nonlinear element.

    Notes
    -----
    The linear part, tangents of the nonlinear elements included, is advanced exactly (see `time_response`).
    Only the deviations from the tangents are approximated, as ramps over a step; their end values are found
    implicitly by Newton steps on the stretches of the nonlinear elements alone, so the scheme stays stable
    for stiff elements and costs little beyond the linear response.
    """
    forces = np.atleast_2d(np.asarray(forces, dtype=float))
    at_rest = displacement is None and velocity is None
    if at_rest and len(forces) == 1 and all(e.law is not None for e in assembly.nonlinear):
        return _from_rest(assembly, sample_rate_hz, forces, out_rows, in_rows, substeps)
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

    fine = _interpolated(forces, substeps)
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


def _from_rest(
    assembly: Assembly,
    sample_rate_hz: float,
    forces: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
    substeps: int,
) -> TimeResponse:
    """The same for one force on elements without memory, in a compiled loop."""
    from ema_pipeline.mechanics.batch import compiled_response

    orders = np.repeat(np.arange(3), len(out_rows))
    motion, direct = compiled_response(
        [assembly], sample_rate_hz, _interpolated(forces, substeps), np.tile(out_rows, (3, 1)), orders, in_rows,
        substeps,
    )  # fmt: skip
    both = motion[0, 0] + direct[0, 0][:, None] * forces
    return TimeResponse(*both.reshape(3, len(out_rows), -1))


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
        "or the step is too long; check the elements' values, or give more substeps"
    )


def force_along(
    elements: Sequence[Element],
    displacement: NDArray[np.float64],
    velocity: NDArray[np.float64],
    time_step: float,
    *,
    deviation: Callable[..., NDArray[np.float64]] | None = None,
) -> NDArray[np.float64]:
    """Force of elements side by side whose common stretch is prescribed.

    Parameters
    ----------
    elements : sequence
        Springs, dampers and nonlinear elements.
    displacement, velocity : ndarray, (n_samples,)
        Stretch and its rate, m and m/s.
    time_step : float
        s.
    deviation : callable, optional
        `deviation_along` (the default) for a motion that starts from rest, `steady_deviation` for one period
        of a steady state.

    Returns
    -------
    ndarray, (n_samples,)
        N.
    """
    total = np.zeros(len(displacement))
    for element in elements:
        if isinstance(element, Damper):
            total += element.coefficient * velocity
        elif isinstance(element, Nonlinear):
            total += element.tangent_stiffness * displacement + element.tangent_damping * velocity
            total += (deviation or deviation_along)(element, displacement, velocity, time_step)
        elif isinstance(element, Spring):
            total += element.stiffness * displacement
        else:
            raise EmaError(f"element '{element.name}' has no force along a prescribed stretch")
    return total


def deviation_along(
    element: Nonlinear,
    displacement: NDArray[np.float64],
    velocity: NDArray[np.float64],
    time_step: float,
) -> NDArray[np.float64]:
    """Deviation of an element's force from its tangent, from rest at the first sample on, (n_samples,)."""
    return element.along(displacement, velocity, time_step, float(displacement[0]), element.start)


def steady_deviation(
    element: Nonlinear,
    displacement: NDArray[np.float64],
    velocity: NDArray[np.float64],
    time_step: float,
) -> NDArray[np.float64]:
    """The same over one period of a motion that has gone on for ever, (n_samples,)."""
    state = element.settled(displacement.tolist(), time_step)
    return element.along(displacement, velocity, time_step, float(displacement[-1]), state)


def element_rows(assembly: Assembly, elements: Sequence[Nonlinear]) -> NDArray[np.float64]:
    """Rows of elements over the coordinates, (m, n)."""
    rows = np.zeros((len(elements), len(assembly.dofs)))
    for i, element in enumerate(elements):
        for dof, value in element.row.items():
            rows[i, assembly.dofs.index(dof)] = value
    return rows


def _interpolated(forces: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
    """Straight lines between samples at `substeps` points per sample."""
    count = forces.shape[1]
    at = np.arange((count - 1) * substeps + 1) / substeps
    return np.stack([np.interp(at, np.arange(count), f) for f in forces])
