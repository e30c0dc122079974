"""Runs the stages of a pipeline over one store; what is unchanged is skipped."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import Field, ValidationError

from ema_pipeline.correlate.settings import CompareSettings, PairingSettings
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.limits import ReadLimits
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.names import check_name
from ema_pipeline.processes import Send, can_fork, one_store_of_memory, release_memory, side_by_side
from ema_pipeline.report.settings import ReportSettings
from ema_pipeline.rigs.types import Rig
from ema_pipeline.settings import Settings, parse, setting_names
from ema_pipeline.stages.base import (
    Progress,
    Run,
    RunInfo,
    Stage,
    code_fingerprint,
    configurations_of,
    file_hash,
    lacks_model,
    load_info,
    silent,
    versions,
)
from ema_pipeline.store import ALL, Store
from ema_pipeline.threads import cores, share_cores
from ema_pipeline.toml_text import parse_toml, read_toml

STAGES = (
    "ingest", "hits", "frf", "modal", "levels", "loops", "ladder", "diagnose", "fit", "correlate", "report",
)  # fmt: skip
"""All stages, in the order in which the data flow."""

STAGES_OF_KIND = {
    "hammer": frozenset(STAGES) - {"loops"},
    "modes": frozenset(STAGES) - {"ingest", "hits", "frf", "levels", "loops"},
    "hysteresis": frozenset({"loops", "ladder", "diagnose", "report"}),
    "continuous": frozenset(STAGES) - {"hits", "levels", "loops"},
}
"""Stages that have something to do, by kind of test."""


class IngestSettings(ReadLimits):
    """Reading raw folders: all but the limits is said in test.toml."""


class CorrelateSettings(Settings):
    """Pairing and comparison."""

    pairing: PairingSettings = Field(PairingSettings(), description="when two modes may be the same")
    compare: CompareSettings = Field(CompareSettings(), description="how differences are counted")


class ModalStageSettings(Settings):
    """Identification, and the circle fits beside it."""

    method: Literal["lscf", "circle"] = Field(
        "lscf",
        description="'lscf': poles of all FRFs at once, circle fits as a check; 'circle': circle fits alone",
    )
    identify: ModalSettings = Field(ModalSettings(), description="poles, selection, shapes")
    circle: CircleSettings = Field(CircleSettings(), description="Nyquist circles")


class LadderSettings(Settings):
    """The ladder is measured with the settings of the diagnosis."""


class PipelineSettings(Settings):
    """All settings of a pipeline; ``pipelines/*.toml`` are files of this kind."""

    rig: str | None = Field(None, description="rig that this pipeline is made for")
    stages: tuple[str, ...] = Field(STAGES, description="stages to run, in order")
    effect_files: tuple[str, ...] = Field((), description="Python files with effects of the user's own")
    processes: int | None = Field(
        None, ge=1, le=64, description="configurations worked on at a time; left out: one per processor"
    )
    ingest: IngestSettings = Field(IngestSettings(), description="reading raw folders")
    hits: HitSettings = Field(HitSettings(), description="hit finding and quality limits")
    frf: FrfSettings = Field(FrfSettings(), description="windows and estimator")
    modal: ModalStageSettings = Field(ModalStageSettings(), description="modal identification")
    levels: LevelSettings = Field(LevelSettings(), description="what moves with the force of the hits")
    fit: FitSettings = Field(FitSettings(), description="fitting the model's parameters")
    correlate: CorrelateSettings = Field(CorrelateSettings(), description="pairing and comparison")
    diagnose: DiagnoseSettings = Field(DiagnoseSettings(), description="search for missing physics")
    loops: LoopSettings = Field(LoopSettings(), description="force-displacement loops")
    ladder: LadderSettings = Field(LadderSettings(), description="the ladder of added effects")
    report: ReportSettings = Field(ReportSettings(), description="tables, plots and the report")

    def of(self, stage: str) -> Settings:
        """Settings of one stage."""
        return cast(Settings, getattr(self, stage))


def shipped_pipelines() -> dict[str, Path]:
    """Pipelines that come with the program, by name."""
    package = Path(__file__).resolve().parent
    for folder in (package / "pipelines", package.parent / "pipelines"):
        if folder.is_dir():
            return {p.stem: p for p in sorted(folder.glob("*.toml"))}
    return {}


def load_pipeline(name_or_path: str, overrides: Iterable[str] = ()) -> PipelineSettings:
    """Read a pipeline and apply overrides such as ``"modal.identify.engine=lscf"``.

    Parameters
    ----------
    name_or_path : str
        Name of a shipped pipeline, or path of a TOML file.
    overrides : iterable of str
        ``stage.key=value`` with a TOML value; a value that is no TOML is taken as text.

    Raises
    ------
    EmaError
        For an unknown pipeline, broken TOML, unknown keys and values of the wrong type.
    """
    shipped = shipped_pipelines()
    path = shipped.get(name_or_path, Path(name_or_path))
    if not os.path.exists(path):
        raise EmaError(
            f"no pipeline '{name_or_path}'{did_you_mean(name_or_path, shipped)}; or give a TOML file"
        )
    return _settings(read_toml(path), overrides, str(path))


def override(settings: PipelineSettings, overrides: Iterable[str], where: str | Path) -> PipelineSettings:
    """The settings with ``stage.key=value`` changed; `where` is named in error messages."""
    return _settings(settings.model_dump(mode="json"), overrides, str(where))


def _settings(data: dict[str, Any], overrides: Iterable[str], where: str) -> PipelineSettings:
    for change in overrides:
        key, sign, value = change.partition("=")
        if not sign or not key.strip():
            raise EmaError(f"--set {change}: is not of the form stage.key=value")
        *parents, last = key.strip().split(".")
        known = setting_names(PipelineSettings)
        if key.strip() not in known and (alike := [k for k in known if k.split(".")[-1] == last]):
            raise EmaError(
                f"--set {change}: there is no setting '{key.strip()}' (did you mean {' or '.join(alike)}?)"
            )
        table = data
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise EmaError(f"--set {change}: '{parent}' is no table of settings")
        table[last] = toml_value(value.strip())
        where = f"{where} with --set {change}"
    settings = parse(PipelineSettings, data, where)
    for stage in settings.stages:
        if stage not in STAGES:
            raise EmaError(f"{where}: unknown stage '{stage}'{did_you_mean(stage, STAGES)}")
    return settings


def toml_value(text: str) -> Any:
    """A value as TOML would read it; text that is no TOML is taken as it stands."""
    try:
        return parse_toml(f"value = {text}", text)["value"]
    except EmaError:
        return text


def new_run(store: Store, info: RunInfo, effect_files: Iterable[str] = (), rig: Rig | None = None) -> Run:
    """A run with the settings that its description holds.

    Parameters
    ----------
    store : Store
    info : RunInfo
    effect_files : iterable of str
        Files with the user's own effects that are named in this call: only their code may run.
    rig : Rig, optional
        Built in Python, in place of that of `info`.
    """
    settings = stored_settings(store, info)
    stages = {name: settings.of(name) for name in STAGES}
    return Run(store, info, stages, settings.effect_files, frozenset(map(_absolute, effect_files)), rig)


def with_effect_files(store: Store, info: RunInfo, effect_files: Iterable[str]) -> RunInfo:
    """The description with the named files of the user's own effects, and their hashes, added.

    A file that is known already but has moved replaces what stood under its name.
    """
    named = [_absolute(file) for file in effect_files]
    if not named:
        return info
    settings = stored_settings(store, info)
    names = {Path(file).name for file in named}
    known = [file for file in settings.effect_files if Path(file).name not in names]
    files = tuple(dict.fromkeys((*known, *named)))
    hashes = info.effect_hashes | {file: file_hash(Path(file)) for file in named}
    return dataclasses.replace(
        info,
        pipeline=settings.model_copy(update={"effect_files": files}).model_dump_json(),
        effect_hashes={file: hashes[file] for file in files if file in hashes},
    )


def _absolute(file: str) -> str:
    return str(Path(file).resolve())


def stored_settings(store: Store, info: RunInfo) -> PipelineSettings:
    """The settings that a run's description holds.

    Raises
    ------
    EmaError
        If this version of the program cannot read them.
    """
    try:
        return PipelineSettings.model_validate_json(info.pipeline)
    except ValidationError:
        raise EmaError(
            f"{store.path}: holds settings that this version of ema does not know; delete it and run again"
        ) from None


def existing_run(folder: Path, effect_files: Iterable[str] = ()) -> Run:
    """The run that a results folder belongs to.

    Parameters
    ----------
    folder : Path
    effect_files : iterable of str
        As in `new_run`.

    Raises
    ------
    EmaError
        If the folder holds no results, or results that cannot be read.
    """
    store = Store.existing(folder)
    info = load_info(store)
    if info is None:
        raise EmaError(f"{store.path}: holds no run; make one with 'ema run RAW --out {folder}'")
    effect_files = tuple(effect_files)
    return new_run(store, with_effect_files(store, info, effect_files), effect_files)


def describe_run(
    kind: str,
    raw: Path,
    title: str,
    rig: str,
    rig_source: str,
    configurations: tuple[str, ...],
    effects: tuple[str, ...],
    settings: PipelineSettings,
) -> RunInfo:
    """Description of a run, for the store.

    Raises
    ------
    EmaError
        If a configuration has a name that no file can have.
    """
    for name in configurations:
        check_name(name, f"{raw}: configuration")
    return RunInfo(
        kind=kind,
        raw=str(raw),
        title=title,
        rig=rig,
        rig_source=rig_source,
        configurations=configurations,
        effects=effects,
        pipeline=settings.model_dump_json(),
        versions=versions(),
    )


def stage_module(name: str) -> Stage:
    """The module of a stage."""
    return cast(Stage, importlib.import_module(f"ema_pipeline.stages.{name}"))


class Keys:
    """Keys of all stages of a run: equal keys mean equal inputs, settings and program.

    Stages that are not to be run are taken as they are in the store.
    """

    def __init__(self, run: Run, names: Iterable[str]) -> None:
        self._run = run
        self._names = frozenset(names)
        self._known: dict[tuple[str, str], str] = {}

    def __call__(self, name: str, configuration: str) -> str:
        """Key that the result of a stage should have."""
        if (name, configuration) not in self._known:
            make = self._compute if name in self._names else self._stored
            self._known[name, configuration] = make(name, configuration)
        return self._known[name, configuration]

    def _stored(self, name: str, configuration: str) -> str:
        key = self._run.store.key(name, configuration)
        if not key:
            where = "" if configuration == ALL else f" for configuration '{configuration}'"
            raise EmaError(
                f"{self._run.store.path}: holds no result of stage '{name}'{where}; "
                f"run 'ema {name} {self._run.store.folder}' first"
            )
        return key

    @cached_property
    def _in_store(self) -> frozenset[str]:
        """Stages that the store held at first: no stage but those to be run can join them."""
        return frozenset(name for name, _ in self._run.store.provenance())

    def _compute(self, name: str, configuration: str) -> str:
        stage, run = stage_module(name), self._run
        present = [o for o in getattr(stage, "USES", ()) if o in self._names or o in self._in_store]
        needed = [
            self(other, c)
            for other in (*stage.NEEDS, *present)
            if other in STAGES_OF_KIND[run.info.kind]
            if not lacks_model(run) or not stage_module(other).NEEDS_RIG
            for c in (
                (configuration,) if configuration != ALL else configurations_of(stage_module(other), run)
            )
        ]
        parts = {
            "stage": name,
            "code": code_fingerprint(),
            "settings": run.settings[name].model_dump_json(),
            "rig": [run.info.rig, run.info.effects] if stage.NEEDS_RIG else "",
            "inputs": stage.inputs(run, configuration),
            "needed": needed,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


ShowStage = Callable[[str], AbstractContextManager[Progress]]
"""Opens the display of one stage's progress and hands out the function to report it with."""


def run_stages(run: Run, names: Iterable[str], show: ShowStage | None = None) -> list[str]:
    """Run the stages that are out of date, in order.

    Returns
    -------
    list of str
        What was computed, as ``stage`` or ``stage (configuration)``; empty where all was up to date.

    Raises
    ------
    EmaError
        With the name of the stage that failed.
    """
    computed: list[str] = []
    names = tuple(names)
    keys = Keys(run, names)
    there = [stage_module(n) for n in names if n in STAGES_OF_KIND[run.info.kind]]
    stages = [stage for stage in there if not (stage.NEEDS_RIG and lacks_model(run))]
    for each, group in groupby(stages, key=lambda stage: stage.PER_CONFIGURATION):
        chain = list(group)
        apart = each and can_fork() and stored_settings(run.store, run.info).processes != 1
        computed += _side_by_side(chain, run, keys, show) if apart else _in_turn(chain, run, keys, show)
    return computed


def _in_turn(stages: list[Stage], run: Run, keys: Keys, show: ShowStage | None) -> list[str]:
    """Run the stages that are out of date one after the other."""
    computed = []
    for stage in stages:
        for configuration in configurations_of(stage, run):
            key = keys(stage.NAME, configuration)
            if not _up_to_date(stage, run, configuration, key):
                label = _label(stage, configuration)
                _run_one(stage, run, configuration, key, label, show)
                computed.append(label)
    return computed


def _side_by_side(stages: list[Stage], run: Run, keys: Keys, show: ShowStage | None) -> list[str]:
    """Run the stages that are out of date, each configuration in a process of its own.

    No configuration asks for results of another, so that all are the same as one after the other. One alone has its own
    process, too: what its stages needed does not burden those that follow.
    """
    wanted = [(stage, c, keys(stage.NAME, c)) for stage in stages for c in run.info.configurations]
    todo = [(stage, c, key) for stage, c, key in wanted if not _up_to_date(stage, run, c, key)]
    names = list(dict.fromkeys(c for _, c, _ in todo))
    processes = min(stored_settings(run.store, run.info).processes or cores(), len(names))

    def job(configuration: str, send: Send) -> None:
        share_cores(processes)
        one_store_of_memory()

        @contextmanager
        def tell(label: str) -> Iterator[Progress]:
            send((label, "begins"))
            yield lambda share, text: send((label, (share, text)))
            send((label, "ends"))

        for stage, c, key in todo:
            if c == configuration:
                _run_one(stage, run, c, key, _label(stage, c), tell if show else None)

    with ExitStack() as open_shows:
        shown: dict[str, tuple[ExitStack, Progress]] = {}

        def hear(message: tuple[str, object]) -> None:
            assert show is not None
            label, what = message
            if what == "begins":
                block = open_shows.enter_context(ExitStack())
                shown[label] = block, block.enter_context(show(label))
            elif what == "ends":
                shown[label][0].close()
            else:
                shown[label][1](*cast("tuple[float, str]", what))

        with run.store.shared():  # nothing is started where nothing is out of date
            side_by_side(job, names, processes, hear)
    return [_label(stage, c) for stage, c, _ in todo]


def _label(stage: Stage, configuration: str) -> str:
    return stage.NAME if configuration == ALL else f"{stage.NAME} ({configuration})"


def _up_to_date(stage: Stage, run: Run, configuration: str, key: str) -> bool:
    return run.store.key(stage.NAME, configuration) == key and _outputs_present(stage, run)


def _run_one(
    stage: Stage, run: Run, configuration: str, key: str, label: str, show: ShowStage | None
) -> None:
    start = time.perf_counter()
    settings = run.settings[stage.NAME].model_dump_json()

    def work(progress: Progress) -> None:
        results = stage.work(run, configuration, progress)
        run.store.save(stage.NAME, configuration, key, settings, time.perf_counter() - start, **results)

    if show is None:
        work(silent)
    else:
        with show(label) as progress:
            work(progress)
            progress(1.0, "")
    release_memory()


def _outputs_present(stage: Stage, run: Run) -> bool:
    """True unless files that a stage writes beside the store are gone."""
    outputs = getattr(stage, "OUTPUTS", ())
    return all((run.store.folder / name).exists() for name in outputs)
