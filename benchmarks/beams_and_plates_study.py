"""Modes whose frequencies move within the decay, and modes closer than their width: simulated beams and plates.

    python benchmarks/beams_and_plates_study.py beam --cases 16
    python benchmarks/beams_and_plates_study.py beam-few --cases 16
    python benchmarks/beams_and_plates_study.py plate --cases 6
    python benchmarks/beams_and_plates_study.py plate-one-sensor --cases 6
    python benchmarks/beams_and_plates_study.py plate-roving --cases 6

Free beams of seven modes, whose stiffness falls with the square of the amplitude, are integrated in time: frequencies
rise by 0.1 to 0.3 % (even seeds) or 0.3 to 1 % (odd seeds) within the decay. Plates are simply supported, 35 modes in
the band. Records go through the program's own hit finding, checks, FRFs and identification.

A true mode of a plate counts where the Cramér–Rao bound of its decay rate, all poles and all residues unknown, is below
20 %. A mode of a beam is found within what its frequency runs through.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
from identification_study import INVISIBLE_STD, match
from numpy.typing import NDArray
from simulate_modal import Hits, TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.records import cut_hit
from ema_pipeline.modal.circle import attach_circles
from ema_pipeline.modal.combine_estimates import pooled
from ema_pipeline.modal.hit_to_hit import identify_hits
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

Real = NDArray[np.float64]
Case = tuple[TrueSystem, Hits, list[int], list[int], float]
"""System, hits, sensors, struck points, relative change of frequencies within the decay."""

WAVE_NUMBERS = np.array([4.730, 7.853, 10.996, 14.137, 17.279, 20.42, 23.56])
"""Of a free beam, times its length."""

SUBSTEPS = 8
TYPICAL_FORCE_N = 120.0


@numba.njit(cache=True)
def _accelerations(omega: float, zeta: float, change: float, size: float, force: Real, step: float) -> Real:
    """Acceleration of one mode whose frequency is `change` lower at an amplitude of `size`; Runge–Kutta of order 4."""
    out = np.zeros(len(force) - 1)
    q, v = 0.0, 0.0
    slope_q, slope_v = np.zeros(4), np.zeros(4)
    for k in range(len(force) - 1):
        for s in range(4):
            share = 0.0 if s == 0 else (1.0 if s == 3 else 0.5)
            at_q = q + share * step * slope_q[s - 1]
            at_v = v + share * step * slope_v[s - 1]
            drive = (1 - share) * force[k] + share * force[k + 1]
            envelope = (at_q * at_q + (at_v / omega) ** 2) / size**2
            slope_q[s] = at_v
            slope_v[s] = drive - 2 * zeta * omega * at_v - omega**2 * (1 - 2 * change * envelope) * at_q
        out[k] = slope_v[0]
        q += step * (slope_q[0] + 2 * slope_q[1] + 2 * slope_q[2] + slope_q[3]) / 6
        v += step * (slope_v[0] + 2 * slope_v[1] + 2 * slope_v[2] + slope_v[3]) / 6
    return out


def beam(rng: np.random.Generator) -> TrueSystem:
    """Seven bending modes at eight points."""
    f = 30.0 * (WAVE_NUMBERS / WAVE_NUMBERS[0]) ** 2
    x = np.linspace(0.03, 0.97, 8)
    ratio = (np.cosh(WAVE_NUMBERS) - np.cos(WAVE_NUMBERS)) / (np.sinh(WAVE_NUMBERS) - np.sin(WAVE_NUMBERS))
    bx = WAVE_NUMBERS[:, None] * x
    shapes = np.cosh(bx) + np.cos(bx) - ratio[:, None] * (np.sinh(bx) + np.sin(bx))
    zeta = np.exp(rng.uniform(np.log(0.001), np.log(0.006), len(f)))
    return TrueSystem(f * (1 + 0.02 * rng.standard_normal(len(f))), zeta, shapes)


def beam_case(seed: int, fewest: int, most: int) -> Case:
    """Hits on a beam with so many sensors."""
    rng = np.random.default_rng(30_000 + seed)
    system = beam(rng)
    top = 0.003 if seed % 2 == 0 else 0.01
    change = rng.uniform(0.3, 1.0, len(system.frequency_hz)) * top
    sensors = sorted(rng.choice(8, int(rng.integers(fewest, most + 1)), replace=False).tolist())
    struck = sorted(rng.choice(8, int(rng.integers(1, 3)), replace=False).tolist())
    f_max, n_hits, noise, pretrigger = 1000.0, int(rng.integers(1, 6)), 0.005, 20
    omega = 2 * np.pi * system.frequency_hz
    record_s = float(np.clip(6 / np.min(system.damping_ratio * omega), 1.0, 4.0))
    n = round(record_s * 2.56 * f_max)
    rate, width = n / record_s, 0.9 / f_max
    step = 1 / (rate * SUBSTEPS)
    time = np.arange(n * SUBSTEPS + 1) * step
    size = np.abs(system.shapes[:, struck]).max(axis=1) * TYPICAL_FORCE_N * width * 2 / np.pi / omega
    line = np.fft.rfftfreq(n * SUBSTEPS, step)
    taper = np.clip((0.5 * rate - line) / (0.5 * rate - 1.05 * f_max), 0, 1)
    taper = 0.5 - 0.5 * np.cos(np.pi * taper)

    def sampled(x: Real) -> Real:
        return np.fft.irfft((np.fft.rfft(x) * taper)[..., : n // 2 + 1], n) / SUBSTEPS

    force = np.zeros((len(struck), n_hits, n))
    responses = np.zeros((len(struck), n_hits, len(sensors), n))
    for i, point in enumerate(struck):
        for h in range(n_hits):
            tau = width * rng.uniform(0.9, 1.1)
            x = (time - (pretrigger + rng.uniform(-0.5, 0.5)) / rate) / tau + 0.5
            blow = np.where((x > 0) & (x < 1), rng.uniform(60, 160) * np.sin(np.pi * np.clip(x, 0, 1)), 0.0)
            modal = [
                _accelerations(w, z, c, a, phi * blow, step)
                for w, z, c, a, phi in zip(
                    omega, system.damping_ratio, change, size, system.shapes[:, point], strict=True
                )
            ]
            force[i, h] = sampled(blow[:-1])
            responses[i, h] = system.shapes[:, sensors].T @ sampled(np.array(modal))
    sigma_f = noise * float(np.sqrt(np.mean(force**2)))
    sigma_y = noise * np.sqrt(np.mean(responses**2, axis=(0, 1, 3)))
    force += sigma_f * rng.standard_normal(force.shape)
    responses += sigma_y[:, None] * rng.standard_normal(responses.shape)
    return system, Hits(force, responses, rate, pretrigger, sigma_f, sigma_y), sensors, struck, 1.2 * top


def plate_case(seed: int, kind: str) -> Case:
    """Hits on an aluminium plate of 0.6 m × 0.41 m × 3 mm at up to 25 points, modes up to 1.6 kHz."""
    rng = np.random.default_rng(40_000 + seed)
    lx, ly, thickness = 0.6, 0.41, 3e-3
    bending, per_area = 70e9 * thickness**3 / 12 / (1 - 0.09), 2700 * thickness
    half_waves = [(m, k) for m in range(1, 25) for k in range(1, 25)]
    f = np.array(
        [np.pi / 2 * np.sqrt(bending / per_area) * ((m / lx) ** 2 + (k / ly) ** 2) for m, k in half_waves]
    )
    order = [int(j) for j in np.argsort(f) if 20 < f[j] < 1600]
    x, y = rng.uniform(0.05, 0.95, 25), rng.uniform(0.05, 0.95, 25)
    m, k = np.array([half_waves[j] for j in order]).T
    shapes = np.sin(np.pi * m[:, None] * x) * np.sin(np.pi * k[:, None] * y)
    zeta = np.exp(rng.uniform(np.log(0.003), np.log(0.012), len(order)))
    system = TrueSystem(f[order], zeta, 2 / np.sqrt(per_area * lx * ly) * shapes)
    one, few = kind == "plate-one-sensor", int(rng.integers(1, 9))
    if kind == "plate-roving":
        sensors, struck = (
            sorted(rng.choice(25, int(rng.integers(1, 3)), replace=False).tolist()),
            [*range(25)],
        )
    else:
        sensors, struck = [int(rng.integers(0, 25))] if one else [*range(few)], [int(rng.integers(0, 25))]
    hits = simulate_hits(
        system, sensors, struck, f_max=1600, record_s=2.0, n_hits=int(rng.integers(1, 6)) if one else 1,
        force_noise=0.01, response_noise=0.01, rng=rng, drift=0.0 if kind == "plate" else 2e-4,
    )  # fmt: skip
    return system, hits, sensors, struck, 0.0


def joint_bound(
    system: TrueSystem, hits: Hits, frfs: FrfSet, dofs_out: list[int], dofs_in: list[int]
) -> Real:
    """Cramér–Rao bound of each mode's relative decay rate, all poles, all residues and a background unknown."""
    omega, n = 2 * np.pi * frfs.frequency_hz[1:], round(frfs.record_s * hits.sample_rate_hz)
    force2 = np.mean(np.abs(np.fft.rfft(hits.force[..., :n])) ** 2, axis=1)[:, 1:]
    truth = system.accelerance(frfs.frequency_hz[1:], dofs_out, dofs_in)
    power = (hits.response_noise[:, None, None] ** 2 + np.abs(truth) ** 2 * hits.force_noise**2) * n
    noise = power / (hits.force.shape[1] * force2[None])
    s = system.poles
    u = 1 / (1j * omega - s[:, None])
    columns = np.concatenate([u, np.ones((1, len(omega))), omega[None] ** -2.0])
    information = np.zeros((len(s), len(s)), dtype=np.complex128)
    for o, out in enumerate(dofs_out):
        for i, point in enumerate(dofs_in):
            weight = 1 / np.sqrt(noise[o, i])
            basis = columns * weight
            known = np.linalg.qr((basis / np.linalg.norm(basis, axis=1, keepdims=True)).T)[0]
            residue = s**2 * system.shapes[:, out] * system.shapes[:, point] / (2j * s.imag)
            slope = residue[:, None] * u**2 * weight
            slope -= (slope @ known.conj()) @ known.T
            information += slope.conj() @ slope.T
    scale = 1 / np.sqrt(np.diag(information).real)
    inverse = np.linalg.pinv(information * scale[:, None] * scale, rcond=1e-14, hermitian=True)
    return np.sqrt(0.5 * np.diag(inverse).real) * scale / np.abs(s.real)


