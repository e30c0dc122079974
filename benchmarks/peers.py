"""The table of docs/peers.md: ours against sdypy-FRF, sdypy-EMA and scipy, all measured in one run.

    python benchmarks/peers.py
    python benchmarks/peers.py --cases 40 --turns 7

Prints Markdown. Times are medians over turns in which ours and the peer run one after the other; ratios are medians
of the ratios of these turns. BLAS is pinned to one thread. The cases of the accuracy rows are those of
identification_study.py.
"""

from __future__ import annotations

import argparse
import os
import platform
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from io import StringIO
from itertools import chain
from types import SimpleNamespace

import bench_frf
import bench_lscf
import numpy as np
from identification_study import (
    INVISIBLE_STD,
    FrfSet,
    Hits,
    TrueSystem,
    crlb_decay,
    match,
    pair_case,
    random_case,
)
from pairing import Paired

from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.threads import single_blas_thread

HEAD = ("what", "ours", "peer", "ratio (spread)")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--cases", type=int, default=20, help="simulated systems per row of accuracy")
    given = parser.parse_args()
    with single_blas_thread():
        print("\n".join(f"- {line}" for line in surroundings()), end="\n\n")
        print(row(*HEAD))
        print(row("---", "---", "---", "---"))
        for cells in chain(speed(given.turns), accuracy(given.cases)):
            print(row(*cells), flush=True)


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def surroundings() -> list[str]:
    """Machine and versions, as far as they bear on the figures."""
    packages = ("ema-pipeline", "sdypy-EMA", "sdypy-FRF", "pyFRF", "numpy", "scipy")
    return [
        f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}",
        ", ".join(f"{name} {version(name)}" for name in packages),
        f"load while measuring (1 min): {os.getloadavg()[0]:.1f} at the start",
    ]


