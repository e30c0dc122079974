"""Pairs of tests of imperfect rigs, before and after a change, and unchanged: what `ema changes` makes of them.

Each case draws a rig (parts scatter 3 %, sensors 4 %, damping by half) and three tests of it with the same sensors,
hits 5 degrees off and frequencies that drift by 0.1 % from hit to hit: A, A again, and B with one effect of FACTOR
times the limit that A and A again state. The rig that the program is given is nominal.

    python benchmarks/changes_study.py [CASES] [--first N] [--json FILE]
"""

from __future__ import annotations

import argparse
import importlib
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from ema_pipeline.changes.compare import Changes, changes_content, compare_runs, open_test
from ema_pipeline.observations.pair import RepeatSettings
from ema_pipeline.stages.base import Run

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
BENCH = importlib.import_module("bench")

FACTOR = 2.2
EFFECTS = ("mass", "spring", "damper")
AS_SIMULATED = RepeatSettings(frequency=1e-4, damping=2e-3, shape=5e-4)
"""Hits off their mark move damping and shapes by about as much; nothing is taken apart between the tests."""
INTERVAL = float(scipy.stats.norm.ppf(0.95))
"""Half width of a 90 % interval in standard deviations."""


def test_of(folder: Path, name: str, case: int, seed: int, effects: tuple[str, ...]) -> Run:
    """One test, simulated and run up to its modes."""
    raw = BENCH.write_bench(
        folder, name, seed=seed, rig_seed=1000 + case, effects=effects, imperfection="normal", aim_deg=5.0
    )
    return open_test(raw, str(folder / "bench.toml"), folder / "out" / name)


def one_case(case: int, repeat: RepeatSettings) -> dict[str, Any]:
    """An unchanged pair, and a pair with one effect."""
    folder = Path(tempfile.mkdtemp(prefix="changes-study-"))
    random = np.random.default_rng(case)
    a = test_of(folder, "a", case, 10 * case + 1, ())
    again = test_of(folder, "again", case, 10 * case + 2, ())
    same = changes_content(compare_runs(a, again, repeat=repeat))
    limits = [
        x
        for x in same["diagnosis"]["limits"]
        if x["label"].split("@")[0] in EFFECTS and "." not in x["label"] and x["size"]
    ]
    found: dict[str, Any] = {"case": case, "false": same["verdict"] == "changed", "same": same["changes"]}
    if limits:
        chosen = limits[int(random.integers(len(limits)))]
        sign = -1.0 if chosen["label"].startswith("spring") and random.random() < 0.5 else 1.0
        size = sign * FACTOR * chosen["size"]
        effect = f"{chosen['label']}:{chosen['parameter']}={size:.8g}"
        b = test_of(folder, "b", case, 10 * case + 3, (effect,))
        compared: Changes = compare_runs(open_test(a.store.folder, None, folder), b, repeat=repeat)
        found |= _judged(changes_content(compared), chosen["label"], size) | {"effect": effect}
    shutil.rmtree(folder)
    return found


def _judged(content: dict[str, Any], label: str, size: float) -> dict[str, Any]:
    """Whether the right effect is claimed and whether its interval holds the truth."""
    changes = content["changes"]
    groups = [set(g) for g in content["diagnosis"]["indistinguishable"]]
    labels = [{f"{c['effect']}@{c['at']}", *c["also_called"]} for c in changes]
    right = len(changes) == 1 and any(label in s for s in (*labels, *groups))
    named = (
        len(changes) == 1
        and changes[0]["effect"] == label.split("@")[0]
        and changes[0]["at"] == label.split("@")[1]
    )
    same_scale = len(changes) == 1 and changes[0]["unit"] in ("kg", "N/m", "N·s/m") and label in labels[0]
    inside = bool(abs(changes[0]["value"] - size) < INTERVAL * changes[0]["std"]) if same_scale else None
    z = (changes[0]["value"] - size) / changes[0]["std"] if same_scale else None
    told = [f"{c['effect']}@{c['at']} {c['value']:.4g}" for c in changes]
    return {
        "right": right,
        "named": named,
        "inside": inside,
        "z": z,
        "told": told,
        "verdict": content["diagnosis"]["verdict"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="?", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--as-simulated", action="store_true", help="state the repeatability that is simulated"
    )
    given = parser.parse_args()
    repeat = AS_SIMULATED if given.as_simulated else RepeatSettings()
    start, rows = time.perf_counter(), []
    for case in range(given.first, given.first + given.cases):
        rows.append(one_case(case, repeat))
        print(rows[-1], flush=True)
        if given.json:
            given.json.write_text(json.dumps(rows), encoding="utf-8")
    changed = [r for r in rows if "right" in r]
    inside = [r["inside"] for r in changed if r["inside"] is not None]
    print(f"{len(rows)} unchanged pairs: {sum(r['false'] for r in rows)} false changes")
    print(f"{len(changed)} changed pairs: {sum(r['right'] for r in changed)} right effect and place")
    print(f"90 % intervals: {sum(inside)} of {len(inside)} hold the truth")
    print(f"{(time.perf_counter() - start) / len(rows):.1f} s per case")


if __name__ == "__main__":
    main()
