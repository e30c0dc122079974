"""Continuous tests as labs make them, simulated by SciPy's integrators: other excitations, rates, sensors and rigs.

    python benchmarks/independent_study.py [CASE ...]

`continuous_study.py` draws many cases of two kinds. Here are a few, each of another kind: noise, multisine, bursts,
sweep and chirp, one or two shakers, one level or several, 1 to 51.2 kHz, all quantities, with a rig file or without.
Forces are sums of cosines or sweeps in closed form, so that nothing is interpolated, and the equations of motion are
written down body by body. All channels carry 1 % noise and sensitivities that are wrong by 2 % (1 sigma).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

NOISE, GAIN_STD = 0.01, 0.02
Force = Callable[[float], float]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Masses in a row on springs, the first on one to ground, with one more force between two of them.

    Attributes
    ----------
    truth : str
        ``id@place`` of what the rig file lacks; empty for nothing.
    hertz : float
        Natural frequency of the first spring and the first mass alone.
    size : float
        Largest force of the effect over that of the spring beside it; of dampers over that of the damper.
    driven : tuple of int
        Driven masses.
    samples : int
        Of each record, or of each burst or period.
    records : tuple of (level, use)
        Level of the force and whether the record is fitted or held out.
    """

    truth: str
    masses: tuple[float, ...]
    hertz: float
    size: float
    excitation: str
    rate: float
    quantity: str
    driven: tuple[int, ...] = (0,)
    samples: int = 6144
    records: tuple[tuple[float, str], ...] = ((1.0, "fit"), (1.0, "held_out"))
    with_rig: bool = True


CASES = {
    "noise": Case("cubic_spring@m1.x", (2.0,), 60.0, 0.3, "random", 2000.0, "acceleration", with_rig=False),
    "multisine": Case(
        "hysteresis@m1-m2", (1.0, 2.0, 1.5), 40.0, 0.4, "multisine", 2000.0, "displacement", samples=4096
    ),
    "fast": Case("dry_friction@m1.x", (0.05,), 1500.0, 3.0, "random", 51_200.0, "velocity"),
    "sweep": Case(
        "quadratic_damping@m1-m2", (1.0, 1.5), 30.0, 4.0, "sweep", 1000.0, "acceleration", (1,), 8192
    ),
    "bursts": Case("", (3.0, 1.0), 25.0, 0.0, "burst_random", 1000.0, "acceleration", samples=2048),
    "two shakers": Case("cubic_spring@m2-m3", (1.0, 1.2, 0.8), 40.0, 0.3, "random", 1000.0, "acceleration", (0, 2)),
    "levels": Case(
        "quadratic_spring@m1.x", (1.5,), 35.0, 0.2, "chirp", 1000.0, "displacement",
        records=((0.3, "fit"), (1.0, "fit"), (0.6, "held_out")), with_rig=False,
    ),
    "nothing, no rig": Case("", (2.0, 1.0), 50.0, 0.0, "random", 2000.0, "displacement", with_rig=False),
}  # fmt: skip


def main() -> None:
    """Run the cases that are named, all where none is."""
    for k, (name, case) in enumerate(CASES.items()):
        if len(sys.argv) > 1 and name not in sys.argv[1:]:
            continue
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder), case, np.random.default_rng(1000 + k))
            told = judged(Path(folder))
        print(
            f"{name:16s} {case.truth or 'nothing':26s} {told} {time.perf_counter() - begin:4.0f} s",
            flush=True,
        )


