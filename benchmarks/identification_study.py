"""Study of modal identification on random systems simulated as hammer tests.

    python benchmarks/identification_study.py random --cases 200
    python benchmarks/identification_study.py pairs --cases 50
    python benchmarks/identification_study.py coverage --cases 500
    python benchmarks/identification_study.py noise --cases 30
    python benchmarks/identification_study.py window --cases 60
    python benchmarks/identification_study.py ringing --cases 60
    python benchmarks/identification_study.py moving --cases 20
    python benchmarks/identification_study.py moving-pairs --cases 40
    python benchmarks/identification_study.py roving --cases 24

Records are simulated by the simulator of the tests (blow, response, noise on all channels) and go through the
program's own hit finding, checks and FRFs. A true mode counts as found when an identified mode lies within
0.5 half-power bandwidths + 0.05 % of it.

A true mode is called invisible, and left out of recall, by a criterion on the truth alone: with the true
noise, the Cramér–Rao bound of its decay rate, all other modes known, exceeds 20 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from simulate_modal import (
    QUANTITIES,
    FrfSet,
    Hits,
    TrueSystem,
    frf_set,
    random_system,
    records_of,
    simulate_hits,
    write_raw_folder,
)

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import Record, cut_hit
from ema_pipeline.modal.circle import attach_circles
from ema_pipeline.modal.combine_estimates import pooled
from ema_pipeline.modal.hit_to_hit import identify_hits
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

INVISIBLE_STD = 0.2


def measured(records: Iterable[Record], settings: FrfSettings | None = None) -> FrfSet:
    """FRFs of records: hits found and checked, and the accepted ones averaged."""
    records = list(records)
    hits = hits_of_test(records)
    by_file = {record.file: record for record in records}
    return estimate_frfs((cut_hit(by_file[h.file], h) for h in hits if h.accepted), settings)


def crlb_decay(
    system: TrueSystem, hits: Hits, frfs: FrfSet, dofs_out: list[int], dofs_in: list[int]
) -> np.ndarray:
    """Cramér–Rao bound of each mode's relative decay rate, other modes known, this mode's residues unknown.

    Per FRF with residue Q and white noise density, a single mode's damping has information
    Σ 2|Q|²·σ²/v·Σ|P⊥ (jω − s)⁻²|², P⊥ taking out the residue.
    """
    omega = 2 * np.pi * frfs.frequency_hz[1:]
    n = round(frfs.record_s * hits.sample_rate_hz)  # undecayed records may have been trimmed
    force2 = np.mean(np.abs(np.fft.rfft(hits.force[..., :n])) ** 2, axis=1)[:, 1:]  # (in, f)
    n_hits = hits.force.shape[1]
    truth = system.accelerance(frfs.frequency_hz[1:], dofs_out, dofs_in)
    v = (hits.response_noise[:, None, None] ** 2 * n + np.abs(truth) ** 2 * hits.force_noise**2 * n) / (
        n_hits * force2[None]
    )
    out = np.empty(len(system.frequency_hz))
    for r, s in enumerate(system.poles):
        q = s**2 * np.outer(system.shapes[r, dofs_out], system.shapes[r, dofs_in]) / (2j * s.imag)
        u = 1 / (1j * omega - s)
        w = 1 / v
        uu = np.einsum("oif,f->oi", w, np.abs(u) ** 2)
        ud = np.einsum("oif,f->oi", w, u.conj() * u**2)
        dd = np.einsum("oif,f->oi", w, np.abs(u) ** 4)
        info = 2 * np.sum(np.abs(q) ** 2 * (dd - np.abs(ud) ** 2 / uu))
        out[r] = 1 / np.sqrt(info) / abs(s.real)
    return out


def match(system: TrueSystem, model: ModalModel) -> tuple[dict[int, int], list[int]]:
    """True mode → identified mode, one to one, nearest first; and the identified modes without a partner."""
    f = np.array([m.frequency_hz for m in model.modes])
    pairs = sorted((abs(fj - ft), t, j) for t, ft in enumerate(system.frequency_hz) for j, fj in enumerate(f))
    found: dict[int, int] = {}
    used: set[int] = set()
    for distance, t, j in pairs:
        limit = (system.damping_ratio[t] + 5e-4) * system.frequency_hz[t]
        if t not in found and j not in used and distance <= limit:
            found[t] = j
            used.add(j)
    return found, [j for j in range(len(f)) if j not in used]


def random_case(seed: int) -> tuple[TrueSystem, Hits, FrfSet, list[int], list[int]]:
    rng = np.random.default_rng(seed)
    n_modes = int(rng.integers(4, 16))
    n_ref = int(rng.integers(1, 5))
    n_out = int(rng.integers(max(6, n_ref), 25))
    f_max = float(rng.choice([400.0, 800.0, 1600.0, 3200.0]))
    low = f_max * rng.uniform(0.02, 0.15)
    system = random_system(rng, n_modes=n_modes, n_dofs=n_out, low_hz=low, high_hz=0.95 * f_max)
    record = float(np.clip(4.5 / system.slowest_decay, 1024 / f_max, 16384 / f_max))
    dofs_out, dofs_in = list(range(n_out)), sorted(rng.choice(n_out, n_ref, replace=False).tolist())
    hits = simulate_hits(
        system,
        dofs_out,
        dofs_in,
        f_max=f_max,
        record_s=record,
        n_hits=int(rng.integers(2, 6)),
        force_noise=rng.uniform(0.01, 0.05),
        response_noise=rng.uniform(0.01, 0.05),
        rng=rng,
    )
    return system, hits, measured(records_of(hits, dofs_out, dofs_in)), dofs_out, dofs_in


def random_study(cases: int, first: int, settings: ModalSettings, peer: bool, verbose: bool) -> None:
    truth = found = spurious = invisible = 0
    ef, ez, zf, zz, ep = [], [], [], [], []
    clock = 0.0
    for seed in range(first, first + cases):
        system, hits, frfs, dofs_out, dofs_in = random_case(seed)
        bound = crlb_decay(system, hits, frfs, dofs_out, dofs_in)
        t = time.perf_counter()
        model = identify(frfs, settings)
        clock += time.perf_counter() - t
        pairs, extra = match(system, model)
        seen = bound < INVISIBLE_STD
        missed = [t for t in range(len(bound)) if seen[t] and t not in pairs]
        truth += int(seen.sum())
        invisible += int((~seen).sum())
        found += int(seen.sum()) - len(missed)
        spurious += len(extra)
        for t_, j in pairs.items():
            mode = model.modes[j]
            ef.append(abs(mode.frequency_hz / system.frequency_hz[t_] - 1))
            ez.append(abs(mode.damping_ratio / system.damping_ratio[t_] - 1))
            zf.append((mode.frequency_hz - system.frequency_hz[t_]) / mode.frequency_std_hz)
            zz.append((mode.damping_ratio - system.damping_ratio[t_]) / mode.damping_std)
        if peer:
            ep += peer_errors(system, frfs)
        if verbose and (missed or extra):
            print(
                f"  seed {seed}: refs {len(dofs_in)} missed",
                [(round(float(system.frequency_hz[t]), 2), round(float(bound[t]), 3)) for t in missed],
                "extra",
                [
                    (round(model.modes[j].frequency_hz, 2), round(model.modes[j].damping_ratio, 4))
                    for j in extra
                ],
                flush=True,
            )
    print(f"modes {truth} (+ {invisible} invisible)  time per case {clock / cases:.2f} s")
    print(f"recall {found / truth:.4f}  precision {len(ef) / (len(ef) + spurious):.4f} ({spurious} spurious)")
    print(f"frequency error median {100 * np.median(ef):.5f} %  p95 {100 * np.quantile(ef, 0.95):.4f} %")
    print(f"damping error   median {100 * np.median(ez):.3f} %  p95 {100 * np.quantile(ez, 0.95):.2f} %")
    for name, z in (("frequency", zf), ("damping", zz)):
        z = np.array(z)
        print(
            f"95 % interval of {name} covers {np.mean(np.abs(z) < 1.96):.3f}, "
            f"rms of z {np.sqrt(np.mean(np.minimum(z**2, 25))):.2f}"
        )
    if peer and ep:
        print(f"sdypy-EMA damping error median {100 * np.median(ep):.3f} % ({len(ep)} modes)")


def peer_errors(system: TrueSystem, frfs: FrfSet) -> list[float]:
    """Damping errors of sdypy-EMA (first reference), given the true frequencies to pick its poles by."""
    import contextlib
    import io
    import warnings

    from sdypy import EMA  # progress bars go to stderr

    errors = []
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        warnings.simplefilter("ignore")
        acc = frfs.accelerance()[:, 0]
        low, high = 0.7 * system.frequency_hz[0], frfs.band_hz[1]
        peer = EMA.Model(acc, frfs.frequency_hz, lower=low, upper=high, pol_order_high=60)
        peer.get_poles(show_progress=False)
        try:
            peer.select_closest_poles(list(system.frequency_hz))
        except Exception:
            return []
        f, z = np.array(peer.nat_freq), np.array(peer.nat_xi)
    for t, ft in enumerate(system.frequency_hz):
        if len(f) and np.min(np.abs(f - ft)) < (system.damping_ratio[t] + 5e-4) * ft:
            errors.append(abs(z[np.argmin(np.abs(f - ft))] / system.damping_ratio[t] - 1))
    return errors


def pair_case(seed: int) -> tuple[TrueSystem, Hits, FrfSet, list[int], list[int], list[tuple[int, int]]]:
    """A system in which two modes are 0.5 % apart or equal, and at least two references."""
    rng = np.random.default_rng(10_000 + seed)
    f_max, n_out, n_ref = 800.0, int(rng.integers(8, 20)), int(rng.integers(2, 5))
    base = random_system(
        rng, n_modes=int(rng.integers(4, 9)), n_dofs=n_out, low_hz=60, high_hz=740, min_spacing=0.05
    )
    k = int(rng.integers(0, len(base.frequency_hz)))
    gap = 0.0 if seed % 2 else 0.005
    zeta = base.damping_ratio[k] * (1.0 if seed % 2 else rng.uniform(0.8, 1.25))
    system = TrueSystem(
        np.insert(base.frequency_hz, k + 1, base.frequency_hz[k] * (1 + gap)),
        np.insert(base.damping_ratio, k + 1, zeta),
        np.insert(base.shapes, k + 1, rng.standard_normal(n_out), axis=0),
    )
    record = float(np.clip(4.5 / system.slowest_decay, 1.28, 20.0))
    dofs_out, dofs_in = list(range(n_out)), sorted(rng.choice(n_out, n_ref, replace=False).tolist())
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=f_max, record_s=record, n_hits=int(rng.integers(2, 6)),
        force_noise=rng.uniform(0.005, 0.02), response_noise=rng.uniform(0.005, 0.02), rng=rng,
    )  # fmt: skip
    return system, hits, measured(records_of(hits, dofs_out, dofs_in)), dofs_out, dofs_in, [(k, k + 1)]


def subspace_mac(a: np.ndarray, b: np.ndarray) -> float:
    """Smallest squared cosine of the angles between two sets of shapes, rows."""
    qa = np.linalg.qr(np.asarray(a).T)[0]
    qb = np.linalg.qr(np.asarray(b).T)[0]
    return float(np.min(np.linalg.svd(qa.conj().T @ qb, compute_uv=False)) ** 2)


def pair_study(cases: int, first: int, settings: ModalSettings, verbose: bool) -> None:
    both = 0
    macs = []
    spurious = 0
    for seed in range(first, first + cases):
        system, _, frfs, _, _, ((a, b),) = pair_case(seed)
        model = identify(frfs, settings)
        pairs, extra = match(system, model)
        spurious += len(extra)
        ok = a in pairs and b in pairs
        both += ok
        value = np.nan
        if ok:
            value = subspace_mac(
                np.array([model.modes[pairs[a]].shape, model.modes[pairs[b]].shape]), system.shapes[[a, b]]
            )
            macs.append(value)
        if verbose and (not ok or value < 0.98 or extra):
            beside = [round(model.modes[j].frequency_hz, 2) for j in extra]
            where = f"f {system.frequency_hz[a]:.2f} ζ {system.damping_ratio[a]:.4f}"
            print(f"  seed {seed}: {where} both {ok} subspace {value:.4f} extra {beside}", flush=True)
    print(
        f"both members in {both} of {cases}; subspace MAC min {min(macs):.4f}, "
        f"median {np.median(macs):.5f}; spurious {spurious}"
    )


def noise_study(cases: int, first: int, settings: ModalSettings) -> None:
    invented = 0
    for seed in range(first, first + cases):
        rng = np.random.default_rng(seed)
        n_out, n_in, n_lines = int(rng.integers(1, 20)), int(rng.integers(1, 4)), int(rng.integers(400, 4000))
        n_hits = int(rng.integers(1, 5))
        each = rng.standard_normal((n_hits, n_out, n_in, n_lines, 2)) @ np.array([1, 1j])
        frf = each.mean(axis=0)
        variance = None if n_hits == 1 else np.mean(np.abs(each - frf) ** 2, axis=0) / (n_hits - 1)
        f = np.arange(n_lines) * 0.5
        frfs = frf_set(f, frf, list(range(n_out)), list(range(n_in)), variance=variance, n_hits=n_hits)
        n = len(identify(frfs, settings).modes)
        invented += n
        if n:
            print(f"  seed {seed}: {n} invented ({n_out} × {n_in}, {n_lines} lines, {n_hits} hits)")
    print(f"{invented} modes invented in {cases} sets of pure noise")


def coverage_case(seed: int) -> tuple[TrueSystem, list[Record]]:
    """A system with well separated modes, in records in which all of them decay."""
    rng = np.random.default_rng(50_000 + seed)
    n_out, n_ref = int(rng.integers(2, 13)), int(rng.integers(1, 3))
    system = random_system(
        rng, n_modes=int(rng.integers(2, 6)), n_dofs=n_out, low_hz=60, high_hz=360, min_spacing=0.05,
        damping=(0.003, 0.02),
    )  # fmt: skip
    dofs_out, dofs_in = list(range(n_out)), list(range(n_ref))
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=400.0, record_s=max(6.0 / system.slowest_decay, 1.28),
        n_hits=int(rng.integers(1, 6)),
        force_noise=rng.uniform(0.002, 0.05), response_noise=rng.uniform(0.002, 0.05), rng=rng,
    )  # fmt: skip
    return system, records_of(hits, dofs_out, dofs_in)


def ringing_case(seed: int) -> tuple[TrueSystem, list[Record]]:
    """A freely suspended system in records at whose end the slowest mode has kept 10 to 60 % of its motion.

    Sensors measure acceleration, velocity or displacement; the suspension moves at 1 to 3 Hz.
    """
    rng = np.random.default_rng(130_000 + seed)
    n_out, n_ref, quantity = int(rng.integers(3, 9)), int(rng.integers(1, 3)), QUANTITIES[seed % 3]
    system = random_system(
        rng, n_modes=int(rng.integers(2, 6)), n_dofs=n_out, low_hz=60, high_hz=360, min_spacing=0.05,
        damping=(0.0005, 0.01),
    )  # fmt: skip
    slowest = system.slowest_decay
    system = TrueSystem(
        np.concatenate([[rng.uniform(1.0, 3.0)], system.frequency_hz]),
        np.concatenate([[0.03], system.damping_ratio]),
        np.concatenate([rng.standard_normal((1, n_out)), system.shapes]),
    )
    dofs_out, dofs_in = list(range(n_out)), list(range(n_ref))
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=400.0, record_s=max(-np.log(rng.uniform(0.1, 0.6)) / slowest, 0.5),
        n_hits=int(rng.integers(2, 6)), force_noise=rng.uniform(1e-4, 0.01),
        response_noise=rng.uniform(1e-4, 0.01), rng=rng, quantity=quantity,
    )  # fmt: skip
    return system, records_of(hits, dofs_out, dofs_in)


def coverage_study(
    case: Callable[[int], tuple[TrueSystem, list[Record]]], seeds: Iterable[int], settings: ModalSettings
) -> None:
    inside = {"frequency": [], "damping": [], "shape": []}
    for seed in seeds:
        system, records = case(seed)
        model = identify(measured(records), settings)
        pairs, _ = match(system, model)
        for t, j in pairs.items():
            mode = model.modes[j]
            inside["frequency"].append((mode.frequency_hz - system.frequency_hz[t]) / mode.frequency_std_hz)
            inside["damping"].append((mode.damping_ratio - system.damping_ratio[t]) / mode.damping_std)
            phi = system.shapes[t]
            phi = phi * np.sign(np.real(np.vdot(phi, mode.shape)))
            inside["shape"] += list(np.real(mode.shape - phi) / mode.shape_std)
    for name, z in inside.items():
        z = np.array(z)
        print(
            f"95 % interval of {name}: covers {np.mean(np.abs(z) < 1.96):.4f} of {len(z)}; "
            f"std of z {np.std(np.clip(z, -6, 6)):.3f}, mean {np.mean(np.clip(z, -6, 6)):.3f}"
        )


def moving_case(seed: int) -> tuple[TrueSystem, Hits, list[int], list[int]]:
    """A system whose frequencies move: drift 0.1 %, half of its modes soften by 0.1 %, calibration 4 %."""
    rng = np.random.default_rng(90_000 + seed)
    n_out, n_ref = int(rng.integers(4, 17)), int(rng.integers(1, 4))
    system = random_system(
        rng, n_modes=int(rng.integers(4, 11)), n_dofs=n_out, low_hz=50, high_hz=760, min_spacing=0.03,
        damping=(0.002, 0.02),
    )  # fmt: skip
    dofs_out, dofs_in = list(range(n_out)), list(range(n_ref))
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=800.0, record_s=float(np.clip(6.0 / system.slowest_decay, 1.28, 10.0)),
        n_hits=int(rng.integers(1, 6)),
        force_noise=rng.uniform(0.01, 0.05), response_noise=rng.uniform(0.01, 0.05), rng=rng,
        drift=1e-3, softening=1e-3, calibration=0.04,
    )  # fmt: skip
    return system, hits, dofs_out, dofs_in


def moving_pairs_case(seed: int) -> tuple[TrueSystem, Hits, list[int], list[int]]:
    """Pairs of modes 0.3 to 3 half-widths apart; drift 0.1 %, two hits on each point, calibration 4 %."""
    rng = np.random.default_rng(30_000 + seed)
    n_pairs, n_out, n_ref = (int(rng.integers(*reach)) for reach in ((2, 6), (6, 17), (3, 7)))
    centre = np.exp(rng.uniform(np.log(50), np.log(700)) + np.linspace(-0.6, 0.6, n_pairs))
    centre = np.repeat(centre * min(1.0, 700 / centre.max()), 2)
    damping = np.exp(rng.uniform(np.log(0.002), np.log(0.02), 2 * n_pairs))
    half = np.repeat(damping.reshape(-1, 2).mean(axis=1), 2)
    apart = np.repeat(rng.uniform(0.15, 1.5, n_pairs), 2) * np.tile([-1.0, 1.0], n_pairs) * half
    system = TrueSystem(centre * (1 + apart), damping, rng.standard_normal((2 * n_pairs, n_out)))
    dofs_out, dofs_in = list(range(n_out)), list(range(n_ref))
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=800.0, record_s=float(np.clip(6.0 / system.slowest_decay, 1.28, 10.0)),
        n_hits=2,
        force_noise=rng.uniform(0.002, 0.02), response_noise=rng.uniform(0.002, 0.02), rng=rng,
        drift=1e-3, calibration=0.04,
    )  # fmt: skip
    return system, hits, dofs_out, dofs_in


MOVING = {"moving": moving_case, "moving-pairs": moving_pairs_case}


def roving_case(seed: int) -> tuple[TrueSystem, Hits, list[int], list[int]]:
    """A hammer that strikes 20 to 50 points once each, three sensors; frequencies drift together and each by itself.

    In every other case a hit keeps 0.7 of what the one before it had moved by; in the others hits are independent.
    """
    rng = np.random.default_rng(60_000 + seed)
    n_in, n_out = int(rng.integers(20, 51)), 3
    system = random_system(
        rng, n_modes=int(rng.integers(4, 9)), n_dofs=n_in, low_hz=40, high_hz=360, min_spacing=0.03,
        damping=(0.002, 0.01),
    )  # fmt: skip
    dofs_in = list(range(n_in))
    dofs_out = sorted(rng.choice(n_in, n_out, replace=False).tolist())
    record_s = float(np.clip(6.0 / system.slowest_decay, 2.56, 10.0))
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=400.0, record_s=record_s, n_hits=1,
        force_noise=rng.uniform(0.002, 0.02), response_noise=rng.uniform(0.002, 0.02), rng=rng,
        drift=1e-4, wander=2e-4, alike=0.7 * (seed % 2), softening=2e-4, calibration=0.04,
    )  # fmt: skip
    return system, hits, dofs_out, dofs_in


def hits_study(
    case: Callable[[int], tuple[TrueSystem, Hits, list[int], list[int]]],
    seeds: Iterable[int],
    settings: ModalSettings,
    verbose: bool,
) -> None:
    """Modes of hits that differ in frequency, as the stage finds them: aligned, with circles, pooled.

    One hit in all, or hits on one point only once each, cannot tell drift; coverage is given for both.
    """
    truth = found = spurious = 0
    z: dict[str, list[float]] = {"frequency": [], "frequency, several hits": [], "damping": []}
    clock, cases = 0.0, 0
    for seed in seeds:
        system, made, dofs_out, dofs_in = case(seed)
        cases += 1
        records = records_of(made, dofs_out, dofs_in)
        by_file, judged = {r.file: r for r in records}, [h for h in hits_of_test(records) if h.accepted]

        def hits(by_file=by_file, judged=judged):
            return (cut_hit(by_file[h.file], h) for h in judged)

        frfs = estimate_frfs(hits())
        bound = crlb_decay(system, made, frfs, dofs_out, dofs_in)
        clock -= time.perf_counter()
        one = identify_hits(hits, lambda frfs=frfs: frfs, FrfSettings(), settings)
        model = pooled(attach_circles(one.frfs, one.modal), one.alignment, frfs.record_s)
        clock += time.perf_counter()
        pairs, extra = match(system, model)
        seen = bound < INVISIBLE_STD
        missed = [t for t in np.flatnonzero(seen) if t not in pairs]
        truth, found, spurious = (
            truth + int(seen.sum()),
            found + int(seen.sum()) - len(missed),
            spurious + len(extra),
        )
        for t, j in pairs.items():
            mode = model.modes[j]
            off = (mode.frequency_hz - system.frequency_hz[t]) / mode.frequency_std_hz
            z["frequency"].append(off)
            if len(judged) > 1:
                z["frequency, several hits"].append(off)
            z["damping"].append((mode.damping_ratio - system.damping_ratio[t]) / mode.damping_std)
        if verbose and (missed or extra):
            print(
                f"  seed {seed}: points {len(dofs_in)} hits {len(judged)} missed",
                [round(float(system.frequency_hz[t]), 2) for t in missed],
                "extra",
                [
                    (round(model.modes[j].frequency_hz, 2), round(model.modes[j].damping_ratio, 4))
                    for j in extra
                ],
                flush=True,
            )
    print(f"modes {truth}  time per case {clock / cases:.2f} s")
    print(
        f"recall {found / truth:.4f}  precision {found / max(found + spurious, 1):.4f} ({spurious} spurious)"
    )
    for name, values in z.items():
        inside = np.abs(np.array(values)) < 1.645
        print(f"90 % interval of {name} covers {inside.mean():.3f} of {len(values)}")


END_VALUES = (0.5, 0.2, 0.05, 0.01, 0.001)
"""What the exponential windows of the study have come down to at the end of the record."""


def window_case(seed: int) -> tuple[TrueSystem, FrfSet, float, bool]:
    """A lightly damped system in records too short for it, under an exponential window.

    In every other case the records come with the window on them and test.toml says so; in the others the
    program puts it on.
    """
    rng = np.random.default_rng(70_000 + seed)
    n_out, n_ref, record_s = int(rng.integers(4, 13)), int(rng.integers(1, 4)), 2.0
    system = random_system(
        rng, n_modes=int(rng.integers(3, 9)), n_dofs=n_out, low_hz=40, high_hz=360, min_spacing=0.03,
        damping=(0.001, 0.02),
    )  # fmt: skip
    dofs_out, dofs_in = list(range(n_out)), sorted(rng.choice(n_out, n_ref, replace=False).tolist())
    decay = float(-np.log(END_VALUES[seed // 2 % len(END_VALUES)]) / record_s)
    declared = seed % 2 == 0
    hits = simulate_hits(
        system, dofs_out, dofs_in, f_max=400.0, record_s=record_s, n_hits=int(rng.integers(3, 6)),
        force_noise=rng.uniform(0.002, 0.01), response_noise=rng.uniform(0.002, 0.01), rng=rng,
        decay_rad_s=decay if declared else 0.0,
    )  # fmt: skip
    records = records_of(hits, dofs_out, dofs_in)
    if not declared:
        return system, measured(records, FrfSettings(exponential_window=decay)), decay, declared
    with tempfile.TemporaryDirectory() as folder:
        write_raw_folder(Path(folder), records, decay)
        return system, measured(load_records(read_description(Path(folder)))), decay, declared


def window_study(cases: int, first: int, settings: ModalSettings, verbose: bool) -> None:
    errors: dict[tuple[float, bool], list[float]] = {}
    scaled: list[float] = []
    lost = spurious = 0
    for seed in range(first, first + cases):
        system, frfs, decay, declared = window_case(seed)
        model = identify(frfs, settings)
        pairs, extra = match(system, model)
        lost += len(system.frequency_hz) - len(pairs)
        spurious += len(extra)
        found = [abs(model.modes[j].damping_ratio / system.damping_ratio[t] - 1) for t, j in pairs.items()]
        errors.setdefault((decay, declared), []).extend(found)
        scaled += [
            (model.modes[j].damping_ratio - system.damping_ratio[t]) / model.modes[j].damping_std
            for t, j in pairs.items()
        ]
        if verbose and (extra or len(pairs) < len(system.frequency_hz)):
            beside = [
                (round(model.modes[j].frequency_hz, 2), round(model.modes[j].damping_ratio, 4)) for j in extra
            ]
            print(
                f"  seed {seed}: σ {decay:.2f} declared {declared} found {len(pairs)} beside {beside}",
                flush=True,
            )
    for (decay, declared), some in sorted(errors.items()):
        by = "test.toml " if declared else "frf stage"
        print(
            f"σ {decay:5.2f} rad/s, window by {by}: median {100 * np.median(some):.3f} % of {len(some)} modes"
        )
    every = np.concatenate(list(errors.values()))
    print(
        f"damping error median {100 * np.median(every):.3f} %  p95 {100 * np.quantile(every, 0.95):.2f} % "
        f"of {every.size} modes in {cases} cases; {lost} lost, {spurious} spurious"
    )
    print(f"95 % interval of damping covers {np.mean(np.abs(scaled) < 1.96):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "study",
        choices=["random", "pairs", "noise", "coverage", "window", "ringing", *MOVING, "roving"],
    )
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--engine", default="plscf", choices=["plscf", "lscf", "sdypy"])
    parser.add_argument("--no-polish", action="store_true")
    parser.add_argument("--peer", action="store_true", help="run sdypy-EMA beside")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    settings = ModalSettings(engine=args.engine, polish=not args.no_polish)
    if args.study == "random":
        random_study(args.cases, args.first, settings, args.peer, args.verbose)
    elif args.study == "pairs":
        pair_study(args.cases, args.first, settings, args.verbose)
    elif args.study == "noise":
        noise_study(args.cases, args.first, settings)
    elif args.study == "window":
        window_study(args.cases, args.first, settings, args.verbose)
    elif args.study in MOVING:
        hits_study(MOVING[args.study], range(args.first, args.first + args.cases), settings, args.verbose)
    elif args.study == "roving":
        for start, words in (
            (0, "hits that do not depend on each other"),
            (1, "each like the one before it"),
        ):
            print(words)
            seeds = range(args.first + start, args.first + args.cases, 2)
            hits_study(roving_case, seeds, settings, args.verbose)
    else:
        case = ringing_case if args.study == "ringing" else coverage_case
        coverage_study(case, range(args.first, args.first + args.cases), settings)


if __name__ == "__main__":
    main()
