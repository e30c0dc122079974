"""Peak memory of a run of many channels, in sizes of its FRFs.

    python benchmarks/bench_memory.py

A hammer test of one impact point is simulated into a temporary raw folder; then `ema run` goes over it as far as the
FRFs, as far as the modes, and to the end, each in a process of its own. What counts is the largest resident size of
the process, less that of a process that imports the package and ends. The second figure is less that of the same run on
two channels of 4096 samples, so that the libraries that a run loads do not count either.
The size of the FRFs is that of their complex values; coherence and variance, which are kept too, have as much again.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from simulate_modal import random_system, simulate_hits

STAGES = {
    "to the FRFs": ["ingest", "hits", "frf"],
    "to the modes": ["ingest", "hits", "frf", "modal"],
    "to the report": ["ingest", "hits", "frf", "modal", "levels", "report"],
}
F_MAX_HZ = 800.0
RUN = "import sys; from ema_pipeline.cli import main; sys.argv[0] = 'ema'; sys.exit(main())"
LAUNCH = """
import os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
print(usage.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""A small process in between: a process counts what the one that started it had at that moment as its own."""


def write_raw(folder: Path, channels: int, hits: int, samples: int) -> None:
    """A raw folder of one impact point: one HDF5 file per hit, written one after the other."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    system = random_system(
        rng, n_modes=12, n_dofs=channels, low_hz=40.0, high_hz=0.9 * F_MAX_HZ, damping=(0.002, 0.01)
    )
    lines = ["schema = 1", f"sample_rate_hz = {2.56 * F_MAX_HZ}", "[[channels]]", 'name = "hammer"']
    lines += ['quantity = "force"', 'unit = "N"']
    for k in range(channels):
        lines += ["[[channels]]", f'name = "a{k}"', 'quantity = "acceleration"', 'unit = "m/s^2"']
        lines.append(f'dof = "p{k}.z"')
    for number in range(hits):
        hit = simulate_hits(
            system, list(range(channels)), [0], f_max=F_MAX_HZ, record_s=samples / (2.56 * F_MAX_HZ),
            n_hits=1, force_noise=0.005, response_noise=0.01, rng=rng,
        )  # fmt: skip
        with h5py.File(folder / f"hit{number}.h5", "w") as file:
            file["hammer"] = hit.force[0, 0]
            for k in range(channels):
                file[f"a{k}"] = hit.responses[0, 0, k]
        lines += ["[[records]]", f'file = "hit{number}.h5"', 'impact = "p0.z"']
    (folder / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def peak_bytes(code: str, *arguments: str) -> int:
    """Largest resident size of a Python process, bytes."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-S", "-c", LAUNCH, sys.executable, "-c", code, *arguments]
    ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    if ended.returncode:
        raise SystemExit(f"{' '.join(arguments) or code} ended with {ended.returncode}")
    return int(ended.stdout) * (1 if sys.platform == "darwin" else 1024)


@dataclass(frozen=True)
class Peak:
    """Peak memory of a run over so many stages: in MB, and in sizes of the FRFs as told above."""

    stages: str
    peak_mb: float
    over_import: float
    over_small_run: float


def measure(channels: int, hits: int, samples: int) -> Iterator[Peak]:
    """Peaks of the runs over more and more stages."""
    size = 16 * channels * (samples // 2 + 1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_raw(folder / "raw", channels, hits, samples)
        write_raw(folder / "small", 2, hits, 4096)
        bare = peak_bytes("import ema_pipeline.cli")
        for number, (name, stages) in enumerate(STAGES.items()):
            pipeline = folder / f"{number}.toml"
            pipeline.write_text(f"stages = {stages}\n".replace("'", '"'), encoding="utf-8")
            peaks = [
                peak_bytes(
                    RUN, "run", str(folder / raw), "--quiet", "--pipeline", str(pipeline),
                    "--out", str(folder / f"{raw}{number}"),
                )
                for raw in ("small", "raw")
            ]  # fmt: skip
            yield Peak(name, peaks[1] / 1e6, (peaks[1] - bare) / size, (peaks[1] - peaks[0]) / size)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--channels", type=int, default=100)
    parser.add_argument("--hits", type=int, default=10)
    parser.add_argument("--samples", type=int, default=65536)
    given = parser.parse_args()
    size = 16 * given.channels * (given.samples // 2 + 1)
    print(
        f"{given.channels} channels x {given.hits} hits x {given.samples} samples: FRFs {size / 1e6:.0f} MB"
    )
    for peak in measure(given.channels, given.hits, given.samples):
        print(
            f"{peak.stages}: {peak.peak_mb:.0f} MB, {peak.over_import:.2f} x FRFs above the bare import, "
            f"{peak.over_small_run:.2f} x above a run of two channels",
            flush=True,
        )


if __name__ == "__main__":
    main()
