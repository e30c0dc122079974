"""What a run starts from: raw folder or table of modes, rig and settings, checked against each other."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.files import read_bounded
from ema_pipeline.ingest.campaign import Campaign, read_campaign
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.kinds import KINDS
from ema_pipeline.names import check_name
from ema_pipeline.rigs import Rig, load_rig, rig_names
from ema_pipeline.run.opening import describe_run
from ema_pipeline.run.settings import load_pipeline, shipped_pipelines
from ema_pipeline.run.types import RunInfo
from ema_pipeline.toml_text import LARGEST_BYTES, read_toml, read_toml_text

DEFAULT_PIPELINE = "default"


def describe(raw: Path, rig: str | None, pipeline: str | None, overrides: Iterable[str]) -> RunInfo:
    """Check raw folder, rig and settings against each other, before anything is written."""
    campaign = read_campaign(raw)
    kinds = {test.kind for test in campaign.tests}
    if len(kinds) > 1:
        raise EmaError(
            f"{raw}: holds tests of several kinds ({', '.join(sorted(kinds))}); run their folders one by one"
        )
    kind = KINDS[kinds.pop()]
    source = rig or _rig_of(campaign) or kind.rig
    model = checked_rig(source) if source else None
    if model is not None:
        kind.check_rig(model, source)
    of_tests = [_configuration(test, model if kind.of_rig else None) for test in campaign.tests]
    if model is not None and kind.of_rig:
        for test, name in zip(campaign.tests, of_tests, strict=True):
            check_dofs(test, name, model)
    names = tuple(dict.fromkeys(of_tests))
    settings = load_pipeline(pipeline or _pipeline_for(model), overrides)
    title = (
        next((t.title for t in campaign.tests if t.title), raw.name)
        if len(names) == 1
        else raw.resolve().name
    )
    return describe_run(kind.name, raw, title, rig_text(source), source, names, (), settings)


def describe_modes(file: Path, rig: str | None, pipeline: str | None, overrides: Iterable[str]) -> RunInfo:
    """Check a table of modes against its rig, before anything is written."""
    from ema_pipeline.exchange.mode_table import read_mode_table

    if rig is None:
        raise EmaError(f"{file}: a table of modes needs a model to compare with; name it with --rig")
    model = checked_rig(rig)
    # Within limits, before the table's own reader sees it.
    if file.suffix.lower() == ".toml":
        read_toml(file)
    else:
        read_bounded(file, LARGEST_BYTES)
    names = tuple(read_mode_table(file, model))
    settings = load_pipeline(pipeline or _pipeline_for(model), overrides)
    return describe_run("modes", file, file.stem, rig_text(rig), rig, names, (), settings)


def check_dofs(test: TestDescription, configuration: str, rig: Rig) -> None:
    """Make sure that the rig knows every DOF that was struck or measured.

    Raises
    ------
    EmaError
        Names the channel or record whose DOF is unknown.
    """
    sensors = rig.system(configuration)
    known = [*sensors.dofs, *sensors.sensors]

    def check(dof: Dof, what: str) -> None:
        if not rig.knows(configuration, dof):
            raise EmaError(
                f"{test.file}: {what}: rig '{rig.name}' ({configuration}) has no dof "
                f"'{dof.point}'{did_you_mean(dof.point, known)}"
            )

    struck = any(record.impact is not None for record in test.records)
    for channel in () if struck else test.forces:
        if channel.dof is not None:
            check(channel.dof, f"channel '{channel.name}'")
    for record in test.records:
        if record.impact is not None:
            check(record.impact, f"record '{record.file}'")
        for channel in test.responses:
            dof = test.dof_of(channel, record)
            if dof is not None:
                check(dof, f"channel '{channel.name}'")


def _rig_of(campaign: Campaign) -> str | None:
    """The rig that the raw folder itself names; a file is looked for beside test.toml."""
    if campaign.rig_file is not None:
        return str(campaign.rig_file)
    name = campaign.rig
    if name is not None and name.endswith(".toml"):
        return str(next((t.folder / name for t in campaign.tests if (t.folder / name).is_file()), Path(name)))
    return name


def rig_text(source: str) -> str:
    """Name of a shipped rig, or the text of the user's file, which then lives on in the store; empty without a rig."""
    if not source or source in rig_names():
        return source
    return read_toml_text(Path(source)).rstrip() + "\n"


def checked_rig(source: str) -> Rig:
    """A rig by its name or from its file, which is checked before the rig's own reader sees it.

    Raises
    ------
    EmaError
        Whatever is wrong with the file, in one line.
    """
    if source not in rig_names() and os.path.exists(source):
        read_toml(Path(source))
    rig = load_rig(source)
    for name in rig.configurations:
        check_name(name, f"{source}: configuration")
    return rig


def _configuration(test: TestDescription, rig: Rig | None) -> str:
    """Name of the test's configuration, checked against the rig's."""
    if rig is None:
        return test.configuration or "default"
    if test.configuration is None:
        if len(rig.configurations) == 1:
            return rig.configurations[0]
        raise EmaError(
            f"{test.file}: configuration is missing; rig '{rig.name}' has {', '.join(rig.configurations)}"
        )
    if test.configuration not in rig.configurations:
        raise EmaError(
            f"{test.file}: rig '{rig.name}' has no configuration "
            f"'{test.configuration}'{did_you_mean(test.configuration, rig.configurations)}"
        )
    return test.configuration


def _pipeline_for(rig: Rig | None) -> str:
    name = DEFAULT_PIPELINE if rig is None else rig.name
    return name if name in shipped_pipelines() else DEFAULT_PIPELINE
