"""Report and live page of a results folder: time to write and to open, size, memory, and from a click to the new error.

    python benchmarks/bench_report.py OUT [--effect EFFECT@PLACE]

OUT is copied first. The browser is Chromium, driven by Playwright; without one the times of the browser are left out.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.pipeline import existing_run
from ema_pipeline.report import diagnosis
from ema_pipeline.report.html import write_report
from ema_pipeline.report.results import RunResults
from ema_pipeline.stages.results import load_results

CHANNELS = 100


def many_channels(results: RunResults) -> RunResults:
    """The results with the FRFs of the first configuration repeated up to `CHANNELS` responses."""
    c = results.configurations[0]
    assert c.frfs is not None
    rows = np.arange(CHANNELS) % len(c.frfs.outputs)
    frfs = replace(
        c.frfs,
        outputs=tuple(Dof(f"p{k}", "z") for k in range(CHANNELS)),
        quantities=tuple(c.frfs.quantities[r] for r in rows),
        **{
            name: getattr(c.frfs, name)[rows]
            for name in ("frf", "coherence", "variance", "hits", "sensor_mass_kg")
        },
    )
    return replace(results, configurations=(replace(c, frfs=frfs), *results.configurations[1:]))


def written(results: RunResults, path: Path) -> None:
    """Write a report and print how long it took and how large it is."""
    start, used = time.perf_counter(), time.process_time()
    write_report(results, path)
    print(
        f"{path.name:28s} written in {time.perf_counter() - start:.2f} s "
        f"({time.process_time() - used:.2f} s of one processor), {path.stat().st_size / 1e6:.2f} MB"
    )


def peak_mb(process: int) -> float:
    """Largest resident memory of a process so far; NaN where the system does not tell."""
    status = Path(f"/proc/{process}/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.is_file() else None
    return int(found[1]) / 1e3 if found else float("nan")


def in_browser(browser: Any, reports: list[Path], out: Path, effect: str) -> None:
    """Load times of the reports, and the live page from a click to the new model."""
    for path in reports:
        tab = browser.new_page()
        start = time.perf_counter()
        tab.goto(path.as_uri())
        tab.wait_for_selector("[data-figure][data-state=shown]")
        print(f"{path.name:28s} opened, first figure drawn: {time.perf_counter() - start:.2f} s")
        tab.close()
    command = [
        sys.executable,
        "-c",
        "from ema_pipeline.cli import main; main()",
        "view",
        str(out),
        "--no-browser",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        address = re.search(r"http://\S+", server.stdout.readline())
        assert address is not None
        tab = browser.new_page()
        tab.goto(address[0])
        tab.wait_for_selector("html[data-ready]")
        tab.wait_for_timeout(4000)  # the worker has started
        version = int(tab.locator("html").get_attribute("data-version"))
        start = time.perf_counter()
        tab.locator("#add-label").fill(effect)
        tab.locator("#add-form button").click()
        tab.locator("#status", has_text="→").wait_for(timeout=120_000)
        print(f"click to the new error:     {time.perf_counter() - start:.2f} s")
        tab.locator(f"html[data-version='{version + 1}']").wait_for(timeout=120_000)
        print(f"click to all figures:       {time.perf_counter() - start:.2f} s")
        print(f"peak memory of the server:  {peak_mb(server.pid):.0f} MB")
        server.send_signal(signal.SIGINT)


def main() -> None:
    """Print all figures for one results folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--effect", help="the most probable one if left out")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        out = Path(shutil.copytree(given.out, Path(place) / "out"))
        start = time.perf_counter()
        results = load_results(existing_run(out))
        print(f"results read in {time.perf_counter() - start:.2f} s")
        reports = [Path(place) / "report.html"]
        written(results, reports[0])
        if results.configurations[0].frfs is not None:
            reports.append(Path(place) / f"report_{CHANNELS}_channels.html")
            written(many_channels(results), reports[1])
        effect = given.effect or (diagnosis.leading(results.diagnosis)[0].label if results.diagnosis else "")
        path = shutil.which("chromium") or shutil.which("google-chrome")
        if path is None:
            print("no Chromium on this machine: the browser's times are left out")
            return
        from playwright.sync_api import sync_playwright

        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
            in_browser(browser, reports, out, effect)
            browser.close()


if __name__ == "__main__":
    main()
