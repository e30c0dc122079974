"""Modes of six masses from a random test with two shakers, beside those from a hammer test of the same rig.

    python benchmarks/shaker_study.py [SEEDS]

Rigs with exactly repeated modes: a ring of six equal masses (two pairs), and a chain of three masses that move in x
and y alike (three pairs), driven at one end or at both. Responses follow from the eigenvalue problem and the force's
Fourier transform; nothing of the program is used to make them. Forces carry 1 % noise, all sensors that of the largest
response. Printed are the modes found of six, and their largest errors of frequency and damping, each also over its
stated standard deviation.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

import ema_pipeline as ema
from ema_pipeline.errors import EmaError

RATE, SAMPLES, NOISE = 512.0, 100_000, 0.01
HITS, HIT_SAMPLES = 5, 8192


@dataclass(frozen=True)
class Rig:
    """Modes of six coordinates, each damped by `ratio`; two of them are driven."""

    name: str
    dofs: tuple[str, ...]
    driven: tuple[int, int]
    frequency_hz: NDArray[np.float64]
    shapes: NDArray[np.float64]
    ratio: NDArray[np.float64]

    def receptance(self, hertz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(n_lines, 6, 2), m/N."""
        own, w = 2 * np.pi * self.frequency_hz, 2 * np.pi * hertz[:, None]
        gain = 1 / (own**2 - w**2 + 2j * self.ratio * own * w)
        return np.einsum("om,fm,im->foi", self.shapes, gain, self.shapes[list(self.driven)])


def main() -> None:
    """Both rigs, by shakers and by hammer."""
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 1):
        for rig in (ring(), pairs(), turned_pairs()):
            for kind, write in (("shakers", write_shakers), ("hammer", write_hammer)):
                with tempfile.TemporaryDirectory() as folder:
                    write(Path(folder) / "raw", rig, np.random.default_rng(seed))
                    print(f"{seed} {rig.name:14s} {kind:8s} {judged(rig, Path(folder))}", flush=True)


def ring() -> Rig:
    """Six masses on springs to ground, each tied to its neighbours: modes 2 and 3, and 4 and 5, are repeated."""
    stiffness = 2e4 * np.eye(6)
    for a in range(6):
        b = (a + 1) % 6
        stiffness[[a, b], [a, b]] += 1.5e4
        stiffness[[a, b], [b, a]] -= 1.5e4
    return _solved("ring", tuple(f"m{k + 1}.x" for k in range(6)), (0, 1), stiffness, np.eye(6))


def pairs() -> Rig:
    """Three masses in a row that move in x and y with the same springs; shakers along x and y at the last."""
    row = 3e4 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    dofs = tuple(f"m{k + 1}.{d}" for d in "xy" for k in range(3))
    return _solved("pairs", dofs, (2, 5), scipy.linalg.block_diag(row, row), np.diag([1.0, 1.5, 1.2] * 2))


def turned_pairs() -> Rig:
    """The same with shakers along x at the last mass and along y at the first."""
    rig = pairs()
    return Rig("pairs, far apart", rig.dofs, (2, 3), rig.frequency_hz, rig.shapes, rig.ratio)


def _solved(
    name: str, dofs: tuple[str, ...], driven: tuple[int, int], k: NDArray[np.float64], m: NDArray[np.float64]
) -> Rig:
    values, shapes = scipy.linalg.eigh(k, m)
    return Rig(name, dofs, driven, np.sqrt(values) / (2 * np.pi), shapes, np.full(6, 0.01))


def write_shakers(folder: Path, rig: Rig, random: np.random.Generator) -> None:
    """One record of two random forces at once, the middle of a longer periodic one."""
    count = 2 * SAMPLES
    hertz = np.fft.rfftfreq(count, 1 / RATE)
    spectra = np.fft.rfft(random.standard_normal((2, count)))
    spectra[:, (hertz < 2) | (hertz > 180)] = 0.0
    response = np.einsum("foi,if->of", rig.receptance(hertz), spectra)
    signals = np.fft.irfft(np.concatenate([spectra, response]), count)[:, :SAMPLES]
    folder.mkdir()
    names = ("f1", "f2", *(f"s{k + 1}" for k in range(6)))
    _write(folder / "r.h5", names, signals, random)
    channels = [(f"f{k + 1}", "force", "N", rig.dofs[d]) for k, d in enumerate(rig.driven)]
    head = 'kind = "continuous"\n' + _channels([*channels, *_responses(rig)])
    (folder / "test.toml").write_text(head + '[[records]]\nfile = "r.h5"\nexcitation = "random"\n')


