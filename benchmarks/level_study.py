"""How often linear structures are called level-dependent, and how small a change with the force is found.

    python benchmarks/level_study.py --linear 100 --one-level 100 --moving 60 [--rigs 12] [--alone 300] [--seed 0]

Linear cases: random modal systems (3 to 9 modes, some close pairs), 2 to 4 levels, 1 to 4 hits per level, 1 to 4
points, noise from 0.003 to 3 % of the softest hits' responses, noise on the hammer, hands that scatter by 5 to 20 %.
One level: the same with the softest level alone, judged by decays.
Moving cases: the same, with one mode's frequency or damping moving with the square of the force (each hit stays
linear, so that its change is known exactly). Rigs: planetary campaigns of `ema simulate`, one half linear, one
half with a cubic spring, dry friction or backlash. Alone: the test of single hits given the true modes, without
identification: half a second per case.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from simulate_levels import Case, hits_of, random_case

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import HitSamples, cut_hit
from ema_pipeline.levels import LevelSettings, LevelStudy, study_levels
from ema_pipeline.levels.hit_trends import hit_trends
from ema_pipeline.levels.single import single_hits
from ema_pipeline.levels.sort import sort_levels
from ema_pipeline.levels.trend import clearest
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart
from ema_pipeline.simulate import simulate_campaign


def studied(hits: list[HitSamples]) -> LevelStudy:
    """From hits to the study."""
    frfs = estimate_frfs(hits, FrfSettings())
    modal = identify(frfs, ModalSettings())
    return study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), ModalSettings(), lambda done, text: None
    )


def linear_cases(count: int, rng: np.random.Generator, one_level: bool) -> None:
    """Print the share of linear systems that are called level-dependent."""
    wrong, known, p_values = 0, 0, []
    for number in range(count):
        case = random_case(rng)
        if one_level:
            case = replace(case, forces_n=case.forces_n[:1])
        study = studied(hits_of(case, rng))
        wrong += study.level_dependent
        if np.isfinite(study.p_value):
            known += 1
            p_values.append(study.p_value)
        if study.level_dependent:
            print(f"  case {number}: p = {study.p_value:.2g}, {study.summary}", flush=True)
    p = np.array(p_values)
    kind = "one level" if one_level else "several levels"
    print(
        f"linear, {kind}: {wrong} of {count} called level-dependent ({known} could be told), p below 0.01, 0.05 "
        "and 0.2 in "
        f"{np.mean(p < 0.01):.1%}, {np.mean(p < 0.05):.1%}, {np.mean(p < 0.2):.1%}",
        flush=True,
    )


def moving_cases(count: int, rng: np.random.Generator) -> None:
    """Print the power over the size of the change, in standard deviations of the hardest against the softest."""
    rows = []
    for _ in range(count):
        case = moving_case(rng)
        study = studied(hits_of(case, rng))
        near = [
            m for m in study.modes
            if np.isfinite(m.frequency_hz).all()
            and abs(m.frequency_hz[0] / case.frequency_hz[case.mode] - 1) < 0.002
        ]  # fmt: skip
        if not near:
            continue
        mode = near[0]
        if case.frequency_shift:
            change = case.frequency_shift * case.frequency_hz[case.mode]
            sigma = float(np.hypot(mode.frequency_std_hz[0], mode.frequency_std_hz[-1]))
        else:
            change = case.damping_shift * case.damping[case.mode]
            sigma = float(np.hypot(mode.damping_std[0], mode.damping_std[-1]))
        rows.append((abs(change) / sigma, mode.depends, study.level_dependent and not mode.depends))
    table = np.array(rows, dtype=float)
    for low, high in ((0, 1), (1, 3), (3, 6), (6, 10), (10, 20), (20, np.inf)):
        of = (table[:, 0] >= low) & (table[:, 0] < high)
        if of.any():
            print(
                f"moving: change of {low} to {high} sigma: found in {int(table[of, 1].sum())} of "
                f"{int(of.sum())}, another mode blamed alone in {int(table[of, 2].sum())}",
                flush=True,
            )


def test_alone(case: Case, rng: np.random.Generator) -> tuple[float, list[bool], float]:
    """P value of the test given the true modes, which modes move, and the change over its standard deviation."""
    hits = hits_of(case, rng)
    frfs = estimate_frfs(hits, FrfSettings())
    found = single_hits(lambda: hits, true_modes(case, frfs), frfs, FrfSettings())
    forces = [abs(h.hit.peak_force) for h in hits]
    place = sort_levels([h.hit.impact.point for h in hits], forces, LevelSettings().level_ratio)
    level_of = {f"{h.hit.file}#{h.hit.number}": int(k) for h, k in zip(hits, place, strict=True)}
    level = np.array([level_of[name] for name in found.names])
    if level.max() == 0:
        return float("nan"), [False] * len(case.damping), 0.0
    tests = hit_trends(found, level, np.zeros(len(case.damping), dtype=bool))
    p_values, p = tests.p_values, tests.p_value
    moves = clearest(p_values, LevelSettings().false_alarm) & (p < LevelSettings().false_alarm)
    change, stds = case.frequency_shift * case.frequency_hz[case.mode], found.frequency_std_hz
    if not case.frequency_shift:
        change, stds = case.damping_shift * case.damping[case.mode], found.damping_std
    ends = [float(np.sum(stds[level == k, case.mode] ** -2.0)) for k in (0, level.max())]
    size = abs(change) / np.sqrt(sum(1 / max(e, 1e-300) for e in ends))
    return p, moves.reshape(3, -1).any(axis=0).tolist(), float(size)


def true_modes(case: Case, frfs: FrfSet) -> ModalModel:
    """The case's own modes in the form of an identification."""
    outputs = [int(d.body.removeprefix("p")) for d in frfs.outputs]
    modes = tuple(
        Mode(
            frequency_hz=float(hz), frequency_std_hz=0.0, damping_ratio=float(zeta), damping_std=0.0,
            pole=2 * np.pi * hz * complex(-zeta, np.sqrt(1 - zeta**2)), shape=shape[outputs].astype(complex),
            shape_std=np.zeros(len(outputs)), mpc=1.0, method="true",
        )
        for hz, zeta, shape in zip(case.frequency_hz, case.damping, case.shapes, strict=True)
    )  # fmt: skip
    none = np.zeros(0)
    chart = StabilisationChart(none.astype(int), none, none, none.astype(bool), none.astype(int))
    return ModalModel(
        frfs.outputs, modes, (0.0, 1000.0), True, "", (), none, np.zeros((0, 0, 0), complex), frfs.outputs,
        frfs.inputs, chart,
    )  # fmt: skip


