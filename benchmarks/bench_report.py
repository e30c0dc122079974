"""Report and live page of a results folder: time to write and to open, size, memory, and from a click to the new error.

    python benchmarks/bench_report.py OUT [--effect EFFECT@PLACE]

OUT is copied first. The browser is Chromium, driven by Playwright; without one the times of the browser are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.report import diagnosis
from ema_pipeline.report.html import write_report
from ema_pipeline.report.results import RunResults
from ema_pipeline.run.opening import existing_run
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


def in_browser(browser: Any, reports: list[Path], out: Path, effects: list[str]) -> None:
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
        tab.wait_for_timeout(6000)  # the worker has started
        for effect in effects:
            tab.locator("#add-label").fill(effect)
            timed(tab, server.pid, f"add {effect}", tab.locator("#add-form button").click)
            timed(tab, server.pid, "undo", tab.locator("#undo").click, "Undone")
        for verb in ("exclude_mode", "exclude_hit"):
            button = tab.locator(f"button[data-verb={verb}]").first
            if button.count():
                timed(tab, server.pid, verb.replace("_", " a "), lambda b=button: b.dispatch_event("click"))
                timed(tab, server.pid, "undo", tab.locator("#undo").click, "Undone")
        print(f"peak memory of the server:  {peak_mb(server.pid):.0f} MB")
        server.send_signal(signal.SIGINT)


def timed(tab: Any, server: int, what: str, click: Callable[[], Any], told: str = "→") -> None:
    """Print the time from a click until the page tells what came of it, and until all is done."""
    version, used = tab.locator("html").get_attribute("data-version"), processor_s(server)
    start = time.perf_counter()
    click()
    tab.locator("#status", has_text=told).wait_for(timeout=300_000)
    told_s, told_used = time.perf_counter() - start, processor_s(server) - used
    tab.locator(f"html[data-ready]:not([data-version='{version}'])").wait_for(timeout=300_000)
    drawn_s, drawn_used = time.perf_counter() - start, processor_s(server) - used
    tab.locator("#status", has_text=re.compile(r"[.]$")).wait_for(timeout=300_000)
    print(
        f"{what}: new error {told_s:.2f} s ({told_used:.2f} s of processors), "
        f"all figures {drawn_s:.2f} s ({drawn_used:.2f} s of processors), "
        f"all done {time.perf_counter() - start:.2f} s ({processor_s(server) - used:.2f} s of processors)"
    )


def processor_s(server: int) -> float:
    """Processor time so far of a server and its workers; NaN where the system does not tell."""
    total, tick = 0.0, os.sysconf("SC_CLK_TCK")
    children = {server}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(") ")[2].split()
            if int(path.parent.name) in children or int(fields[1]) in children:
                children.add(int(path.parent.name))
                total += sum(map(int, fields[11:15])) / tick
    return total if Path("/proc/self/stat").is_file() else float("nan")


def likely(results: RunResults) -> list[str]:
    """The effect that the diagnosis names, whose fit it has kept, and the next one, which has to be fitted."""
    found = results.diagnosis
    if found is None:
        return []
    first = diagnosis.leading(found)[0].label
    return [first, *[c.label for c in found.candidates if c.label != first][:1]]


def main() -> None:
    """Print all figures for one results folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--effect",
        action="append",
        help="the most probable one, and one less so, if left out; may be repeated",
    )
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
        effects = given.effect or likely(results)
        path = shutil.which("chromium") or shutil.which("google-chrome")
        if path is None:
            print("no Chromium on this machine: the browser's times are left out")
            return
        from playwright.sync_api import sync_playwright

        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
            in_browser(browser, reports, out, effects)
            browser.close()


if __name__ == "__main__":
    main()
