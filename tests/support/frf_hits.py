"""A structure of three modes whose FRFs are known exactly, and hits on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from simulate_hits import modal_response

from ema_pipeline.dof import Dof
from ema_pipeline.frf import FrfSet
from ema_pipeline.ingest.records import Hit, HitSamples, ResponseChannel

RATE = 2048.0
POLES = np.array([-6 + 2j * np.pi * 80, -9 + 2j * np.pi * 143.3, -12 + 2j * np.pi * 310])


def half_sine(n: int, start: int, width: int, height: float) -> NDArray[np.float64]:
    """A half-sine pulse of `width` samples."""
    force = np.zeros(n)
    force[start : start + width] = height * np.sin(np.pi * (np.arange(width) + 0.5) / width)
    return force


def hit_of(
    force: NDArray[np.float64],
    responses: NDArray[np.float64],
    impact: str = "p0.z",
    outputs: tuple[str, ...] | None = None,
    file: str = "r",
) -> HitSamples:
    """A whole record as one hit."""
    outputs = outputs or tuple(f"p{i}.z" for i in range(len(responses)))
    channels = tuple(
        ResponseChannel(f"a{i}", Dof.parse(d), "acceleration", 0.01 * i) for i, d in enumerate(outputs)
    )
    hit = Hit(file, 1, Dof.parse(impact), 0, force.size, int(np.argmax(np.abs(force))), float(force.max()))
    return HitSamples(hit, RATE, force, responses, channels)


def residues(output: int) -> NDArray[np.complex128]:
    """Residues of the test structure."""
    return np.random.default_rng(100 + output).normal(size=3) * np.array([80j, 140j, 310j])


def exact(frequency_hz: NDArray[np.float64], output: int, decay: float = 0.0) -> NDArray[np.complex128]:
    """FRF of `modal_response` (a sampled system, so a rational function of z) with added decay."""
    z = np.exp(2j * np.pi * frequency_hz / RATE)
    total = np.zeros(frequency_hz.size, dtype=complex)
    for pole, residue in zip(POLES, residues(output), strict=True):
        for s, a in ((pole, residue), (pole.conjugate(), residue.conjugate())):
            total += a / RATE / (1 - np.exp((s - decay) / RATE) / z)
    return total


def error(frfs: FrfSet, row: int, column: int, output: int) -> float:
    """Largest error of an FRF below 0.8 of the Nyquist frequency, over its largest value."""
    lines = slice(1, int(0.8 * frfs.frequency_hz.size))
    true = exact(frfs.frequency_hz[lines], output)
    return float(np.abs(frfs.frf[row, column, lines] - true).max() / np.abs(true).max())


def clean_hits(n_hits: int, n: int, outputs: int = 2, noise: float = 0.0, seed: int = 0) -> list[HitSamples]:
    """Hits of varying force and width on the test structure."""
    rng = np.random.default_rng(seed)
    hits = []
    for k in range(n_hits):
        force = half_sine(n, 20, 5 + k % 3, rng.uniform(50, 100))
        answers = np.array([modal_response(force, RATE, POLES, residues(o)) for o in range(outputs)])
        hits.append(hit_of(force, answers + noise * rng.standard_normal(answers.shape), file=f"r{k}"))
    return hits
