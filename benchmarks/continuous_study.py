"""Simulated oscillators and three-mass chains with one hidden nonlinear effect, or none, from records to the verdict.

    python benchmarks/continuous_study.py [CASES] [FIRST]

Every sixth case is linear. The equations of motion are integrated by steps of a hundredth of the fastest period or
less, in code that shares nothing with the program: dry friction sticks and slips, forces are continuous in time. All
channels carry 1 % noise and sensitivities that are wrong by 2 % (1 sigma). Drawn by lot are random force or multisine,
accelerometers or displacement sensors, and for oscillators a rig file or none. Rig files are wrong by a factor.
A case is right where exactly the hidden effect is claimed, at its place; nothing, where there is none.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numba
import numpy as np
from numpy.typing import NDArray

RATE, PERIOD, FINE, LEAD = 512.0, 2048, 12, 2048
FIT, HELD_OUT = 2 * PERIOD, PERIOD
EFFECTS = ("cubic_spring", "quadratic_spring", "dry_friction", "quadratic_damping", "hysteresis", "linear")
NOISE, GAIN_STD = 0.01, 0.02
STUCK = 0.0005
"""Way that a dry contact gives before it slips, over the root mean square of its motion."""


@dataclass(frozen=True)
class Chain:
    """Masses in a row, the first one on a spring to ground, and one nonlinear force along `row`."""

    mass: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    row: NDArray[np.float64]
    place: str


def main() -> None:
    """Run all cases and count."""
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    first, right = int(sys.argv[2]) if len(sys.argv) > 2 else 0, 0
    for case in range(first, first + cases):
        effect, masses = EFFECTS[case % len(EFFECTS)], (1, 3)[case // len(EFFECTS) % 2]
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            place, size = write(Path(folder), case, effect, masses)
            verdict, claimed = run(Path(folder))
        hidden = "" if effect == "linear" else f"{effect}@{place}"
        good = [name for name, _ in claimed] == ([hidden] if hidden else [])
        right += good
        ratio = claimed[0][1] / size if good and hidden else float("nan")
        print(
            f"{case:3d} {masses} mass {hidden or 'linear':26s} {verdict:13s} "
            f"{' + '.join(n for n, _ in claimed) or 'nothing':26s} size/true {ratio:6.3f} "
            f"{time.perf_counter() - begin:4.0f} s {'' if good else 'WRONG'}",
            flush=True,
        )
    print(f"{right} of {cases} right")


def write(folder: Path, case: int, effect: str, masses: int) -> tuple[str, float]:
    """Write one raw folder and, for some, a rig file; place and true size of the effect."""
    random = np.random.default_rng(case)
    chain = make_chain(random, masses)
    periodic, accelerometers, with_rig = (bool(b) for b in random.integers(2, size=3))
    rms = 20.0
    driven = masses - 1
    forces = [excitation(random, n, periodic, rms) for n in (FIT, HELD_OUT)]
    law, numbers = sized(chain, effect, forces[0], driven, random)
    raw = folder / "raw"
    raw.mkdir()
    wrong = 1 + GAIN_STD * random.standard_normal(masses + 1)
    motions = [respond(chain, law, numbers, force, driven) for force in forces]
    # A quadratic spring lets go where it is pulled far.
    while not all(np.all(np.isfinite(x)) for x, _ in motions):
        numbers = numbers / 2
        motions = [respond(chain, law, numbers, force, driven) for force in forces]
    signals = []
    for force, (x, a), n in zip(forces, motions, (FIT, HELD_OUT), strict=True):
        read = (a if accelerometers else x)[LEAD : LEAD + n]
        signals.append(np.column_stack([force[:: 2 * FINE][LEAD : LEAD + n], read]) * wrong)
    whole = np.concatenate(signals)
    whole += NOISE * np.std(whole, axis=0) * random.standard_normal(whole.shape)
    names = ["f", *(f"s{k + 1}" for k in range(masses))]
    with h5py.File(raw / "r.h5", "w") as file:
        for name, signal in zip(names, whole.T, strict=True):
            file[name] = signal
    quantity, unit = ("acceleration", "m/s^2") if accelerometers else ("displacement", "m")
    described = [("f", "force", "N", f"m{driven + 1}.x")]
    described += [(f"s{k + 1}", quantity, unit, f"m{k + 1}.x") for k in range(masses)]
    channels = "".join(
        f'[[channels]]\nname = "{n}"\nquantity = "{q}"\nunit = "{u}"\ndof = "{d}"\n'
        for n, q, u, d in described
    )
    kind = f'"multisine"\nperiod_samples = {PERIOD}' if periodic else '"random"'
    records = "".join(
        f'[[records]]\nfile = "r.h5"\nname = "{n}"\nexcitation = {kind}\nfirst_sample = {a}\nlast_sample = {b}\n'
        f'use = "{n}"\n'
        for n, a, b in (("fit", 0, FIT - 1), ("held_out", FIT, FIT + HELD_OUT - 1))
    )
    (raw / "test.toml").write_text(f'kind = "continuous"\nsample_rate_hz = {RATE}\n{channels}{records}')
    if masses > 1 or with_rig:
        write_rig(folder / "rig.toml", chain, random)
    turned = effect == "quadratic_spring" and "-" in chain.place  # an even law counted along the other way
    return chain.place, float(-numbers[0] if turned else numbers[0])


def make_chain(random: np.random.Generator, masses: int) -> Chain:
    """Masses, springs and dampers drawn at random, modes below about 60 Hz; the effect sits at one of the springs."""
    mass = random.uniform(0.5, 4.0, masses)
    frequency = random.uniform(15.0, 40.0)
    stiffness = np.mean(mass) * (2 * np.pi * frequency) ** 2 * random.uniform(0.7, 1.4, masses)
    ratio = random.uniform(0.01, 0.04)
    damping = 2 * ratio * stiffness / (2 * np.pi * frequency)
    at = int(random.integers(masses))
    row = np.zeros(masses)
    row[at] = 1.0
    if at:
        row[at - 1] = -1.0
    return Chain(mass, stiffness, damping, row, f"m{at}-m{at + 1}" if at else "m1.x")


def excitation(random: np.random.Generator, samples: int, periodic: bool, rms: float) -> NDArray[np.float64]:
    """Force from 3 to 100 Hz at 2·FINE points a sample, with a lead-in."""
    length = PERIOD if periodic else samples + LEAD
    count = 2 * FINE * length
    hertz = np.fft.rfftfreq(count, 1 / (2 * FINE * RATE))
    spectrum = np.fft.rfft(random.standard_normal(count))
    if periodic:
        spectrum = np.exp(2j * np.pi * random.uniform(size=len(hertz)))
    force = np.fft.irfft(np.where((hertz > 3) & (hertz < 100), spectrum, 0), count)
    force *= rms / np.std(force)
    return np.asarray(np.tile(force, (samples + LEAD) // length))


def sized(
    chain: Chain, effect: str, force: NDArray[np.float64], driven: int, random: np.random.Generator
) -> tuple[int, NDArray[np.float64]]:
    """Law and numbers of an effect of 5 to 20 % of the force of the spring or twice that of the damper beside it."""
    x, _ = respond(chain, 5, np.zeros(4), force, driven)
    along = x @ chain.row
    size, rate = float(np.std(along)), float(np.std(np.gradient(along) * RATE))
    k, c = float(chain.stiffness[np.argmax(chain.row)]), float(chain.damping[np.argmax(chain.row)])
    share = random.uniform(0.05, 0.2)
    numbers = {
        "cubic_spring": (share * k / size**2,),
        "quadratic_spring": (share * k / size,),
        "dry_friction": (5 * share * c * rate, 0.0, 0.0, 5 * share * c * rate / (STUCK * size)),
        "quadratic_damping": (10 * share * c / rate,),
        "hysteresis": (3 * share * k, 2.5 * share * k * size, 0.0, 1.0),
        "linear": (0.0,),
    }[effect]
    return EFFECTS.index(effect), np.array([*numbers, *[0.0] * (4 - len(numbers))])


def respond(
    chain: Chain, law: int, numbers: NDArray[np.float64], force: NDArray[np.float64], driven: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacements and accelerations at the samples, (n_samples, n_masses) each, from rest."""
    count = len(force) // (2 * FINE)
    x = np.zeros((count, len(chain.mass)))
    a = np.zeros_like(x)
    force = np.append(force, force[-1])  # the end of the last step
    _march(
        chain.mass, chain.stiffness, chain.damping, chain.row, law, numbers, force, driven, FINE, RATE, x, a
    )
    return x, a


