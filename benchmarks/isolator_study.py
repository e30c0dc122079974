"""Hidden effects in simulated loops of an isolator: is the exact set found?

    nice -n 15 python benchmarks/isolator_study.py --cases 40 --out isolator_study.json
    python benchmarks/isolator_study.py --draw isolator_study.json --figure docs/figures/isolator_study.png

Each case hides a random set of effects with random sizes in nine loops (10, 12, 15 Hz; 1, 1.5, 2 mm; 30 cycles; 1 %
noise on both channels) and asks the diagnosis for it. An effect is above the limit where leaving it out of the true
model costs so much, without noise, that 19 of 20 tests exceed the threshold which the diagnosis states for it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from ema_pipeline.loops.diagnosis import diagnose_loops
from ema_pipeline.loops.effects import PARAMETERS, Structure
from ema_pipeline.loops.fitting import LoopSet, fit
from ema_pipeline.loops.visible import MARGIN
from matplotlib.figure import Figure

from ema_pipeline.loops.extract import measure_loop
from ema_pipeline.loops.simulate import PRINTED, simulate_sine_test
from ema_pipeline.loops.types import Loop
from ema_pipeline.threads import single_blas_thread

FREQUENCIES_HZ, AMPLITUDES_M = (10.0, 12.0, 15.0), (1e-3, 1.5e-3, 2e-3)
RATE_HZ = 5120.0
SHARE = (0.002, 0.3)
"""Force of an effect as a share of the spring's at the largest amplitude: log-uniform."""


def hidden(random: np.random.Generator) -> dict[str, float]:
    """Parameters of an isolator with a random set of effects."""
    k = PRINTED["stiffness"] * float(np.exp(0.2 * random.standard_normal()))
    x, omega = max(AMPLITUDES_M), 2 * np.pi * 12.0
    values = {"stiffness": k}

    def share() -> float:
        return float(np.exp(random.uniform(*np.log(SHARE))))

    chosen = [e for e in PARAMETERS if random.random() < 0.4]
    sign = float(random.choice([-1.0, 1.0]))
    if "quadratic_stiffness" in chosen:
        values["quadratic_stiffness"] = sign * share() * k / x
    if "cubic_stiffness" in chosen:
        values["cubic_stiffness"] = sign * share() * k / x**2
    if "viscous_damping" in chosen:
        values["viscous_damping"] = share() * k / omega
    if "hysteresis" in chosen:
        rho = PRINTED["hysteresis_rho"] * float(np.exp(0.5 * random.standard_normal()))
        values |= {
            "hysteresis_force": share() * k * x,
            "hysteresis_rho": rho,
            "hysteresis_sigma": float(random.uniform(0.15, 1.0)),
        }
    if "relaxation" in chosen:
        values |= {
            "relaxation_stiffness": share() * k,
            "relaxation_time": float(np.exp(random.uniform(np.log(0.7), np.log(4.0)))) / omega,
        }
    if "backlash" in chosen:
        values["backlash_gap"] = share() * x
    return values


def loops_of(values: dict[str, float], noise: float, random: np.random.Generator) -> list[Loop]:
    """The nine loops."""
    loops = []
    for f in FREQUENCIES_HZ:
        for a in AMPLITUDES_M:
            x, force = simulate_sine_test(values, f, a, sample_rate_hz=RATE_HZ, noise=noise, random=random)
            loops.append(measure_loop(x, force, RATE_HZ, f, a, name=f"{f:g} Hz, {1e3 * a:g} mm"))
    return loops


def effects_of(values: dict[str, float]) -> list[str]:
    """Effects that are hidden."""
    return [e for e, names in PARAMETERS.items() if set(names.values()) & set(values)]


def costs(values: dict[str, float], noisy: list[Loop], random: np.random.Generator) -> dict[str, float]:
    """What leaving each effect out of the true model costs without noise, in variances."""
    clean = [
        dataclasses.replace(c, force_std_n=n.force_std_n, displacement_std_m=n.displacement_std_m)
        for c, n in zip(loops_of(values, 0.0, random), noisy, strict=True)
    ]
    loops, true = LoopSet(clean), Structure(tuple(effects_of(values)))
    floor = fit(loops, true, values, grid=False).chi2
    return {e: fit(loops, true.without(e), values).chi2 - floor for e in true.effects}


