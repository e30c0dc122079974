"""Which effect is missing? Diagnosis of rigs drawn at random: confusion, detection, false alarms, calibration.

    python benchmarks/diagnosis_study.py --null 40 --cases 2 --seed 1 --noise 0.1

Every rig is drawn from its tolerances, its mesh stiffnesses from half a decade, its planets differ by
`--planet-scatter`. Modes are drawn from the model at its truth with scatter of frequency, damping and shape; some
are missed, some are spurious. The diagnosis sees the modes and their standard deviations only. `--raw` writes hammer
hits instead and runs the whole chain on them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.correlate.residuals import matrices, observable_modes
from ema_pipeline.diagnose import DiagnoseSettings, Diagnosis, diagnose
from ema_pipeline.diagnose.hypotheses import single_hypotheses
from ema_pipeline.diagnose.thresholds import from_null_gains
from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.planetary import extra_parameter, planetary
from ema_pipeline.rigs.types import Rig

# Sizes from barely to clearly visible, in units of the effects' own scale.
SIZES = (0.1, 0.3, 1.0)


@dataclass(frozen=True)
class Noise:
    """Standard deviations (relative; shape in units of the largest entry) and shares of bad modes."""

    frequency: float = 1e-3
    damping: float = 0.1
    shape: float = 0.02
    missed: float = 0.05
    spurious: float = 0.03
    planets: float = 1e-3
    band: tuple[float, float] = (2.0, 2000.0)


def draw(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    """True values of the base rig's parameters."""
    return {
        n: 10 ** rng.uniform(6.8, 7.3)
        if p.free
        else p.value * (1 + p.tolerance * float(np.clip(rng.normal(), -2.5, 2.5)))
        for n, p in rig.parameters.items()
    }


def true_rig(
    planets: int, effects: list[str], values: dict[str, float], noise: Noise, rng: np.random.Generator
) -> tuple[Rig, dict[str, float]]:
    """The rig with its effect, and planets that differ slightly."""
    parameters, given = {}, dict(values)
    for n in range(1, planets + 1):
        for quantity in ("mass", "inertia", "bearing_stiffness"):
            p = extra_parameter(f"planet{n}_{quantity}", planets)
            assert p is not None
            parameters[p.name] = p
            given[p.name] = values[f"planet_{quantity}"] * (1 + noise.planets * rng.normal())
    return rig_with_effects(planetary(planets, parameters), effects), given


def measure(
    rig: Rig, configuration: str, values: Mapping[str, float], noise: Noise, rng: np.random.Generator
) -> MeasuredModes:
    """Measured modes with scatter, misses and spurious ones."""
    system = rig.system(configuration, values)
    modes = observable_modes(matrices(system))
    f = modes.omega[0] / (2 * np.pi)
    bodies = [b for b in ("carrier", "ring", "sun") if f"{b}.x" in system.dofs]
    planets = sorted({d.partition(".")[0] for d in system.dofs if d.startswith("planet")})
    dofs = tuple(Dof(b, d) for b in (*bodies, *planets) for d in ("x", "y", "u"))
    inside = (f > noise.band[0]) & (f < noise.band[1]) & (rng.random(f.size) > noise.missed)
    shapes = (sensor_rows(system, dofs) @ modes.shapes[0][:, inside]).T.astype(complex)
    shapes = shapes / np.abs(shapes).max(axis=1, keepdims=True)
    turn = np.exp(-0.5j * np.angle(np.sum(shapes**2, axis=1)))
    shapes = shapes * turn[:, None]
    f, zeta = f[inside], modes.damping_ratio[0][inside]
    false = rng.poisson(noise.spurious * f.size)
    f = np.concatenate([f, rng.uniform(*noise.band, false)])
    zeta = np.concatenate([zeta, np.full(false, 0.02)])
    wild = rng.normal(size=(false, len(dofs))) + 0j
    shapes = np.concatenate([shapes, wild / np.maximum(np.abs(wild).max(axis=1, keepdims=True), 1e-9)])
    scatter = rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape)
    measured = f * (1 + noise.frequency * rng.normal(size=f.size))
    order = np.argsort(measured)
    return MeasuredModes(
        configuration=configuration,
        frequency_hz=measured[order],
        frequency_std_hz=noise.frequency * f[order],
        damping_ratio=(zeta * (1 + noise.damping * rng.normal(size=f.size)))[order],
        damping_std=noise.damping * zeta[order],
        shapes=(shapes + noise.shape * scatter)[order],
        shape_std=np.full(shapes.shape, noise.shape),
        dofs=dofs,
        band_hz=noise.band,
        references=tuple(Dof(b, d) for b in (*bodies, planets[0]) for d in ("x", "y", "u")),
    )


