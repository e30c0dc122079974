"""Pairs of tests of imperfect rigs, before and after a change, and unchanged: what `ema changes` makes of them.

Each case draws a rig of two to eight masses (parts scatter 3 %, sensors 4 %, damping by half) and three tests of it
with the same sensors, hits 5 degrees off and frequencies that drift by 0.1 % from hit to hit: A, A again, and B with
one effect of FACTOR times the limit that A and A again state. The rig that the program is given is nominal.

    python benchmarks/changes_study.py [CASES] [--first N] [--json FILE] [--keep FOLDER]

With --keep, simulated tests and their modes stay in a folder; a second study of the same cases takes them from there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from study_own_rigs import draw_rig

from ema_pipeline.changes.two_tests import Changes, changes_content, compare_runs, open_test
from ema_pipeline.observations.pair import RepeatSettings
from ema_pipeline.run.types import Run
from ema_pipeline.simulate import simulate_campaign

PARTS = 0.03
"""Scatter of springs, 1 σ; masses scatter by half a per cent."""
FACTOR = 2.2
EFFECTS = ("mass", "spring", "damper")
AS_SIMULATED = RepeatSettings(frequency=1e-4, damping=2e-3, shape=5e-4)
"""Hits off their mark move damping and shapes by about as much; nothing is taken apart between the tests."""
INTERVAL = float(scipy.stats.norm.ppf(0.95))
"""Half width of a 90 % interval in standard deviations."""


def test_of(folder: Path, name: str, case: int, seed: int, effects: tuple[str, ...]) -> Run:
    """One test, simulated and run up to its modes."""
    raw, out = folder / name, folder / "out" / name
    if out.is_dir():
        return open_test(out, None, folder)
    random = np.random.default_rng([7, case])
    own = draw_rig(random, case)
    springs = [
        replace(s, true=s.stated * float(np.exp(PARTS * random.standard_normal()))) for s in own.springs
    ]
    own = replace(own, springs=tuple(springs))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(own.toml(true=False), encoding="utf-8")
    (folder / "true.toml").write_text(own.toml(true=True), encoding="utf-8")
    bodies = list(own.masses)
    impacts = [
        f"{body}.{d}" for body, d in zip((bodies[0], bodies[-1]), (own.directions * 2)[:2], strict=True)
    ]
    simulate_campaign(
        raw, folder / "true.toml", effects=list(effects), impacts=impacts, hits=3, duration_s=4.0,
        sample_rate_hz=2560.0, contact_s=1e-3, format="hdf5", seed=seed, rig_seed=1000 + case,
        imperfection="normal", aim_deg=5.0, part_scatter=0.0, scatter=0.0,
    )  # fmt: skip
    return open_test(raw, str(folder / "rig.toml"), out)


def one_case(case: int, repeat: RepeatSettings, folder: Path) -> dict[str, Any]:
    """An unchanged pair, and a pair with one effect."""
    random = np.random.default_rng(case)
    a = test_of(folder, "a", case, 10 * case + 1, ())
    again = test_of(folder, "again", case, 10 * case + 2, ())
    same = changes_content(compare_runs(a, again, repeat=repeat))
    limits = [x for x in same["diagnosis"]["limits"] if x["label"].split("@")[0] in EFFECTS and x["size"]]
    found: dict[str, Any] = {"case": case, "false": same["verdict"] == "changed", "same": same["changes"]}
    if limits:
        drawn = folder / "effect.json"
        if drawn.exists():
            label, parameter, size = json.loads(drawn.read_text(encoding="utf-8"))
        else:
            chosen = limits[int(random.integers(len(limits)))]
            label, parameter = chosen["label"], chosen["parameter"]
            sign = -1.0 if label.startswith("spring") and random.random() < 0.5 else 1.0
            size = sign * FACTOR * chosen["size"]
            drawn.write_text(json.dumps([label, parameter, size]), encoding="utf-8")
        found["limit"] = next((abs(x["size"]) for x in limits if x["label"] == label), None)
        effect = f"{label}:{parameter}={size:.8g}"
        b = test_of(folder, "b", case, 10 * case + 3, (effect,))
        compared: Changes = compare_runs(open_test(a.store.folder, None, folder), b, repeat=repeat)
        found |= _judged(changes_content(compared), label, size) | {"effect": effect}
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
    parser.add_argument("--keep", type=Path, help="folder in which the simulated tests stay")
    given = parser.parse_args()
    repeat = AS_SIMULATED if given.as_simulated else RepeatSettings()
    start, rows = time.perf_counter(), []
    for case in range(given.first, given.first + given.cases):
        folder = given.keep / f"case{case}" if given.keep else Path(tempfile.mkdtemp(prefix="changes-study-"))
        rows.append(one_case(case, repeat, folder))
        if not given.keep:
            shutil.rmtree(folder)
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
