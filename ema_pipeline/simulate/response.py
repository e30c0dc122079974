"""What ideal sensors read: band-limited samples, exact for a linear rig."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.modes import complex_modes
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.mechanics.sampling import anti_alias
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.simulate.hammer import ForceHistory
from ema_pipeline.simulate.poles import pole_accelerance

Signals = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Force (n_samples,), N, and accelerations (n_sensors, n_samples), m/s²."""

Respond = Callable[[Assembly, tuple[ForceHistory, ...], Dof, tuple[Dof, ...]], tuple[Signals, ...]]
"""``respond(assembly, histories, impact, sensors)``: force (n,), accelerations (n_sensors, n) per history."""

Transfer = Callable[
    [LinearSystem, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], NDArray[np.complex128]
]

REST = 1e-7
"""The periodic record is so long that responses decay to this share before it starts anew."""

LONGEST = 2**22

FINE_RATE_HZ = 25600.0
"""A nonlinear rig is integrated at this rate or a little above."""

TAIL = 0.05
"""A nonlinear record runs on by this share of its length, so that the filter meets no edge."""


def response(
    assembly: Assembly, histories: tuple[ForceHistory, ...], impact: Dof, sensors: tuple[Dof, ...]
) -> tuple[Signals, ...]:
    """Force and accelerations of each record; see `linear_response` and `integrated_response`."""
    respond = integrated_response if assembly.nonlinear else linear_response
    return respond(assembly, histories, impact, sensors)


def response_by_poles(
    assembly: Assembly, histories: tuple[ForceHistory, ...], impact: Dof, sensors: tuple[Dof, ...]
) -> tuple[Signals, ...]:
    """As `response`, faster where every hit has its own system and every mode its own damping."""
    if assembly.nonlinear:
        return integrated_response(assembly, histories, impact, sensors)
    return linear_response(assembly, histories, impact, sensors, pole_accelerance)


def integrated_response(
    assembly: Assembly, histories: tuple[ForceHistory, ...], impact: Dof, sensors: tuple[Dof, ...]
) -> tuple[Signals, ...]:
    """Force and accelerations of each record of a rig with nonlinear elements, by stepping in time.

    Parameters and result are those of `linear_response`. The steps are `FINE_RATE_HZ` apart; the samples are
    taken behind the same anti-alias filter.
    """
    system = assembly.system()
    rate, n = histories[0].sample_rate_hz, histories[0].n_samples
    factor = int(np.ceil(FINE_RATE_HZ / rate))
    length = scipy.fft.next_fast_len(n + int(np.ceil(TAIL * n)) + 64, real=True)
    time_s = np.arange(length * factor) / (rate * factor)
    fade = np.ones(length * factor)
    fade[n * factor :] = np.cos(0.5 * np.pi * np.linspace(0, 1, (length - n) * factor)) ** 2
    gain = anti_alias(np.asarray(np.fft.rfftfreq(length, 1 / rate), dtype=np.float64), rate) / factor
    ramp = np.sinc(np.fft.rfftfreq(length * factor)) ** 2
    out, into = sensor_rows(system, sensors), sensor_rows(system, (impact,))
    direct = out @ np.linalg.solve(system.mass, into.T)
    results = []
    for history in histories:
        force = np.sum([p.force(time_s) for p in history.pulses], axis=0)
        # Between steps the force runs straight, which acts on the motion like sinc²: taken back here, but not
        # for the part of the acceleration that is the force itself over the mass.
        straight = scipy.fft.irfft(scipy.fft.rfft(force) / ramp, len(force))
        motion = nonlinear_response(assembly, rate * factor, straight[None], out, into).acceleration
        motion += direct * (force - straight)
        signals = np.vstack([force, motion]) * fade
        spectrum = scipy.fft.rfft(signals, axis=-1)[:, : len(gain)] * gain
        sampled = scipy.fft.irfft(spectrum, length, axis=-1)[:, :n]
        results.append((sampled[0], sampled[1:]))
    return tuple(results)


def linear_response(
    assembly: Assembly,
    histories: tuple[ForceHistory, ...],
    impact: Dof,
    sensors: tuple[Dof, ...],
    transfer: Transfer = accelerance,
) -> tuple[Signals, ...]:
    """Force and accelerations of each record.

    The force's spectrum is known in closed form and the accelerance exactly, so their product is sampled
    without an error of time stepping or interpolation; the anti-alias filter acts on force and responses
    alike. The transform's period is long enough for every mode to die out.

    Parameters
    ----------
    assembly : Assembly
    histories : tuple of ForceHistory
        Of equal rate and length.
    impact : Dof
    sensors : tuple of Dof
    transfer : callable
        Accelerance, as `mechanics.frf.accelerance` gives it.

    Returns
    -------
    tuple of (force, accelerations)
        N, (n_samples,), and m/s², (n_sensors, n_samples).

    Raises
    ------
    EmaError
        If a mode is damped too little to die out in any reasonable time.
    """
    system = assembly.system()
    rate, n = histories[0].sample_rate_hz, histories[0].n_samples
    period = scipy.fft.next_fast_len(n + int(np.ceil(rate * _decay_time(system))), real=True)
    if period > LONGEST:
        raise EmaError(
            f"simulated responses ring for {period / rate:.0f} s: give every mode some damping, "
            "e.g. modal_damping_ratio = 0.01"
        )
    frequency_hz = np.asarray(np.fft.rfftfreq(period, 1 / rate), dtype=np.float64)
    of_force = transfer(system, frequency_hz, sensor_rows(system, sensors), sensor_rows(system, (impact,)))[
        :, 0
    ]
    gain = rate * anti_alias(frequency_hz, rate)
    results = []
    for history in histories:
        spectrum = gain * history.spectrum(frequency_hz)
        force = scipy.fft.irfft(spectrum, period)[:n]
        results.append((force, scipy.fft.irfft(of_force * spectrum, period, axis=-1)[:, :n]))
    return tuple(results)


def _decay_time(system: LinearSystem) -> float:
    """Time in which the slowest mode decays to `REST`, s."""
    poles = complex_modes(system).poles
    decay = -poles.real[np.abs(poles) > 0]
    slowest = float(decay.min(initial=np.inf))
    if slowest <= 0:
        return float(LONGEST)
    return float(-np.log(REST) / slowest)
