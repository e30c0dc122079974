"""How often is an effect that depends on the force level named rightly? Random rigs through simulated hits.

    python benchmarks/level_diagnosis_study.py --cases 20 --seed 1 --out study.jsonl

Every case draws a rig from its tolerances, hides one effect of a random size at a random place (or none), simulates
hammer tests at 30, 100 and 300 N, writes and reads them as raw volts, and runs the diagnosis by hits. Modes of the
softest and of the hardest level are identified from their own FRFs. Sizes are drawn evenly over the logarithm in
ranges that reach from hardly to clearly visible; the misfit that the base model leaves at the hardest (friction: the
softest) level says how visible a case was.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from ema_pipeline.correlate.measured import from_modal_model
from ema_pipeline.diagnose.levels.case import LevelCase
from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels
from ema_pipeline.diagnose.levels.prepare import LevelTest, common_levels, highest_mode, soft_and_hard, windows_of
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.fit.map_fit import fit_rig
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.description import read_campaign
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.quality import hits_of_test
from ema_pipeline.ingest.records import cut_hit
from ema_pipeline.levels.types import ForceLevel, LevelStudy
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.simulate.campaign import simulate_campaign

IMPACTS = {
    "no_ring": ("carrier.x", "sun.y", "planet1.x", "sun.u"),
    "with_ring": ("carrier.x", "sun.y", "planet1.x", "sun.u", "ring.x"),
}
LEVELS_N = (30.0, 100.0, 300.0)
SIZES = {
    "bearing_cubic": ("stiffness", 1e11, 3e12, True),
    "bearing_quadratic": ("stiffness", 3e7, 5e8, True),
    "dry_friction": ("force", 0.2, 8.0, False),
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
    levels = []
    for k in range(len(LEVELS_N)):
        own = [h for h, level in zip(hits, at, strict=True) if level == k]
        frfs = estimate_frfs([cut_hit(by_file[h.file], h) for h in own], FrfSettings())
        modal = identify(frfs, ModalSettings()) if k in (0, len(LEVELS_N) - 1) else None
        names = tuple(f"{h.file}#{h.number}" for h in own)
        levels.append(ForceLevel(float(np.median(peaks[at == k])), names, frfs, modal))
    assert levels[0].modal is not None
    study = LevelStudy(tuple(levels), (), (), (), (), True, 0.0, "")
    tests = [LevelTest(case["configuration"], study, levels[0].modal)]
    settings = DiagnoseSettings()
    starts = [
        {n: p.value for n, p in fit_rig(rig, m, FitSettings(), None, lambda share, text: None).parameters.items()}
        for m in soft_and_hard(tests)
    ]
    pairs = [(by_file[h.file], h) for h in hits]
    windows = windows_of(tests[0], pairs, common_levels(tests), settings.levels)
    return LevelCase(rig, (windows,), settings, None, tuple(starts), highest_mode(tests))


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
                result = {"effect": effect, "label": "", "seed": given.seed + k, "verdict": f"failed: {error}", "claimed": [], "group": []}
            results.append(result)
            with given.out.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(effect, result.get("label"), result.get("size"), "->", judged(result), result["verdict"],
                  result.get("first"), result.get("found"), flush=True)  # fmt: skip
    for effect in given.only:
        print(effect, dict(Counter(judged(r) for r in results if r["effect"] == effect)))


if __name__ == "__main__":
    main()
