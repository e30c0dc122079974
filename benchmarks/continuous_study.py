"""Simulated oscillators with one hidden nonlinear effect, or none, from raw records to the verdict of `ema run`.

    python benchmarks/continuous_study.py [CASES]

Every fifth oscillator is linear. The equations of motion are integrated in plain Python, with 1 % noise on force and
response. Printed is whether the first claim is the hidden effect, and its size over the true one.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

RATE, FIT, HELD_OUT, FINE, LEAD = 512.0, 4096, 2048, 6, 512
EFFECTS = ("cubic_spring", "quadratic_spring", "dry_friction", "quadratic_damping", "linear")
Law = Callable[[float, float], float]


def main() -> None:
    """Run all cases and count."""
    cases, right = int(sys.argv[1]) if len(sys.argv) > 1 else 20, 0
    for case in range(cases):
        effect = EFFECTS[case % len(EFFECTS)]
        with tempfile.TemporaryDirectory() as folder:
            size = write(Path(folder) / "raw", effect, np.random.default_rng(case))
            verdict, claimed = run(Path(folder))
        first = claimed[0] if claimed else ("nothing", float("nan"))
        good = (first[0] == effect and len(claimed) == 1) or (effect == "linear" and not claimed)
        right += good
        ratio = first[1] / size if effect == first[0] else float("nan")
        print(
            f"{case:3d} {effect:18s} {verdict:15s} {first[0]:18s} size/true {ratio:6.3f} {'' if good else 'WRONG'}"
        )
    print(f"{right} of {cases} right")


def write(folder: Path, effect: str, random: np.random.Generator) -> float:
    """Write one raw folder; the true size of its effect."""
    mass, frequency, ratio = random.uniform(0.5, 4.0), random.uniform(15.0, 40.0), random.uniform(0.01, 0.04)
    stiffness = mass * (2 * np.pi * frequency) ** 2
    damping, rms = 2 * ratio * np.sqrt(stiffness * mass), 20.0
    x = rms / stiffness * np.sqrt(0.5 / ratio)  # what a broad force of this size moves it by, roughly
    v, share = x * 2 * np.pi * frequency, random.uniform(0.05, 0.2)
    size = {
        "cubic_spring": share * stiffness / x**2,
        "quadratic_spring": share * stiffness / x,
        "dry_friction": 2 * share * damping * v,
        "quadratic_damping": 4 * share * damping / v,
        "linear": 0.0,
    }[effect]
    laws: dict[str, Law] = {
        "cubic_spring": lambda x, v: size * x**3,
        "quadratic_spring": lambda x, v: size * x**2,
        "dry_friction": lambda x, v: size * float(np.tanh(v / slow)),
        "quadratic_damping": lambda x, v: size * abs(v) * v,
        "linear": lambda x, v: 0.0,
    }
    slow = 0.05 * v
    folder.mkdir()
    parts = [respond(mass, damping, stiffness, laws[effect], n, rms, random) for n in (FIT, HELD_OUT)]
    with h5py.File(folder / "r.h5", "w") as file:
        for k, name in enumerate(("f", "x")):
            signal = np.concatenate([p[k] for p in parts])
            file[name] = signal + 0.01 * np.std(signal) * random.standard_normal(len(signal))
    channels = "".join(
        f'[[channels]]\nname = "{n}"\nquantity = "{q}"\nunit = "{u}"\ndof = "mass.x"\n'
        for n, q, u in (("f", "force", "N"), ("x", "displacement", "m"))
    )
    records = "".join(
        f'[[records]]\nfile = "r.h5"\nname = "{n}"\nexcitation = "random"\nfirst_sample = {a}\nlast_sample = {b}\n'
        f'use = "{n}"\n'
        for n, a, b in (("fit", 0, FIT - 1), ("held_out", FIT, FIT + HELD_OUT - 1))
    )
    (folder / "test.toml").write_text(f'kind = "continuous"\nsample_rate_hz = {RATE}\n{channels}{records}')
    return size


def respond(
    mass: float,
    damping: float,
    stiffness: float,
    law: Law,
    samples: int,
    rms: float,
    random: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Force and displacement after a lead-in from rest; the force is band-limited noise from 3 to 100 Hz."""
    count = 2 * FINE * (samples + LEAD)
    spectrum = np.fft.rfft(random.standard_normal(count))
    hertz = np.fft.rfftfreq(count, 1 / (2 * FINE * RATE))
    force = np.fft.irfft(np.where((hertz > 3) & (hertz < 100), spectrum, 0), count)
    force *= rms / np.std(force)
    x, v, step, found = 0.0, 0.0, 1 / (RATE * FINE), np.empty(samples + LEAD)

    def pull(x: float, v: float, f: float) -> float:
        return (f - damping * v - stiffness * x - law(x, v)) / mass

    for k in range(FINE * (samples + LEAD) - 1):
        if k % FINE == 0:
            found[k // FINE] = x
        f, g, h = force[2 * k : 2 * k + 3]
        a = pull(x, v, f)
        b = pull(x + step / 2 * v, v + step / 2 * a, g)
        c = pull(x + step / 2 * (v + step / 2 * a), v + step / 2 * b, g)
        d = pull(x + step * (v + step / 2 * b), v + step * c, h)
        x += step * v + step**2 / 6 * (a + b + c)
        v += step / 6 * (a + 2 * b + 2 * c + d)
    return force[:: 2 * FINE][LEAD:], found[LEAD:]


def run(folder: Path) -> tuple[str, list[tuple[str, float]]]:
    """Verdict and claims, each with its first size."""
    command = [sys.executable, "-c", "from ema_pipeline.cli import main; main()", "run", str(folder / "raw")]
    done = subprocess.run([*command, "--out", str(folder / "out"), "--quiet"], capture_output=True, text=True)
    if done.returncode:
        return done.stderr.strip()[:60], []
    found = json.loads((folder / "out" / "summary.json").read_text())["diagnosis"]
    claimed = [
        (c["effect"], next(iter(c["parameters"].values()))["value"])
        for c in found["candidates"]
        if c["claimed"]
    ]
    return found["verdict"], claimed


if __name__ == "__main__":
    main()
