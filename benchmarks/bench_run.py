"""Where the time and the memory of a whole run go, stage by stage, beside what nobody can do without.

    python benchmarks/bench_run.py                       # 100 channels x 2 points x 5 hits x 65536 samples
    python benchmarks/bench_run.py --growth              # 12, 100 and 400 channels
    python benchmarks/bench_run.py --raw sample_data/hidden_effect --rig planetary

A hammer test is simulated into a temporary raw folder, and `ema run` goes over it once, in a process of its own. Of
every stage: wall time, processor time of the run and its workers, and the largest memory of all of them together,
looked at ten times a second. The floor beside it is the time to read all record files once and to Fourier-transform
all channels. Stages of several configurations run at the same time; then processor time and memory are those of all.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from simulate_modal import random_system, simulate_hits

F_MAX_HZ = 800.0
LOOK_EVERY_S = 0.1
GROWTH = ((12, 2, 5), (100, 2, 5), (400, 2, 5))
"""Channels, points and hits per point."""


def write_raw(folder: Path, channels: int, points: int, hits: int, samples: int) -> None:
    """A raw folder: one HDF5 file per hit, written one after the other."""
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
    for point in range(points):
        for number in range(hits):
            hit = simulate_hits(
                system, list(range(channels)), [point], f_max=F_MAX_HZ, record_s=samples / (2.56 * F_MAX_HZ),
                n_hits=1, force_noise=0.005, response_noise=0.01, rng=rng,
            )  # fmt: skip
            name = f"p{point}_hit{number}.h5"
            with h5py.File(folder / name, "w") as file:
                file["hammer"] = hit.force[0, 0]
                for k in range(channels):
                    file[f"a{k}"] = hit.responses[0, 0, k]
            lines += ["[[records]]", f'file = "{name}"', f'impact = "p{point}.z"']
    (folder / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def floor_s(folder: Path) -> tuple[float, float]:
    """Wall and processor time to read every simulated record once and to transform every channel once."""
    wall, used = time.perf_counter(), time.process_time()
    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:
            for dataset in file.values():
                np.fft.rfft(dataset[()])
    return time.perf_counter() - wall, time.process_time() - used


def family(process: int) -> list[int]:
    """A process and all that descend from it (Linux)."""
    found = [process]
    for task in Path(f"/proc/{process}/task").glob("*"):
        try:
            children = (task / "children").read_text().split()
        except OSError:
            continue
        for child in children:
            found += family(int(child))
    return found


def resident_mb(process: int) -> float:
    """Memory that a process has to itself plus its share of what it shares, MB."""
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:")) / 1e3


def inside(arguments: list[str]) -> None:
    """One `ema run` in this process; prints a line of JSON per stage and one for the whole."""
    started, used = time.perf_counter(), _processor_s()
    from ema_pipeline import job

    peak, begun, stop = [0.0], [0], threading.Event()
    me = os.getpid()

    def look() -> None:
        while not stop.wait(LOOK_EVERY_S):
            during, now = begun[0], sum(map(resident_mb, family(me)))
            if during == begun[0]:  # else another stage has begun meanwhile
                peak[0] = max(peak[0], now)

    threading.Thread(target=look, daemon=True).start()

    @contextmanager
    def show(label: str) -> Iterator[object]:
        wall, cpu = time.perf_counter(), _processor_s()
        begun[0] += 1
        peak[0] = 0.0
        yield lambda fraction, text: None
        row = {
            "stage": label,
            "wall": time.perf_counter() - wall,
            "cpu": _processor_s() - cpu,
            "mb": max(peak[0], sum(map(resident_mb, family(me)))),
        }
        print(json.dumps(row), flush=True)

    raw, rig, out, *overrides = arguments
    job.run_raw(Path(raw), rig or None, Path(out), None, overrides, show)  # type: ignore[arg-type]
    stop.set()
    row = {
        "stage": "whole run",
        "wall": time.perf_counter() - started,
        "cpu": _processor_s() - used,
        "mb": 0.0,
    }
    print(json.dumps(row), flush=True)


def _processor_s() -> float:
    """Processor time of this process, of those that descend from it, and of those that have ended."""
    return sum(map(_used_s, family(os.getpid())))


def _used_s(process: int) -> float:
    """Processor time of a process and of its children that have ended."""
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return 0.0
    return sum(map(int, text.rpartition(")")[2].split()[11:15])) / os.sysconf("SC_CLK_TCK")


def measured(raw: Path, rig: str, out: Path, overrides: list[str]) -> list[dict[str, float]]:
    """The stages of one run in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--inside", str(raw), rig, str(out), *overrides]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    rows[-1]["mb"] = max(row["mb"] for row in rows)
    return rows


def show(rows: list[dict[str, float]]) -> None:
    """Print the table of one run."""
    print("| stage | wall, s | processor, s | peak memory, MB |\n| --- | --- | --- | --- |")
    for row in rows:
        print(f"| {row['stage']} | {row['wall']:.1f} | {row['cpu']:.1f} | {row['mb']:.0f} |", flush=True)


def simulated(channels: int, points: int, hits: int, samples: int, overrides: list[str]) -> None:
    """Simulate, measure and print one test."""
    with tempfile.TemporaryDirectory() as place:
        raw, out = Path(place) / "raw", Path(place) / "out"
        write_raw(raw, channels, points, hits, samples)
        size = 16e-6 * channels * points * (samples // 2 + 1)
        wall, cpu = floor_s(raw)
        print(
            f"\n{channels} channels x {points} points x {hits} hits x {samples} samples: FRFs {size:.0f} MB; "
            f"reading and transforming everything once {wall:.1f} s ({cpu:.1f} s of one processor)\n"
        )
        rows = measured(raw, "", out, overrides)
        show(rows)
        peak = rows[-1]["mb"]
        print(f"\nwhole run: {peak / size:.1f} x FRFs, or 2 x FRFs {peak - 2 * size:+.0f} MB", flush=True)


def main() -> None:
    """Print the tables asked for."""
    if sys.argv[1:2] == ["--inside"]:
        return inside(sys.argv[2:])
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--raw", type=Path, help="a raw folder in place of simulated tests")
    parser.add_argument("--rig", default="")
    parser.add_argument("--channels", type=int, default=100)
    parser.add_argument("--points", type=int, default=2)
    parser.add_argument("--hits", type=int, default=5, help="per point")
    parser.add_argument("--samples", type=int, default=65536)
    parser.add_argument("--growth", action="store_true", help="12, 100 and 400 channels")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    given = parser.parse_args()
    if given.raw is not None:
        with tempfile.TemporaryDirectory() as place:
            show(measured(given.raw, given.rig, Path(place) / "out", given.set))
        return None
    tests = GROWTH if given.growth else ((given.channels, given.points, given.hits),)
    for channels, points, hits in tests:
        simulated(channels, points, hits, given.samples, given.set)
    return None


if __name__ == "__main__":
    main()
