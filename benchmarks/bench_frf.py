"""H1 and coherence (ours with variance) of many channels against sdypy-FRF, in one run.

Prints time and extra memory of both, and the ratios. BLAS is pinned to one thread; both get the same
arrays. Run: ``python benchmarks/bench_frf.py``.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

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
    force: NDArray[np.float64], responses: NDArray[np.float64], channels: tuple[ResponseChannel, ...]
) -> FrfSet:
    """Our estimate from views of the same arrays."""
    n = force.shape[-1]

    def stream() -> Iterator[HitSamples]:
        for i in range(force.shape[0]):
            hit = Hit(f"r{i}", 0, Dof("p0", "z"), 0, n, 105, 100.0)
            yield HitSamples(hit, RATE_HZ, force[i, 0], responses[i], channels)

    return estimate_frfs(stream(), FrfSettings())


def peer(
    force: NDArray[np.float64], responses: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """The estimate of sdypy-FRF."""
    from sdypy import FRF

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frf = FRF.FRF(int(RATE_HZ), exc=force, resp=responses, resp_type="d", copy=False)
        return frf.get_H1(), frf.get_coherence()


def ffts(responses: NDArray[np.float64]) -> None:
    """The floor: transforms alone."""
    for hit in responses:
        for start in range(0, len(hit), 4):
            rfft(hit[start : start + 4], axis=-1)


def best_time(work: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs, s."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def peak_memory(work: Callable[[], object]) -> int:
    """Peak of memory allocated meanwhile, results included, bytes."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def main() -> None:
    """Run the comparison and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--channels", type=int, default=100)
    parser.add_argument("--hits", type=int, default=10)
    parser.add_argument("--samples", type=int, default=65536)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    force, responses, channels = data(arguments.channels, arguments.hits, arguments.samples)
    size = force.nbytes + responses.nbytes
    with single_blas_thread():
        result = ours(force, responses, channels)
        h1, coherence = peer(force, responses)
        assert np.allclose(result.frf[:, 0, 1:], np.squeeze(h1)[..., 1:], rtol=1e-9)
        assert np.allclose(result.coherence[:, 0, 1:], np.squeeze(coherence)[..., 1:], rtol=1e-9)
        del result, h1, coherence
        time_ours = best_time(lambda: ours(force, responses, channels), arguments.repeats)
        time_peer = best_time(lambda: peer(force, responses), arguments.repeats)
        time_floor = best_time(lambda: ffts(responses), arguments.repeats)
        memory_ours = peak_memory(lambda: ours(force, responses, channels))
        memory_peer = peak_memory(lambda: peer(force, responses))
    print(
        f"{arguments.channels} channels x {arguments.hits} hits x {arguments.samples} samples, "
        f"{size / 1e6:.0f} MB"
    )
    print(f"ours        {time_ours * 1e3:8.0f} ms   extra memory {memory_ours / size:5.2f} x data")
    print(f"sdypy-FRF   {time_peer * 1e3:8.0f} ms   extra memory {memory_peer / size:5.2f} x data")
    print(f"FFTs, 1 thread {time_floor * 1e3:5.0f} ms")
    print(f"ratio       {time_peer / time_ours:8.2f} x faster, {memory_peer / memory_ours:.1f} x less memory")


if __name__ == "__main__":
    main()
