"""Time of the poles of all orders: common-denominator LSCF against sdypy-EMA, in one run.

OPENBLAS_NUM_THREADS=1 python benchmarks/bench_lscf.py [--large]
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from simulate_modal import random_system

from ema_pipeline.modal.lscf import common_denominator_poles
from ema_pipeline.modal.plscf import polyreference_poles
from ema_pipeline.modal.selection import link
from ema_pipeline.threads import single_blas_thread


def timed(work, repeats: int) -> float:
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


def compare(channels: int, lines: int, order: int, repeats: int) -> None:
    from sdypy import EMA

    rng = np.random.default_rng(0)
    system = random_system(rng, n_modes=12, n_dofs=channels, low_hz=100, high_hz=0.85 * lines)
    frequency = np.arange(lines + 1, dtype=float)
    frf = system.accelerance(frequency, list(range(channels)), [0])[:, 0]
    frf += 0.01 * np.abs(frf).mean() * (rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape))
    model = EMA.Model(frf, frequency, lower=50, upper=float(lines), pol_order_high=order)

    def peer() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.get_poles(show_progress=False)

    orders = list(range(2, 2 * order + 1, 2))

    def ours() -> None:
        common_denominator_poles(model.frf[:, 50:], 2 * np.pi, 50, len(model.freq) - 1, orders)

    theirs, mine = timed(peer, max(1, repeats // 2)), timed(ours, repeats)
    print(
        f"{channels} channels, {lines} lines, order {order}: sdypy-EMA {1e3 * theirs:.1f} ms, "
        f"ours {1e3 * mine:.1f} ms, ratio {theirs / mine:.1f}"
    )


def chart() -> None:
    rng = np.random.default_rng(0)
    system = random_system(rng, n_modes=12, n_dofs=12, low_hz=100, high_hz=3500)
    frequency = np.arange(50.0, 4097.0)
    frf = system.accelerance(frequency, list(range(12)), [0, 1])
    frf += 0.01 * np.abs(frf).mean() * (rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape))
    omega, weight, orders = 2 * np.pi * frequency, np.ones(len(frequency)), list(range(2, 61))
    poles = polyreference_poles(omega, frf, weight, orders)
    build = timed(lambda: polyreference_poles(omega, frf, weight, orders), 2)
    select = timed(lambda: link(poles), 3)
    print(
        f"polyreference chart, 12 × 2 FRFs, 59 orders: poles {1e3 * build:.0f} ms, linking {len(poles.pole)} "
        f"poles {1e3 * select:.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", action="store_true", help="also 400 channels, 16384 lines, order 100")
    args = parser.parse_args()
    with single_blas_thread():
        compare(12, 4096, 60, 7)
        compare(12, 4096, 100, 5)
        compare(100, 4096, 60, 5)
        if args.large:
            compare(400, 16384, 100, 2)
        chart()


if __name__ == "__main__":
    main()
