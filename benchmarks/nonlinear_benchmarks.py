"""Free-run errors on the Silverbox and the Bouc-Wen benchmark beside published ones, and the speed of the simulation.

    python benchmarks/nonlinear_benchmarks.py DATA

DATA is a folder with the raw folders ``silverbox`` and ``bouc_wen`` (test.toml and records). Each is run as a user runs
it: the Silverbox with a rig file of two lines, Bouc-Wen without a rig. Published figures are
printed where they could be checked.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.driven_system import CodedElements
from ema_pipeline.mechanics.laws import PolynomialSpring
from ema_pipeline.mechanics.simulation import between_samples, march

RIG = """masses = [{ at = "mass.x", value = 1.0 }]
springs = [{ at = "mass.x", value = 1.0 }]
"""
PUBLISHED: dict[str, tuple[tuple[str, float, str], ...]] = {
    "bouc_wen": (
        ("multisine", 1.2e-5, "polynomial nonlinear state space (Noël, Esfahani, Kerschen, Schoukens 2017)"),
    ),
}
"""Figures on the same records that could be checked; the Silverbox is mostly divided in other ways."""


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.toml"
        rig.write_text(RIG)
        show("silverbox", data / "silverbox", Path(folder) / "silverbox", rig)
        show("bouc_wen", data / "bouc_wen", Path(folder) / "bouc_wen", None)
    speed()


def show(name: str, raw: Path, out: Path, rig: Path | None) -> None:
    """Run one benchmark and print it."""
    start = time.perf_counter()
    given = ["--rig", str(rig)] if rig else []
    command = [sys.executable, "-c", "from ema_pipeline.cli import main; main()", "run", str(raw), *given]
    subprocess.run([*command, "--out", str(out), "--quiet"], check=True)
    seconds = time.perf_counter() - start
    found = json.loads((out / "summary.json").read_text())
    print(f"\n{name}: {seconds:.0f} s from raw records to the report")
    print("  ladder: linear" + "".join(f" -> + {r['effects'][-1]}" for r in found["ladder"] if r["effects"]))
    for record, e in found["simulation"]["records"].items():
        print(
            f"  {record:12s} {e['use']:9s} {e['rmse']:.3g} {e['unit']} ({100 * e['relative']:.2g} % of the response; "
            f"linear {e['rmse_without_effects']:.3g} {e['unit']})"
        )
    for record, rmse, source in PUBLISHED.get(name, ()):
        print(f"  published: {record:12s} {rmse:.3g} m, {source}")


def speed(samples: int = 100_000, substeps: int = 4) -> None:
    """DOF-steps a second of the compiled loop, for a mass and for a chain of three with one cubic spring."""
    force = np.random.default_rng(0).standard_normal((1, samples))
    fine = between_samples(force, 2 * substeps)
    print("\nsimulation:")
    for n in (1, 3):
        dofs = tuple(f"m{k}.x" for k in range(n))
        elements = [e for d in dofs for e in (Mass(d, {d: 1.0}, 1.0), Damper(d, {d: 1.0}, 20.0))]
        springs = [
            Spring(f"k{k}", {dofs[k]: 1.0, **({dofs[k - 1]: -1.0} if k else {})}, 1e5) for k in range(n)
        ]
        cubic = PolynomialSpring("cubic", {dofs[0]: 1.0}, 0.0, 1e9)
        assembly = Assembly(dofs, (*elements, *springs, cubic))
        system = CodedElements.of(assembly).driven(assembly.system(), np.eye(n)[:1])
        march(system, 1024.0, substeps, fine, np.zeros(system.size))
        times = []
        for _ in range(5):
            start = time.process_time()
            march(system, 1024.0, substeps, fine, np.zeros(system.size))
            times.append(time.process_time() - start)
        rate = n * samples * substeps / min(times)
        print(f"  {n} DOF: {rate / 1e6:.1f} million DOF-steps a second, one core")


if __name__ == "__main__":
    main()
