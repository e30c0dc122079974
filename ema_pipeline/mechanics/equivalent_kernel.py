"""Compiled loops of `mechanics.equivalent`: forces of elements without memory, averaged over phases."""

from __future__ import annotations

import numba
import numpy as np

from ema_pipeline.mechanics.laws import LAWS, PARTING

_parting = numba.njit(LAWS[PARTING], inline="always")
OWN_PHASES = 8
"""Phases of the frequency itself; the describing function of a sign alone is then 3 % off."""
_NEAR, _FAR = np.sin(np.pi / OWN_PHASES), np.cos(np.pi / OWN_PHASES)
"""Of eight phases half a step from zero, sines and cosines have these two sizes, each four times."""
_SATURATED = 4.97
"""Argument from which the fraction that stands for a hyperbolic tangent is 1, within 1e-4."""


@numba.njit(inline="always")
def _tanh(u):  # type: ignore[no-untyped-def]
    """Continued fraction of tanh to the seventh power; several at a time, which the exact one does not allow."""
    u = min(max(u, -_SATURATED), _SATURATED)
    square = u * u
    above = u * (135135.0 + square * (17325.0 + square * (378.0 + square)))
    return above / (135135.0 + square * (62370.0 + square * (3150.0 + 28.0 * square)))


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def friction(velocity, amplitude, omega, phases):  # type: ignore[no-untyped-def]
    """Equivalent damping of friction of unit force at every frequency, times the frequency.

    Parameters
    ----------
    velocity : float
        m/s, see `laws.DryFriction`.
    amplitude : ndarray, (n_states, n_frequencies)
    omega : ndarray, (n_frequencies,)
    phases : ndarray, (n_frequencies, n_sets)

    Returns
    -------
    ndarray, (n_states, n_frequencies)
        1/m; 0 where the frequency has no motion.
    """
    states, count = amplitude.shape
    sets = phases.shape[1]
    sin = np.sin(phases)
    result = np.zeros((states, count))
    rate, other = np.zeros(sets), np.zeros(sets)
    for s in range(states):
        rate[:] = 0.0
        for k in range(count):
            size = amplitude[s, k] * omega[k] / velocity
            for p in range(sets):
                rate[p] -= size * sin[k, p]
        for k in range(count):
            size = amplitude[s, k] * omega[k] / velocity
            if size <= 0.0:
                continue
            for p in range(sets):
                other[p] = rate[p] + size * sin[k, p]
            total = 0.0
            near, far = size * _NEAR, size * _FAR
            for p in range(sets):
                total += _NEAR * (_tanh(other[p] + near) - _tanh(other[p] - near))
                total += _FAR * (_tanh(other[p] + far) - _tanh(other[p] - far))
            result[s, k] = total / (0.5 * OWN_PHASES / 2 * sets * amplitude[s, k])
    return result


@numba.njit(inline="always")
def _parted(x, preload, gap):  # type: ignore[no-untyped-def]
    """How far teeth are apart, m."""
    return min(max(-x - preload, 0.0), gap)


@numba.njit(cache=True)
def parting(preload, gap, amplitude, phases, offset):  # type: ignore[no-untyped-def]
    """Stiffness that teeth of unit stiffness lose by parting at every frequency, negative, of N/m.

    Parameters
    ----------
    preload, gap : float
        m, see `laws.PartingSpring`.
    amplitude : ndarray, (n_states, n_frequencies)
    phases : ndarray, (n_frequencies, n_sets)
    offset : ndarray, (n_states,)

    Returns
    -------
    ndarray, (n_states, n_frequencies)
        0 where the frequency has no motion.
    """
    states, count = amplitude.shape
    sets = phases.shape[1]
    cos = np.cos(phases)
    result = np.zeros((states, count))
    stretch, other = np.zeros(sets), np.zeros(sets)
    for s in range(states):
        stretch[:] = offset[s]
        reach = 0.0
        for k in range(count):
            size = amplitude[s, k]
            reach += size
            for p in range(sets):
                stretch[p] += size * cos[k, p]
        if preload >= 0.0 and reach - offset[s] <= preload:
            continue  # the teeth do not part
        for k in range(count):
            size = amplitude[s, k]
            if size <= 0.0:
                continue
            for p in range(sets):
                other[p] = stretch[p] - size * cos[k, p]
            total = 0.0
            near, far = size * _NEAR, size * _FAR
            for p in range(sets):
                x = other[p]
                total += _NEAR * (_parted(x + near, preload, gap) - _parted(x - near, preload, gap))
                total += _FAR * (_parted(x + far, preload, gap) - _parted(x - far, preload, gap))
            result[s, k] = total / (0.5 * OWN_PHASES / 2 * sets * size)
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
