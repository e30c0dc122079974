"""Kinds of tests, one module each, and how their models are judged: all that tells one kind from another."""

from __future__ import annotations

from ema_pipeline.errors import EmaError
from ema_pipeline.kinds import continuous, hammer, loops, mode_table
from ema_pipeline.kinds.base import Judge, Kind
from ema_pipeline.run.types import Run, RunInfo

__all__ = ["KINDS", "Judge", "Kind", "kind_of", "require_judge", "require_stage", "stages_of"]

KINDS = {kind.name: kind for kind in (hammer.KIND, mode_table.KIND, loops.KIND, continuous.KIND)}
"""Every kind of test by its name."""


def kind_of(info: RunInfo) -> Kind:
    """The kind of test that a run is of.

    Raises
    ------
    EmaError
        For a kind that this version does not know.
    """
    if info.kind not in KINDS:
        raise EmaError(f"{info.raw}: is of kind '{info.kind}', which this version of ema does not know")
    return KINDS[info.kind]


def stages_of(run: Run) -> frozenset[str]:
    """Stages of a run: those that measure, those that judge the model where there is one, and the report."""
    kind = kind_of(run.info)
    judge = kind.judge(run)
    return frozenset((*kind.measures, "report")) | (judge.stages if judge is not None else frozenset())


def require_stage(run: Run, stage: str) -> None:
    """Make sure that a stage works on what a run holds.

    Raises
    ------
    EmaError
        Without a model where the stage needs one, and for a stage of tests of another kind.
    """
    there, kind = stages_of(run), kind_of(run.info)
    if stage in there:
        return
    if kind.judge(run) is None and not any(stage in k.measures for k in KINDS.values()):
        raise run.without_model(stage)
    raise EmaError(
        f"{run.store.folder}: {kind.words} have no stage '{stage}'; theirs are {', '.join(sorted(there))}"
    )


def require_judge(run: Run, command: str) -> Judge:
    """The judge of a run's model.

    Raises
    ------
    EmaError
        Without a model.
    """
    judge = kind_of(run.info).judge(run)
    if judge is None:
        raise run.without_model(command)
    return judge
