"""Opens runs: a new one of a description, that of a results folder; keeps the description in the store."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import platform
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from ema_pipeline import __version__, codec
from ema_pipeline.errors import EmaError
from ema_pipeline.files import file_hash
from ema_pipeline.names import check_name
from ema_pipeline.rigs.types import Rig
from ema_pipeline.run.settings import PipelineSettings
from ema_pipeline.run.types import Run, RunInfo
from ema_pipeline.store import ALL, Store


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
    return Run(store, info, stored_settings(store, info), frozenset(map(_absolute, effect_files)), rig)


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


def versions() -> dict[str, str]:
    """Versions of the program, of Python and of the libraries that compute."""
    libraries = ("numpy", "scipy", "h5py", "sdypy-EMA", "matplotlib", "pandas")
    found = {"ema-pipeline": __version__, "python": platform.python_version()}
    return found | {name: importlib.metadata.version(name) for name in libraries}


def save_info(store: Store, info: RunInfo) -> None:
    """Write the run's description into the store, unless it is there already.

    Results of configurations that are no longer part of the run are dropped.
    """
    if store.path.is_file() and load_info(store) == info:
        return
    with store.changing() as file:
        if "run" in file:
            del file["run"]
        for stage in file.get("stages", {}).values():
            for stale in set(stage) - {*info.configurations, ALL}:
                del stage[stale]
        codec.write(file, "run", info)


def load_info(store: Store) -> RunInfo | None:
    """The run's description, None where the store has none that this version can read."""
    with store.reading() as file:
        if "run" not in file:
            return None
        try:
            info: RunInfo = codec.read(file, "run", RunInfo)
        except codec.MissingError:  # written by a version that knew less; a new run writes it again
            return None
    for name in info.configurations:
        check_name(name, f"{store.path}: configuration")
    return info
