"""H1 and coherence (ours with variance) of many channels against sdypy-FRF and scipy, in one run.

    python benchmarks/bench_frf.py

All get the same arrays and run in turns; BLAS is pinned to one thread. Ours works on blocks of channels in as many
threads as its settings say (two unless told otherwise), or in one; the peers know one.
"""

from __future__ import annotations

import argparse
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pairing import Paired, paired
from scipy.signal import csd

from ema_pipeline.dof import Dof
from ema_pipeline.frf import FrfSet, FrfSettings, estimate_frfs
from ema_pipeline.ingest.records import Hit, HitSamples, ResponseChannel
from ema_pipeline.threads import single_blas_thread

RATE_HZ = 25600.0


def data(
    channels: int, hits: int, samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[ResponseChannel, ...]]:
    """Force (hits, 1, samples), responses (hits, channels, samples) and the channels' description."""
    rng = np.random.default_rng(1)
    force = 0.01 * rng.standard_normal((hits, 1, samples))
    force[:, 0, 100:110] += np.hanning(12)[1:-1] * rng.uniform(80, 120, (hits, 1))
    decay = np.exp(-np.arange(samples) / (0.1 * samples))
    responses = rng.standard_normal((hits, channels, samples))
    responses *= decay
    described = tuple(ResponseChannel(f"c{i}", Dof(f"p{i}", "z"), "acceleration") for i in range(channels))
    return force, responses, described


def ours(
    force: NDArray[np.float64],
    responses: NDArray[np.float64],
    channels: tuple[ResponseChannel, ...],
    settings: FrfSettings,
) -> FrfSet:
    """Our estimate from views of the same arrays."""
    n = force.shape[-1]

    def stream() -> Iterator[HitSamples]:
        for i in range(force.shape[0]):
            hit = Hit(f"r{i}", 0, Dof("p0", "z"), 0, n, 105, 100.0)
            yield HitSamples(hit, RATE_HZ, force[i, 0], responses[i], channels)

    return estimate_frfs(stream(), settings)


def peer(
    force: NDArray[np.float64], responses: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """The estimate of sdypy-FRF."""
    from sdypy import FRF

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frf = FRF.FRF(int(RATE_HZ), exc=force, resp=responses, resp_type="d", copy=False)
        return frf.get_H1(), frf.get_coherence()


def scipy_peer(
    force: NDArray[np.float64], responses: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """The estimate by scipy.signal.csd, one channel after the other, hits as segments without overlap."""
    n = force.shape[-1]
    options = {"fs": RATE_HZ, "window": "boxcar", "nperseg": n, "noverlap": 0, "detrend": False}
    x = force[:, 0].reshape(-1)
    sxx = csd(x, x, **options)[1].real
    frf, coherence = [], []
    for k in range(responses.shape[1]):
        y = responses[:, k].reshape(-1)
        sxy, syy = csd(x, y, **options)[1], csd(y, y, **options)[1].real
        frf.append(sxy / sxx)
        coherence.append(np.abs(sxy) ** 2 / (sxx * syy))
    return np.array(frf), np.array(coherence)


def peak_memory(work: Callable[[], object]) -> int:
    """Peak of memory allocated meanwhile, results included, bytes."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


@dataclass(frozen=True)
class Comparison:
    """Times of ours with two threads and with one against sdypy-FRF, of ours with two against scipy.

    Memory is the peak of what is allocated, results included, as a share of the records.
    """

    two_threads: Paired
    one_thread: Paired
    scipy: Paired
    memory_ours: float
    memory_peer: float
    memory_scipy: float


def compare(n_channels: int, hits: int, samples: int, turns: int) -> Comparison:
    """All of the comparison; the estimates must agree."""
    force, responses, channels = data(n_channels, hits, samples)
    size = force.nbytes + responses.nbytes
    settings = FrfSettings()

    def mine() -> FrfSet:
        return ours(force, responses, channels, settings)

    def mine_alone() -> FrfSet:
        return ours(force, responses, channels, settings.model_copy(update={"threads": 1}))

    def theirs() -> object:
        return peer(force, responses)

    def by_scipy() -> object:
        return scipy_peer(force, responses)

    result = mine()
    for h1, coherence in (peer(force, responses), scipy_peer(force, responses)):
        assert np.allclose(result.frf[:, 0, 1:-1], np.squeeze(h1)[..., 1:-1], rtol=1e-9)
        assert np.allclose(result.coherence[:, 0, 1:-1], np.squeeze(coherence)[..., 1:-1], rtol=1e-9)
    del result, h1, coherence
    return Comparison(
        paired(mine, theirs, turns),
        paired(mine_alone, theirs, turns),
        paired(mine, by_scipy, turns),
        *(peak_memory(work) / size for work in (mine, theirs, by_scipy)),
    )


def main() -> None:
    """Run the comparison and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--channels", type=int, default=100)
    parser.add_argument("--hits", type=int, default=10)
    parser.add_argument("--samples", type=int, default=65536)
    parser.add_argument("--turns", type=int, default=5)
    given = parser.parse_args()
    with single_blas_thread():
        found = compare(given.channels, given.hits, given.samples, given.turns)
    print(f"{given.channels} channels x {given.hits} hits x {given.samples} samples")
    print(f"sdypy-FRF, ours in two threads: {found.two_threads}")
    print(f"sdypy-FRF, ours in one thread:  {found.one_thread}")
    print(f"scipy.signal, ours in two threads: {found.scipy}")
    print(
        f"extra memory in sizes of the records: ours {found.memory_ours:.2f}, "
        f"sdypy-FRF {found.memory_peer:.2f}, scipy {found.memory_scipy:.2f}"
    )


if __name__ == "__main__":
    main()