@numba.njit(cache=True)
def _pull(law, n, d, v, z):  # type: ignore[no-untyped-def]
    """Force of the hidden effect; `z` is the force that hysteresis and friction remember."""
    if law == 0:
        return n[0] * d**3
    if law == 1:
        return n[0] * d**2
    if law == 3:
        return n[0] * abs(v) * v
    if law == 2 or law == 4:
        return z
    return 0.0


@numba.njit(cache=True)
def _accelerate(m, k, c, row, law, n, f, driven, x, v, z, a):  # type: ignore[no-untyped-def]
    d, r = 0.0, 0.0
    for i in range(len(m)):
        d += row[i] * x[i]
        r += row[i] * v[i]
    more = _pull(law, n, d, r, z)
    for i in range(len(m)):
        left = k[i] * (x[i] - (x[i - 1] if i else 0.0)) + c[i] * (v[i] - (v[i - 1] if i else 0.0))
        right = 0.0
        if i + 1 < len(m):
            right = k[i + 1] * (x[i + 1] - x[i]) + c[i + 1] * (v[i + 1] - v[i])
        a[i] = (right - left - row[i] * more + (f if i == driven else 0.0)) / m[i]
    if law == 4:  # Bouc-Wen by its rate equation
        return n[0] * (r - abs(r) * z / n[1])
    if law == 2:  # Coulomb friction behind a stiff contact (Jenkins)
        stiff = n[3]
        return stiff * (r if z * r <= 0 or abs(z) < n[0] else 0.0)
    return 0.0


