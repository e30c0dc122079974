"""Do the modes of half the hits agree with those of the other half, within their stated intervals?

    python benchmarks/halves_study.py RAW [RAW ...] [--splits 8] [--blocks 1] [--rig planetary] [--verbose]

Every other hit of a raw folder, or every other block of hits, goes to one half, the others to the other; further splits
are drawn at random. `ema run` identifies the modes of both. Modes of the halves are paired by frequency, and the
differences of frequency and of ln ζ compared with the standard deviations that the program states: χ² per degree of
freedom is 1 where these are true and no hit of one half depends on one of the other. Where neighbours in the order of
records are alike, halves of every other record differ by less than two tests would, and large blocks by more.
A folder of gzipped records is unpacked first, and described by `ema` where it has no test.toml.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline import cli
from ema_pipeline.ingest.draft import write_drafts
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.store import Store
from ema_pipeline.toml_text import read_toml

STAGES = 'stages = ["ingest", "hits", "frf", "modal"]\n'
REACH = 2.0
"""Half-power half-widths within which two modes may be one; beyond 0.1 % of the frequency, which drift may make."""


@dataclass(frozen=True)
class Pair:
    """One mode in both halves; differences in units of their standard deviation."""

    one: Mode
    other: Mode

    @property
    def frequency(self) -> float:
        std = np.hypot(self.one.frequency_std_hz, self.other.frequency_std_hz)
        return float((self.one.frequency_hz - self.other.frequency_hz) / std)

    @property
    def damping(self) -> float:
        relative = [m.damping_std / m.damping_ratio for m in (self.one, self.other)]
        return float(np.log(self.one.damping_ratio / self.other.damping_ratio) / np.hypot(*relative))


def unpacked(raw: Path, to: Path) -> Path:
    """The folder itself, or a copy of it with records unpacked and described."""
    if (raw / "test.toml").exists():
        return raw
    to.mkdir()
    for file in raw.iterdir():
        if file.suffix == ".gz":
            (to / file.stem).write_bytes(gzip.decompress(file.read_bytes()))
        else:
            shutil.copy(file, to)
    write_drafts(to)
    return to


def halves(n: int, split: int, block: int = 1) -> NDArray[np.bool_]:
    """Which of n records go to the first half: every other block of them in split 0, else drawn at random."""
    every_other = np.arange(n) // block % 2 == 0
    return every_other if split == 0 else np.random.default_rng(split).permutation(every_other)


def part_of(raw: Path, keep: NDArray[np.bool_], to: Path) -> Path:
    """A raw folder with some of the records of another, in the order of its test.toml."""
    to.mkdir()
    head, *records = (raw / "test.toml").read_text(encoding="utf-8").split("[[records]]")
    described = read_toml(raw / "test.toml")["records"]
    chosen = [k for k in range(len(records)) if keep[k]]
    (to / "test.toml").write_text("[[records]]".join([head, *(records[k] for k in chosen)]), encoding="utf-8")
    for k in chosen:
        (to / described[k]["file"]).symlink_to((raw / described[k]["file"]).resolve())
    return to


def identified(raw: Path, out: Path, arguments: Sequence[str]) -> ModalModel:
    """Modes that `ema run` finds in a raw folder of one configuration."""
    out.mkdir()
    (out / "pipeline.toml").write_text(STAGES, encoding="utf-8")
    before = sys.argv
    sys.argv = ["ema", "run", str(raw), "--out", str(out / "results"), "-q", *arguments]
    sys.argv += ["-p", str(out / "pipeline.toml")]
    try:
        with contextlib.suppress(SystemExit):
            cli.main()
    finally:
        sys.argv = before
    name = read_toml(raw / "test.toml").get("configuration", "default")
    return Store(out / "results").load("modal", name, "modal", ModalModel)


def paired(one: ModalModel, other: ModalModel) -> tuple[list[Pair], list[Mode]]:
    """Modes of both halves, nearest first, and those that one half alone shows."""
    candidates = sorted(
        (abs(a.frequency_hz - b.frequency_hz), i, j)
        for i, a in enumerate(one.modes)
        for j, b in enumerate(other.modes)
        if abs(a.frequency_hz - b.frequency_hz)
        < (REACH * max(a.damping_ratio, b.damping_ratio) + 1e-3) * a.frequency_hz
    )
    taken: list[tuple[int, int]] = []
    for _, i, j in candidates:
        if all(i != p and j != q for p, q in taken):
            taken.append((i, j))
    single = [m for i, m in enumerate(one.modes) if all(i != p for p, _ in taken)]
    single += [m for j, m in enumerate(other.modes) if all(j != q for _, q in taken)]
    return [Pair(one.modes[i], other.modes[j]) for i, j in sorted(taken)], single


def per_degree(values: Sequence[float]) -> str:
    """χ² over its degrees of freedom, and the median of its terms (0.45 for normal errors)."""
    square = np.square(values)
    return f"{square.mean():.2f} (median {np.median(square):.2f})"


def study(raw: Path, splits: int, block: int, arguments: Sequence[str], verbose: bool) -> None:
    pairs: list[Pair] = []
    single: list[Mode] = []
    with tempfile.TemporaryDirectory(prefix="halves-") as temporary:
        work = Path(temporary)
        source = unpacked(raw, work / "unpacked")
        n = len(read_toml(source / "test.toml")["records"])
        for split in range(splits):
            first = halves(n, split, block)
            models = []
            for name, keep in (("a", first), ("b", ~first)):
                part = part_of(source, keep, work / f"{split}{name}")
                models.append(identified(part, work / f"{split}{name}_out", arguments))
            both, alone = paired(*models)
            pairs, single = pairs + both, single + alone
            if verbose:
                report(both, alone)
    print(f"{raw.name}: {n} records, {splits} split(s); {len(pairs)} pairs of modes, {len(single)} alone")
    f, z = [p.frequency for p in pairs], [p.damping for p in pairs]
    print(f"  χ² per degree: f {per_degree(f)}, ζ {per_degree(z)}, both {per_degree(f + z)}", flush=True)


def report(pairs: list[Pair], single: list[Mode]) -> None:
    """A line per mode."""
    for p in pairs:
        a, b = p.one, p.other
        print(
            f"  {a.frequency_hz:9.3f}({a.frequency_std_hz:.3f}) {b.frequency_hz:9.3f}({b.frequency_std_hz:.3f}) Hz "
            f"{p.frequency:+6.2f} σ   {100 * a.damping_ratio:.4f}({100 * a.damping_std:.4f}) "
            f"{100 * b.damping_ratio:.4f}({100 * b.damping_std:.4f}) % {p.damping:+6.2f} σ"
        )
        for m in (a, b):
            print("".join(f"      {m.frequency_hz:.3f}: {text}\n" for text in m.flags), end="")
    for m in single:
        print(f"  {m.frequency_hz:9.3f} Hz, ζ {100 * m.damping_ratio:.3f} %: in one half only")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("raw", type=Path, nargs="+")
    parser.add_argument("--splits", type=int, default=1)
    parser.add_argument("--blocks", type=int, default=1, help="records that go to a half together, in order")
    parser.add_argument("--rig", help="for the folders that need one")
    parser.add_argument("--verbose", action="store_true", help="a line per mode")
    given = parser.parse_args()
    arguments = ["--rig", given.rig] if given.rig else []
    for raw in given.raw:
        study(raw, given.splits, given.blocks, arguments, given.verbose)


if __name__ == "__main__":
    main()
