"""Simulator of hammer tests at several force levels, for the tests and the study of force levels.

Each hit meets a linear system, whose modes may move from hit to hit: their change with the force is known exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.ingest.records import Hit, HitSamples, ResponseChannel
from ema_pipeline.mechanics.sampling import anti_alias
from ema_pipeline.simulate.hammer import ForceHistory, Pulse

Real = NDArray[np.float64]
RATE_HZ = 2048.0
SAMPLES = 4096
TRIGGER_S = 0.05


@dataclass(frozen=True)
class Case:
    """A modal system and how it is struck; `mode` moves by `shift` (relative) from the softest to the hardest.

    Its size in the FRFs is in proportion to the force to the power of `growth`.
    """

    frequency_hz: Real
    damping: Real
    shapes: Real
    n_points: int
    forces_n: Real
    hits_per_level: int
    noise: float
    hammer_noise: float
    hand: float
    mode: int = 0
    frequency_shift: float = 0.0
    damping_shift: float = 0.0
    growth: float = 0.0


LINEAR = Case(
    frequency_hz=np.array([80.0, 130.0, 215.0]),
    damping=np.array([0.008, 0.006, 0.01]),
    shapes=np.array([[1.0, 0.6, -0.4, 0.8], [0.7, -1.0, 0.5, 0.3], [-0.5, 0.8, 1.0, 0.6]]),
    n_points=2,
    forces_n=np.array([20.0, 60.0, 180.0]),
    hits_per_level=2,
    noise=3e-3,
    hammer_noise=1e-4,
    hand=0.1,
)


def random_case(rng: np.random.Generator) -> Case:
    """A linear case."""
    n = int(rng.integers(3, 10))
    frequency = np.sort(rng.uniform(40, 650, n))
    for k in range(1, n):
        frequency[k] = max(frequency[k], frequency[k - 1] * (1 + rng.choice([0.008, 0.03, 0.05])))
    n_out = int(rng.integers(4, 13))
    levels = int(rng.integers(2, 5))
    return Case(
        frequency,
        np.exp(rng.uniform(np.log(0.003), np.log(0.02), n)),
        rng.normal(size=(n, n_out)),
        int(rng.integers(1, 5)),
        20.0 * rng.uniform(2.0, 3.5) ** np.arange(levels),
        int(rng.integers(1, 5)),
        float(np.exp(rng.uniform(np.log(3e-5), np.log(0.03)))),
        float(np.exp(rng.uniform(np.log(1e-5), np.log(1e-3)))),
        float(rng.uniform(0.05, 0.2)),
    )


def hits_of(case: Case, rng: np.random.Generator) -> list[HitSamples]:
    """Records of every hit; noise is in proportion to the responses to the softest hits."""
    period = int(scipy.fft.next_fast_len(8 * SAMPLES, real=True))
    axis = np.fft.rfftfreq(period, 1 / RATE_HZ)
    gain = RATE_HZ * anti_alias(axis, RATE_HZ)
    clean = []
    top = float(case.forces_n.max())
    for point in range(case.n_points):
        for level in case.forces_n:
            for _ in range(case.hits_per_level):
                peak = level * np.exp(case.hand * rng.normal())
                # harder blows are shorter (Hertz)
                pulse = Pulse(TRIGGER_S, peak, 2.2e-3 * (level / top) ** -0.1)
                spectrum = gain * ForceHistory((pulse,), RATE_HZ, SAMPLES).spectrum(axis)
                moved = (peak / top) ** 2
                frequency, damping = case.frequency_hz.copy(), case.damping.copy()
                frequency[case.mode] *= 1 + case.frequency_shift * moved
                damping[case.mode] *= 1 + case.damping_shift * moved
                w, wr = 2 * np.pi * axis, 2 * np.pi * frequency[:, None]
                transfer = -(w**2) / (wr**2 - w**2 + 2j * damping[:, None] * wr * w)
                transfer[case.mode] *= (peak / top) ** case.growth
                frf = (case.shapes * case.shapes[:, [point]]).T @ transfer
                force = scipy.fft.irfft(spectrum, period)[:SAMPLES]
                clean.append((point, level, force, scipy.fft.irfft(frf * spectrum, period)[:, :SAMPLES]))
    soft = np.mean([np.std(y, axis=1) for _, level, _, y in clean if level == case.forces_n[0]], axis=0)
    out = []
    for number, (point, _, force, responses) in enumerate(clean):
        noisy = force + case.hammer_noise * case.forces_n[0] * rng.normal(size=SAMPLES)
        records = responses + case.noise * soft[:, None] * rng.normal(size=responses.shape)
        channels = tuple(
            ResponseChannel(f"a{i}", Dof(f"p{i}", "z"), "acceleration") for i in range(len(soft))
        )
        peak = int(np.argmax(noisy))
        hit = Hit(f"h{number}.csv", 1, Dof(f"p{point}", "z"), 0, SAMPLES, peak, float(noisy[peak]))
        out.append(HitSamples(hit, RATE_HZ, noisy, records, channels))
    return out


def sampled_hit(name: str, force: Real, responses: Real, rate_hz: float) -> HitSamples:
    """A hit on p0.z from its samples; sensors p0.z, p1.z, …, accelerations."""
    channels = tuple(
        ResponseChannel(f"a{i}", Dof(f"p{i}", "z"), "acceleration") for i in range(len(responses))
    )
    peak = int(np.argmax(force))
    hit = Hit(name, 1, Dof("p0", "z"), 0, force.size, peak, float(force[peak]))
    return HitSamples(hit, rate_hz, force, responses, channels)