@numba.njit(cache=True)
def _march(m, k, c, row, law, n, force, driven, fine, rate, found, rates):  # type: ignore[no-untyped-def]
    """Runge-Kutta steps of fourth order; two force values per step, FINE steps per sample."""
    size = len(m)
    x, v, z = np.zeros(size), np.zeros(size), 0.0
    a1, a2, a3, a4 = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    h = 1 / (rate * fine)
    for s in range(len(found) * fine):
        f, g, e = force[2 * s], force[2 * s + 1], force[2 * s + 2]
        z1 = _accelerate(m, k, c, row, law, n, f, driven, x, v, z, a1)
        if s % fine == 0:
            found[s // fine] = x
            rates[s // fine] = a1
        v2 = v + h / 2 * a1
        z2 = _accelerate(m, k, c, row, law, n, g, driven, x + h / 2 * v, v2, z + h / 2 * z1, a2)
        v3 = v + h / 2 * a2
        z3 = _accelerate(m, k, c, row, law, n, g, driven, x + h / 2 * v2, v3, z + h / 2 * z2, a3)
        v4 = v + h * a3
        z4 = _accelerate(m, k, c, row, law, n, e, driven, x + h * v3, v4, z + h * z3, a4)
        x = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        z += h / 6 * (z1 + 2 * z2 + 2 * z3 + z4)
        if law == 2:
            z = min(max(z, -n[0]), n[0])


def write_rig(path: Path, chain: Chain, random: np.random.Generator) -> None:
    """A rig file whose masses and springs are right within a factor of one and a half; its dampers are guesses."""
    factor = np.exp(0.4 * random.standard_normal(2 * len(chain.mass)))
    masses, springs, dampers = [], [], []
    for k, (m, s) in enumerate(zip(chain.mass, chain.stiffness, strict=True)):
        at = f'between = ["m{k}.x", "m{k + 1}.x"]' if k else 'at = "m1.x"'
        masses.append(f'  {{ at = "m{k + 1}.x", value = {m * factor[2 * k]:.4g} }},')
        springs.append(f"  {{ {at}, value = {s * factor[2 * k + 1]:.4g} }},")
        dampers.append(f"  {{ {at}, value = {0.02 * np.sqrt(s * m):.4g} }},")
    parts = {"masses": masses, "springs": springs, "dampers": dampers}
    path.write_text("".join(f"{n} = [\n" + "\n".join(lines) + "\n]\n" for n, lines in parts.items()))


def run(folder: Path) -> tuple[str, list[tuple[str, float]]]:
    """Verdict and claims ``id@place``, each with its size."""
    rig = folder / "rig.toml"
    given = ["--rig", str(rig)] if rig.exists() else []
    command = [
        sys.executable,
        "-c",
        "from ema_pipeline.cli import main; main()",
        "run",
        str(folder / "raw"),
        *given,
        "--set",
        "diagnose.processes=1",
    ]
    done = subprocess.run([*command, "--out", str(folder / "out"), "--quiet"], capture_output=True, text=True)
    if done.returncode:
        return "failed", [(done.stderr.strip()[:120], float("nan"))]
    found = json.loads((folder / "out" / "summary.json").read_text())["diagnosis"]
    claimed = [
        (f"{c['effect']}@{c['at']}", _size(c["parameters"])) for c in found["candidates"] if c["claimed"]
    ]
    return found["verdict"], claimed


def _size(parameters: dict[str, dict[str, float]]) -> float:
    """The first parameter; of hysteresis, which has several, its stiffness."""
    return parameters.get("stiffness", next(iter(parameters.values())))["value"]


if __name__ == "__main__":
    main()
