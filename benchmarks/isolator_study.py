"""Hidden effects in simulated loops of an isolator: is the exact set found?

    nice -n 15 python benchmarks/isolator_study.py --cases 40 --out isolator_study.json
    python benchmarks/isolator_study.py --draw isolator_study.json --figure docs/figures/isolator_study.png

Each case hides a random set of effects with random sizes in nine loops (10, 12, 15 Hz; 1, 1.5, 2 mm; 30 cycles; 1 %
noise on both channels) and asks the diagnosis for it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ema_pipeline.diagnose.loops import diagnose_loops
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Diagnosis
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.loops.extract import measure_loop
from ema_pipeline.loops.model import EFFECTS
from ema_pipeline.loops.simulate import PRINTED, simulate_sine_test
from ema_pipeline.loops.types import Loop
from ema_pipeline.observations.loops import LoopObservations
from ema_pipeline.rigs.isolator import PLACE, isolator
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

    chosen = [e for e in EFFECTS if random.random() < 0.4]
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
    return [e for e, names in EFFECTS.items() if set(names.values()) & set(values)]


def ratios(found: Diagnosis, values: dict[str, float]) -> dict[str, float]:
    """Log evidence that every hidden effect gains, over what a claim needs; 0 where it was never a finalist."""
    gains = {c.effect: c.log_evidence / c.threshold for c in found.candidates}
    return {e: max(gains.get(e, 0.0), 0.0) for e in effects_of(values)}


def deviations(found: Diagnosis, values: dict[str, float]) -> dict[str, float]:
    """(Size - truth) in standard deviations, of every size that was found."""
    known = {"stiffness": "stiffness"}
    for effect, names in EFFECTS.items():
        for place in (PLACE, f"{PLACE}.mount"):
            known |= {f"{effect}@{place}.{own}": name for own, name in names.items()}
    sizes = found.ladder.rungs[-1].parameters
    return {n: (s.value - values[known[n]]) / s.std for n, s in sizes.items() if known.get(n) in values}


def case(seed: int) -> dict[str, object]:
    """One case, asked and judged."""
    random = np.random.default_rng([2027, seed])
    values = hidden(random)
    loops = loops_of(values, 0.01, random)
    start = time.process_time()
    with single_blas_thread():
        observations = LoopObservations(isolator(), loops)
        found = diagnose_loops(observations, shipped_effects(), settings=DiagnoseSettings(processes=1))
    seconds = time.process_time() - start
    top = found.ladder.rungs[-1]
    return {
        "seed": seed,
        "hidden": effects_of(values),
        "values": values,
        "found": [label.partition("@")[0] for label in top.effects],
        "verdict": found.verdict,
        "groups": [list(g) for g in found.indistinguishable],
        "ratio": ratios(found, values),
        "error": top.error,
        "heldout_error": top.heldout_error,
        "deviations": deviations(found, values),
        "cpu_s": seconds,
    }


def judge(cases: list[dict]) -> dict[str, object]:
    """Shares over all cases."""
    wrong = [bool(set(c["found"]) - set(c["hidden"])) for c in cases]
    missed = [bool(set(c["hidden"]) - set(c["found"])) for c in cases]
    apart = np.abs([z for c in cases for z in c["deviations"].values()])
    return {
        "cases": len(cases),
        "exact set": sum(set(c["found"]) == set(c["hidden"]) for c in cases),
        "cases with a missed effect": sum(missed),
        "cases with a wrong effect": sum(wrong),
        "sizes within 90 % intervals": float(np.mean(apart < 1.645)) if len(apart) else float("nan"),
        "cpu_s, median": float(np.median([c["cpu_s"] for c in cases])),
    }


def draw(cases: list[dict], path: Path) -> None:
    """Every hidden effect: what it gains, and whether it was found."""
    from ema_pipeline.report.style import GREEN, VERMILLION, margins, new_figure, png, styled

    @styled
    def figure() -> Figure:
        fig = new_figure(3.2)
        ax = fig.add_subplot(fig.add_gridspec(1, 1, **margins(fig, left=1.35))[0, 0])
        names = list(EFFECTS)
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
        ax.set_xlabel("log evidence that the hidden effect gains, over what a claim needs")
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
