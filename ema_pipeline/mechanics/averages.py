"""Compiled loops of `mechanics.equivalent`: forces of elements without memory, averaged over phases."""

from __future__ import annotations

import numba
import numpy as np

from ema_pipeline.mechanics.laws import FRICTION, LAWS, PARTING

_parting = numba.njit(LAWS[PARTING], inline="always")
OWN_PHASES = 8
"""Phases of the frequency itself; the describing function of a sign alone is then 3 % off."""
_SATURATED = 20.0
"""Argument from which a hyperbolic tangent is 1 to the last digit."""


@numba.njit(inline="always")
def _force(kind, a, b, c, x, v):  # type: ignore[no-untyped-def]
    """Friction or parting at stretch `x` and rate `v`; the derivative in the law of friction costs as much again."""
    if kind == FRICTION:
        u = v / b
        if abs(u) > _SATURATED:
            return a if u > 0.0 else -a
        return a * np.tanh(u)
    return _parting(x, v, a, b, c)[0]


@numba.njit(cache=True)
def stiffness(kind, a, b, c, amplitude, omega, phases, offset):  # type: ignore[no-untyped-def]
    """Complex stiffness at every frequency.

    Parameters
    ----------
    kind : int
    a, b, c : float
        Numbers of the law.
    amplitude : ndarray, (n_states, n_frequencies)
    omega : ndarray, (n_frequencies,)
    phases : ndarray, (n_frequencies, n_sets)
    offset : ndarray, (n_states,)

    Returns
    -------
    complex ndarray, (n_states, n_frequencies)
        N/m; 0 where the frequency has no motion.
    """
    states, count = amplitude.shape
    sets = phases.shape[1]
    cos, sin = np.cos(phases), np.sin(phases)
    own = 2 * np.pi * (np.arange(OWN_PHASES) + 0.5) / OWN_PHASES
    own_cos, own_sin = np.cos(own), np.sin(own)
    result = np.zeros((states, count), dtype=np.complex128)
    stretch, rate = np.zeros(sets), np.zeros(sets)
    force = np.zeros(OWN_PHASES)
    for s in range(states):
        stretch[:] = offset[s]
        rate[:] = 0.0
        reach = 0.0
        for k in range(count):
            size = amplitude[s, k]
            reach += size
            for p in range(sets):
                stretch[p] += size * cos[k, p]
                rate[p] -= omega[k] * size * sin[k, p]
        if kind == PARTING and b >= 0.0 and reach - offset[s] <= b:
            continue  # the teeth do not part
        for k in range(count):
            size = amplitude[s, k]
            if size <= 0.0:
                continue
            force[:] = 0.0
            for p in range(sets):
                x = stretch[p] - size * cos[k, p]
                v = rate[p] + omega[k] * size * sin[k, p]
                for q in range(OWN_PHASES):
                    force[q] += _force(kind, a, b, c, x + size * own_cos[q], v - omega[k] * size * own_sin[q])
            real = imag = 0.0
            for q in range(OWN_PHASES):
                real += force[q] * own_cos[q]
                imag -= force[q] * own_sin[q]
            result[s, k] = complex(real, imag) * (2 / (OWN_PHASES * sets * size))
    return result


@numba.njit(cache=True)
def mean_force(a, b, c, amplitude, phases, offset):  # type: ignore[no-untyped-def]
    """Mean force of teeth that part, N, (n_states,). Arguments as of `stiffness`."""
    states, count = amplitude.shape
    sets = phases.shape[1]
    cos = np.cos(phases)
    result = np.zeros(states)
    stretch = np.zeros(sets)
    for s in range(states):
        stretch[:] = 0.0
        for k in range(count):
            for p in range(sets):
                stretch[p] += amplitude[s, k] * cos[k, p]
        total = 0.0
        for p in range(sets):  # every set of phases and its opposite
            total += _parting(offset[s] + stretch[p], 0.0, a, b, c)[0]
            total += _parting(offset[s] - stretch[p], 0.0, a, b, c)[0]
        result[s] = total / (2 * sets)
    return result
