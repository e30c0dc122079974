"""What teeth that part, and friction, change of the modes in single hits, by marching every hit through time.

Teeth part for some hundredths of a second after a blow and are a spring again thereafter: of a mode's decay only the
begin is other than linear, and with it the sizes of all modes that the teeth move. Friction ends a decay, and holds a
body for the rest of the record. No equivalent stiffness tells that, so the hits themselves are marched, from the
recorded force on, in the modes of the linear model. What the elements' forces add to each mode is then read as the fit
of a single hit reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.mechanics.laws import FRICTION, PARTING, Nonlinear
from ema_pipeline.observations.hit_data import HitData
from ema_pipeline.observations.hit_reading import line_weights, read_of_drive

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

_PHASE = 0.4
"""Phase, in rad, by which the highest mode may turn in one step."""
_SLOWEST = 2 * np.pi * 1e-2
"""Rigid-body modes are held by springs so soft that no record sees them, rad/s."""
_LONGER, _FADED = 3.0, 0.02
"""Factor by which the time that is marched is extended until no force is left in its last third; of friction, which
only fades, no more than this share of each hit's largest."""


def parts(element: Nonlinear) -> bool:
    """True for teeth that part, and for all that is loose."""
    return element.law is not None and element.law[0] == PARTING


def rubs(element: Nonlinear) -> bool:
    """True for dry friction."""
    return element.law is not None and element.law[0] == FRICTION


def steps_to_end(data: HitData) -> float:
    """Steps of a march of all hits to the end of their records, about."""
    assert data.pulses is not None
    per_second = max(data.pulses.sample_rate_hz, float(data.omega.max()) / _PHASE)
    return len(data.names) / data.line_hz * per_second


@dataclass(frozen=True)
class Driven:
    """The linear model that blows and elements drive.

    Attributes
    ----------
    omega, decay : ndarray, (n,)
        Of all modes of the model, rad/s and 1/s.
    stretch : ndarray, (n_elements, n)
        Of every element in each mass-normalised shape.
    struck : real or complex ndarray, (h, n)
        Motion of each hit's point along the blow in each shape; complex where it starts with another phase.
    match : ndarray of int, (m,)
        Mode of the model that each hit mode is; -1 for none.
    scale : float
        Factor on all forces.
    """

    omega: Real
    decay: Real
    stretch: Real
    struck: Real | Complex
    match: Integers
    scale: float

    @classmethod
    def of(
        cls,
        data: HitData,
        stretch: Real,
        struck: Real | Complex,
        match: Integers,
        eigenvalues: Real,
        scale: float,
    ) -> Driven:
        """With the poles that were measured where the hits tell them, and the usual damping elsewhere.

        Parameters
        ----------
        data : HitData
        stretch : ndarray, (n_elements, n)
        struck : real or complex ndarray, (h, n)
        match : ndarray of int, (m,)
        eigenvalues : ndarray, (n,)
            (rad/s)².
        scale : float
        """
        omega = np.maximum(np.sqrt(np.maximum(eigenvalues, 0.0)), _SLOWEST)
        decay = omega * np.median(data.usual_damping)
        on = match >= 0
        omega[match[on]], decay[match[on]] = data.omega[on], data.decay[on]
        return cls(omega, decay, stretch, struck, match, scale)


def marched_modes(
    data: HitData, elements: Sequence[Nonlinear], driven: Driven, displacement: Complex
) -> Complex | None:
    """What nonlinear elements change of every mode in every hit: its pole, 1/s, and ln of its size, (2, h, m).

    Parameters
    ----------
    data : HitData
        With `pulses`.
    elements : sequence of Nonlinear
    driven : Driven
    displacement : complex ndarray, (h, m)
        Amplitude of each modal coordinate just after the blow, as measured.

    Returns
    -------
    complex ndarray or None
        None where the motion grows without bound.

    Notes
    -----
    In the envelope z of a mode with pole λ a force f along v adds (j/ω)(v·φ)∫f(τ)exp(-λτ)dτ. Its spectrum is that of
    the force over jω - λ.
    """
    forces, step = _forces(data, elements, driven)
    if forces is None:
        return None
    result = np.zeros((2, *displacement.shape), complex)
    if not np.any(forces):
        return result
    spectra, begin = _spectra(data, forces, step)
    weighed = any(map(rubs, elements))
    sheets = data.sheet if weighed else np.zeros_like(data.sheet)
    for r in np.flatnonzero(driven.match >= 0):
        low, high = data.band_hz[r].tolist()
        lines = np.arange(low, high, data.line_hz)
        own = spectra[:, :, np.rint(lines / data.line_hz).astype(int)] * np.exp(-2j * np.pi * lines * begin)
        drive = 1j / data.omega[r] * np.einsum("j,hjl->hl", driven.stretch[:, driven.match[r]], own)
        s = 2j * np.pi * lines + data.window_decay - complex(-data.decay[r], data.omega[r])
        for sheet in np.unique(sheets):
            on = np.flatnonzero(sheets == sheet)
            heard = on[data.used[on, r]]
            weight = line_weights(s, drive[heard], displacement[heard, r]) if weighed else np.ones(len(s))
            result[:, on, r] = read_of_drive(s, drive[on], displacement[on, r], data.decay[r], weight)
    return result