def write_hammer(folder: Path, rig: Rig, random: np.random.Generator) -> None:
    """Five hits at each of the two points, of a few milliseconds each."""
    count = 4 * HIT_SAMPLES
    hertz = np.fft.rfftfreq(count, 1 / RATE)
    time = np.arange(count) / RATE
    receptance = rig.receptance(hertz)
    folder.mkdir()
    records = ""
    for i, d in enumerate(rig.driven):
        for hit in range(HITS):
            width = 4e-3 * random.uniform(0.9, 1.1)
            force = random.uniform(80, 120) * np.exp(-0.5 * ((time - 0.25) / (width / 2)) ** 2)
            response = np.fft.irfft(receptance[:, :, i].T * np.fft.rfft(force), count)
            name = f"hit_{i + 1}_{hit + 1}.h5"
            signals = np.concatenate([force[None], response])[:, :HIT_SAMPLES]
            _write(folder / name, ("h", *(f"s{k + 1}" for k in range(6))), signals, random)
            records += f'[[records]]\nfile = "{name}"\nimpact = "{rig.dofs[d]}"\n'
    channels = _channels([("h", "force", "N", ""), *_responses(rig)])
    (folder / "test.toml").write_text(channels + records)


def _write(
    path: Path, names: tuple[str, ...], signals: NDArray[np.float64], random: np.random.Generator
) -> None:
    forces = len(names) - 6
    rms = np.std(signals, axis=1, keepdims=True)
    rms[forces:] = np.max(rms[forces:])  # sensors of one range
    noise = NOISE * rms * random.standard_normal(signals.shape)
    with h5py.File(path, "w") as file:
        for name, signal in zip(names, signals + noise, strict=True):
            file[name] = signal


def _responses(rig: Rig) -> list[tuple[str, str, str, str]]:
    return [(f"s{k + 1}", "displacement", "m", d) for k, d in enumerate(rig.dofs)]


def _channels(described: list[tuple[str, str, str, str]]) -> str:
    text = f"sample_rate_hz = {RATE}\n"
    for name, quantity, unit, dof in described:
        text += f'[[channels]]\nname = "{name}"\nquantity = "{quantity}"\nunit = "{unit}"\n'
        text += f'dof = "{dof}"\n' if dof else ""
    return text


def judged(rig: Rig, folder: Path) -> str:
    """Modes found of six, and the largest errors among them."""
    try:
        table = ema.identify(ema.read(folder / "raw").frfs()).table()
    except EmaError as e:
        return str(e)[:150]
    columns = ["frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std"]
    found = table[columns].to_numpy(dtype=np.float64)
    left = list(zip(rig.frequency_hz, rig.ratio, strict=True))
    errors = []
    for f, f_std, zeta, zeta_std in found:
        near = min(left, key=lambda m: abs(m[0] - f), default=None)
        if near is None or abs(near[0] - f) > 0.02 * near[0]:
            continue
        left.remove(near)
        gaps = abs(f - near[0]), abs(zeta - near[1])
        errors.append((gaps[0] / near[0], gaps[0] / f_std, gaps[1] / near[1], gaps[1] / zeta_std))
    worst = np.max(errors, axis=0) if errors else np.full(4, np.nan)
    return (
        f"{len(errors)} of 6 modes, {len(found) - len(errors)} more; frequency within {100 * worst[0]:.4f} % "
        f"({worst[1]:.1f} sigma), damping within {100 * worst[2]:.2f} % ({worst[3]:.1f} sigma)"
    )


if __name__ == "__main__":
    main()
