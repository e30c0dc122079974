"""How often is an effect that depends on the force level named rightly? Random rigs through simulated hits.

    python benchmarks/level_diagnosis_study.py --cases 20 --seed 1 --out study.jsonl

Every case draws a rig from its tolerances, hides one effect of a random size at a random place (or none), simulates
hammer tests at 30, 100 and 300 N, writes and reads them as raw volts, and runs the diagnosis by hits. In place of an
identification, which takes longer than all the rest, modes of the true rig with the scatter of one are the start.
Sizes are drawn evenly over the logarithm in ranges that reach from hardly to clearly visible; the misfit that the
base model leaves at the hardest (friction: the softest) level says how visible a case was.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import cast

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
from ema_pipeline.fit.map_fit import fit_rig
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf.types import FrfSet
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
NO_FRFS = cast(FrfSet, None)
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


def draw(effect: str, random: np.random.Generator) -> dict:
    """Planets, configuration, place and size of one case."""
    planets = int(random.choice([2, 3]))
    configuration = str(random.choice(["no_ring", "with_ring"]))
    rig = planetary(planets)
    if effect == "none":
        return {"planets": planets, "configuration": configuration, "effect": "none", "label": ""}
    place = str(random.choice(shipped_effects()[effect].places(rig, configuration)))
    name, low, high, signed = SIZES[effect]
    size = float(np.exp(random.uniform(np.log(low), np.log(high))))
    if signed and random.uniform() < (0.3 if effect == "bearing_cubic" else 0.5):
        size = -0.3 * size if effect == "bearing_cubic" else -size
    label = f"{effect}@{place}"
    return {
        "planets": planets, "configuration": configuration, "effect": effect, "label": label,
        "parameter": name, "size": size,
    }  # fmt: skip


def measure(case: dict, folder: Path, seed: int) -> LevelCase:
    """Simulated raw data of a case, read back, with the starts of its fit."""
    rig = planetary(case["planets"])
    effects = [f"{case['label']}:{case['parameter']}={case['size']}"] if case["label"] else []
    simulate_campaign(
        folder, rig, configurations=[case["configuration"]], effects=effects,
        impacts=IMPACTS[case["configuration"]],
        hits=1, peak_force_n=LEVELS_N, scatter=1.0, seed=seed,
    )  # fmt: skip
    test = read_campaign(folder).tests[0]
    records = list(load_records(test))
    hits = [h for h in hits_of_test(records) if h.accepted]
    by_file = {r.file: r for r in records}
    peaks = np.array([abs(h.peak_force) for h in hits])
    at = np.argmin(np.abs(np.log(peaks[:, None] / np.array(LEVELS_N))), axis=1)
    modes = level_modes(rig, case["configuration"], folder, windows_sensors(records), seed)
    modal = to_modal_model(modes)
    levels = []
    for k in range(len(LEVELS_N)):
        names = tuple(f"{h.file}#{h.number}" for h, level in zip(hits, at, strict=True) if level == k)
        levels.append(ForceLevel(float(np.median(peaks[at == k])), names, NO_FRFS, modal))
    study = LevelStudy(tuple(levels), (), (), (), (), True, 0.0, "")
    tests = [LevelTest(case["configuration"], study, modal)]
    settings = DiagnoseSettings()
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
    """Modes of the true rig without the effect, with the scatter that an identification leaves."""
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


def run(effect: str, seed: int) -> dict:
    """One case, from its drawing to the verdict."""
    case = draw(effect, np.random.default_rng([seed, sorted([*SIZES, "none"]).index(effect)]))
    with tempfile.TemporaryDirectory() as folder:
        prepared = measure(case, Path(folder) / "raw", seed)
    begun = time.process_time()
    found = diagnose_levels(prepared, (), None, "", ())
    first, last = found.ladder.rungs[0], found.ladder.rungs[-1]
    top = found.candidates[0]
    claimed = [c.label for c in found.candidates if c.claimed]
    value = top.parameters.get(case.get("parameter", ""))
    return case | {
        "seed": seed,
        "verdict": found.verdict,
        "claimed": claimed,
        "group": [list(g) for g in found.indistinguishable],
        "first": top.label,
        "probability": top.probability,
        "found": None if value is None else value.value,
        "std": None if value is None else value.std,
        "gain": top.gain,
        "misfit": first.misfit,
        "heldout": [first.heldout_misfit, last.heldout_misfit],
        "errors": [first.error, last.error],
        "noise": found.ladder.hit_noise,
        "seconds": time.process_time() - begun,
    }


def judged(result: dict) -> str:
    """Right, in a group, missed or wrong."""
    right = [result["label"]] if result["label"] else []
    if result["verdict"] == "effect":
        return "right" if result["claimed"] == right else "wrong"
    if result["verdict"] == "ambiguous":
        return "in the group" if any(result["label"] in g for g in result["group"]) else "wrong group"
    return "nothing claimed"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=5, help="cases per effect")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first case")
    parser.add_argument("--only", nargs="*", default=[*SIZES, "none"], help="effects")
    parser.add_argument("--out", type=Path, default=Path("level_diagnosis.jsonl"))
    given = parser.parse_args()
    results = []
    for k in range(given.cases):
        for effect in given.only:
            try:
                result = run(effect, given.seed + k)
            except Exception as error:  # a failing case is a result too
                result = {
                    "effect": effect,
                    "label": "",
                    "seed": given.seed + k,
                    "verdict": f"failed: {error}",
                    "claimed": [],
                    "group": [],
                }
            results.append(result)
            with given.out.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(effect, result.get("label"), result.get("size"), "->", judged(result), result["verdict"],
                  result.get("first"), result.get("found"), flush=True)  # fmt: skip
    for effect in given.only:
        print(effect, dict(Counter(judged(r) for r in results if r["effect"] == effect)))


if __name__ == "__main__":
    main()
