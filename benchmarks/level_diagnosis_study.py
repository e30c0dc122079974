"""How often is an effect that depends on the force level named rightly? Random rigs through simulated hits.

    python benchmarks/level_diagnosis_study.py --cases 20 --seed 1 --out study.jsonl
    python benchmarks/level_diagnosis_study.py --cases 0 --out study.jsonl --report study.md

Every case draws a rig from its tolerances, hides one effect of a random size at a random place (none, a linear one, or
a linear one beside one that depends on the level), simulates hammer tests at 30, 100 and 300 N and takes them as raw
volts through `ema run`: hits, FRFs, modes, levels, fit, diagnosis. Dry friction changes its direction over a random
rate.

Sizes are drawn evenly over the logarithm in ranges that reach from hardly to clearly visible. Whether a case was
visible is told by the detection limit that the diagnosis states for its true effect; cases without one are counted
apart.

Cases that the results file holds are not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.job import run_raw
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.simulate.campaign import simulate_campaign

IMPACTS = {
    "no_ring": ("carrier.x", "sun.y", "planet1.x", "sun.u"),
    "with_ring": ("carrier.x", "sun.y", "planet1.x", "sun.u", "ring.x"),
}
LEVELS_N = (30.0, 100.0, 300.0)
SIZES = {
    "bearing_cubic": ("stiffness", 2e11, 5e12, True),
    "bearing_quadratic": ("stiffness", 1e8, 1.5e9, True),
    "dry_friction": ("force", 0.1, 5.0, False),
    "mesh_backlash": ("preload", 5e-8, 2e-6, False),
}
KINDS = (*SIZES, "none", "linear", "both")
OUTCOMES = ("right", "in the group", "missed", "wrong", "wrong group", "failed")


def draw(kind: str, random: np.random.Generator) -> dict:
    """Planets, configuration, place and size of one case."""
    planets = int(random.choice([2, 3]))
    configuration = str(random.choice(["no_ring", "with_ring"]))
    rig = planetary(planets)
    case = {
        "kind": kind,
        "planets": planets,
        "configuration": configuration,
        "label": "",
        "linear": "",
        "hidden": [],
    }
    if kind in ("linear", "both"):
        places = shipped_effects()["mesh_stiffness_loss"].places(rig, configuration)
        case["linear"] = f"mesh_stiffness_loss@{random.choice(places)}"
        case["hidden"].append(f"{case['linear']}:fraction={random.uniform(0.15, 0.4):.4g}")
    if kind in ("none", "linear"):
        return case
    effect = "bearing_cubic" if kind == "both" else kind
    place = str(random.choice(shipped_effects()[effect].places(rig, configuration)))
    name, low, high, signed = SIZES[effect]
    size = float(np.exp(random.uniform(np.log(low), np.log(high))))
    if signed and random.uniform() < (0.3 if effect == "bearing_cubic" else 0.5):
        size = -0.3 * size if effect == "bearing_cubic" else -size
    label = f"{effect}@{place}"
    further = f",velocity={10 ** random.uniform(-4.5, -2):.3g}" if effect == "dry_friction" else ""
    case["hidden"].append(f"{label}:{name}={size}{further}")
    return case | {"label": label, "parameter": name, "size": size}


def summary_of(case: dict, folder: Path, seed: int) -> dict[str, Any]:
    """What `ema run` writes about simulated raw data of a case."""
    rig = planetary(case["planets"])
    simulate_campaign(
        folder / "raw", rig, configurations=[case["configuration"]], effects=case["hidden"],
        impacts=IMPACTS[case["configuration"]],
        hits=2, peak_force_n=LEVELS_N, scatter=1.0, seed=seed,
    )  # fmt: skip
    (folder / "rig.toml").write_text(f'base = "planetary"\n[geometry]\nplanets = {case["planets"]}\n')
    run_raw(
        folder / "raw",
        str(folder / "rig.toml"),
        folder / "out",
        overrides=("report.plots=false", "diagnose.processes=1"),  # one, so that its time is all there is
    )
    return dict(json.loads((folder / "out" / "summary.json").read_text()))


def run(kind: str, seed: int) -> dict:
    """One case, from its drawing to the verdict."""
    case = draw(kind, np.random.default_rng([seed, sorted(KINDS).index(kind)]))
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        summary = summary_of(case, Path(folder), seed)
    found, ladder = summary["diagnosis"], summary["ladder"]
    candidates = {f"{c['effect']}@{c['at']}": c for c in found["candidates"]}
    own = candidates.get(case["label"], {})
    value = own.get("parameters", {}).get(case.get("parameter", ""), {})
    limits = {(x["label"], x["parameter"]): x["size"] for x in found["detection_limits"]}
    first = next(iter(candidates), "")
    return case | {
        "seed": seed,
        "verdict": found["verdict"],
        "level_dependent": any(c["levels"]["level_dependent"] for c in summary["configurations"].values()),
        "claimed": [label for label, c in candidates.items() if c["claimed"]],
        "group": found["indistinguishable"],
        "first": first,
        "probability": candidates[first]["probability"] if first else None,
        "found": value.get("value"),
        "std": value.get("std"),
        "gain": own.get("gain"),
        "limit": limits.get((case["label"], case.get("parameter", ""))),
        "errors": [r["error"] for r in ladder],
        "misfit": [r.get("misfit") for r in ladder],
        "heldout": [r.get("heldout_misfit") for r in ladder],
        "summary": found["summary"],
        "notes": found["notes"],
        "seconds": time.process_time() - begun,
    }


def judged(result: dict) -> str:
    """One of `OUTCOMES`."""
    right = {x for x in (result.get("label"), result.get("linear")) if x}
    claimed = set(result["claimed"])
    if result["verdict"].startswith("failed"):
        return "failed"
    if result["verdict"] == "ambiguous":
        return "in the group" if any(right & set(g) for g in result["group"]) else "wrong group"
    if claimed - right and result["verdict"] == "effect":
        return "wrong"
    if result["kind"] == "none":
        return "right" if result["verdict"] == "adequate" else "missed"
    return "right" if claimed == right and result["verdict"] == "effect" else "missed"


def visible(result: dict) -> bool:
    """True for an effect above its stated detection limit, and where none depends on the level."""
    limit = result.get("limit")
    if result["kind"] in ("none", "linear"):
        return True
    if limit is None or "size" not in result:
        return False
    size = abs(result["size"])
    # teeth part at a small preload: the limit is the largest that shows
    return bool(size <= limit if result["kind"] == "mesh_backlash" else size >= limit)


def report(results: Sequence[dict]) -> str:
    """Counts as a Markdown page."""
    lines = [
        "| hidden | cases | no limit stated (right) | above the stated limit | right | in the group | missed | wrong | "
        "size within 15 % | within 3 σ |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        cases = [r for r in results if r["kind"] == kind]
        counted = [r for r in cases if visible(r)]
        unstated = [r for r in cases if not visible(r) and r.get("limit") is None]
        if not cases:
            continue
        count = {o: sum(judged(r) == o for r in counted) for o in OUTCOMES}
        named = [r for r in counted if judged(r) == "right" and r.get("found") is not None and "size" in r]
        near = sum(abs(r["found"] / r["size"] - 1) < 0.15 for r in named)
        sure = sum(abs(r["found"] - r["size"]) < 3 * r["std"] for r in named)
        sizes = f"{near} of {len(named)} | {sure} of {len(named)}" if named else "| "
        wrong = count["wrong"] + count["wrong group"] + count["failed"]
        open_ = f"{len(unstated)} ({sum(judged(r) == 'right' for r in unstated)})" if unstated else ""
        lines.append(
            f"| {kind} | {len(cases)} | {open_} | {len(counted)} | {count['right']} | {count['in the group']} | "
            f"{count['missed']} | {wrong} | {sizes} |"
        )
    below = [r for r in results if not visible(r) and r.get("limit") is not None]
    claims = sum(judged(r) in ("wrong", "wrong group") for r in results)
    linear = [r for r in results if r["kind"] in ("none", "linear")]
    hours = sum(r.get("seconds", 0.0) for r in results) / 3600
    lines += [
        "",
        f"Of {len(below)} cases below the limit {sum(judged(r) == 'right' for r in below)} were named rightly. Wrong "
        f"claims: {claims} of all {len(results)} cases. A rig without an effect is right where it is called adequate. "
        f"Of {len(linear)} linear rigs {sum(r.get('level_dependent', False) for r in linear)} were called "
        f"level-dependent. Processor time: {hours:.1f} h.",
        "",
        "Cases that were not right:",
        "",
    ]
    for r in results:
        if judged(r) not in ("right", "in the group"):
            lines.append(
                f"- {r['kind']}, seed {r['seed']}: {' + '.join(r.get('hidden', []))} → {judged(r)}: {r['verdict']}, "
                f"claimed {', '.join(r['claimed']) or 'nothing'}, first {r.get('first')}"
                f"{'' if visible(r) else ' (no limit stated)' if r.get('limit') is None else ' (below the limit)'}"
            )
    return "\n".join(lines) + "\n"


def known_results(path: Path) -> list[dict]:
    """What a results file holds, a line cut short by a break left out."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=5, help="cases per kind")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first case")
    parser.add_argument("--only", nargs="*", default=KINDS, choices=KINDS, help="kinds of cases")
    parser.add_argument("--out", type=Path, default=Path("level_diagnosis.jsonl"))
    parser.add_argument("--report", type=Path, help="write a Markdown page of all results in the file")
    given = parser.parse_args()
    results = known_results(given.out)
    done = {(r["kind"], r["seed"]) for r in results}
    for seed in range(given.seed, given.seed + given.cases):
        for kind in given.only:
            if (kind, seed) in done:
                continue
            try:
                result = run(kind, seed)
            except Exception as error:  # a failing case is a result too
                result = {
                    "kind": kind,
                    "seed": seed,
                    "verdict": f"failed: {error}",
                    "claimed": [],
                    "group": [],
                }
            results.append(result)
            with given.out.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(kind, seed, *result.get("hidden", []), "->", judged(result), result["verdict"],
                  result["claimed"], result.get("found"), f"{result.get('seconds', 0):.0f} s", flush=True)  # fmt: skip
    page = report(results)
    print(page)
    if given.report:
        given.report.write_text(page)


if __name__ == "__main__":
    main()