def case(seed: int) -> dict[str, object]:
    """One case, asked and judged."""
    random = np.random.default_rng([2027, seed])
    values = hidden(random)
    loops = loops_of(values, 0.01, random)
    start = time.process_time()
    found, _ = diagnose_loops(loops)
    seconds = time.process_time() - start
    with single_blas_thread():
        cost = costs(values, loops, random)
    threshold = {c.effect: c.threshold for c in found.candidates}
    sizes = found.ladder.rungs[-1].parameters
    return {
        "seed": seed,
        "hidden": effects_of(values),
        "values": values,
        "found": [label.partition("@")[0] for label in found.ladder.rungs[-1].effects],
        "verdict": found.verdict,
        "groups": [list(g) for g in found.indistinguishable],
        "ratio": {
            e: float(np.sqrt(max(c, 0.0)) / (np.sqrt(threshold.get(e, 30.0)) + MARGIN))
            for e, c in cost.items()
        },
        "error": found.ladder.rungs[-1].error,
        "heldout_error": found.ladder.rungs[-1].heldout_error,
        "sizes": {n: [s.value, s.std] for n, s in sizes.items()},
        "cpu_s": seconds,
    }


def judge(cases: list[dict]) -> dict[str, object]:
    """Shares over all cases, and over those whose effects all lie above the limit."""
    clear = [c for c in cases if all(r >= 1 for r in c["ratio"].values())]
    exact = [set(c["found"]) == set(c["hidden"]) for c in clear]
    wrong = [bool(set(c["found"]) - set(c["hidden"])) for c in cases]
    return {
        "cases": len(cases),
        "above the limit": len(clear),
        "exact set": sum(exact),
        "share": sum(exact) / max(len(exact), 1),
        "exact set, all cases": sum(set(c["found"]) == set(c["hidden"]) for c in cases),
        "cases with a wrong effect": sum(wrong),
        "cpu_s, median": float(np.median([c["cpu_s"] for c in cases])),
    }


def draw(cases: list[dict], path: Path) -> None:
    """Every hidden effect: how far above the limit it lies, and whether it was found."""
    from ema_pipeline.report.style import GREEN, VERMILLION, margins, new_figure, png, styled

    @styled
    def figure() -> Figure:
        fig = new_figure(3.2)
        ax = fig.add_subplot(fig.add_gridspec(1, 1, **margins(fig, left=1.35))[0, 0])
        names = list(PARAMETERS)
        random = np.random.default_rng(0)
        seen = set()
        for c in cases:
            for effect, ratio in c["ratio"].items():
                hit = effect in c["found"]
                kind = "found" if hit else "not found"
                ax.plot(
                    max(ratio, 0.02),
                    names.index(effect) + random.uniform(-0.2, 0.2),
                    "o" if hit else "X",
                    color=GREEN if hit else VERMILLION,
                    label=kind if kind not in seen else None,
                )
                seen.add(kind)
        ax.axvline(1.0, color="#444444", ls="--", lw=0.9)
        ax.set_xscale("log")
        ax.set_yticks(range(len(names)), [n.replace("_", " ") for n in names])
        ax.set_xlabel("size of the hidden effect over the smallest that the diagnosis promises to show")
        ax.set_title(f"{len(cases)} isolators with hidden effects", loc="left")
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        return fig

    path.write_bytes(png(figure()))


def main() -> None:
    """Run the cases, or draw them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("isolator_study.json"))
    parser.add_argument("--draw", type=Path)
    parser.add_argument("--figure", type=Path, default=Path("isolator_study.png"))
    given = parser.parse_args()
    if given.draw:
        cases = json.loads(given.draw.read_text(encoding="utf-8"))
        draw(cases, given.figure)
    else:
        cases = []
        for seed in range(given.first, given.first + given.cases):
            cases.append(case(seed))
            last = cases[-1]
            print(
                seed,
                last["hidden"],
                last["found"],
                last["verdict"],
                last["ratio"],
                f"{last['cpu_s']:.0f} s",
                flush=True,
            )
            given.out.write_text(json.dumps(cases, indent=1), encoding="utf-8")
    print(json.dumps(judge(cases), indent=1))


if __name__ == "__main__":
    main()
