"""Time of the poles of all orders and of their selection: ours against sdypy-EMA, in one run.

    python benchmarks/bench_lscf.py [--large]

BLAS is pinned to one thread, neither side uses threads of its own, and both run in turns. Poles are compared too.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from pairing import Paired, paired
from simulate_modal import TrueSystem, random_system

from ema_pipeline.modal.lscf import common_denominator_poles
from ema_pipeline.modal.plscf import polyreference_poles
from ema_pipeline.modal.pole_tracks import link
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.threads import single_blas_thread

SIZES = ((12, 4096, 60), (100, 4096, 60), (400, 16384, 100))
"""Channels, lines, orders as sdypy-EMA counts them (our polynomials have twice the order)."""

LOWER_HZ = 50


@dataclass(frozen=True)
class Comparison:
    """Times of both, and the largest relative distance from a stable pole of sdypy-EMA to the nearest of ours."""

    time: Paired
    distance: float


def simulated(channels: int, lines: int, references: int) -> tuple[TrueSystem, np.ndarray, np.ndarray]:
    """A system of 12 modes, frequencies and noisy FRFs."""
    rng = np.random.default_rng(0)
    system = random_system(rng, n_modes=12, n_dofs=channels, low_hz=100, high_hz=0.85 * lines)
    frequency = np.arange(lines + 1, dtype=float)
    frf = system.accelerance(frequency, list(range(channels)), list(range(references)))
    frf += 0.01 * np.abs(frf).mean() * (rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape))
    return system, frequency, frf


def peer_model(frequency: np.ndarray, frf: np.ndarray, order: int) -> Any:
    """Model of sdypy-EMA of the first reference."""
    from sdypy import EMA

    upper = float(frequency[-1])
    return EMA.Model(frf[:, 0], frequency, lower=LOWER_HZ, upper=upper, pol_order_high=order)


def poles(channels: int, lines: int, order: int, turns: int) -> Comparison:
    """All orders of the common-denominator LSCF."""
    _, frequency, frf = simulated(channels, lines, 1)
    model = peer_model(frequency, frf, order)
    orders = list(range(2, 2 * order + 1, 2))
    data, grid = model.frf[:, LOWER_HZ:], len(model.freq) - 1

    def ours() -> list[np.ndarray]:
        return common_denominator_poles(data, 2 * np.pi, LOWER_HZ, grid, orders)

    def peer() -> None:
        model.get_poles(show_progress=False)

    time = paired(ours, peer, turns)
    return Comparison(time, farthest(model.all_poles, ours(), 2 * np.pi * model.freq[-1]))


def farthest(theirs: list[np.ndarray], mine: list[np.ndarray], top: float) -> float:
    """Largest relative distance from a stable pole of theirs to the nearest of mine, ends of the band left out."""
    distance = 0.0
    for one, other in zip(theirs, mine, strict=True):
        inside = (one.imag > 1e-6 * top) & (one.imag < 0.999 * top) & (one.real < 0)
        for pole in one[inside]:
            distance = max(distance, float(np.min(np.abs(other - pole)) / abs(pole)))
    return distance


def chart(turns: int) -> tuple[Paired, Paired]:
    """A whole chart of 12 modes, 12 responses: poles, and selection.

    Ours is the polyreference chart of two references and picks by itself; sdypy-EMA is given the true frequencies.
    """
    system, frequency, frf = simulated(12, 4096, 2)
    model = peer_model(frequency, frf, 60)
    band = frequency >= LOWER_HZ
    omega, weight, orders = 2 * np.pi * frequency[band], np.ones(band.sum()), list(range(2, 61))

    def build() -> PoleSet:
        return polyreference_poles(omega, frf[..., band], weight, orders)

    made = build()
    time = paired(build, lambda: model.get_poles(show_progress=False), turns)
    wanted = system.frequency_hz.tolist()
    return time, paired(lambda: link(made), lambda: model.select_closest_poles(wanted), turns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", action="store_true", help="also 400 channels, 16384 lines, order 100")
    parser.add_argument("--turns", type=int, default=7)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with single_blas_thread():
        for size in SIZES if args.large else SIZES[:2]:
            found = poles(*size, max(3, args.turns // (1 + size[0] // 200)))
            print("{} channels, {} lines, order {}: ".format(*size), end="")
            print(f"{found.time}; poles equal to {found.distance:.1e}")
        build, select = chart(args.turns)
        print(f"chart: poles {build}")
        print(f"chart: selection {select}")


if __name__ == "__main__":
    main()