def identified(hits: Hits, sensors: list[int], struck: list[int]) -> tuple[ModalModel, FrfSet]:
    """Modes as the stage finds them: aligned, with circles, pooled."""
    records = records_of(hits, sensors, struck)
    by_file, judged = {r.file: r for r in records}, [h for h in hits_of_test(records) if h.accepted]

    def source():
        return (cut_hit(by_file[h.file], h) for h in judged)

    frfs = estimate_frfs(source())
    one = identify_hits(source, lambda: frfs, FrfSettings(), ModalSettings())
    return pooled(attach_circles(one.frfs, one.modal), one.alignment, frfs.record_s), frfs


def study(case: Callable[[int], Case], seeds: range, verbose: bool) -> None:
    truth = found = extra = 0
    inside: dict[str, list[bool]] = {"frequency": [], "damping": []}
    for seed in seeds:
        system, hits, sensors, struck, change = case(seed)
        model, frfs = identified(hits, sensors, struck)
        seen = np.ones(len(system.poles), dtype=bool)
        if not change:
            seen = joint_bound(system, hits, frfs, sensors, struck) < INVISIBLE_STD
        pairs, others = match(replace(system, damping_ratio=system.damping_ratio + change), model)
        mine = {t: j for t, j in pairs.items() if seen[t]}
        truth, found, extra = truth + int(seen.sum()), found + len(mine), extra + len(others)
        for t, j in mine.items():
            mode = model.modes[j]
            off = abs(mode.frequency_hz - system.frequency_hz[t]) / mode.frequency_std_hz
            inside["frequency"].append(off < 1.645)
            off = abs(mode.damping_ratio - system.damping_ratio[t]) / mode.damping_std
            inside["damping"].append(off < 1.645)
        if verbose:
            lost = [round(float(system.frequency_hz[t]), 2) for t in np.flatnonzero(seen) if t not in pairs]
            beside = [round(model.modes[j].frequency_hz, 2) for j in others]
            print(f"  seed {seed}: {len(sensors)} sensors, lost {lost}, beside {beside}", flush=True)
    print(f"{found} of {truth} modes found ({found / truth:.3f}), {extra} beside them")
    for name, values in inside.items():
        print(f"90 % interval of {name} covers {np.mean(values):.3f} of {len(values)}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=["beam", "beam-few", "plate", "plate-one-sensor", "plate-roving"])
    parser.add_argument("--cases", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.cases)
    sensors = {"beam": (3, 6), "beam-few": (1, 2)}

    def case(seed: int) -> Case:
        if given.study in sensors:
            return beam_case(seed, *sensors[given.study])
        return plate_case(seed, given.study)

    study(case, seeds, given.verbose)


if __name__ == "__main__":
    main()
