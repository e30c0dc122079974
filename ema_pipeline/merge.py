"""Several set-ups of one state (two hammers, roving sensors) merged into one raw folder, each with its band."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import scipy.stats
import tomlkit

from ema_pipeline.correlate.matching import match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.errors import EmaError
from ema_pipeline.files import cannot_write
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.parts import gain_ratios
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.description import DESCRIPTION_FILE, RIG_FILE, TestDescription
from ema_pipeline.job import run_raw
from ema_pipeline.names import check_name
from ema_pipeline.number_text import format_percent
from ema_pipeline.pipeline import ShowStage
from ema_pipeline.run.measured import measured_frfs, measured_modes
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.records import accepted_hits
from ema_pipeline.run.types import Run
from ema_pipeline.significance import holm
from ema_pipeline.store import RESULTS_FILE

TOLERANCE = 1e-3
"""Relative 1 σ by which frequencies of one state differ between set-ups: temperature, and sensors that moved."""

LEVEL = 0.01
"""Chance to call any two parts of one state different."""

_MEASURING = 'stages=["ingest", "hits", "frf", "modal"]'
_JOINING = 'stages=["ingest", "hits", "frf"]'


@dataclass(frozen=True)
class Part:
    """One set-up.

    Attributes
    ----------
    name : str
    raw : Path
    test : TestDescription
    frfs : FrfSet
    modes : MeasuredModes
    """

    name: str
    raw: Path
    test: TestDescription
    frfs: FrfSet
    modes: MeasuredModes

    @property
    def band_hz(self) -> tuple[float, float]:
        """Band in which it is used: that of its force spectrum, within what its description states."""
        return self.frfs.band_hz


@dataclass(frozen=True)
class CommonMode:
    """A mode that two parts show.

    Attributes
    ----------
    a, b : str
        Names of the parts.
    frequency_a, frequency_b : float
        Hz.
    change, std : float
        Relative difference b - a, and its 1 σ from the scatter of both parts.
    p : float
        Of no difference but by scatter and set-up, adjusted for all that is compared (Holm).
    """

    a: str
    b: str
    frequency_a: float
    frequency_b: float
    change: float
    std: float
    p: float


@dataclass(frozen=True)
class Merged:
    """What was merged.

    Attributes
    ----------
    folder : Path
        The new raw folder.
    parts : tuple of Part
    frfs : FrfSet
        Of all parts together.
    modes : tuple of CommonMode
    gains : dict of (str, str) to (float, float)
        ln of the gain of one part over that of another, and its 1 σ, where the same sensors measured the same.
    """

    folder: Path
    parts: tuple[Part, ...]
    frfs: FrfSet
    modes: tuple[CommonMode, ...]
    gains: dict[tuple[str, str], tuple[float, float]]


def merge(
    sources: Sequence[Path], out: Path, tolerance: float = TOLERANCE, show: ShowStage | None = None
) -> Merged:
    """Merge set-ups of one state into one raw folder, which ``ema run`` takes like any other.

    Parameters
    ----------
    sources : sequence of Path
        Raw folders, or results folders, of one test each.
    out : Path
        New raw folder: a copy of every source, with ``part`` and ``band_hz`` in its test.toml.
    tolerance : float
        Relative 1 σ by which frequencies may differ from set-up to set-up, beside the scatter of the tests.
    show : callable, optional
        Display of progress.

    Raises
    ------
    EmaError
        If the sources cannot be one test: other kinds, rigs, configurations, states, sample rates; no point in common;
        hammers or sensors that contradict each other. Nothing is written then.
    """
    if out.exists():
        raise EmaError(f"{out}: exists already; choose a new folder with --out, or remove it")
    with tempfile.TemporaryDirectory(prefix="ema-merge-") as scratch:
        parts = _parts(sources, Path(scratch), show)
        _check_connected(parts)
        modes = common_modes({p.name: p.modes for p in parts}, tolerance)
        _check_one_state(modes)
        folder = Path(scratch) / "merged"
        for part in parts:
            _copy(part, folder / part.name)
        _check_one_rig(parts, folder)
        run, _ = run_raw(folder, None, Path(scratch) / "results", None, [_JOINING], show)
        ((configuration, frfs),) = measured_frfs(run).items()
        gains = gain_ratios({p.name: _frfs_of(run, configuration, p.name) for p in parts})
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(folder, out)
        except OSError as error:
            shutil.rmtree(out, ignore_errors=True)
            raise cannot_write(out, error) from None
    return Merged(out, tuple(parts), frfs, modes, gains)


def _parts(sources: Sequence[Path], scratch: Path, show: ShowStage | None) -> list[Part]:
    if len(sources) < 2:
        raise EmaError("one test is nothing to merge; give two or more folders")
    parts: list[Part] = []
    for source in sources:
        run: Run | None = existing_run(source) if (source / RESULTS_FILE).is_file() else None
        raw = source if run is None else Path(run.info.raw)
        test = _single_test(raw)
        name = check_name(raw.resolve().name, f"{raw}: name of the folder")
        if any(p.name == name for p in parts):
            raise EmaError(
                f"{raw}: another of the folders is called '{name}', too; rename one, parts go by that name"
            )
        if parts and (test.configuration or "") != (parts[0].test.configuration or ""):
            raise EmaError(
                f"{test.file}: is of configuration '{test.configuration or ''}', {parts[0].test.file} of "
                f"'{parts[0].test.configuration or ''}'; only tests of one configuration can be merged"
            )
        if run is None or not all(run.store.key("modal", c) for c in run.info.configurations):
            run, _ = run_raw(raw, None, scratch / name, None, [_MEASURING], show)
        ((_, frfs),) = measured_frfs(run).items()
        ((_, modes),) = measured_modes(run).items()
        parts.append(Part(name, raw, test, frfs, modes))
    return parts


def _single_test(raw: Path) -> TestDescription:
    tests = read_campaign(raw).tests
    if len(tests) > 1:
        what = "is merged already" if tests[0].part else "is a campaign of several configurations"
        raise EmaError(f"{raw}: {what}; give the folders of single tests")
    if tests[0].kind != "hammer":
        raise EmaError(f"{tests[0].file}: is of kind '{tests[0].kind}'; only hammer tests can be merged")
    return tests[0]


def _check_connected(parts: Sequence[Part]) -> None:
    """Every part must share a point that is struck, or a sensor, with those before: else no shape goes through all."""
    known: set[str] = set()
    for k, part in enumerate(parts):
        struck = {f"strike {d.point}" for d in part.frfs.inputs}
        measured = {f"measure {d.point}" for d in part.frfs.outputs}
        if k and not known & (struck | measured):
            raise EmaError(
                f"{part.raw}: strikes no point and measures no direction that the other parts do; strike one of "
                "theirs, or leave one sensor where it was"
            )
        known |= struck | measured


def common_modes(parts: Mapping[str, MeasuredModes], tolerance: float = TOLERANCE) -> tuple[CommonMode, ...]:
    """Modes that any two parts show, and whether their frequencies agree.

    Parameters
    ----------
    parts : mapping of str to MeasuredModes
    tolerance : float
        Relative 1 σ of frequencies from set-up to set-up.
    """
    found: list[tuple[str, str, float, float, float, float]] = []
    for a, b in combinations(parts, 2):
        one, other = parts[a], parts[b]
        for i, j in enumerate(match_modes(one, other)):
            if j >= 0:
                f_a, f_b = float(one.frequency_hz[i]), float(other.frequency_hz[j])
                std = float(np.hypot(one.frequency_std_hz[i] / f_a, other.frequency_std_hz[j] / f_b))
                found.append((a, b, f_a, f_b, f_b / f_a - 1, std))
    p = holm([_p(change, float(np.hypot(std, tolerance))) for *_, change, std in found])
    return tuple(CommonMode(*one, float(value)) for one, value in zip(found, p, strict=True))


def _p(change: float, std: float) -> float:
    return float(2 * scipy.stats.norm.sf(abs(change) / std)) if np.isfinite(std) else float("nan")


def _check_one_state(modes: Sequence[CommonMode]) -> None:
    if not modes:
        return
    worst = min(modes, key=lambda m: m.p if np.isfinite(m.p) else 1.0)
    if worst.p < LEVEL:
        raise EmaError(
            f"'{worst.a}' and '{worst.b}' are not of one state: the mode at {worst.frequency_a:.5g} Hz of '{worst.a}' "
            f"is at {worst.frequency_b:.5g} Hz in '{worst.b}' ({format_percent(worst.change, worst.std)}); "
            "merge tests between which nothing changed, or say with --tolerance how far set-ups may differ"
        )


def _frfs_of(run: Run, configuration: str, part: str) -> FrfSet:
    """FRFs of one part of a merged test, of hits as long as those of the others."""
    hits = (h for h in accepted_hits(run.store, configuration) if h.hit.part == part)
    return estimate_frfs(hits, run.settings.frf)


def _check_one_rig(parts: Sequence[Part], folder: Path) -> None:
    """One rig file for all parts stands beside them."""
    files = [folder / p.name / RIG_FILE for p in parts if (folder / p.name / RIG_FILE).is_file()]
    if not files:
        return
    read_campaign(folder)  # refuses rig files that differ
    shutil.move(files[0], folder / RIG_FILE)
    for file in files[1:]:
        file.unlink()


def _copy(part: Part, folder: Path) -> None:
    """A part of the merged folder: its records, and its description with name and band."""
    test = part.test
    try:
        folder.mkdir(parents=True)
        files = [record.file for record in test.records]
        rigs = {RIG_FILE, Path(test.rig or RIG_FILE).name}
        files += [name for name in sorted(rigs) if (test.folder / name).is_file()]
        for name in dict.fromkeys(files):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(test.folder / name, target)
        text = test.file.read_text(encoding="utf-8-sig")
        (folder / DESCRIPTION_FILE).write_text(_with_part(text, part), encoding="utf-8")
    except OSError as error:
        raise cannot_write(folder, error) from None


def _with_part(text: str, part: Part) -> str:
    """The description with the part's name and band in front of its other keys."""
    description = tomlkit.parse(text)
    for key in ("part", "band_hz"):
        description.pop(key, None)
    source = "stated" if part.test.band_hz is not None else "the band of its force spectrum"
    low, high = part.band_hz
    own = f'part = "{part.name}"\nband_hz = [{low:.6g}, {high:.6g}]  # {source}\n'
    return own + tomlkit.dumps(description)
