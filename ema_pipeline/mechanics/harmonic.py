"""Steady state under a sine force with nonlinear elements: harmonic balance, alternating frequency and time.

References
----------
T. M. Cameron, J. H. Griffin, "An alternating frequency/time domain method for calculating the steady-state
response of nonlinear dynamic systems", *J. Appl. Mech.* 56 (1989) 149-154.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import Nonlinear, check_element
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import eigen_solution, total_damping
from ema_pipeline.mechanics.nonlinear import steady_deviation
from ema_pipeline.mechanics.system import LinearSystem


@dataclass(frozen=True)
class HarmonicResponse:
    """Steady state at every frequency.

    Attributes
    ----------
    frequency_hz : ndarray, (n_lines,)
    displacement : complex ndarray, (n_outputs, n_harmonics + 1, n_lines)
        m; harmonic h is the factor of e^{jhωt}, from the static part h = 0 on.
    converged : bool ndarray, (n_lines,)
    """

    frequency_hz: NDArray[np.float64]
    displacement: NDArray[np.complex128]
    converged: NDArray[np.bool_]


def harmonic_response(
    assembly: Assembly,
    frequency_hz: NDArray[np.float64],
    amplitude_n: float,
    out_rows: NDArray[np.float64],
    in_row: NDArray[np.float64],
    *,
    harmonics: int = 7,
    samples: int = 128,
) -> HarmonicResponse:
    """Steady state under the force amplitude_n·cos(ωt).

    Parameters
    ----------
    assembly : Assembly
    frequency_hz : ndarray, (n_lines,)
        In the order in which the sine is stepped: each line starts from the last one's solution, so a
        sweep up and a sweep down follow their own branches.
    amplitude_n : float
    out_rows, in_row : ndarray, (n_outputs, n), (n,)
    harmonics, samples : int
        Harmonics kept, and samples per period for the nonlinear forces.

    Returns
    -------
    HarmonicResponse

    Notes
    -----
    Unknown are only the harmonics of the stretches of the nonlinear elements; the rest of the system is
    condensed exactly by its receptance at every harmonic.
    """
    elements = assembly.nonlinear
    for element in elements:
        check_element(element)
    system = assembly.system()
    rows = element_rows(assembly, elements)
    frequency_hz = np.asarray(frequency_hz, dtype=float)
    m = len(elements)
    shape = (m, harmonics + 1)
    result = np.zeros((len(out_rows), harmonics + 1, len(frequency_hz)), dtype=complex)
    converged = np.ones(len(frequency_hz), dtype=bool)
    damping = total_damping(system)
    static = _static_flexibility(system)
    guess: NDArray[np.float64] | None = None
    for i, f in enumerate(frequency_hz):
        omega = 2 * np.pi * float(f)
        flexibility = [static.astype(complex)]
        for h in range(1, harmonics + 1):
            z = system.stiffness + 1j * system.structural - (h * omega) ** 2 * system.mass
            flexibility.append(np.linalg.inv(z + 1j * h * omega * damping))
        free = flexibility[1] @ in_row * amplitude_n
        direct = np.zeros(shape, dtype=complex)
        direct[:, 1] = rows @ free
        coupling = np.stack([rows @ z @ rows.T for z in flexibility])  # (h, m, m)
        scale = max(float(np.max(np.abs(direct), initial=0.0)), 1e-300)

        def residual(
            x: NDArray[np.float64],
            omega: float = omega,
            direct: NDArray[np.complex128] = direct,
            coupling: NDArray[np.complex128] = coupling,
            scale: float = scale,
        ) -> NDArray[np.float64]:
            stretch = _complex(x, shape) * scale
            force = _deviations(elements, stretch, omega, samples)
            miss = stretch - direct + np.einsum("hij,jh->ih", coupling, force)
            return _real(miss) / scale

        if m:
            start = _real(direct) / scale if guess is None else guess / scale
            solution = scipy.optimize.root(residual, start, method="hybr", options={"xtol": 1e-10})
            if not _solved(solution.fun):
                again = scipy.optimize.root(residual, _real(direct) / scale, method="lm")
                solution = again if _solved(again.fun) else solution
            converged[i] = _solved(solution.fun)
            guess = np.asarray(solution.x) * scale
            force = _deviations(elements, _complex(guess, shape), omega, samples)
        else:
            force = np.zeros(shape, dtype=complex)
        for h, z in enumerate(flexibility):
            motion = -z @ rows.T @ force[:, h] + (free if h == 1 else 0.0)
            result[:, h, i] = out_rows @ motion
    return HarmonicResponse(frequency_hz, result, converged)


def describing_function(element: Nonlinear, amplitude: float, omega: float, samples: int = 1024) -> complex:
    """Complex stiffness that takes the element's place for the motion amplitude·cos(ωt), N/m."""
    if amplitude <= 0:
        raise EmaError(f"a describing function needs an amplitude above 0, not {amplitude:g}")
    stretch = np.array([[0.0, amplitude]], dtype=complex)
    deviation = complex(_deviations((element,), stretch, omega, samples)[0, 1])
    return element.tangent_stiffness + 1j * omega * element.tangent_damping + deviation / amplitude


def _solved(residual: NDArray[np.float64]) -> bool:
    return bool(np.max(np.abs(residual)) < 1e-6)


def _deviations(
    elements: Sequence[Nonlinear], stretch: NDArray[np.complex128], omega: float, samples: int
) -> NDArray[np.complex128]:
    """Harmonics of the deviation forces, (m, n_harmonics + 1), for harmonics of the stretches."""
    count = stretch.shape[1]
    order = np.arange(count)
    full = np.zeros((len(stretch), samples // 2 + 1), dtype=complex)
    full[:, :count] = stretch * np.where(order > 0, 0.5, 1.0) * samples
    full[:, 0] = full[:, 0].real
    motion = np.fft.irfft(full, samples)
    full[:, :count] *= 1j * omega * order
    rate = np.fft.irfft(full, samples)
    step = 2 * np.pi / (omega * samples)
    force = np.stack([steady_deviation(e, motion[i], rate[i], step) for i, e in enumerate(elements)])
    spectrum = np.fft.rfft(force)[:, :count] / samples
    return np.asarray(spectrum * np.where(order > 0, 2.0, 1.0))


def _static_flexibility(system: LinearSystem) -> NDArray[np.float64]:
    """Inverse stiffness without the rigid-body modes, which strain no element and so take no static force."""
    values, shapes = eigen_solution(system)
    elastic = values > 0
    return np.asarray((shapes[:, elastic] / values[elastic]) @ shapes[:, elastic].T)


def _real(harmonics: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.concatenate([harmonics.real.ravel(), harmonics[:, 1:].imag.ravel()])


def _complex(x: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.complex128]:
    m, count = shape
    result = x[: m * count].reshape(shape).astype(complex)
    result[:, 1:] += 1j * x[m * count :].reshape(m, count - 1)
    return result