def cases_alone(count: int, rng: np.random.Generator) -> None:
    """Print false alarms and power of the test given the true modes: half of the cases linear, half moving."""
    p = np.array([test_alone(random_case(rng), rng)[0] for _ in range(count)])
    known = p[np.isfinite(p)]
    print(
        f"alone, linear: {np.sum(known < LevelSettings().false_alarm)} of {count} called level-dependent ({len(known)} "
        f"could be told), p below 0.05 and 0.2 in {np.mean(known < 0.05):.1%}, {np.mean(known < 0.2):.1%}",
        flush=True,
    )
    rows = []
    for _ in range(count):
        case = moving_case(rng)
        _, moves, size = test_alone(case, rng)
        rows.append((size, moves[case.mode], sum(moves) > moves[case.mode]))
    table = np.array(rows, dtype=float)
    for low, high in ((0, 2), (2, 4), (4, 10), (10, np.inf)):
        of = (table[:, 0] >= low) & (table[:, 0] < high)
        print(
            f"alone, change of {low} to {high} sigma: found in {int(table[of, 1].sum())} of {int(of.sum())}, "
            f"another mode blamed too in {int(table[of, 2].sum())}",
            flush=True,
        )


def moving_case(rng: np.random.Generator) -> Case:
    """A case with one mode whose frequency or damping moves."""
    case = random_case(rng)
    case = replace(
        case, hits_per_level=max(case.hits_per_level, 2), mode=int(rng.integers(len(case.damping)))
    )
    size = float(np.exp(rng.uniform(np.log(1e-6), np.log(3e-2))))
    if rng.random() < 0.5:
        return replace(case, frequency_shift=size * rng.choice([-1, 1]))
    return replace(case, damping_shift=30 * size * rng.choice([-1, 1]))


RIG_EFFECTS = (
    "bearing_cubic@carrier:stiffness=8e11", "dry_friction@carrier:force=2.0", "bearing_cubic@sun:stiffness=5e11",
    "dry_friction@sun:force=2.0",
)  # fmt: skip


def rig_cases(count: int, rng: np.random.Generator) -> None:
    """Print what is said of simulated planetary rigs."""
    for number in range(count):
        effects = () if number % 2 == 0 else (RIG_EFFECTS[(number // 2) % len(RIG_EFFECTS)],)
        with tempfile.TemporaryDirectory() as folder:
            simulate_campaign(
                Path(folder) / "raw",
                configurations=("no_ring",),
                effects=effects,
                peak_force_n=(30.0, 100.0, 300.0)[: int(rng.integers(2, 4))],
                hits=int(rng.integers(1, 4)),
                acceleration_noise=float(np.exp(rng.uniform(np.log(0.002), np.log(0.2)))),
                seed=int(rng.integers(1 << 30)),
            )
            test = read_campaign(Path(folder) / "raw").tests[0]
            records = list(load_records(test))
            found = hits_of_test(records, HitSettings())
            hits = [cut_hit(r, h) for r in records for h in found if h.file == r.file and h.accepted]
        study = studied(hits)
        name = effects[0] if effects else "linear"
        print(f"rig, {name}: level-dependent {study.level_dependent}, p = {study.p_value:.2g}", flush=True)


def main() -> None:
    """Run the studies asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--linear", type=int, default=100)
    parser.add_argument("--one-level", type=int, default=0)
    parser.add_argument("--moving", type=int, default=60)
    parser.add_argument("--rigs", type=int, default=0)
    parser.add_argument("--alone", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    start = time.perf_counter()
    if given.linear:
        linear_cases(given.linear, np.random.default_rng(given.seed), one_level=False)
    if given.one_level:
        linear_cases(given.one_level, np.random.default_rng(given.seed + 3), one_level=True)
    if given.moving:
        moving_cases(given.moving, np.random.default_rng(given.seed + 1))
    if given.rigs:
        rig_cases(given.rigs, np.random.default_rng(given.seed + 2))
    if given.alone:
        cases_alone(given.alone, np.random.default_rng(given.seed + 4))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
