"""Which effect is missing? Diagnosis of simulated hammer tests of random rigs: confusion, limits, false alarms.

    python benchmarks/diagnosis_study.py study.jsonl --hours 2
    python benchmarks/diagnosis_study.py --report study.jsonl

Every test is simulated as raw hits and goes through all stages: hits, FRFs, modes, diagnosis. Rigs have two to four
planets, are drawn from their tolerances, their mesh stiffnesses from half a decade; one or both configurations are
measured, at one of two noise levels. Cases come in rounds: every linear effect once, at a random place and with a size
between hardly and clearly visible; for each of them a twin, the same test of the same rig with nothing missing; then
effects taken out of the library, and pairs of effects. So any number of cases is a balanced sample. A line is appended
to the file for each case; a study that was stopped goes on where it ended.

Detection limits are those that the tool states itself for the twin with nothing missing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from diagnosis_report import report

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.diagnose import DiagnoseSettings, Diagnosis, diagnose
from ema_pipeline.diagnose.hypotheses import single_hypotheses
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.planetary import extra_parameter, planetary
from ema_pipeline.rigs.types import Rig

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "mesh_stiffness_loss": {"fraction": (0.003, 0.5)},
    "planet_bearing_mistune": {"relative_change": (0.01, 0.5)},
    "planet_mass_mistune": {"mass": (0.003, 0.15)},
    "bearing_anisotropy": {"relative_stiffness": (0.01, 0.6)},
    "shaft_torsion": {"stiffness": (2e3, 1e6)},
    "shaft_coupling": {"stiffness": (5e3, 5e6)},
    "sensor_mass": {"mass": (0.005, 0.1)},
    "flexible_support": {"mass": (1.0, 6.0), "stiffness": (5e6, 5e7)},
    "local_damper": {"coefficient": (1.0, 200.0)},
    "hysteretic_damping": {"loss_factor": (0.002, 0.1)},
    "gyroscopic": {"coefficient": (1.0, 200.0)},
}
"""Ranges of sizes, evenly over their logarithm."""
NOISE = {"low": 1.0, "high": 5.0}
"""Of sensors and hammer, in units of the simulator's defaults."""
PLANETS_DIFFER = 1e-4
"""Of their masses, inertias and bearings: ten times more is a mistuned planet, which the tool names."""
SAME_AT_A_PLANET = ("sensor_mass", "planet_mass_mistune")
"""One and the same change under two names: a library that lacks the one must lack the other."""
REMOVED, PAIRS = 3, 3
"""Cases per round with an effect that the library lacks, and with two effects."""


@dataclass(frozen=True)
class Case:
    """One simulated test.

    Attributes
    ----------
    kind : str
        ``"single"``, ``"nothing"``, ``"removed"`` or ``"pair"``.
    seed : int
        Of the rig and of the noise; twins share it.
    truth : tuple of str
        Labels with sizes, ``id@place:name=value``.
    """

    number: int
    kind: str
    seed: int
    planets: int
    configurations: tuple[str, ...]
    noise: str
    truth: tuple[str, ...]

    @property
    def labels(self) -> list[str]:
        return [t.partition(":")[0] for t in self.truth]


def cases(seed: int) -> Iterator[Case]:
    """All cases, without end."""
    number = 0
    effects = sorted(SIZES)
    for turn in range(10**6):
        rng = np.random.default_rng([seed, turn])
        plan = [("single", (e,)) for e in rng.permutation(effects)]
        removed = [effects[(turn * REMOVED + i) % len(effects)] for i in range(REMOVED)]
        plan += [("removed", (e,)) for e in removed]
        plan += [("pair", tuple(rng.permutation(effects)[:2])) for _ in range(PAIRS)]
        for kind, chosen in plan:
            planets = int(rng.choice(3, p=[0.5, 0.3, 0.2])) + 2
            configurations = (("no_ring",), ("with_ring",), ("no_ring", "with_ring"))[
                rng.choice(3, p=[0.25, 0.25, 0.5])
            ]
            noise = str(rng.choice(list(NOISE)))
            truth = tuple(_sized(str(e), planets, configurations, kind != "single", rng) for e in chosen)
            own = seed * 10**6 + number
            yield Case(number, kind, own, planets, configurations, noise, truth)
            number += 1
            if kind == "single":
                yield Case(number, "nothing", own, planets, configurations, noise, ())
                number += 1


def _sized(
    effect: str, planets: int, configurations: tuple[str, ...], large: bool, rng: np.random.Generator
) -> str:
    """An effect at a random place; with a size in the upper half of its range where `large`."""
    rig = planetary(planets)
    library = {effect: shipped_effects()[effect]}
    places = [h.place for h in single_hypotheses(rig, configurations, library, parameters=False)]
    sizes = []
    for name, (low, high) in SIZES[effect].items():
        share = rng.uniform(0.5 if large else 0.0, 1.0)
        sizes.append(f"{name}={float(low * (high / low) ** share):.4g}")
    if effect == "bearing_anisotropy":
        sizes.append(f"angle_deg={rng.uniform(-90, 90):.1f}")
    return f"{effect}@{rng.choice(places)}:{','.join(sizes)}"


