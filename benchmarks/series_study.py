"""A series of small simulated tests: speed of two processes, killed and resumed, broken folders, a Dask cluster.

    python benchmarks/series_study.py [TESTS] [--broken 5] [--kills 10] [--dask]
    python benchmarks/series_study.py --growth 10 40 160 [--driver 10 100 1000]

Printed: wall time with one process and with two and their ratio, processor time per test and its growth,
memory of the driver, whether a series killed at random moments and resumed has the same table, and the same on a
cluster of a scheduler and two workers in processes of their own, one of which is killed.

With --growth: the cost of one test in series of several sizes, each run anew. With --driver: the cost of everything but
the tests themselves (finding, fingerprints, processes, table), with rows that were made before.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ema_pipeline.series.one_test import Task
from ema_pipeline.series.rows import COLUMNS, TestRow
from ema_pipeline.series.run import run_series

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
BENCH = importlib.import_module("bench")
EMA = [sys.executable, "-m", "ema_pipeline.cli"]


def simulate(root: Path, count: int, broken: int) -> Path:
    """Tests of one lot, every tenth with a mass added, and broken folders among them."""
    for i in range(count):
        effects = ["mass@m2:mass=0.3"] if i % 10 == 7 else []
        BENCH.write_bench(root, f"tree/unit{i:04d}", hits=2, seed=i, imperfection="good", effects=effects)
    faults: tuple[Any, ...] = (
        lambda f: (f / "test.toml").write_text("channels = ["),
        lambda f: next(f.glob("*.h5")).write_bytes(b"rubbish"),
        lambda f: next(f.glob("*.h5")).unlink(),
        lambda f: (f / "test.toml").write_text(
            (f / "test.toml").read_text().replace('unit = "N"', 'unit = "kN/s"')
        ),
        lambda f: (f / "test.toml").write_text((f / "test.toml").read_text().replace('"m1.x"', '"m9.x"')),
    )
    for k in range(broken):
        faults[k % len(faults)](root / "tree" / f"unit{(k * count) // broken:04d}")
    return root / "tree"


def command(root: Path, out: str, *more: str) -> list[str]:
    rig = ["--rig", str(root / "bench.toml")]
    return [*EMA, "series", "run", str(root / "tree"), "--out", str(root / out), *rig, *more]


def timed(root: Path, out: str, jobs: int) -> dict[str, Any]:
    start = time.perf_counter()
    said = subprocess.run(
        command(root, out, "--jobs", str(jobs), "--json"), check=True, capture_output=True, text=True
    )
    return {**json.loads(said.stdout), "wall": time.perf_counter() - start}


def same(a: Path, b: Path) -> bool:
    return all(
        x.equals(y)
        for x, y in zip(BENCH.facts_of_series(a).values(), BENCH.facts_of_series(b).values(), strict=True)
    )


def killed(root: Path, out: str, kills: int, wall: float) -> None:
    """Run a series that is killed at random moments, and resumed."""
    chance = random.Random(0)
    for _ in range(kills):
        run = subprocess.Popen(command(root, out, "--jobs", "2", "-q"), start_new_session=True)
        try:
            run.wait(timeout=chance.uniform(0.05, 0.25) * wall)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    subprocess.run(command(root, out, "--jobs", "2", "-q"), check=True)


def growth(root: Path, sizes: list[int]) -> None:
    """Series of several sizes, each anew with two processes: cost per test, and memory of the driver."""
    simulate(root, max(sizes), 0)
    for size in sizes:
        part = root / f"series{size}"
        (part / "tree").mkdir(parents=True)
        (part / "bench.toml").write_bytes((root / "bench.toml").read_bytes())
        for folder in sorted((root / "tree").iterdir())[:size]:
            (part / "tree" / folder.name).symlink_to(folder)
        told = timed(part, "S", 2)
        grown = "" if told["growth"] is None else f" (last tenth {told['growth']:.2f} times the first)"
        print(
            f"{size} tests: {told['seconds_per_test']:.2f} s of processor time per test{grown}, "
            f"{told['wall'] / size:.2f} s of wall time; driver {told['driver_mb']:.0f} MB, "
            f"{told['driver_growth_mb']:.1f} MB more than after the first tenth",
            flush=True,
        )


def row_made_before(task: Task) -> TestRow:
    """The row of a test as one that was run has it: seven numbers per mode, three modes, four parameters."""
    test = dict.fromkeys(COLUMNS["tests"], "some text of a usual length") | {
        "test": task.name,
        "key": task.key,
    }
    rows = {
        name: tuple({**dict.fromkeys(COLUMNS[name], 1.0), "test": task.name} for _ in range(count))
        for name, count in (("modes", 3), ("parameters", 4), ("effects", 1))
    }
    cost = {"test": task.name, "seconds": 0.0, "processor_seconds": 0.0, "peak_memory_mb": 0.0}
    return TestRow(test | {"state": "failed"}, cost=cost, **rows)


def driver_alone(root: Path, size: int) -> None:
    """Everything but the tests themselves, in a process of its own: what one test costs the driver."""
    tree = root / "tree"
    for i in range(size):
        folder = tree / f"unit{i:05d}"
        folder.mkdir(parents=True)
        (folder / "test.toml").write_text("schema = 1\n")
    begun, start = time.process_time(), time.perf_counter()
    told = run_series(tree, root / "S", jobs=2, work=row_made_before)
    print(
        f"driver with {size} tests: {1e3 * (time.process_time() - begun) / size:.1f} ms of processor time and "
        f"{1e3 * (time.perf_counter() - start) / size:.1f} ms of wall time per test, {told.driver_mb:.0f} MB, "
        f"{told.driver_growth_mb:.1f} MB more than after the first tenth",
        flush=True,
    )


def on_dask(root: Path, out: str) -> None:
    """Run a series on a cluster of three processes; one worker is killed when a third of the tests are done."""
    file = root / "scheduler.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    scheduler = subprocess.Popen([*dask, "--scheduler-file", str(file)], **quiet)
    workers = []
    try:
        while not file.is_file() or not file.read_text():
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
        workers = [subprocess.Popen([*worker, "--no-dashboard", "--no-nanny"], **quiet) for _ in range(2)]
        driver = subprocess.Popen(command(root, out, "--scheduler", address, "-q"))
        total = len(list((root / "tree").glob("*")))
        while len(list((root / out).glob("tests/*/summary.json"))) < total / 3 and driver.poll() is None:
            time.sleep(0.2)
        workers[0].kill()
        driver.wait()
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tests", nargs="?", type=int, default=60)
    parser.add_argument("--broken", type=int, default=5)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--dask", action="store_true")
    parser.add_argument("--growth", type=int, nargs="+", default=[])
    parser.add_argument("--driver", type=int, nargs="+", default=[])
    given = parser.parse_args()
    if given.growth or given.driver:
        if given.growth:
            growth(Path(tempfile.mkdtemp(prefix="series-growth-")), given.growth)
        for size in given.driver:
            alone = multiprocessing.get_context("fork").Process(
                target=driver_alone, args=(Path(tempfile.mkdtemp(prefix="series-driver-")), size)
            )
            alone.start()
            alone.join()
        return
    root = Path(tempfile.mkdtemp(prefix="series-study-"))
    simulate(root, given.tests, given.broken)
    print(f"{given.tests} tests in {root}", flush=True)
    two, one = timed(root, "two", 2), timed(root, "one", 1)
    print(
        f"one process {one['wall']:.1f} s, two {two['wall']:.1f} s: {one['wall'] / two['wall']:.2f} times the speed"
    )
    print(
        f"processor time per test {one['seconds_per_test']:.2f} s, "
        f"of the last tenth {one['growth'] or 1:.2f} times that of the first tenth"
    )
    print(
        f"driver {one['driver_mb']:.0f} MB, {one['driver_growth_mb']:.1f} MB more than after the first tenth"
    )
    tests = BENCH.facts_of_series(root / "one")["tests"]
    failed = tests[tests["state"] != "ok"]
    print(f"{(tests['state'] == 'ok').sum()} rows with results, {len(failed)} with a reason:")
    for row in failed.itertuples():
        print(f"  {row.test}: {row.reason}")
    heavy = tests[(tests["state"] == "ok") & (tests["test"].str[-1] == "7")]
    print(f"{heavy['effects'].str.contains('m2').sum()} of {len(heavy)} added masses found")
    print(f"two processes give the table of one: {same(root / 'one', root / 'two')}", flush=True)
    if given.kills:
        killed(root, "killed", given.kills, two["wall"])
        print(
            f"killed {given.kills} times and resumed, the same table: {same(root / 'one', root / 'killed')}",
            flush=True,
        )
    if given.dask:
        on_dask(root, "dask")
        print(
            f"on a Dask cluster, one of two workers killed, the same table: {same(root / 'one', root / 'dask')}"
        )


if __name__ == "__main__":
    main()