def sizes_of(label: str, share: float) -> dict[str, float]:
    """Sizes of an effect at a share of its scale."""
    from ema_pipeline.effects.library import get_effect

    sizes = {}
    for p in get_effect(label.partition("@")[0]).parameters:
        if p.unit == "deg":
            sizes[p.name] = 30.0
        elif p.minimum > 0:
            sizes[p.name] = p.start
        else:
            sizes[p.name] = min(p.null + share * p.scale, 0.95 * p.maximum)
    return sizes


def raw_modes(rig: Rig, effects: list[str], values: dict[str, float], seed: int) -> dict[str, MeasuredModes]:
    """Hits, written and read again, through the whole chain."""
    from ema_pipeline.simulate import simulate_campaign

    with tempfile.TemporaryDirectory() as folder:
        simulate_campaign(Path(folder) / "raw", rig, effects=effects, values=values, seed=seed)
        return chain(Path(folder) / "raw")


def chain(raw: Path) -> dict[str, MeasuredModes]:
    """Measured modes of a raw folder."""
    from ema_pipeline.frf import estimate_frfs
    from ema_pipeline.frf.settings import FrfSettings
    from ema_pipeline.ingest.description import read_campaign
    from ema_pipeline.ingest.hit_settings import HitSettings
    from ema_pipeline.ingest.hits import find_hits
    from ema_pipeline.ingest.load import load_record
    from ema_pipeline.ingest.records import cut_hit
    from ema_pipeline.modal.identify import identify
    from ema_pipeline.modal.settings import ModalSettings

    result = {}
    for test in read_campaign(raw).tests:
        hits = []
        for entry in test.records:
            record = load_record(test, entry)
            hits += [cut_hit(record, h) for h in find_hits(record, HitSettings())]
        name = test.configuration or "default"
        result[name] = from_modal_model(identify(estimate_frfs(hits, FrfSettings()), ModalSettings()), name)
    return result


def describe(d: Diagnosis, truth: str, share: float, seconds: float) -> dict[str, object]:
    """One line of the result."""
    first = d.candidates[0] if d.candidates else None
    claimed = [c.label for c in d.candidates if c.claimed]
    return {
        "truth": truth,
        "share": share,
        "verdict": d.verdict,
        "first": first.label if first else "",
        "p": round(first.probability, 4) if first else 0.0,
        "null": round(d.null_probability, 4),
        "claimed": claimed,
        "group": [list(g) for g in d.indistinguishable],
        "gain": round(first.gain, 2) if first else 0.0,
        "error": [round(r.error, 3) for r in d.ladder.rungs],
        "heldout": [round(r.heldout_error, 3) for r in d.ladder.rungs],
        "size": {k: (v.value, v.std) for k, v in first.parameters.items()} if first else {},
        "seconds": round(seconds, 1),
    }


def right(row: dict[str, object]) -> str:
    """right, group, wrong, missed, or unknown."""
    truth, claimed, verdict = row["truth"], row["claimed"], row["verdict"]
    assert isinstance(claimed, list)
    if truth == "nothing":
        return "false alarm" if claimed or verdict == "unknown_effect" else "right"
    if verdict == "unknown_effect":
        return "unknown"
    if not claimed:
        return "missed"
    if verdict == "ambiguous":
        groups = row["group"]
        assert isinstance(groups, list)
        return "group" if any(truth in g for g in groups) else "wrong"
    return "right" if claimed[0] == truth else "wrong"


