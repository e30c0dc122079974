"""What a stage of the pipeline is, and the run that it works on."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Protocol

from ema_pipeline import __version__, codec
from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.effects.base import Effect
from ema_pipeline.effects.library import effect_library
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.names import check_name
from ema_pipeline.rigs import Rig, load_rig, rig_kinds
from ema_pipeline.rigs.files import rig_from_text
from ema_pipeline.settings import Settings
from ema_pipeline.store import ALL, Store

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0…1, and a few words on what is going on."""


def silent(done: float, text: str = "") -> None:
    """Show no progress."""


@dataclass(frozen=True)
class RunInfo:
    """What a results folder has to know of its run, kept in the store.

    Attributes
    ----------
    kind : str
        ``"hammer"``, ``"modes"`` (a table of modes in place of raw data), ``"hysteresis"`` or ``"continuous"``.
    raw : str
        Folder that the records came from, or the file with the table of modes.
    title : str
    rig : str
        Name of a shipped rig, or the whole text of the user's rig file; empty without a rig.
    rig_source : str
        Name or path under which the rig was given; empty without a rig.
    configurations : tuple of str
    effects : tuple of str
        Effects that the user added to the model, ``id@place``, in the order in which they were added.
    pipeline : str
        Settings of the pipeline, JSON.
    versions : dict of str to str
        Versions of the program, Python and the libraries that compute.
    effect_hashes : dict of str to str
        SHA-256 of the files with the user's own effects, by path, as they were when they last ran.
    choices : Choices
        Hits and modes that the user excluded or included.
    """

    kind: str
    raw: str
    title: str
    rig: str
    rig_source: str
    configurations: tuple[str, ...]
    effects: tuple[str, ...]
    pipeline: str
    versions: dict[str, str]
    effect_hashes: dict[str, str] = field(default_factory=dict)
    choices: Choices = NO_CHOICES


@dataclass(frozen=True)
class Run:
    """One run: its store, its settings by stage, and its rig.

    Attributes
    ----------
    store : Store
    info : RunInfo
    settings : mapping of str to Settings
        The settings of each stage.
    effect_files : tuple of str
        Python files with the user's own effects, as the results remember them.
    named_files : frozenset of str
        Those of them that the user has named in this call: only their code may run, as the results folder may
        come from somebody else.
    built_rig : Rig or None
        A rig built in Python, which takes the place of that of `info`.
    """

    store: Store
    info: RunInfo
    settings: Mapping[str, Settings]
    effect_files: tuple[str, ...] = ()
    named_files: frozenset[str] = frozenset()
    built_rig: Rig | None = None

    @cached_property
    def library(self) -> dict[str, Effect]:
        """The effects that ship with the program and those of the user's files.

        Raises
        ------
        EmaError
            If the results remember a file that the user has not named in this call.
        """
        for path in self.effect_files:
            if path not in self.named_files:
                raise EmaError(
                    f"{self.store.folder}: was made with effects of the Python file '{path}', SHA-256 "
                    f"{self.info.effect_hashes.get(path, 'unknown')[:12]}; code runs only if you name it: "
                    f"look at it, then add --effect-file {path}"
                )
        return effect_library(self.effect_files, self.rig)

    def effect_hashes(self) -> str:
        """Fingerprint of the files with the user's own effects."""
        return " ".join(
            file_hash(Path(path)) if path in self.named_files else self.info.effect_hashes.get(path, "")
            for path in self.effect_files
        )

    @cached_property
    def memory(self) -> dict[tuple[str, str], Any]:
        """Small results that several stages ask for, by name and key of what they were made of."""
        return {}

    @cached_property
    def model(self) -> Rig | None:
        """The rig with the effects that the user added."""
        if self.rig is None or not self.info.effects:
            return self.rig
        return rig_with_effects(self.rig, self.info.effects, self.library)

    @cached_property
    def rig(self) -> Rig | None:
        """The rig without added effects, None for a modal analysis without a model."""
        if self.built_rig is not None:
            return self.built_rig
        if not self.info.rig:
            return None
        if "\n" in self.info.rig:
            return rig_from_text(self.info.rig, Path(self.info.rig_source), rig_kinds())
        return load_rig(self.info.rig)

    def require_model(self, stage: str) -> Rig:
        """The rig with the effects that the user added.

        Raises
        ------
        EmaError
            If the run has none.
        """
        if self.model is None:
            raise EmaError(f"{self.store.folder}: '{stage}' needs a model; run again with --rig")
        return self.model


class Stage(Protocol):
    """One step of the pipeline; a module of this package is a stage.

    Attributes
    ----------
    NAME : str
    NEEDS : tuple of str
        Stages whose results it reads. A module may also have ``USES``: stages whose results it reads where a
        pipeline has them.
    PER_CONFIGURATION : bool
        True where it works on one configuration at a time.
    NEEDS_RIG : bool
        True where there is nothing to do without a model.
    """

    NAME: str
    NEEDS: tuple[str, ...]
    PER_CONFIGURATION: bool
    NEEDS_RIG: bool

    def inputs(self, run: Run, configuration: str) -> str:
        """Fingerprint of inputs other than settings and the needed stages' results, e.g. of raw files."""
        ...

    def work(self, run: Run, configuration: str, progress: Progress) -> dict[str, object]:
        """Do the work; the results go into the store under their names."""
        ...


def lacks_model(run: Run) -> bool:
    """True where there is no model to compare with; that of a continuous test without a rig are its own modes."""
    return run.rig is None and run.info.kind != "continuous"


def configurations_of(stage: Stage, run: Run) -> tuple[str, ...]:
    """Configurations that a stage is run for, or `ALL`."""
    return run.info.configurations if stage.PER_CONFIGURATION else (ALL,)


def file_hash(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    EmaError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({error.strerror})") from None


@cache
def code_fingerprint() -> str:
    """Hash of the package's source and its pages' templates, so that a changed program does not trust old results."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.suffix in (".py", ".j2", ".js"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


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
