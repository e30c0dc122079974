"""What a stage of the pipeline is."""

from __future__ import annotations

import importlib
from typing import Protocol, cast

from ema_pipeline.run.types import Progress, Run
from ema_pipeline.store import ALL


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


def configurations_of(stage: Stage, run: Run) -> tuple[str, ...]:
    """Configurations that a stage is run for, or `ALL`."""
    return run.info.configurations if stage.PER_CONFIGURATION else (ALL,)


def stage_module(name: str) -> Stage:
    """The module of a stage."""
    return cast(Stage, importlib.import_module(f"ema_pipeline.stages.{name}"))
