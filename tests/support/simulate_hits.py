"""Simulated hammer hits: pulses through filter, AC coupling and converter, on random modal systems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ema_pipeline.dof import Dof
from ema_pipeline.ingest.records import Record, ResponseChannel

SHAPES = ("half-sine", "haversine", "gaussian", "beta", "skew gaussian")


@dataclass(frozen=True)
class Blow:
    """A hammer blow; `second` is (ratio, delay in s, width in s) of a second impact."""

    rate_hz: float
    shape: str
    width_s: float
    second: tuple[float, float, float] | None = None
    ringing: tuple[float, float, float] | None = None
    high_pass_hz: float | None = None
    linear_phase: bool = True
    noise: float = 1e-3
    bits: int = 16
    pre_s: float = 0.02
    length_s: float = 0.4


def pulse_shape(shape: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pulse with peak 1 over 0 < x < 1."""
    inside = np.clip(x, 0, 1)
    if shape == "half-sine":
        return np.sin(np.pi * inside)
    if shape == "haversine":
        return np.sin(np.pi * inside) ** 2
    if shape == "gaussian":
        return np.exp(-0.5 * ((x - 0.5) * 6) ** 2)
    if shape == "beta":
        top = 1.2 / 3.4
        return (inside / top) ** 1.2 * ((1 - inside) / (1 - top)) ** 2.2
    return np.exp(-0.5 * ((x - 0.35) / np.where(x < 0.35, 0.35, 0.65) * 3) ** 2)


def force_of(blow: Blow, rng: np.random.Generator) -> NDArray[np.float64]:
    """Force samples: pulses at 200 kHz, filtered, decimated, AC-coupled, with noise, offset and steps."""
    over = max(1, int(np.ceil(200e3 / blow.rate_hz)))
    fast = blow.rate_hz * over
    time = np.arange(int(blow.length_s * fast)) / fast
    start = blow.pre_s + rng.uniform(0, 2) / blow.rate_hz
    force = pulse_shape(blow.shape, (time - start) / blow.width_s)
    if blow.second is not None:
        ratio, delay, width = blow.second
        force = force + ratio * pulse_shape(blow.shape, (time - start - delay) / width)
    if blow.ringing is not None:
        frequency, damping, share = blow.ringing
        t = time[: int(0.05 * fast)]
        answer = np.exp(-2 * np.pi * frequency * damping * t) * np.sin(2 * np.pi * frequency * t)
        swing = signal.fftconvolve(force, answer)[: force.size]
        force = force + share * swing / np.abs(swing[int((start + blow.width_s) * fast) :]).max()
    if over > 1 and blow.linear_phase:
        force = signal.resample_poly(force, 1, over, window=("kaiser", 8.0))
    elif over > 1:
        force = signal.sosfilt(signal.ellip(8, 0.05, 90, 0.78 / over, output="sos"), force)[::over]
    if blow.high_pass_hz is not None:
        keep = 1 / (1 + 2 * np.pi * blow.high_pass_hz / blow.rate_hz)
        force = signal.lfilter([keep, -keep], [1, -keep], force)
    force = force / np.abs(force).max() + blow.noise * rng.standard_normal(force.size)
    full_scale = rng.uniform(1.2, 4)
    step = 2 * full_scale / 2**blow.bits
    return 80 * np.round(force / step) * step + rng.normal()


def random_blow(rng: np.random.Generator, double: bool) -> Blow:
    """A blow at 4 to 51.2 kHz, 0.3 to 4 ms wide; some hammers ring, some amplifiers droop."""
    width = float(np.exp(rng.uniform(np.log(0.3e-3), np.log(4e-3))))
    ratio = 0.05 if rng.random() < 0.4 else float(np.exp(rng.uniform(np.log(0.05), np.log(0.8))))
    delay = float(np.exp(rng.uniform(np.log(2e-3), np.log(50e-3))))
    return Blow(
        rate_hz=float(np.exp(rng.uniform(np.log(4000), np.log(51200)))),
        shape=SHAPES[rng.integers(len(SHAPES))],
        width_s=width,
        second=(ratio, delay, width * rng.uniform(0.8, 1.25)) if double else None,
        ringing=(rng.uniform(300, 4000), rng.uniform(0.01, 0.1), rng.uniform(0, 0.02))
        if rng.random() < 0.3
        else None,
        high_pass_hz=rng.uniform(0.1, 3) if rng.random() < 0.4 else None,
        linear_phase=bool(rng.random() < 0.5),
        pre_s=rng.uniform(0.005, 0.05),
    )


def modal_response(
    force: NDArray[np.float64],
    rate_hz: float,
    poles: NDArray[np.complex128],
    residues: NDArray[np.complex128],
) -> NDArray[np.float64]:
    """Response 2·Re Σ R·(exp(st) * f), the force held between samples: exact poles at any rate."""
    out = np.zeros(force.size)
    for pole, residue in zip(poles, residues, strict=True):
        z = np.exp(pole / rate_hz)
        out += 2 * np.real(signal.lfilter([residue / rate_hz], [1, -z], force.astype(complex)))
    return out


def record_of(
    force: NDArray[np.float64],
    responses: NDArray[np.float64],
    rate_hz: float,
    file: str = "r.csv",
    impact: str = "p0.z",
    force_full_scale: float = float("inf"),
    full_scale: float = float("inf"),
) -> Record:
    """A record of one hammer and some accelerometers p0.z, p1.z, …"""
    channels = tuple(
        ResponseChannel(f"a{i}", Dof(f"p{i}", "z"), "acceleration", full_scale=full_scale)
        for i in range(len(responses))
    )
    return Record(
        file,
        Dof.parse(impact),
        rate_hz,
        "hammer",
        force,
        np.atleast_2d(responses),
        channels,
        force_full_scale,
    )


def random_record(rng: np.random.Generator, double: bool = False, channels: int = 2) -> Record:
    """A random blow on a random modal system, its responses decayed at the end."""
    blow = random_blow(rng, double)
    force = force_of(blow, rng)
    n_modes = rng.integers(3, 8)
    frequency = np.exp(rng.uniform(np.log(60), np.log(0.35 * blow.rate_hz), n_modes))
    damping = np.maximum(rng.uniform(0.005, 0.03, n_modes), 20 / (2 * np.pi * frequency))
    poles = 2 * np.pi * frequency * (-damping + 1j * np.sqrt(1 - damping**2))
    responses = []
    for _ in range(channels):
        answer = modal_response(force - np.median(force), blow.rate_hz, poles, 1j * rng.normal(size=n_modes))
        answer += 1e-3 * np.abs(answer).max() * rng.standard_normal(answer.size)
        step = np.abs(answer).max() / 2**14
        responses.append(np.round(answer / step) * step + 5 * step * rng.normal())
    return record_of(force, np.array(responses), blow.rate_hz)
