"""Response of an assembly with nonlinear elements to a sampled force, and their force under a given motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Spring
from ema_pipeline.mechanics.laws import Nonlinear
from ema_pipeline.mechanics.marching import marched_response
from ema_pipeline.mechanics.modal_response import response_from_rest
from ema_pipeline.mechanics.time_response import TimeResponse


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
        return response_from_rest(assembly, sample_rate_hz, forces, out_rows, in_rows, substeps)
    return marched_response(
        assembly, sample_rate_hz, forces, out_rows, in_rows, substeps, displacement, velocity
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