def _forces(data: HitData, elements: Sequence[Nonlinear], driven: Driven) -> tuple[Real | None, float]:
    """Forces of the elements beside their tangents', (h, n_elements, n_steps), until there are none; step, s."""
    from ema_pipeline.mechanics.modal_response_kernel import march  # compiles at its first use

    pulses = data.pulses
    assert pulses is not None
    rate = pulses.sample_rate_hz
    substeps = max(1, int(np.ceil(driven.omega.max() / rate / _PHASE)))
    poles = np.asarray(1j * driven.omega - driven.decay, np.complex128)
    moved = driven.stretch / (1j * driven.omega)
    rows = np.concatenate([moved, moved * poles])
    laws = np.array([e.law for e in elements], dtype=float)
    nothing = np.zeros((0, len(poles)), complex), np.zeros((0, len(elements)))
    blows, hits, whole = data.blows(substeps), len(pulses.force_n), int(rate / data.line_hz)
    found: Real = np.zeros((hits, len(elements), 0))
    faded = _FADED if any(map(rubs, elements)) else 0.0
    left, count = np.arange(hits), (blows.shape[1] - 1) // substeps + 1
    while len(left):
        count = min(count, whole)
        force = np.zeros((len(left), (count - 1) * substeps + 1))
        cut = min(force.shape[1], blows.shape[1])
        force[:, :cut] = driven.scale * blows[left, :cut]
        inputs = np.concatenate([driven.struck[left], -driven.stretch]).astype(complex)
        marched = march(
            laws,
            poles,
            inputs,
            rows,
            *nothing,
            force,
            1 / (rate * substeps),
            substeps,
            trace=True,
        )
        if marched.failed:
            return None, 0.0
        forces = marched.forces
        found = _lengthened(found, forces.shape[2])
        found[left] = forces
        late = _largest(forces[:, :, forces.shape[2] * 2 // 3 :]) > faded * _largest(forces)
        left = left[late] if count < whole else left[:0]
        count = int(_LONGER * count)
    return found, 1 / (rate * substeps)


def _lengthened(forces: Real, steps: int) -> Real:
    """With nothing after them, (h, n_elements, steps)."""
    longer = np.zeros((*forces.shape[:2], steps))
    longer[:, :, : forces.shape[2]] = forces
    return longer


def _largest(forces: Real) -> Real:
    """Of each hit, (h,)."""
    return np.asarray(np.abs(forces).max(axis=(1, 2), initial=0.0))


def _spectra(data: HitData, forces: Real, step: float) -> tuple[Complex, float]:
    """Of forces at steps, under the exponential window, at the lines of the FRFs, as if they began at once; and when
    they do, counted from the peak, s.
    """
    pulses = data.pulses
    assert pulses is not None
    substeps = round(1 / (pulses.sample_rate_hz * step))
    samples = -(-forces.shape[2] // substeps)
    means = _lengthened(forces, samples * substeps).reshape(*forces.shape[:2], samples, substeps).mean(axis=3)
    time = (np.arange(samples) + 0.5 * (substeps - 1) / substeps - pulses.peak) / pulses.sample_rate_hz
    whole = round(pulses.sample_rate_hz / data.line_hz)
    spectra = rfft(means * np.exp(-data.window_decay * time), whole, axis=2) / pulses.sample_rate_hz
    return np.asarray(spectra, np.complex128), float(time[0])
