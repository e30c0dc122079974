"""Is the diagnosis right, and is what it says of its own certainty true? Random imperfect rigs from raw hits.

    python benchmarks/calibration_study.py study.jsonl --kind own --level normal --first 0 --cases 100
    python benchmarks/calibration_study.py study.jsonl --kind planetary --level good --without --cases 20
    python benchmarks/calibration_study.py --table study.jsonl

Every case draws a rig, hides none, one or two effects of random size at random places, simulates a test as a good or a
normal laboratory makes it (parts, calibration, transverse sensitivity, aim, drift, damping; see
docs/simulated_tests.md), states nothing of that, and takes the raw volts through the whole of `ema run`. With
`--without` the library lacks the hidden effect's kind; what the whole library says of the same data tells whether the
effect is visible at all. A JSON line per case is appended to the results file; cases that
the file holds are not run again, so a study can be broken off at any time.

A case runs in a process of its own, so that neither a crash nor a changed library touches the next one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from study_cases import KINDS, Case, Made, lacking, make
from study_tally import Line, key, outcome, read, table

MARK = "case: "
"""Starts the line of a case's process that holds its result."""
NOTHING = "nothing"


def run(case: Case, overrides: list[str]) -> Line:
    """One case, from its drawing to the verdict, as a line of the results file."""
    from ema_pipeline.job import run_raw

    line: Line = {**asdict(case), "hidden": case.effects, "rig": "", "truth": [], "values": {}}
    with tempfile.TemporaryDirectory() as folder:
        raw, out = Path(folder) / "raw", Path(folder) / "out"
        start = time.monotonic()
        try:
            made = make(case, raw)
            line |= _of_truth(made)
            middle = time.monotonic()
            if case.without:
                run_raw(raw, None, Path(folder) / "whole", overrides=overrides)
                line["whole"] = told((Path(folder) / "whole" / "summary.json").read_text(encoding="utf-8"))
                remove_from_library(made)
            run_raw(raw, None, out, overrides=overrides)
            line |= told((out / "summary.json").read_text(encoding="utf-8"))
        except Exception as error:  # a case that fails is a result
            return line | {"failed": f"{type(error).__name__}: {error}"}
        end = time.monotonic()
    return line | {"seconds": {"simulate": round(middle - start, 2), "run": round(end - middle, 2)}}


def _of_truth(made: Made) -> Line:
    return {
        "rig": made.rig,
        "hidden": len(made.truth),
        "truth": [asdict(t) for t in made.truth],
        "values": made.values,
    }


def remove_from_library(made: Made) -> None:
    """Take the hidden effects' kind out of the shipped library of this process."""
    from ema_pipeline.effects.library import shipped_effects

    known = shipped_effects()  # one and the same dictionary at every call
    for family in lacking(made.truth) & set(known):
        del known[family]


def told(summary: str) -> Line:
    """What a summary says, as far as the tally needs it."""
    content = json.loads(summary)
    found = content["diagnosis"]
    candidates = [
        {
            "label": f"{c['effect']}@{c['at']}",
            "probability": c["probability"],
            "sizes": {n: [p["value"], p["std"]] for n, p in c["parameters"].items()},
        }
        for c in found["candidates"]
    ]
    return {
        "verdict": found["verdict"],
        "claimed": _claimed(content),
        "groups": found["indistinguishable"],
        "candidates": candidates,
        "nothing": _nothing(found),
        "visible": found.get("nothing_visible_probability"),
        "error": found.get("error"),
        "errors": [[r["error"], r["heldout_error"]] for r in content.get("ladder") or ()],
        "limits": [
            {
                "label": x.get("effect") or x.get("label"),
                "parameter": x["parameter"],
                "size": x["size"],
                "unit": x.get("unit", ""),
                "largest": x.get("largest", False),
            }
            for x in found.get("detection_limits") or ()
        ],
        "scatters": {name: x["learned"] for name, x in (found.get("scatter") or {}).items()},
        "fit": _fit(content.get("fit")),
        "next": found.get("next_measurement", ""),
    }


def _claimed(content: dict[str, Any]) -> list[str]:
    """Effects that are claimed: marked so, or else those of the last rung where the verdict names an effect."""
    found = content["diagnosis"]
    if any("claimed" in c for c in found["candidates"]):
        return [f"{c['effect']}@{c['at']}" for c in found["candidates"] if c.get("claimed")]
    if found["verdict"] not in ("effect", "ambiguous") or not content.get("ladder"):
        return []
    return list(content["ladder"][-1]["effects"])


def _nothing(found: dict[str, Any]) -> float | None:
    stated = found.get("nothing_missing_probability")
    if stated is None:
        stated = (found.get("probabilities") or {}).get(NOTHING)
    return None if stated is None else float(stated)


def _fit(fit: dict[str, Any] | None) -> dict[str, list[float | None]]:
    return {n: [p["value"], p["std"]] for n, p in (fit or {"parameters": {}})["parameters"].items()}


def run_apart(case: Case, overrides: list[str], seconds: float) -> Line:
    """The same in a process of its own, which is ended after `seconds`."""
    command = [sys.executable, __file__, "--one", json.dumps(asdict(case))]
    command += [part for text in overrides for part in ("--set", text)]
    failed: Line = {**asdict(case), "hidden": case.effects, "rig": "", "truth": [], "values": {}}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return failed | {"failed": f"not done after {seconds:g} s"}
    lines = [text for text in done.stdout.splitlines() if text.startswith(MARK)]
    if not lines:
        return failed | {"failed": (done.stderr.strip().splitlines() or ["ended without a word"])[-1]}
    return dict(json.loads(lines[-1].removeprefix(MARK)))


def shown(line: Line) -> str:
    """One line for the screen."""
    hidden = ", ".join(f"{t['label']} {t['size']:.3g}" for t in line["truth"]) or "nothing"
    said = line.get("failed") or f"{line['verdict']} {line['claimed']}"
    time_s = line.get("seconds", {})
    return f"{line['kind']} {line['level']} {line['number']}: {hidden} → {outcome(line)}: {said} {time_s}"


def main() -> None:
    """Run cases, or print the tally of those that were run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, nargs="?", default=Path("calibration_study.jsonl"))
    parser.add_argument("--kind", choices=KINDS, default="own")
    parser.add_argument("--level", choices=("good", "normal"), default="normal")
    parser.add_argument("--without", action="store_true", help="the library lacks what is hidden")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--seconds", type=float, default=1800.0, help="a case that takes longer has failed")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    parser.add_argument("--table", type=Path, help="print the tally of this results file and end")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    o = parser.parse_args()
    if o.one:
        print(MARK + json.dumps(run(Case(**json.loads(o.one)), o.set)), flush=True)
        return
    if o.table:
        print(table(read(o.table)))
        return
    done = {key(line) for line in read(o.file)}
    cases = [Case(o.kind, o.level, n, o.without) for n in range(o.first, o.first + o.cases)]
    with ThreadPoolExecutor(o.jobs) as pool:
        left = [
            pool.submit(run_apart, case, o.set, o.seconds) for case in cases if key(asdict(case)) not in done
        ]
        for one in as_completed(left):
            line = one.result()
            with o.file.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(shown(line), flush=True)


if __name__ == "__main__":
    main()