def main() -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--null", type=int, default=10, help="cases with nothing missing")
    parser.add_argument("--cases", type=int, default=1, help="cases per effect, place and size")
    parser.add_argument(
        "--effects", default="", help="ids, separated by commas; all linear ones where left out"
    )
    parser.add_argument("--places", type=int, default=1, help="places per effect, drawn at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--noise", type=float, default=1.0, help="1: 0.1 %% frequency, 10 %% damping, 2 %% shape"
    )
    parser.add_argument("--planets", type=int, default=2)
    parser.add_argument("--planet-scatter", type=float, default=1e-3, help="relative difference of planets")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--raw", action="store_true", help="simulate hits and run the whole chain")
    parser.add_argument("--out", type=Path, default=None, help="JSON lines of all cases")
    o = parser.parse_args()

    base = planetary(o.planets) if o.planets != 2 else load_rig("planetary")
    noise = replace(
        Noise(),
        frequency=1e-3 * o.noise,
        damping=0.1 * o.noise,
        shape=0.02 * o.noise,
        planets=o.planet_scatter,
    )
    rng = np.random.default_rng(o.seed)
    labels: list[tuple[str, float]] = [("nothing", 0.0)] * o.null
    by_effect: dict[str, list[str]] = {}
    for h in single_hypotheses(base, base.configurations, None, parameters=False):
        by_effect.setdefault(h.family, []).append(h.label)
    wanted = [e for e in o.effects.split(",") if e] or list(by_effect)
    if o.cases:
        for effect in wanted:
            for share in SIZES:
                for _ in range(o.cases):
                    chosen = rng.permutation(len(by_effect[effect]))[: o.places]
                    labels += [(by_effect[effect][i], share) for i in chosen]
    settings = DiagnoseSettings(processes=o.processes)
    rows, gains = [], []
    for number, (label, share) in enumerate(labels):
        case_rng = np.random.default_rng([o.seed, number])
        values = draw(base, case_rng)
        effects = [] if label == "nothing" else [label]
        rig, true = true_rig(o.planets, effects, values, noise, case_rng)
        if effects:
            true |= {f"{label}.{k}": v for k, v in sizes_of(label, share).items()}
        if o.raw:
            measured = raw_modes(base, effects, {}, o.seed + number)
        else:
            measured = {c: measure(rig, c, true, noise, case_rng) for c in base.configurations}
        start = time.time()
        d = diagnose(base, measured, settings)
        row = describe(d, label, share, time.time() - start)
        row["outcome"] = right(row)
        rows.append(row)
        if label == "nothing":
            best: dict[str, float] = {}
            for c in d.candidates:
                best[c.effect] = max(best.get(c.effect, 0.0), c.gain)
            gains.append(best)
        print(json.dumps(row), flush=True)
        if o.out:
            with o.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    tables(rows)
    if gains:
        print("thresholds at 1 %:", {k: round(v, 1) for k, v in from_null_gains(gains).items()})


def tables(rows: list[dict[str, object]]) -> None:
    """Outcomes by effect and size, confusions, calibration."""
    print("\noutcomes by effect and size (share of the effect's scale)")
    for key in dict.fromkeys((str(r["truth"]).partition("@")[0], r["share"]) for r in rows):
        outcomes = Counter(
            r["outcome"] for r in rows if (str(r["truth"]).partition("@")[0], r["share"]) == key
        )
        print(f"  {key[0]:26s} {key[1]!s:5s} {dict(outcomes)}")
    print("confusions")
    for (truth, first), n in Counter(
        (r["truth"], r["first"]) for r in rows if r["outcome"] == "wrong"
    ).most_common(20):
        print(f"  {truth} taken for {first}: {n}")
    print(
        "calibration: probability of the first candidate (over something missing) and how often it is right"
    )
    for low, high in ((0.0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01)):
        picked = [r for r in rows if r["truth"] != "nothing" and low <= float(str(r["p"])) < high]
        if picked:
            hits = np.mean([r["first"] == r["truth"] for r in picked])
            print(f"  {low:.2f}-{min(high, 1):.2f}: {len(picked)} cases, right {100 * hits:.0f} %")


if __name__ == "__main__":
    main()
