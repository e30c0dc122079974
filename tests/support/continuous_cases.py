"""Raw folders of continuous tests, simulated from the equations of motion in plain Python."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

RATE = 512.0
MASS, DAMPING, STIFFNESS = 2.0, 20.0, 5e4
Law = Callable[[float, float], float]


class Multisine:
    """Sum of cosines of equal size and random phases, one period of `samples`."""

    def __init__(self, samples: int, low_hz: float, high_hz: float, rms: float, seed: int) -> None:
        self.samples, random = samples, np.random.default_rng(seed)
        self.lines = np.arange(int(np.ceil(low_hz * samples / RATE)), int(high_hz * samples / RATE) + 1)
        self.phase = random.uniform(0, 2 * np.pi, len(self.lines))
        self.size = rms * np.sqrt(2 / len(self.lines))

    def points(self, per_sample: int, count: int) -> NDArray[np.float64]:
        """The first `count` of so many points per sample, no more than a period."""
        all_ = self.samples * per_sample
        assert count <= all_
        spectrum = np.zeros(all_ // 2 + 1, complex)
        spectrum[self.lines] = 0.5 * all_ * self.size * np.exp(1j * self.phase)
        return np.fft.irfft(spectrum, all_)[:count]


def respond(
    force: Multisine, law: Law, samples: int, skipped: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Force and displacement of an oscillator with one more force law(x, v), from rest, `skipped` samples left out."""
    fine = 8
    count = (samples + skipped) * fine
    known = force.points(2 * fine, 2 * count + 1)
    x, v, step = 0.0, 0.0, 1 / (RATE * fine)
    found = np.empty(samples)

    def rate(x: float, v: float, f: float) -> tuple[float, float]:
        return v, (f - DAMPING * v - STIFFNESS * x - law(x, v)) / MASS

    for k in range(count):
        if k % fine == 0 and k // fine >= skipped:
            found[k // fine - skipped] = x
        a = rate(x, v, known[2 * k])
        b = rate(x + step / 2 * a[0], v + step / 2 * a[1], known[2 * k + 1])
        c = rate(x + step / 2 * b[0], v + step / 2 * b[1], known[2 * k + 1])
        d = rate(x + step * c[0], v + step * c[1], known[2 * k + 2])
        x += step / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        v += step / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    return known[:: 2 * fine][skipped : skipped + samples], found


def write_oscillator(
    folder: Path, law: Law, noise: float = 0.005, seed: int = 1, samples: tuple[int, int] = (2048, 1024)
) -> Path:
    """A raw folder with a record to fit and one held out, of so many samples."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    with h5py.File(folder / "records.h5", "w") as file:
        forces, responses = [], []
        for k, count in enumerate(samples):
            force, x = respond(Multisine(8192, 5.0, 60.0, 30.0, seed + k), law, count, 512)
            forces.append(force)
            responses.append(x + noise * np.std(x) * random.standard_normal(len(x)))
        file["force"], file["x"] = np.concatenate(forces), np.concatenate(responses)
    (folder / "test.toml").write_text(
        f"""schema = 1
kind = "continuous"
sample_rate_hz = {RATE}
channels = [
  {{ name = "force", quantity = "force", unit = "N", dof = "mass.x" }},
  {{ name = "x", quantity = "displacement", unit = "m", dof = "mass.x" }},
]
[[records]]
file = "records.h5"
name = "one"
excitation = "multisine"
last_sample = {samples[0] - 1}
[[records]]
file = "records.h5"
name = "two"
excitation = "multisine"
first_sample = {samples[0]}
use = "held_out"
transient_samples = 50
"""
    )
    return folder


RIG = """masses = [{ at = "mass.x", value = 1.0 }]
springs = [{ at = "mass.x", value = 1e4 }]
"""