def write(folder: Path, case: Case, random: np.random.Generator) -> None:
    """Write the raw folder, and the rig file, wrong by a factor, where there is one."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    n, inputs = len(case.masses), len(case.driven)
    stiffness = case.masses[0] * (2 * np.pi * case.hertz) ** 2 * random.uniform(0.8, 1.2, n)
    damping = 0.04 * stiffness / (2 * np.pi * case.hertz)
    wrong = 1 + GAIN_STD * random.standard_normal(inputs + n)
    extra = law(case, stiffness, damping, 0.0)
    forces = [[excitation(case, random) for _ in case.driven] for _ in case.records]
    # of the linear rig at the largest level: what the size of the effect refers to
    level = max(level for level, _ in case.records)
    x, v, _, _ = march(case, stiffness, damping, extra, forces[0], level)
    at, below = row(case)
    extra = law(
        case,
        stiffness,
        damping,
        float(np.std(x[at] - below * x[at - 1])),
        float(np.std(v[at] - below * v[at - 1])),
    )
    entries = ""
    for k, ((level, use), own) in enumerate(zip(case.records, forces, strict=True)):
        x, v, a, driven = march(case, stiffness, damping, extra, own, level)
        read = {"displacement": x, "velocity": v, "acceleration": a}[case.quantity]
        signals = np.concatenate([driven, read]) * wrong[:, None]
        signals += NOISE * np.std(signals, axis=1, keepdims=True) * random.standard_normal(signals.shape)
        with h5py.File(raw / f"r{k}.h5", "w") as file:
            for i, signal in enumerate(signals):
                file[f"f{i + 1}" if i < inputs else f"s{i - inputs + 1}"] = signal
        period = (
            f"period_samples = {case.samples}\n" if case.excitation in ("multisine", "burst_random") else ""
        )
        entries += f'[[records]]\nfile = "r{k}.h5"\nexcitation = "{case.excitation}"\n'
        entries += f'{period}level = {level}\nuse = "{use}"\n'
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}[case.quantity]
    channels = [(f"f{i + 1}", "force", "N", m) for i, m in enumerate(case.driven)]
    channels += [(f"s{i + 1}", case.quantity, unit, i) for i in range(n)]
    told = "".join(
        f'[[channels]]\nname = "{name}"\nquantity = "{q}"\nunit = "{u}"\ndof = "m{m + 1}.x"\n'
        for name, q, u, m in channels
    )
    (raw / "test.toml").write_text(f'kind = "continuous"\nsample_rate_hz = {case.rate}\n{told}{entries}')
    if case.with_rig:
        lines = []
        for i in range(n):
            place = f'between = ["m{i}.x", "m{i + 1}.x"]' if i else 'at = "m1.x"'
            factor = np.exp(0.3 * random.standard_normal(2))
            lines.append(f'[[masses]]\nat = "m{i + 1}.x"\nvalue = {case.masses[i] * factor[0]:.4g}\n')
            lines.append(f"[[springs]]\n{place}\nvalue = {stiffness[i] * factor[1]:.4g}\n")
        (folder / "rig.toml").write_text("".join(lines))


def row(case: Case) -> tuple[int, int]:
    """The mass that the effect acts on, and 1 where it acts against the one before, 0 against ground."""
    place = case.truth.partition("@")[2] or "m1.x"
    return (int(place[-1]) - 1, 1) if "-" in place else (int(place[1]) - 1, 0)


Law = tuple[Callable[[float, float, float], float], Callable[[float, float], float]]


def law(case: Case, stiffness: Array, damping: Array, moved: float, rate: float = 1.0) -> Law:
    """Force of the effect by displacement, rate and memory, and the rate of the memory; nought for no motion."""
    at, _ = row(case)
    kind = case.truth.partition("@")[0]
    if not kind or not moved:
        return (lambda d, r, z: 0.0), (lambda r, z: 0.0)
    k, c, s = stiffness[at], damping[at], case.size
    if kind == "cubic_spring":
        return (lambda d, r, z: s * k * d**3 / moved**2 / 3), (lambda r, z: 0.0)
    if kind == "quadratic_spring":
        return (lambda d, r, z: s * k * d**2 / moved / 2), (lambda r, z: 0.0)
    if kind == "dry_friction":
        return (lambda d, r, z: s * c * rate * np.tanh(r / (0.002 * rate))), (lambda r, z: 0.0)
    if kind == "quadratic_damping":
        return (lambda d, r, z: s * c * abs(r) * r / rate), (lambda r, z: 0.0)
    yields = s * k * moved
    return (lambda d, r, z: z), (
        lambda r, z: s * k * (r - 0.6 * abs(r) * z / yields - 0.4 * r * abs(z) / yields)
    )


def excitation(case: Case, random: np.random.Generator) -> Force:
    """One force in closed form, of about 1 N root mean square."""
    low, high, length = 0.3 * case.hertz, 2.5 * case.hertz, case.samples / case.rate
    if case.excitation in ("sweep", "chirp"):
        growth = (high - low) / length
        return lambda t: float(np.sqrt(2) * np.sin(2 * np.pi * (low * t + growth * t**2 / 2)))
    if case.excitation == "burst_random":
        bursts = [noise(random, low, high, 150) for _ in range(12)]
        return lambda t: (
            bursts[min(int(t // length), 11)](t)
            * float(np.sin(np.pi * min((t % length) / (0.4 * length), 1.0)))
        )
    if case.excitation == "multisine":
        lines = np.arange(int(np.ceil(low * length)), int(high * length)) / length
        phase = random.uniform(0, 2 * np.pi, len(lines))
        size = np.sqrt(2 / len(lines))
        return lambda t: float(size * np.sum(np.cos(2 * np.pi * lines * t + phase)))
    return noise(random, low, high, 300)


def noise(random: np.random.Generator, low: float, high: float, count: int) -> Force:
    """Sum of cosines of frequencies that share no period."""
    hertz, phase = random.uniform(low, high, count), random.uniform(0, 2 * np.pi, count)
    size = np.sqrt(2 / count)
    return lambda t: float(size * np.sum(np.cos(2 * np.pi * hertz * t + phase)))


def march(
    case: Case, k: Array, c: Array, extra: Law, forces: list[Force], level: float
) -> tuple[Array, Array, Array, Array]:
    """Displacements, velocities, accelerations and forces at the samples of a record, (n, n_samples) each."""
    n, m, (at, below) = len(case.masses), np.array(case.masses), row(case)
    scale = 20.0 * level * case.masses[0] * (case.hertz / 30.0) ** 2
    periods = {"multisine": 3, "burst_random": 6}.get(case.excitation, 1)
    lead = case.samples if case.excitation == "multisine" else 0
    t = np.arange(lead, lead + periods * case.samples) / case.rate

    def slope(time: float, y: Array) -> Array:
        x, v, z = y[:n], y[n : 2 * n], y[2 * n]
        pull = k * np.diff(x, prepend=0.0) + c * np.diff(v, prepend=0.0)
        d, r = x[at] - below * x[at - 1], v[at] - below * v[at - 1]
        pull[at] += extra[0](d, r, z)
        net = np.append(pull[1:], 0.0) - pull
        for i, f in zip(case.driven, forces, strict=True):
            net[i] += scale * f(time)
        return np.concatenate([v, net / m, [extra[1](r, z)]])

    stiff = case.truth.startswith("dry_friction")
    found = solve_ivp(
        slope, (0.0, t[-1]), np.zeros(2 * n + 1), "LSODA" if stiff else "DOP853", t,
        rtol=1e-6 if stiff else 1e-8, atol=1e-12, max_step=0.05 / case.hertz,
    )  # fmt: skip
    if not found.success:
        raise RuntimeError(found.message)
    x, v = found.y[:n], found.y[n : 2 * n]
    a = np.array([slope(time, y)[n : 2 * n] for time, y in zip(t, found.y.T, strict=True)]).T
    return x, v, a, np.array([[scale * f(time) for time in t] for f in forces])


def judged(folder: Path) -> str:
    """What ``ema run`` claims, and its free-run errors in per cent of the response."""
    rig = folder / "rig.toml"
    command = [sys.executable, "-c", "from ema_pipeline.cli import main; main()", "run", str(folder / "raw")]
    command += ["--rig", str(rig)] if rig.exists() else []
    done = subprocess.run([*command, "--out", str(folder / "out"), "--quiet"], capture_output=True, text=True)
    if done.returncode:
        return done.stderr.strip()[:200]
    found = json.loads((folder / "out" / "summary.json").read_text())
    claimed = [f"{c['effect']}@{c['at']}" for c in found["diagnosis"]["candidates"] if c["claimed"]]
    errors = [f"{100 * e['relative']:.2g}" for e in found["simulation"]["records"].values()]
    return f"{found['diagnosis']['verdict']:14s} {' + '.join(claimed) or 'nothing':26s} free run {' '.join(errors)} %"


if __name__ == "__main__":
    main()
