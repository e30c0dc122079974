"""Simulated sine tests of an isolator with known parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.model import (
    CUBIC,
    DAMPING,
    FORCE,
    GAP,
    QUADRATIC,
    RHO,
    SIGMA,
    STIFFNESS,
    elements,
    loop_force,
)
from ema_pipeline.mechanics.assembly import Damper, Spring
from ema_pipeline.mechanics.laws import Nonlinear

PRINTED: Mapping[str, float] = {
    STIFFNESS: 9.702e4,
    QUADRATIC: -1.12e7,
    CUBIC: -2.33e5,
    DAMPING: 39.69,
    FORCE: 133.25,
    RHO: 631.42,
    SIGMA: 0.169,
}
"""Parameters as the source prints them (exponents as far as its text was recovered)."""

_STEPS = 2000
_CYCLES = 4


def simulate_sine_test(
    values: Mapping[str, float],
    frequency_hz: float,
    amplitude_m: float,
    *,
    sample_rate_hz: float = 5120.0,
    cycles: int = 30,
    noise: float = 0.01,
    random: np.random.Generator | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacement, m, and force, N, of a steady sine test, each (n_samples,).

    Parameters
    ----------
    values : dict of str to float
        Parameters named as in `IsolatorResult.parameters`.
    frequency_hz, amplitude_m, sample_rate_hz : float
    cycles : int
    noise : float
        Standard deviation of white noise as a share of the amplitude of each channel.
    random : numpy Generator, optional
    """
    random = random or np.random.default_rng(0)
    count = round(cycles * sample_rate_hz / frequency_hz)
    phase = np.asarray(frequency_hz * np.arange(count) / sample_rate_hz, dtype=np.float64)
    force = steady_force(values, frequency_hz, amplitude_m, phase)
    displacement = amplitude_m * np.sin(2 * np.pi * phase)
    displacement += noise * amplitude_m * random.standard_normal(count)
    force += noise * 0.5 * np.ptp(force) * random.standard_normal(count)
    return displacement, force


def steady_force(
    values: Mapping[str, float], frequency_hz: float, amplitude_m: float, phase: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Steady force at phases of x = amplitude·sin, with free play too, N, (n_points,)."""
    if not values.get(GAP):
        return loop_force(values, np.array([0.0, 0.0, amplitude_m]), frequency_hz, phase)
    grid = np.arange(_CYCLES * _STEPS) / _STEPS
    force = _through_play(values, frequency_hz, amplitude_m * np.sin(2 * np.pi * grid))[-_STEPS:]
    return np.interp(phase, grid[:_STEPS], force, period=1.0)


def _through_play(
    values: Mapping[str, float], frequency_hz: float, x: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Force step by step: contact is lost where the force would turn, and found again at the end of the play."""
    parts, half, step = elements(values), 0.5 * values[GAP], 1 / (frequency_hz * _STEPS)
    states = [getattr(one, "start", 0.0) for one in parts]
    stretch, side = 0.0, 0.0
    force = np.zeros(len(x))
    for k, position in enumerate(x.tolist()):
        if side == 0.0 and abs(position - stretch) >= half:
            side = 1.0 if position > stretch else -1.0
        wanted = position - side * half if side else stretch
        total, after = 0.0, []
        for one, state in zip(parts, states, strict=True):
            rate = (wanted - stretch) / step
            if isinstance(one, Nonlinear):
                deviation, _, _, state = one.step(stretch, wanted, rate, state, step)
                total += deviation + one.tangent_stiffness * wanted
            elif isinstance(one, Damper):
                total += one.coefficient * rate
            elif isinstance(one, Spring):
                total += one.stiffness * wanted
            after.append(state)
        if side and total * side < 0:
            side = 0.0
            continue
        force[k] = total if side else 0.0
        stretch, states = wanted, after
    return force


def write_sine_tests(
    out: Path,
    values: Mapping[str, float],
    frequencies_hz: Sequence[float] = (10.0, 12.0, 15.0),
    amplitudes_m: Sequence[float] = (1e-3, 1.5e-3, 2e-3),
    *,
    noise: float = 0.01,
    seed: int = 0,
    sample_rate_hz: float = 5120.0,
) -> int:
    """Write a raw folder with one CSV record per frequency and amplitude; return their number."""
    out.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    lines = [
        "schema = 1",
        'kind = "hysteresis"',
        'title = "Simulated isolator"',
        'rig = "isolator"',
        f"sample_rate_hz = {sample_rate_hz}",
    ]
    for name, unit in (("force", "N"), ("displacement", "m")):
        lines += ["", "[[channels]]", f'name = "{name}"', f'quantity = "{name}"', f'unit = "{unit}"']
    count = 0
    for f in frequencies_hz:
        for amplitude in amplitudes_m:
            x, force = simulate_sine_test(
                values, f, amplitude, noise=noise, random=random, sample_rate_hz=sample_rate_hz
            )
            file = f"{f:g}Hz_{1e3 * amplitude:g}mm.csv"
            table = np.column_stack([force, x])
            np.savetxt(out / file, table, delimiter=",", header="force,displacement", comments="", fmt="%.9g")
            lines += [
                "",
                "[[records]]",
                f'file = "{file}"',
                f"frequency_hz = {f}",
                f"amplitude_m = {amplitude}",
            ]
            count += 1
    (out / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return count
