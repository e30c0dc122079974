"""Several set-ups of one state (two hammers, roving sensors) merged into one raw folder, each with its band."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import scipy.stats
import tomlkit

from ema_pipeline.correlate.matching import match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.files import cannot_write, read_bounded, refuse_existing
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.parts import Recorded, check_recorded_alike, gain_ratios
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.campaign import Campaign, read_campaign
from ema_pipeline.ingest.description import DESCRIPTION_FILE, RIG_FILE, TestDescription
from ema_pipeline.ingest.load import load_records
from ema_pipeline.job import run_raw
from ema_pipeline.names import check_name
from ema_pipeline.number_text import format_percent
from ema_pipeline.pipeline import ShowStage
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.run.measured import measured_frfs, measured_modes
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.records import accepted_hits
from ema_pipeline.run.types import Run
from ema_pipeline.significance import holm
from ema_pipeline.toml_text import LARGEST_BYTES

TOLERANCE = 1e-3
"""Relative 1 σ by which frequencies of one state differ between set-ups: temperature, and sensors that moved."""

LEVEL = 0.01
"""Chance to call any two parts of one state different."""

_MEASURING = 'stages=["ingest", "hits", "frf", "modal"]'
_JOINING = 'stages=["ingest", "hits", "frf"]'


@dataclass(frozen=True)
class _Described:
    """One set-up as it is described, and its run where its results folder was given."""

    name: str
    raw: Path
    test: TestDescription
    rig_file: Path | None
    run: Run | None

    @property
    def points(self) -> set[str]:
        """What is struck and what is measured."""
        pairs = [(r.impact, [self.test.dof_of(c, r) for c in self.test.responses]) for r in self.test.records]
        return _points([d for d, _ in pairs if d], [d for _, dofs in pairs for d in dofs if d])

    @property
    def recorded(self) -> Recorded:
        """What must be alike in all parts."""
        test = self.test
        dofs = [(test.dof_of(c, r), c.quantity) for r in test.records for c in test.responses]
        quantities = {dof.point: quantity for dof, quantity in dofs if dof}
        return Recorded(not test.force.uncalibrated, test.exponential_window_rad_s, quantities)


@dataclass(frozen=True)
class Part:
    """One set-up.

    Attributes
    ----------
    name : str
    raw : Path
    test : TestDescription
    rig_file : Path or None
    frfs : FrfSet
    modes : MeasuredModes
    """

    name: str
    raw: Path
    test: TestDescription
    rig_file: Path | None
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
        hammers or sensors that contradict each other. Nothing is written then. What the descriptions tell is checked
        before modes are identified.
    """
    refuse_existing([out], "choose a new folder with --out, or remove it")
    described = _described(sources)
    with tempfile.TemporaryDirectory(prefix="ema-merge-") as scratch:
        parts = [_identified(d, Path(scratch) / d.name, show) for d in described]
        # hits that were left out may have been all on the point in common
        _check_connected({p.raw: _points(p.frfs.inputs, p.frfs.outputs) for p in parts})
        modes = common_modes({p.name: p.modes for p in parts}, tolerance)
        _check_one_state(modes)
        folder = Path(scratch) / "merged"
        for part in parts:
            _copy(part, folder / part.name)
        _move_rig(parts, folder)
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