def true_rig(case: Case, rng: np.random.Generator) -> tuple[Rig, dict[str, float]]:
    """A rig drawn from its tolerances, whose planets differ slightly."""
    base = planetary(case.planets)
    values = {
        n: 10 ** rng.uniform(6.8, 7.3)
        if p.free
        else p.value * (1 + p.tolerance * float(np.clip(rng.normal(), -2.5, 2.5)))
        for n, p in base.parameters.items()
    }
    parameters = {}
    for n in range(1, case.planets + 1):
        for quantity in ("mass", "inertia", "bearing_stiffness"):
            p = extra_parameter(f"planet{n}_{quantity}", case.planets)
            assert p is not None
            parameters[p.name] = p
            values[p.name] = values[f"planet_{quantity}"] * (1 + PLANETS_DIFFER * rng.normal())
    return planetary(case.planets, parameters), values


def measure(case: Case) -> tuple[dict[str, MeasuredModes], dict[str, FrfSet]]:
    """Hits, written and read again, and the modes in them."""
    from ema_pipeline.simulate import simulate_campaign

    rig, values = true_rig(case, np.random.default_rng(case.seed))
    level = NOISE[case.noise]
    with tempfile.TemporaryDirectory() as folder:
        simulate_campaign(
            Path(folder) / "raw",
            rig,
            configurations=case.configurations,
            effects=case.truth,
            values=values,
            seed=case.seed,
            acceleration_noise=0.002 * level,
            force_noise_n=0.009 * level,
        )
        return chain(Path(folder) / "raw", case.configurations)


def chain(raw: Path, names: tuple[str, ...] = ()) -> tuple[dict[str, MeasuredModes], dict[str, FrfSet]]:
    """Measured modes and FRFs of a raw folder."""
    from ema_pipeline.frf import estimate_frfs
    from ema_pipeline.frf.settings import FrfSettings
    from ema_pipeline.ingest.description import read_campaign
    from ema_pipeline.ingest.hit_settings import HitSettings
    from ema_pipeline.ingest.hits import find_hits
    from ema_pipeline.ingest.load import load_record
    from ema_pipeline.ingest.records import cut_hit
    from ema_pipeline.modal.identify import identify
    from ema_pipeline.modal.settings import ModalSettings

    modes, frfs = {}, {}
    for i, test in enumerate(read_campaign(raw).tests):
        hits = []
        for entry in test.records:
            record = load_record(test, entry)
            hits += [cut_hit(record, h) for h in find_hits(record, HitSettings())]
        name = test.configuration or names[i]
        frfs[name] = estimate_frfs(hits, FrfSettings())
        modes[name] = from_modal_model(identify(frfs[name], ModalSettings()), name)
    return modes, frfs


def run(case: Case) -> dict[str, object]:
    """One case: a line of the study's file."""
    start = time.process_time()
    line: dict[str, object] = {**asdict(case), "version": version()}
    library = dict(shipped_effects())
    if case.kind == "removed":
        for label in case.labels:
            family, _, place = label.partition("@")
            del library[family]
            if place.startswith("planet") and family in SAME_AT_A_PLANET:
                library = {k: v for k, v in library.items() if k not in SAME_AT_A_PLANET}
    try:
        measured, frfs = measure(case)
        middle = time.process_time()
        found = diagnose(planetary(case.planets), measured, DiagnoseSettings(processes=1), library, frfs=frfs)
    except EmaError as error:
        return {**line, "failed": str(error)}
    end = time.process_time()
    return {**line, **_told(found), "seconds": [round(middle - start, 2), round(end - middle, 2)]}


def _told(d: Diagnosis) -> dict[str, object]:
    return {
        "verdict": d.verdict,
        "summary": d.summary,
        "nothing": d.null_probability,
        "claimed": list(d.ladder.rungs[-1].effects),
        "errors": [[r.error, r.heldout_error] for r in d.ladder.rungs],
        "candidates": [
            {
                "label": c.label,
                "probability": c.probability,
                "gain": c.gain,
                "heldout": [c.heldout_before, c.heldout_error_after],
                "sizes": {k: [v.value, v.std] for k, v in c.parameters.items()},
            }
            for c in d.candidates
        ],
        "groups": [list(g) for g in d.indistinguishable],
        "places": [(x.place, x.acts_like) for x in d.localisation[:3]],
        "limits": {f"{x.label}.{x.parameter}": x.size for x in d.detection_limits},
    }


def version() -> str:
    """Commit of the program, with a plus where files are changed."""

    here = Path(__file__).parent
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=here, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit


def main() -> None:
    """Run cases until the time is over, or report on those that were run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="JSON lines, one per case")
    parser.add_argument("--report", action="store_true", help="print the tables as Markdown and end")
    parser.add_argument("--hours", type=float, default=1.0, help="no case is started after this time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, nargs="*", default=(), help="numbers of cases to run (again)")
    o = parser.parse_args()
    if o.report:
        print(report(o.file))
        return
    lines = o.file.read_text().splitlines() if o.file.is_file() else []
    done = {json.loads(line)["number"] for line in lines}
    end = time.monotonic() + 3600 * o.hours
    for case in cases(o.seed):
        if time.monotonic() > end or (o.only and case.number > max(o.only)):
            break
        if case.number not in o.only if o.only else case.number in done:
            continue
        line = run(case)
        with o.file.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(
            case.number,
            case.kind,
            case.truth,
            line.get("verdict", line.get("failed")),
            line.get("claimed"),
            line.get("seconds"),
            flush=True,
        )


if __name__ == "__main__":
    main()
