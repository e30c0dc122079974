"""Nonlinear elements in motion of several frequencies, each replaced by a complex stiffness per frequency.

The motion after a blow holds all modes at once. An element's force at one of their frequencies is its complex stiffness
times the motion at that frequency; the stiffness depends on the motion at all of them (multiple-input describing
functions [1]_).

References
----------
.. [1] A. Gelb, W. E. Vander Velde, *Multiple-Input Describing Functions and Nonlinear System Design*, 1968,
   chapters 2 and 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.harmonic import describing_function
from ema_pipeline.mechanics.laws import FRICTION, POLYNOMIAL, BoucWen, Nonlinear

_PRIMES = (11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)
_GOLDEN = 0.6180339887498949
_OFFSET_STEPS = 4
_LEAST_SLOPE = 0.3
"""Newton steps to an offset, and the least slope they take: a spring about to buckle has none."""
_LEAST = 1e-30
"""Amplitude, m, below which there is no motion."""
_TABLE_POINTS = 25
_TABLE_SAMPLES = 256
_DECADES = 6.0
"""Amplitudes below the largest by more do not differ from those at rest."""

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Motions:
    """States of motion of an element: sines of several frequencies about an offset.

    Attributes
    ----------
    amplitude : ndarray, (n_states, n_frequencies)
        Of the stretch, m.
    omega : ndarray, (n_frequencies,)
        rad/s, in no fixed ratio.
    """

    amplitude: Real
    omega: Real

    def mean_force(self, element: Nonlinear, offset: Real) -> Real:
        """Mean force beside the tangent's about an offset (n_states,), N; 0 for an element with memory."""
        if element.law is None:
            return np.zeros(len(offset))
        kind, quadratic, cubic, _ = element.law
        if kind == POLYNOMIAL:
            square = 0.5 * np.sum(self.amplitude**2, axis=1)
            return np.asarray(quadratic * (offset**2 + square) + cubic * offset * (offset**2 + 3 * square))
        if kind == FRICTION:  # odd in the rate
            return np.zeros(len(offset))
        from ema_pipeline.mechanics import equivalent_kernel as kernel  # compiled on first use

        found = kernel.mean_force(*element.law[1:], self.amplitude, _phases(len(self.omega)), offset)
        return np.asarray(found)

    def stiffness(self, element: Nonlinear, offset: Real) -> Complex:
        """Complex stiffness beside the tangent at every frequency, N/m, (n_states, n_frequencies).

        Averaged over the phases of all frequencies for an element without memory; for one with memory, that of a single
        sine whose amplitude is the root of the sum of squares.
        """
        law = element.law
        if law is None:
            return _from_table(element, np.sqrt(np.sum(self.amplitude**2, axis=1)), self.omega)
        kind, quadratic, cubic, _ = law
        if kind == POLYNOMIAL:  # E[f cos φ]/E[a cos² φ] with independent phases, exactly
            each = self.amplitude**2
            others = 0.5 * np.sum(each, axis=1, keepdims=True) - 0.5 * each
            about = offset[:, None]
            return (2 * quadratic * about + cubic * (3 * (about**2 + others) + 0.75 * each)).astype(complex)
        from ema_pipeline.mechanics import equivalent_kernel as kernel  # compiled on first use

        phases = _phases(len(self.omega))
        if kind == FRICTION:
            limit, velocity = law[1:3]
            return np.asarray(1j * limit * kernel.friction(velocity, self.amplitude, self.omega, phases))
        k, preload, gap = law[1:]
        if preload == np.inf:
            return np.zeros(self.amplitude.shape, complex)
        return np.asarray(k * kernel.parting(preload, gap, self.amplitude, phases, offset), complex)


def settled_offsets(elements: Sequence[Nonlinear], motions: Sequence[Motions], flexibility: Real) -> Real:
    """Offsets about which elements move whose mean force is not zero, m, (n_elements, n_states).

    Parameters
    ----------
    elements : sequence of Nonlinear
    motions : sequence of Motions
        Of each element.
    flexibility : ndarray, (n_elements, n_elements)
        Static stretch of each per force along each, m/N.

    Notes
    -----
    Quadratic springs and parting teeth push the mean of the motion aside, and their stiffness there is another: of a
    quadratic spring's shift of a frequency this is all but a sixth.
    """
    offset = np.zeros((len(elements), len(motions[0].amplitude)))
    own = np.diag(flexibility)[:, None]
    for _ in range(_OFFSET_STEPS):
        force = np.array([m.mean_force(e, o) for e, m, o in zip(elements, motions, offset, strict=True)])
        if not np.any(force):
            break
        step = 1e-3 * np.array([np.linalg.norm(m.amplitude, axis=1) for m in motions]) + _LEAST
        moved = np.array(
            [m.mean_force(e, o) for e, m, o in zip(elements, motions, offset + step, strict=True)]
        )
        slope = np.maximum(1 + own * (moved - force) / step, _LEAST_SLOPE)
        offset = offset - (offset + flexibility @ force) / slope
    return offset


@cache
def _phases(count: int) -> Real:
    """Sets of phases of `count` frequencies, (count, n_sets).

    A lattice whose first and second moments are exact: of any prime number of sets above twice that of the
    frequencies, each frequency with a step of its own. Offsets in golden ratios keep sums of steps from meeting.
    """
    sets = next(p for p in _PRIMES if p > 2 * count) if 2 * count < _PRIMES[-1] else 2 * count + 1
    steps = np.arange(1, count + 1)
    turns = np.outer(steps, np.arange(sets)) / sets + _GOLDEN * steps[:, None] ** 2
    return np.asarray(2 * np.pi * (turns % 1))


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