def speed(turns: int) -> Iterator[tuple[str, ...]]:
    """Rows of time and memory."""
    frf = bench_frf.compare(100, 10, 65536, turns)
    what = "H1 and coherence, 100 channels × 10 hits × 65536 samples"
    yield times(f"{what}; sdypy-FRF, ours in two threads", frf.two_threads)
    yield times(f"{what}; sdypy-FRF, both in one thread", frf.one_thread)
    yield times(f"{what}; scipy.signal.csd, ours in two threads", frf.scipy)
    for name, memory in (("sdypy-FRF", frf.memory_peer), ("scipy.signal.csd", frf.memory_scipy)):
        yield (
            f"extra memory of the same; {name}",
            f"{frf.memory_ours:.2f} × records",
            f"{memory:.2f} × records",
            f"{memory / frf.memory_ours:.1f}",
        )
    for channels, lines, order in bench_lscf.SIZES:
        found = bench_lscf.poles(channels, lines, order, turns if channels < 400 else max(2, turns // 2))
        what = f"LSCF poles of all orders, {channels} channels × {lines} lines, order {order}; sdypy-EMA"
        yield times(what, found.time)
        yield "its stable poles, largest relative distance to ours", f"{found.distance:.1e}", "", ""
    build, select = bench_lscf.chart(turns)
    yield times("poles of a chart, ours polyreference with 2 references, sdypy-EMA with 1", build)
    yield times("selection from that chart, ours by itself, sdypy-EMA given the 12 true frequencies", select)


def times(what: str, found: Paired) -> tuple[str, ...]:
    low, high = found.spread
    return (
        what,
        f"{1e3 * found.ours_s:.0f} ms" if found.ours_s > 0.0995 else f"{1e3 * found.ours_s:.1f} ms",
        f"{1e3 * found.peer_s:.0f} ms",
        f"**{found.ratio:.1f}** ({low:.1f} to {high:.1f})",
    )


@dataclass(frozen=True)
class Found:
    """A mode that an estimator found."""

    frequency_hz: float
    damping_ratio: float


@dataclass
class Score:
    """How an estimator did over all cases."""

    truth: int = 0
    missed: int = 0
    spurious: int = 0
    damping: list[float] = field(default_factory=list)

    def add(self, system: TrueSystem, wanted: np.ndarray, modes: list[Found]) -> None:
        """Count one case; modes that are not wanted may be found, but need not."""
        pairs, extra = match(system, SimpleNamespace(modes=modes))
        self.truth += int(np.count_nonzero(wanted))
        self.missed += sum(t not in pairs for t in np.flatnonzero(wanted).tolist())
        self.spurious += len(extra)
        self.damping += [
            abs(modes[j].damping_ratio / system.damping_ratio[t] - 1) for t, j in pairs.items() if wanted[t]
        ]

    def errors(self) -> str:
        """Median and 95 % quantile of the damping error."""
        return f"{100 * np.median(self.damping):.2f} / {100 * np.quantile(self.damping, 0.95):.1f} %"

    def misses(self) -> str:
        """Missed modes of all, and modes that are none."""
        return f"{self.missed} of {self.truth} / {self.spurious}"


def accuracy(cases: int) -> Iterator[tuple[str, ...]]:
    """Rows of damping errors, missed and spurious modes."""
    ours, alone, theirs = Score(), Score(), Score()
    for seed in range(cases):
        system, hits, frfs, dofs_out, dofs_in = random_case(seed)
        ours.add(system, visible(system, hits, frfs, dofs_out, dofs_in), by_ours(frfs))
        hits = replace(hits, force=hits.force[:1], responses=hits.responses[:1])
        frfs = first_reference(frfs)
        seen = visible(system, hits, frfs, dofs_out, dofs_in[:1])
        alone.add(system, seen, by_ours(frfs))
        theirs.add(system, seen, by_peer(frfs, system))
    what = f"{cases} systems of 4 to 15 modes, 1 to 5 % noise"
    yield f"damping error, median / 95 %, {what}, one reference; sdypy-EMA", *compared(alone, theirs)
    yield (
        "missed / spurious modes of the same, sdypy-EMA given the true frequencies",
        alone.misses(),
        theirs.misses(),
        "",
    )
    yield "damping error of the same systems, all references", ours.errors(), "takes one reference", ""
    yield "missed / spurious modes of these", ours.misses(), "takes one reference", ""

    ours, theirs = Score(), Score()
    for seed in range(0, 2 * cases, 2):  # the odd ones have a repeated mode, which one reference cannot show
        system, _, frfs, _, _, (pair,) = pair_case(seed)
        members = np.isin(np.arange(len(system.frequency_hz)), pair)
        ours.add(system, members, by_ours(frfs))
        theirs.add(system, members, by_peer(first_reference(frfs), system))
    what = f"{cases} pairs 0.5 % apart, 2 to 4 references, 0.5 to 2 % noise"
    yield f"damping error, median / 95 %, {what}; sdypy-EMA with one reference", *compared(ours, theirs)
    yield (
        "missed members / spurious modes of the same, sdypy-EMA given the true frequencies",
        ours.misses(),
        theirs.misses(),
        "",
    )


def compared(ours: Score, theirs: Score) -> tuple[str, str, str]:
    low, high = (np.median(s.damping) for s in (ours, theirs))
    return ours.errors(), theirs.errors(), f"{high / low:.1f}"


def visible(
    system: TrueSystem, hits: Hits, frfs: FrfSet, dofs_out: list[int], dofs_in: list[int]
) -> np.ndarray:
    """Modes that the noise lets anyone find, by the Cramér–Rao bound of their damping."""
    return crlb_decay(system, hits, frfs, dofs_out, dofs_in) < INVISIBLE_STD


def first_reference(frfs: FrfSet) -> FrfSet:
    """The FRFs of the first impact point alone."""
    arrays = {name: getattr(frfs, name)[:, :1] for name in ("frf", "coherence", "variance", "hits")}
    return replace(frfs, **arrays, inputs=frfs.inputs[:1], delay_s=frfs.delay_s[:1])


def by_ours(frfs: FrfSet) -> list[Found]:
    """Modes of the automatic identification."""
    return [Found(m.frequency_hz, m.damping_ratio) for m in identify(frfs, ModalSettings()).modes]


def by_peer(frfs: FrfSet, system: TrueSystem) -> list[Found]:
    """Modes that sdypy-EMA selects from the stable poles nearest to the true frequencies."""
    from sdypy import EMA

    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        low, high = 0.7 * float(system.frequency_hz[0]), frfs.band_hz[1]
        frf = frfs.accelerance()[:, 0]
        model = EMA.Model(frf, frfs.frequency_hz, lower=low, upper=high, pol_order_high=60)
        model.get_poles(show_progress=False)
        try:
            model.select_closest_poles(system.frequency_hz.tolist())
        except (IndexError, ValueError):  # no stable pole near by
            return []
    return [Found(f, z) for f, z in sorted(set(zip(model.nat_freq, model.nat_xi, strict=True)))]


if __name__ == "__main__":
    main()
