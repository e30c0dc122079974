"""A run: its description, its settings, its store and its model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.effects.base import Effect
from ema_pipeline.effects.library import effect_library
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.files import file_hash
from ema_pipeline.rigs import Rig, load_rig, rig_kinds
from ema_pipeline.rigs.files import rig_from_text
from ema_pipeline.run.settings import PipelineSettings
from ema_pipeline.store import Store

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
    """One run: its store, its settings, and its rig.

    Attributes
    ----------
    store : Store
    info : RunInfo
    settings : PipelineSettings
        With the Python files of the user's own effects, as the results remember them.
    named_files : frozenset of str
        Those of these files that the user has named in this call: only their code may run, as the results folder
        may come from somebody else.
    built_rig : Rig or None
        A rig built in Python, which takes the place of that of `info`.
    """

    store: Store
    info: RunInfo
    settings: PipelineSettings
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
        for path in self.settings.effect_files:
            if path not in self.named_files:
                raise EmaError(
                    f"{self.store.folder}: was made with effects of the Python file '{path}', SHA-256 "
                    f"{self.info.effect_hashes.get(path, 'unknown')[:12]}; code runs only if you name it: "
                    f"look at it, then add --effect-file {path}"
                )
        return effect_library(self.settings.effect_files, self.rig)

    def check_effect_files(self) -> None:
        """Refuse a file named in this call that is not right, before anything is written."""
        if self.named_files:
            _ = self.library

    def effect_hashes(self) -> str:
        """Fingerprint of the files with the user's own effects."""
        return " ".join(
            file_hash(Path(path)) if path in self.named_files else self.info.effect_hashes.get(path, "")
            for path in self.settings.effect_files
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
            raise self.without_model(stage)
        return self.model

    def without_model(self, command: str) -> EmaError:
        """What is said where a command or a stage needs a model."""
        return EmaError(f"{self.store.folder}: '{command}' needs a model; run again with --rig")
