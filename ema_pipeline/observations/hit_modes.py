"""How far nonlinear elements move the modes of single hits, by equivalent linearisation.

A fit of one pole to the spectrum of a whole decay finds a mean of the momentary pole over time. Fitted to all lines its
weight were (2σ)²t·exp(-2σt), which leaves a quarter of the shift that a cubic spring makes at the blow; the band and
the smooth terms of the fit leave less, so the weight is taken from that fit itself. The motions of modes that move in
step add before an element's force is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.equivalent import Motions, settled_offsets
from ema_pipeline.mechanics.laws import POLYNOMIAL, Nonlinear
from ema_pipeline.observations.hit_data import HitData

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

_STILL = 1e-300
_QUASI_STATIC = 0.5
"""Modes below the lowest measured frequency times this take no part in static flexibility: they are slower than the
decay of the motion that pushes the mean aside."""
_NEAR = 0.05
"""Relative distance of squared frequencies within which a mode that is not in step gives no stretch at once."""
_RIGID = 0.02
_SETTLING_STEPS = 3
_MOST_GIVEN = 5.0
"""Change of a stretch by its own force that is not worth a further step, most steps, and largest change allowed."""


@dataclass(frozen=True)
class Linear:
    """What of the linear model the elements' forces act on.

    Attributes
    ----------
    along : ndarray, (n_elements, m)
        Stretch of every element in each hit mode's mass-normalised shape; 0 for a mode that the model has not.
    flexibility : ndarray, (n_elements, n_elements)
        Static stretch per force, m/N.
    elsewhere : ndarray, (n_elements, n_groups)
        Stretch per force at the frequency of each group of modes that all other modes give, m/N.
    displacement : complex ndarray, (h, m)
        Amplitude of each modal coordinate just after the blow.
    """

    along: Real
    flexibility: Real
    elsewhere: Real
    displacement: Complex

    @classmethod
    def of(
        cls, data: HitData, stretch: Real, match: Integers, eigenvalues: Real, displacement: Complex
    ) -> Linear:
        """From the stretch of every element in every mode of the model, (n_elements, n).

        Parameters
        ----------
        data : HitData
        stretch : ndarray, (n_elements, n)
        match : ndarray of int, (m,)
            Mode of the model that each hit mode is; -1 for none.
        eigenvalues : ndarray, (n,)
            (rad/s)².
        displacement : complex ndarray, (h, m)
        """
        along = np.where(match >= 0, stretch[:, match], 0.0)
        lowest = float(data.omega.min())
        flexible = np.where(eigenvalues < (_QUASI_STATIC * lowest) ** 2, 0.0, 1 / eigenvalues)
        elsewhere = np.zeros((len(stretch), len(data.groups)))
        for c, group in enumerate(data.groups):
            square = float(np.mean(data.poles.imag[:, group])) ** 2
            apart = eigenvalues - square
            dynamic = apart / (apart**2 + (_NEAR * square) ** 2)
            dynamic[match[group][match[group] >= 0]] = 0.0
            elsewhere[:, c] = stretch**2 @ dynamic
        return cls(along, (stretch * flexible) @ stretch.T, elsewhere, displacement)


def changed_modes(data: HitData, elements: Sequence[Nonlinear], linear: Linear) -> Complex:
    """What nonlinear elements change of every mode in every hit: its pole, 1/s, and ln of its size, (2, h, m).

    Notes
    -----
    A force G·e^{jωt} along v changes the envelope of the mass-normalised coordinate z by (j/2ω)(v·φ)G per second. What
    the force moves of all other modes changes the stretch at once: a spring of stiffness N in a place that gives
    way by S per force stretches by 1/(1 + NS) of what it did.

    A force with the square of the stretch has the sums and differences of all frequencies. It moves poles in second
    order only, but it sets every mode in motion from the blow on, and that changes sizes in first order.
    """
    total = np.zeros((2, *linear.displacement.shape), complex)
    if not elements:
        return total
    ringing = data.ringing
    centre, step = ringing.omega, ringing.in_step
    z = linear.displacement[:, None] * ringing.motion  # (h, t, m)
    along = np.concatenate([v[:, None] * step for v in linear.along], axis=1)
    paths = np.split((z.reshape(-1, len(step)) @ along), len(elements), axis=1)
    motions = [Motions(np.abs(p), centre) for p in paths]
    offsets = settled_offsets(elements, motions, linear.flexibility)
    force = np.zeros(z.shape, complex)
    for i, (element, motion) in enumerate(zip(elements, motions, strict=True)):
        stiffness = _settled_stiffness(element, motion, offsets[i], linear.elsewhere[i])
        force += linear.along[i] * ((stiffness * paths[i]) @ step.T).reshape(z.shape)
        total += _of_products(data, element, linear.along[i], linear.displacement)
    still = np.abs(z) < _STILL
    ratio = np.where(still, 0.0, force / np.where(still, 1.0, z))
    weighed = (ratio.transpose(2, 0, 1) @ ringing.weights[1].transpose(2, 1, 0)).transpose(2, 1, 0)
    return total + 0.5j / data.omega * weighed


def _of_products(data: HitData, element: Nonlinear, along: Real, displacement: Complex) -> Complex:
    """What the square of an element's stretch changes of every mode in every hit, (2, h, m)."""
    if element.law is None or element.law[0] != POLYNOMIAL or not element.law[1]:
        return np.zeros((2, *displacement.shape), complex)
    stretch = 0.5 * along * displacement
    both = np.concatenate([stretch, stretch.conj()], axis=1)
    a, b = data.ringing.motion_pairs
    driven = (both[:, a] * both[:, b]) @ data.ringing.product_gains
    driven = driven.reshape(len(both), 2, -1).transpose(1, 0, 2)
    still = np.abs(displacement) < _STILL
    relative = np.where(still, 0.0, driven / np.where(still, 1.0, displacement))
    return np.asarray(1j * element.law[1] * along / data.omega * relative, np.complex128)


def _settled_stiffness(element: Nonlinear, motion: Motions, offset: Real, elsewhere: Real) -> Complex:
    """Force over the stretch that the linear model has, once the stretch has settled, (n_states, n_groups)."""
    stiffness = motion.stiffness(element, offset)
    given = _given_way(stiffness, elsewhere)
    for _ in range(_SETTLING_STEPS):
        if np.max(np.abs(given - 1), initial=0.0) < _RIGID:
            break
        settled = Motions(motion.amplitude * np.abs(given), motion.omega)
        stiffness = settled.stiffness(element, offset)
        given = _given_way(stiffness, elsewhere)
    return stiffness * given


def _given_way(stiffness: Complex, elsewhere: Real) -> Complex:
    """Stretch over that of the linear model, within `_MOST_GIVEN`."""
    inverse = 1 + stiffness * elsewhere
    square = inverse.real**2 + inverse.imag**2
    if np.min(square, initial=1.0) < _MOST_GIVEN**-2 or np.max(square, initial=1.0) > _MOST_GIVEN**2:
        size = np.sqrt(square)
        inverse *= np.clip(size, 1 / _MOST_GIVEN, _MOST_GIVEN) / np.maximum(size, 1e-12)
        square = inverse.real**2 + inverse.imag**2
    return np.asarray(inverse.conj() / square)
