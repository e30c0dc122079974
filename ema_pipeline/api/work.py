"""Where the results of one test are kept while Python works on them: a results file in a temporary folder.

A result handed to the user never changes: a call computes what it adds in stages, as a run does, and whatever could
change a result that exists already is done on a copy.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from ema_pipeline.api import arguments
from ema_pipeline.api.arguments import expect, plain, texts
from ema_pipeline.describe import checked_rig, rig_text
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.files import link_or_copy
from ema_pipeline.kinds import kind_of
from ema_pipeline.pipeline import run_stages
from ema_pipeline.results_folder import PARTS_FOLDER
from ema_pipeline.run.opening import new_run, stored_settings, with_effect_files
from ema_pipeline.run.settings import override
from ema_pipeline.run.types import Run, RunInfo
from ema_pipeline.store import Store
from ema_pipeline.threads import single_blas_thread

if TYPE_CHECKING:
    from ema_pipeline.rigs.types import Rig

Settings = Mapping[str, object]
"""Settings of a pipeline by their dotted name, e.g. ``{"modal.identify.engine": "lscf"}``."""


def overrides(settings: Settings | None) -> list[str]:
    """The settings as the command line takes them."""
    if settings is None:
        return []
    wanted = "settings by their dotted name, e.g. {'frf.estimator': 'H2'}"
    expect("settings", settings, Mapping, wanted)
    texts("settings", settings, wanted)
    try:
        return [f"{name}={json.dumps(plain(value))}" for name, value in settings.items()]
    except TypeError as error:
        raise EmaError(f"settings: a value is no number, text or list of these ({error})") from None


MADE_FRFS = dict.fromkeys(("hits", "frf"), "Test.frfs(settings=…)")
"""Sections that FRFs have been made with, and the call that takes their settings."""

MADE_MODES = dict.fromkeys(("modal", "levels"), "ema.identify(…, settings=…)")
"""The same of modes."""


@dataclass(frozen=True)
class Work:
    """A results file in a temporary folder, which is removed with the last result that needs it.

    Attributes
    ----------
    store : Store
    info : RunInfo
    rig : Rig or None
        A rig built in Python, which takes the place of that of `info`.
    effect_files : tuple of str
        Python files with effects that the user has named.
    models : dict
        What was made of these measurements with one rig, by `with_rig`.
    """

    store: Store
    info: RunInfo
    rig: Rig | None = None
    effect_files: tuple[str, ...] = ()
    models: dict[tuple[object, ...], Work] = field(default_factory=dict, compare=False)
    _folder: tempfile.TemporaryDirectory[str] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def new(cls, info: RunInfo) -> Work:
        """An empty results file."""
        folder = tempfile.TemporaryDirectory(prefix="ema_", ignore_cleanup_errors=True)
        return cls(Store(Path(folder.name)), info, _folder=folder)

    @classmethod
    def copy_of(cls, store: Store, info: RunInfo, effect_files: tuple[str, ...] = ()) -> Work:
        """A copy of a results folder's file."""
        made = cls.new(info)
        shutil.copyfile(store.path, made.store.path)
        (made.store.folder / PARTS_FOLDER).mkdir()
        for part in store.parts():
            link_or_copy(part, made.store.folder / PARTS_FOLDER / part.name)
        return dataclasses.replace(made, effect_files=effect_files)

    def run(self, *stages: str) -> Run:
        """Run the stages that are not up to date."""
        import scipy.linalg  # noqa: F401  # its BLAS must be there to be held to one thread, as the commands do

        run = self.look()
        with self.store.lock(), single_blas_thread():
            run_stages(run, stages)
        return run

    def look(self) -> Run:
        """The run as it stands."""
        return new_run(self.store, self.info, self.effect_files, self.rig)

    def with_settings(
        self, settings: Settings | None, made: Mapping[str, str] = MappingProxyType({})
    ) -> Work:
        """The same results with other settings for what is computed from here on.

        Parameters
        ----------
        settings : mapping, optional
        made : mapping of str to str, optional
            Sections of what is there already, and the call that takes their settings.

        Raises
        ------
        EmaError
            Where a setting is of what is there already: it would change nothing.
        """
        changes = overrides(settings)
        if not changes:
            return self
        stored = stored_settings(self.store, self.info)
        changed = override(stored, changes, "settings")
        for section, call in made.items():
            if getattr(changed, section) != getattr(stored, section):
                name = next(n for n in settings or () if n.partition(".")[0] == section)
                raise EmaError(f"settings: '{name}' cannot change what is there already; give it to {call}")
        info = dataclasses.replace(self.info, pipeline=changed.model_dump_json())
        return dataclasses.replace(Work.copy_of(self.store, info, self.effect_files), rig=self.rig)

    def without_rig(self) -> Work:
        """The measurements alone."""
        info = dataclasses.replace(self.info, rig="", rig_source="", effects=())
        return dataclasses.replace(self, info=info, rig=None)

    def only(self, configuration: str) -> Work:
        """One configuration of these results.

        Raises
        ------
        EmaError
            If there is no such configuration.
        """
        names = self.info.configurations
        expect("configuration", configuration, str, f"the name of a configuration, e.g. '{names[0]}'")
        if configuration not in names:
            raise EmaError(f"no configuration '{configuration}'{did_you_mean(configuration, names)}")
        info = dataclasses.replace(self.info, configurations=(configuration,))
        return dataclasses.replace(self, info=info, models={})

    def with_rig(
        self, rig: Rig | str | Path, settings: Settings | None, effect_files: Iterable[str | Path]
    ) -> Work:
        """What was measured, in a file of its own beside a rig; the same for the same rig, settings and effects.

        Raises
        ------
        EmaError
            If the rig does not have the configurations or the DOFs that were measured.
        """
        files = tuple(str(Path(file).resolve()) for file in arguments.effect_files(effect_files))
        if not hasattr(rig, "assembly"):
            expect("rig", rig, (str, Path), "a rig, the name of one or a rig file")
        named = isinstance(rig, str | Path)
        key = (str(rig) if named else id(rig), tuple(overrides(settings)), files)
        if key not in self.models:
            self.models[key] = self._with_rig(rig, settings, files)
        return self.models[key]

    def _with_rig(self, rig: Rig | str | Path, settings: Settings | None, files: tuple[str, ...]) -> Work:
        named = isinstance(rig, str | Path)
        model = checked_rig(str(rig)) if isinstance(rig, str | Path) else rig
        names = _names_in(model, self.info.configurations)
        info = dataclasses.replace(
            self.info,
            rig=rig_text(str(rig)) if named else f"{model.name}, built in Python",
            rig_source=str(rig) if named else model.name,
            configurations=names,
            effects=(),
        )
        made = Work.new(info)
        measures = kind_of(info).measures
        made.store.copy_from(self.store, measures, dict(zip(self.info.configurations, names, strict=True)))
        made = dataclasses.replace(made, rig=None if named else model, effect_files=files)
        info = with_effect_files(made.store, made.info, files)
        return dataclasses.replace(made, info=info).with_settings(settings, {**MADE_FRFS, **MADE_MODES})

    def with_effects(self, effects: Sequence[str]) -> Work:
        """The same results with other effects in the model from here on."""
        return dataclasses.replace(self, info=dataclasses.replace(self.info, effects=tuple(effects)))


def _names_in(rig: Rig, measured: Sequence[str]) -> tuple[str, ...]:
    """The rig's names of the configurations measured; a lone unnamed one is that of a rig with one configuration."""
    if len(measured) == 1 and len(rig.configurations) == 1 and measured[0] == "default":
        return rig.configurations
    for name in measured:
        if name not in rig.configurations:
            raise EmaError(
                f"rig '{rig.name}' has no configuration '{name}'{did_you_mean(name, rig.configurations)}; "
                "name the configuration in test.toml"
            )
    return tuple(measured)
