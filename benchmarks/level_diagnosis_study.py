"""How often is an effect that depends on the force level named rightly? Random rigs through simulated hits.

    python benchmarks/level_diagnosis_study.py --cases 20 --seed 1 --out study.jsonl
    python benchmarks/level_diagnosis_study.py --cases 0 --out study.jsonl --report study.md

Every case draws a rig from its tolerances, hides one effect of a random size at a random place (none, a linear one, or
a linear one beside one that depends on the level), simulates hammer tests at 30, 100 and 300 N, writes and reads them
as raw volts, and runs the diagnosis by hits. In place of an identification, which takes longer than all the rest, modes
of the true rig with the scatter of one are the start. Dry friction changes its direction over a random rate.

Sizes are drawn evenly over the logarithm in ranges that reach from hardly to clearly visible. Whether a case was
visible is told by the detection limit that the diagnosis states for its true effect, or where it states none by the
misfit that the base model leaves.

Cases that the results file holds are not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes, to_modal_model
from ema_pipeline.diagnose.levels.case import LevelCase
from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels
from ema_pipeline.diagnose.levels.prepare import (
    LevelTest,
    common_levels,
    highest_mode,
    soft_and_hard,
    windows_of,
)
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.fit.map_fit import fit_rig
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.ingest.description import read_campaign
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.quality import hits_of_test
from ema_pipeline.ingest.records import Record
from ema_pipeline.levels.types import ForceLevel, LevelStudy
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.rigs.types import Rig
from ema_pipeline.simulate.campaign import simulate_campaign

SCATTER = 5e-4
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


def measure(case: dict, folder: Path, seed: int) -> LevelCase:
    """Simulated raw data of a case, read back, with the starts of its fit."""
    rig = planetary(case["planets"])
    simulate_campaign(
        folder, rig, configurations=[case["configuration"]], effects=case["hidden"],
        impacts=IMPACTS[case["configuration"]],
        hits=1, peak_force_n=LEVELS_N, scatter=1.0, seed=seed,
    )  # fmt: skip
    test = read_campaign(folder).tests[0]
    records = list(load_records(test))
    hits = [h for h in hits_of_test(records) if h.accepted]
    by_file = {r.file: r for r in records}
    peaks = np.array([abs(h.peak_force) for h in hits])
    at = np.argmin(np.abs(np.log(peaks[:, None] / np.array(LEVELS_N))), axis=1)
    linear = rig_with_effects(rig, [case["linear"]] if case["linear"] else [])
    modes = level_modes(linear, case["configuration"], folder, windows_sensors(records), seed)
    modal = to_modal_model(modes)
    levels = []
    for k in range(len(LEVELS_N)):
        names = tuple(f"{h.file}#{h.number}" for h, level in zip(hits, at, strict=True) if level == k)
        levels.append(ForceLevel(float(np.median(peaks[at == k])), names, modal=modal))
    study = LevelStudy(tuple(levels), (), (), (), (), True, 0.0, "")
    tests = [LevelTest(case["configuration"], study, modal)]
    settings = DiagnoseSettings(processes=1)  # so that the time of this process is all there is
    starts = [
        {
            n: p.value
            for n, p in fit_rig(rig, m, FitSettings(), None, lambda share, text: None).parameters.items()
        }
        for m in soft_and_hard(tests)[:1]
    ]
    pairs = [(by_file[h.file], h) for h in hits]
    windows = windows_of(tests[0], pairs, common_levels(tests), settings.levels)
    return LevelCase(rig, (windows,), settings, None, tuple(starts), highest_mode(tests))


def windows_sensors(records: list[Record]) -> tuple[Dof, ...]:
    """DOFs of all response channels."""
    return tuple(dict.fromkeys(c.dof for r in records for c in r.channels))


def level_modes(
    rig: Rig, configuration: str, folder: Path, dofs: tuple[Dof, ...], seed: int
) -> MeasuredModes:
    """Modes of the true rig at rest, with the scatter that an identification leaves."""
    random = np.random.default_rng([seed, 7])
    values = json.loads((folder / "truth.json").read_text())["values"]
    system = rig.system(configuration, {n: v for n, v in values.items() if n in rig.parameters})
    hz, phi = normal_modes(system)
    shapes = (sensor_rows(system, dofs) @ phi).T
    seen = (hz > 5) & (hz < 1900) & (np.max(np.abs(shapes), axis=1) > 0.02)
    hz, shapes = hz[seen], shapes[seen]
    zeta = np.full(hz.size, values["modal_damping_ratio"])
    largest = np.max(np.abs(shapes), axis=1, keepdims=True)
    return MeasuredModes(
        configuration=configuration,
        frequency_hz=np.sort(hz * (1 + SCATTER * random.standard_normal(hz.size))),
        frequency_std_hz=SCATTER * hz,
        damping_ratio=zeta * (1 + 0.03 * random.standard_normal(hz.size)),
        damping_std=0.03 * zeta,
        shapes=shapes + 0.01 * largest * random.standard_normal(shapes.shape) + 0j,
        shape_std=np.broadcast_to(0.01 * largest, shapes.shape).copy(),
        dofs=dofs,
        scaled=True,
        band_hz=(5.0, 2000.0),
    )


def run(kind: str, seed: int) -> dict:
    """One case, from its drawing to the verdict."""
    case = draw(kind, np.random.default_rng([seed, sorted(KINDS).index(kind)]))
    with tempfile.TemporaryDirectory() as folder:
        prepared = measure(case, Path(folder) / "raw", seed)
    begun = time.process_time()
    found = diagnose_levels(prepared, (), None, "", ())
    first, last = found.ladder.rungs[0], found.ladder.rungs[-1]
    own = next((c for c in found.candidates if c.label == case["label"]), found.candidates[0])
    value = own.parameters.get(case.get("parameter", ""))
    limits = [x.size for x in found.detection_limits if (x.label, x.parameter) == (case["label"], case["parameter"])] \
        if case["label"] else []  # fmt: skip
    return case | {
        "seed": seed,
        "verdict": found.verdict,
        "claimed": [c.label for c in found.candidates if c.claimed],
        "group": [list(g) for g in found.indistinguishable],
        "first": found.candidates[0].label,
        "probability": found.candidates[0].probability,
        "found": None if value is None else value.value,
        "std": None if value is None else value.std,
        "gain": own.gain,
        "limit": limits[0] if limits else None,
        "misfit": first.misfit,
        "heldout": [first.heldout_misfit, last.heldout_misfit],
        "errors": [first.error, last.error],
        "noise": found.ladder.hit_noise,
        "notes": found.notes,
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
    if result["kind"] in ("none", "linear"):
        return "right"
    return "right" if claimed == right and result["verdict"] == "effect" else "missed"


def visible(result: dict) -> bool:
    """True for an effect above its stated detection limit."""
    limit = result.get("limit")
    if limit is None or "size" not in result:
        return result.get("kind") not in ("none", "linear")
    size = abs(result["size"])
    # teeth part at a small preload: the limit is the largest that shows
    return bool(size <= limit if result["kind"] == "mesh_backlash" else size >= limit)


def report(results: Sequence[dict]) -> str:
    """Counts as a Markdown page."""
    lines = [
        "| hidden | cases | above the stated limit | right | in the group | missed | wrong | size within 15 % | "
        "within 3 σ |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        cases = [r for r in results if r["kind"] == kind]
        seen = [r for r in cases if visible(r)]
        counted = cases if kind in ("none", "linear") else seen
        if not cases:
            continue
        count = {o: sum(judged(r) == o for r in counted) for o in OUTCOMES}
        named = [r for r in counted if judged(r) == "right" and r.get("found") is not None and "size" in r]
        near = sum(abs(r["found"] / r["size"] - 1) < 0.15 for r in named)
        sure = sum(abs(r["found"] - r["size"]) < 3 * r["std"] for r in named)
        sizes = f"{near} of {len(named)} | {sure} of {len(named)}" if named else "| "
        wrong = count["wrong"] + count["wrong group"] + count["failed"]
        above = "" if kind in ("none", "linear") else str(len(seen))
        lines.append(
            f"| {kind} | {len(cases)} | {above} | {count['right']} | {count['in the group']} | {count['missed']} | "
            f"{wrong} | {sizes} |"
        )
    below = [r for r in results if not visible(r) and r["kind"] not in ("none", "linear")]
    claims = sum(judged(r) in ("wrong", "wrong group") for r in results)
    hours = sum(r.get("seconds", 0.0) for r in results) / 3600
    lines += [
        "",
        f"Of {len(below)} cases below the limit {sum(judged(r) == 'right' for r in below)} were named rightly. Wrong "
        f"claims: {claims} of all {len(results)} cases. A rig without an effect, or with a linear one, is right "
        f"where nothing that depends on the level is claimed. Processor time: {hours:.1f} h.",
        "",
        "Cases that were not right:",
        "",
    ]
    for r in results:
        if judged(r) not in ("right", "in the group"):
            lines.append(
                f"- {r['kind']}, seed {r['seed']}: {' + '.join(r.get('hidden', []))} → {judged(r)}: {r['verdict']}, "
                f"claimed {', '.join(r['claimed']) or 'nothing'}, first {r.get('first')}"
                f"{'' if visible(r) else ' (below the limit)'}"
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
