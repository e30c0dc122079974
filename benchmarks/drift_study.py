"""Intervals of frequencies where the rig drifts, from simulated frequencies of single hits.

    python benchmarks/drift_study.py --cases 300

One to five points are struck two to five times each; two to eight peaks show with random strengths, in half of the
tests on two points each peak on one point only ("apart"). All frequencies drift together by 0.01 to 0.2 %: along a
line, along a line with scatter, along a decaying exponential, from hit to hit, from point to point, both, or with
20 to 40 hits that keep 0.7 of what the one before had moved by. The true frequency is that without drift
or, of a line and an exponential, the mean over hits.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from ema_pipeline.modal.drift.shifts import movement

INSIDE = 1.645
"""Standard deviations of a 90 % interval."""

KINDS = ("line", "line and scatter", "exponential", "hits", "points", "hits and points", "alike", "none")


@dataclass(frozen=True)
class Case:
    """Relative frequencies of single hits: shift, std, strength (n_hits, n_peaks); point (n_hits,)."""

    shift: np.ndarray
    std: np.ndarray
    strength: np.ndarray
    point: np.ndarray
    size: float
    apart: bool


def case(rng: np.random.Generator, kind: str) -> Case:
    """One random test."""
    normal = rng.standard_normal
    fewest = 2 if "points" in kind else 1  # one point shows nothing of what differs from point to point
    n_points, per_point = int(rng.choice([k for k in (1, 2, 3, 5) if k >= fewest])), int(rng.integers(2, 6))
    if kind == "alike":
        n_points, per_point = int(rng.integers(20, 40)), 1
    n_peaks = int(rng.integers(2, 9))
    point = np.repeat(np.arange(n_points), per_point)
    n = len(point)
    order = np.linspace(-0.5, 0.5, n)
    size = float(np.exp(rng.uniform(np.log(1e-4), np.log(2e-3))))
    decaying = np.exp(-3 * (order + 0.5))
    keeping = normal(n)
    for k in range(1, n):
        keeping[k] = 0.7 * keeping[k - 1] + np.sqrt(1 - 0.7**2) * keeping[k]
    drift = (
        size
        * {
            "line": lambda: order,
            "line and scatter": lambda: order + normal(n) / 10,
            "exponential": lambda: decaying - decaying.mean(),
            "hits": lambda: normal(n) / 3,
            "points": lambda: normal(n_points)[point] / 3,
            "hits and points": lambda: normal(n_points)[point] / 4 + normal(n) / 4,
            "alike": lambda: keeping / 3,
            "none": lambda: np.zeros(n),
        }[kind]()
    )
    shown = np.abs(normal((n_points, n_peaks))) + 0.03
    apart = n_points == 2 and rng.random() < 0.5
    if apart:
        side = np.arange(n_peaks) % 2
        shown = np.where(side == np.arange(2)[:, None], shown, 0.01 * shown)
    strength = shown[point]
    noise = np.exp(rng.uniform(np.log(3e-6), np.log(3e-5))) / strength
    shift = drift[:, None] + noise * normal((n, n_peaks))
    std = np.where(noise < 6e-4, noise, np.inf)
    known = 2 * np.isfinite(std).sum(axis=0) >= n  # as peaks are followed
    return Case(shift[:, known], std[:, known], strength[:, known], point, size, apart)


def judged(test: Case) -> np.ndarray:
    """Error of every peak's frequency and its standard deviation, (n_peaks, 2)."""
    power = np.where(np.isfinite(test.std), test.strength**2, 0.0)
    share = power / power.sum(axis=0)
    pole = np.sum(share * test.shift, axis=0)
    found = movement(
        test.shift - pole, test.std, test.strength / np.median(test.strength, axis=0), test.point
    )
    noise = np.sqrt(np.sum(np.where(share > 0, share * test.std, 0.0) ** 2, axis=0))
    left = np.array([found.error.mean_std(of_peak) for of_peak in share.T])
    return np.stack([pole - share.T @ found.common, np.hypot(left, noise)], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=300)
    cases = parser.parse_args().cases
    print("drift              apart  tests  inside 90 %  std / drift  error / drift (medians)")
    for number, kind in enumerate(KINDS):
        rng = np.random.default_rng(number)
        tests = [t for t in (case(rng, kind) for _ in range(cases)) if t.shift.size]
        found = [judged(t) for t in tests]
        for apart in (False, True):
            chosen = [(t, f) for t, f in zip(tests, found, strict=True) if t.apart == apart]
            if not chosen:
                continue
            inside = np.mean([np.mean(np.abs(f[:, 0]) < INSIDE * f[:, 1]) for _, f in chosen])
            std = np.median([np.median(f[:, 1]) / t.size for t, f in chosen])
            error = np.median([np.median(np.abs(f[:, 0])) / t.size for t, f in chosen])
            where = "yes" if apart else "no"
            print(
                f"{kind:18} {where:5} {len(chosen):6} {100 * inside:10.1f} % {std:12.3f} {error:12.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