def _described(sources: Sequence[Path]) -> list[_Described]:
    """The set-ups to merge, refused where their descriptions tell that they are not of one test."""
    if len(sources) < 2:
        raise EmaError("one test is nothing to merge; give two or more folders")
    found: list[_Described] = []
    for source in sources:
        run: Run | None = existing_run(source) if (source / RESULTS_FILE).is_file() else None
        raw = source if run is None else Path(run.info.raw)
        name = check_name(raw.resolve().name, f"{raw}: name of the folder")
        campaign = _of_one_test(raw)
        found.append(_Described(name, raw, campaign.tests[0], campaign.rig_file, run))
    first = found[0].test
    for k, part in enumerate(found):
        if any(other.raw.resolve() == part.raw.resolve() for other in found[:k]):
            raise EmaError(f"{part.raw}: is given twice; give each test once")
        if any(other.name == part.name for other in found[:k]):
            raise EmaError(
                f"{part.raw}: another of the folders is called '{part.name}', too; rename one, parts go by that name"
            )
        if (part.test.configuration or "") != (first.configuration or ""):
            raise EmaError(
                f"{part.test.file}: is of configuration '{part.test.configuration or ''}', {first.file} of "
                f"'{first.configuration or ''}'; only tests of one configuration can be merged"
            )
    _check_one_rig([part.test for part in found], [p.rig_file for p in found if p.rig_file is not None])
    _check_connected({part.raw: part.points for part in found})
    check_recorded_alike({part.name: part.recorded for part in found})
    # sample rates may stand in the record files only
    for _ in load_records(
        *(p.test.model_copy(update={"part": p.name, "records": p.test.records[:1]}) for p in found)
    ):
        pass
    return found


def _identified(part: _Described, out: Path, show: ShowStage | None) -> Part:
    run = part.run
    if run is None or not all(run.store.key("modal", c) for c in run.info.configurations):
        run, _ = run_raw(part.raw, None, out, None, [_MEASURING], show)
    ((_, frfs),) = measured_frfs(run).items()
    ((_, modes),) = measured_modes(run).items()
    return Part(part.name, part.raw, part.test, part.rig_file, frfs, modes)


def _of_one_test(raw: Path) -> Campaign:
    campaign = read_campaign(raw)
    tests = campaign.tests
    if len(tests) > 1:
        what = "is merged already" if tests[0].part else "is a campaign of several configurations"
        raise EmaError(f"{raw}: {what}; give the folders of single tests")
    if tests[0].kind != "hammer":
        raise EmaError(f"{tests[0].file}: is of kind '{tests[0].kind}'; only hammer tests can be merged")
    return campaign


def _points(struck: Iterable[Dof], measured: Iterable[Dof]) -> set[str]:
    return {f"strike {d.point}" for d in struck} | {f"measure {d.point}" for d in measured}


def _check_connected(points: Mapping[Path, set[str]]) -> None:
    """Every part must share a point that is struck, or a sensor, with those before: else no shape goes through all."""
    known: set[str] = set()
    for raw, own in points.items():
        if known and not known & own:
            raise EmaError(
                f"{raw}: strikes no point and measures no direction that the other parts do; strike one of "
                "theirs, or leave one sensor where it was"
            )
        known |= own


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


def _check_one_rig(tests: Sequence[TestDescription], files: Sequence[Path]) -> None:
    """One rig for all parts, by its name and by the rig files."""
    named = [t for t in tests if t.rig is not None]
    for test in named[1:]:
        if test.rig != named[0].rig:
            raise EmaError(
                f"{test.file}: names rig '{test.rig}', {named[0].file} names '{named[0].rig}'; one test has one rig"
            )
    for file in files[1:]:
        if read_bounded(file, LARGEST_BYTES) != read_bounded(files[0], LARGEST_BYTES):
            raise EmaError(
                f"{files[0]} and {file} differ; one test has one rig, copy the right one over the other"
            )


def _move_rig(parts: Sequence[Part], folder: Path) -> None:
    """One rig file for all parts stands beside them."""
    files = [folder / p.name / RIG_FILE for p in parts if (folder / p.name / RIG_FILE).is_file()]
    for file in files:
        file.replace(folder / RIG_FILE)


def _copy(part: Part, folder: Path) -> None:
    """A part of the merged folder: its records, and its description with name and band."""
    test = part.test
    try:
        folder.mkdir(parents=True)
        files = [record.file for record in test.records]
        if test.rig is not None and (test.folder / Path(test.rig).name).is_file():
            files.append(Path(test.rig).name)
        for name in dict.fromkeys(files):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(test.folder / name, target)
        if part.rig_file is not None:
            shutil.copy2(part.rig_file, folder / RIG_FILE)
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
