"""Nonlinear elements in motion of several frequencies, each replaced by a complex stiffness per frequency.

The motion after a blow holds all modes at once. An element's force at one of their frequencies is its complex stiffness
times the motion at that frequency; what the stiffness is hangs on the motion at all of them (multiple-input describing
functions [1]_).

References
----------
.. [1] A. Gelb, W. E. Vander Velde, *Multiple-Input Describing Functions and Nonlinear System Design*, 1968,
   chapters 2 and 5.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.harmonic import describing_function
from ema_pipeline.mechanics.laws import BoucWen, Nonlinear

OWN_PHASES = 12
"""Phases of the frequency itself; the describing function of a sign is then 1 % off."""
OTHER_PHASES = 16
"""Sets of phases of all other frequencies, which are in no fixed ratio to it."""
_TABLE_POINTS = 25
_TABLE_SAMPLES = 256
_DECADES = 6.0
"""Amplitudes below the largest by more do not differ from those at rest."""

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Force = Callable[[Real, Real], Real]


def equivalent_stiffness(element: Nonlinear, motion: Complex, omega: Real) -> Complex:
    """Complex stiffness of an element beside its tangent, at every frequency of a motion.

    Parameters
    ----------
    element : Nonlinear
    motion : complex ndarray, (n_states, n_frequencies)
        Amplitudes of the stretch, m.
    omega : ndarray, (n_frequencies,)
        rad/s.

    Returns
    -------
    complex ndarray, (n_states, n_frequencies)
        N/m. Averaged over the phases of all frequencies for an element without memory; for one with memory, that of a
        single sine whose amplitude is the root of the sum of squares.
    """
    law = element.law
    if law is None:
        return _from_table(element, np.sqrt(np.sum(np.abs(motion) ** 2, axis=1)), omega)
    force = _vectorised(law)
    own = 2 * np.pi * (np.arange(OWN_PHASES) + 0.5) / OWN_PHASES
    amplitude = np.abs(motion)
    others = _phases(motion.shape[1])
    stretch = amplitude[:, :, None] * np.cos(others)
    rate = -(omega[:, None] * amplitude[:, :, None]) * np.sin(others)
    rest = stretch.sum(axis=1, keepdims=True) - stretch
    rest_rate = rate.sum(axis=1, keepdims=True) - rate
    size = amplitude[:, :, None, None]
    x = rest[..., None] + size * np.cos(own)
    v = rest_rate[..., None] - omega[:, None, None] * size * np.sin(own)
    mean = np.einsum("sfkj,j->sf", force(x, v), np.exp(-1j * own)) / (OWN_PHASES * OTHER_PHASES)
    return np.asarray(2 * mean / np.maximum(amplitude, 1e-300))


def _phases(count: int) -> Real:
    """Sets of phases that fill the cube of `count` dimensions evenly, (count, `OTHER_PHASES`).

    Multiples of the powers of the generalised golden ratio, the root of g^(count + 1) = g + 1.
    """
    g = 2.0
    for _ in range(30):
        g = (1 + g) ** (1 / (count + 1))
    steps = g ** -np.arange(1.0, count + 1)
    return np.asarray(2 * np.pi * (0.5 + np.outer(steps, np.arange(1, OTHER_PHASES + 1)) % 1))


def _vectorised(law: tuple[int, float, float, float]) -> Force:
    """One of `mechanics.laws.LAWS` for arrays of stretches and rates."""
    kind, a, b, c = law
    if kind == 0:
        return lambda x, v: (a + b * x) * x * x
    if kind == 1:
        return lambda x, v: a * np.tanh(v / b)
    if b == np.inf:
        return lambda x, v: np.zeros_like(x)
    return lambda x, v: a * (np.clip(-x - b, 0.0, c) - max(-b, 0.0))


def _from_table(element: Nonlinear, amplitude: Real, omega: Real) -> Complex:
    """Describing function of a sine of these amplitudes, (n_states, n_frequencies), from a table over amplitude."""
    top = float(np.max(amplitude, initial=0.0))
    if top <= 0:
        return np.zeros((len(amplitude), len(omega)), complex)
    table = np.geomspace(top * 10**-_DECADES, top, _TABLE_POINTS)
    at = np.log(np.maximum(amplitude, table[0]))
    path_only = isinstance(element, BoucWen)
    rates = omega[:1] if path_only else omega
    result = np.empty((len(amplitude), len(rates)), complex)
    for i, w in enumerate(rates):
        values = np.array([_deviation(element, a, float(w)) for a in table])
        result[:, i] = np.interp(at, np.log(table), values.real) + 1j * np.interp(
            at, np.log(table), values.imag
        )
    return np.broadcast_to(result, (len(amplitude), len(omega))).copy() if path_only else result


def _deviation(element: Nonlinear, amplitude: float, omega: float) -> complex:
    try:
        whole = describing_function(element, amplitude, omega, _TABLE_SAMPLES)
    except (EmaError, ArithmeticError, ValueError):
        return complex(np.nan, np.nan)
    return whole - element.tangent_stiffness - 1j * omega * element.tangent_damping
