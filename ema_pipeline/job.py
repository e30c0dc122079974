"""Starting a run: raw folder, rig, pipeline and results folder are brought together and checked."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ema_pipeline.dof import Dof
from ema_pipeline.effects.isolators import isolators
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.files import read_bounded
from ema_pipeline.ingest.description import Campaign, TestDescription, read_campaign
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import Hit
from ema_pipeline.names import check_name
from ema_pipeline.observations.loop_forces import effects_of_loops
from ema_pipeline.pipeline import (
    ShowStage,
    describe_run,
    existing_run,
    load_pipeline,
    new_run,
    override,
    run_stages,
    shipped_pipelines,
    stored_settings,
    toml_value,
    with_effect_files,
)
from ema_pipeline.rigs import Rig, load_rig, model_modes, rig_names
from ema_pipeline.stages.base import Run, RunInfo, load_info, save_info
from ema_pipeline.store import Store
from ema_pipeline.toml_text import LARGEST_BYTES, read_toml, read_toml_text

if TYPE_CHECKING:
    from ema_pipeline.simulate.campaign import SimulatedCampaign

DEFAULT_PIPELINE = "default"
LOOPS_RIG = "isolator"
"""Rig of force-displacement loops where none is named."""

DescribeSource = Callable[[Path, str | None, str | None, Iterable[str]], RunInfo]
"""Checks what a run starts from; takes source, rig, pipeline and overrides."""


def run_raw(
    raw: Path,
    rig: str | None,
    out: Path,
    pipeline: str | None = None,
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    describe_source: DescribeSource | None = None,
    effect_files: Iterable[str] = (),
) -> tuple[Run, list[str]]:
    """Run a whole pipeline on a raw folder, or on a table of modes.

    Parameters
    ----------
    raw : Path
        Raw folder, or a file with a table of modes.
    rig : str or None
        Name of a rig or path of a rig file. Left out: the ``rig.toml`` beside test.toml, then the rig that
        test.toml names, then none.
    out : Path
        Results folder; made where it does not exist.
    pipeline : str or None
        Name or path of a pipeline; left out, the one made for the rig.
    overrides : iterable of str
        ``stage.key=value``.
    show : ShowStage or None
        Display of progress.
    describe_source : callable
        `describe` for raw folders, `describe_modes` for a table of modes.
    effect_files : iterable of str
        Python files with the user's own effects.

    Returns
    -------
    run : Run
    computed : list of str
        What was computed; empty where everything was up to date.

    Raises
    ------
    EmaError
        Whatever is wrong with data or settings, in one line.
    """
    info = (describe_source or describe)(raw, rig, pipeline, overrides)
    store, effect_files = Store(out), tuple(effect_files)
    info = with_effect_files(store, info, effect_files)
    with _tidy(out), store.lock():
        info = _with_effects_of(store, info)
        save_info(store, info)
        run = new_run(store, info, effect_files)
        stages = stored_settings(store, info).stages
        return run, run_stages(run, stages, show)


def run_on(
    folder: Path,
    stages: Iterable[str],
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    effect_files: Iterable[str] = (),
) -> tuple[Run, list[str]]:
    """Run single stages on a results folder; settings changed by `overrides` stay changed there.

    Raises
    ------
    EmaError
        Whatever is wrong with the folder or the settings, in one line.
    """
    effect_files = tuple(effect_files)
    info = existing_run(folder, effect_files).info
    store = Store(folder)
    settings = override(stored_settings(store, info), overrides, folder)
    with store.lock():
        info = dataclasses.replace(info, pipeline=settings.model_dump_json())
        save_info(store, info)
        run = new_run(store, info, effect_files)
        return run, run_stages(run, stages, show)


def change_effects(
    folder: Path,
    change: Callable[[tuple[str, ...]], tuple[str, ...]],
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    effect_files: Iterable[str] = (),
) -> Run:
    """Change the effects that were added to the model, and refit, compare and report.

    Parameters
    ----------
    folder : Path
        Results folder.
    change : callable
        Takes the effects as they are, returns them as they shall be.
    overrides : iterable of str
        ``stage.key=value``.
    show : ShowStage or None
    effect_files : iterable of str
        Python files with the user's own effects.

    Raises
    ------
    EmaError
        For effects or places that do not exist; nothing is changed then.
    """
    effect_files = tuple(effect_files)
    run = existing_run(folder, effect_files)
    run.require_model("add")
    store = Store(folder)
    settings = override(stored_settings(store, run.info), overrides, folder)
    with store.lock():
        info = dataclasses.replace(
            run.info, effects=change(run.info.effects), pipeline=settings.model_dump_json()
        )
        run = new_run(store, info, effect_files)
        run.require_model("add")  # refuses unknown effects and places before anything is written
        if info.kind == "hysteresis" and run.rig is not None:
            effects_of_loops(run.rig, info.effects, run.library)  # refuses what a loop does not show
        save_info(store, info)
        run_stages(run, ("ladder", "fit", "correlate", "report"), show)
    return run


def adding(labels: Iterable[str]) -> Callable[[tuple[str, ...]], tuple[str, ...]]:
    """The change that adds effects on top."""

    def change(effects: tuple[str, ...]) -> tuple[str, ...]:
        for label in labels:
            if label in effects:
                raise EmaError(f"effect '{label}' is in the model already")
            effects = (*effects, label)
        return effects

    return change


def removing(label: str) -> Callable[[tuple[str, ...]], tuple[str, ...]]:
    """The change that takes one effect away."""

    def change(effects: tuple[str, ...]) -> tuple[str, ...]:
        if label not in effects:
            raise EmaError(f"effect '{label}' is not in the model{did_you_mean(label, effects)}")
        return tuple(x for x in effects if x != label)

    return change


def _with_effects_of(store: Store, info: RunInfo) -> RunInfo:
    """Keep the effects that the user had added to the same rig in an earlier run."""
    if not store.path.is_file():
        return info
    before = load_info(store)
    if before is None or before.rig != info.rig:
        return info
    return dataclasses.replace(info, effects=before.effects)


def describe(raw: Path, rig: str | None, pipeline: str | None, overrides: Iterable[str]) -> RunInfo:
    """Check raw folder, rig and settings against each other, before anything is written."""
    campaign = read_campaign(raw)
    kinds = {test.kind for test in campaign.tests}
    if len(kinds) > 1:
        raise EmaError(f"{raw}: holds hammer and hysteresis tests; run their folders one by one")
    if kinds == {"hysteresis"}:
        return _describe_loops(campaign, rig, pipeline, overrides)
    source = rig or _rig_of(campaign)
    model = None if source is None else checked_rig(source)
    names = tuple(_configuration(test, model) for test in campaign.tests)
    if model is not None:
        for test, name in zip(campaign.tests, names, strict=True):
            check_dofs(test, name, model)
    settings = load_pipeline(pipeline or _pipeline_for(model), overrides)
    title = (
        next((t.title for t in campaign.tests if t.title), raw.name)
        if len(names) == 1
        else raw.resolve().name
    )
    return describe_run("hammer", raw, title, _rig_text(source), source or "", names, (), settings)


def _describe_loops(
    campaign: Campaign, rig: str | None, pipeline: str | None, overrides: Iterable[str]
) -> RunInfo:
    """Hysteresis tests: the base model is the linear spring of an isolator, which the loops themselves determine."""
    source = rig or _rig_of(campaign) or LOOPS_RIG
    model = checked_rig(source)
    if not any(isolators(model.assembly(name)) for name in model.configurations):
        raise EmaError(f"{source}: has no isolator that loops could be measured on; leave --rig out")
    names = tuple(test.configuration or "default" for test in campaign.tests)
    title = campaign.tests[0].title or campaign.root.resolve().name
    settings = load_pipeline(pipeline or DEFAULT_PIPELINE, overrides)
    return describe_run("hysteresis", campaign.root, title, _rig_text(source), source, names, (), settings)


def describe_modes(file: Path, rig: str | None, pipeline: str | None, overrides: Iterable[str]) -> RunInfo:
    """Check a table of modes against its rig, before anything is written."""
    from ema_pipeline.correlate.mode_table import read_mode_table

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
    return describe_run("modes", file, file.stem, _rig_text(rig), rig, names, (), settings)


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


def _rig_text(source: str | None) -> str:
    """Name of a shipped rig, or the text of the user's file, which then lives on in the store."""
    if source is None or source in rig_names():
        return source or ""
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


def check_raw(raw: Path, overrides: Iterable[str] = ()) -> dict[str, tuple[Hit, ...]]:
    """Hits of every configuration of a raw folder with their verdicts; nothing is written."""
    from ema_pipeline.ingest.quality import hits_of_test

    settings = load_pipeline(DEFAULT_PIPELINE, overrides)
    judged = {}
    for test in read_campaign(raw).tests:
        judged[test.configuration or "default"] = hits_of_test(
            list(load_records(test, settings.ingest)), settings.hits
        )
    return judged


def draft_raw(raw: Path, overrides: Iterable[str] = ()) -> list[Path]:
    """Draft test.toml from what the record files of a folder say; returns the files written."""
    from ema_pipeline.ingest.draft import write_drafts

    return write_drafts(raw, load_pipeline(DEFAULT_PIPELINE, overrides).ingest)


def report_path(out: Path) -> Path:
    """The report of a results folder.

    Raises
    ------
    EmaError
        If there is none.
    """
    path = Store.existing(out).folder / "report.html"
    if not path.is_file():
        raise EmaError(f"{path}: there is no report yet; write it with 'ema report {out}'")
    return path.resolve()


def export_results(out: Path, folder: Path, effect_files: Iterable[str] = ()) -> list[Path]:
    """Write FRFs, modes and shapes of every configuration as universal file and as CSV.

    Raises
    ------
    EmaError
        If nothing has been identified yet, or the folder cannot be written.
    """
    from ema_pipeline.exchange.tables import shapes_table, write_frf_csv, write_table
    from ema_pipeline.exchange.uff import write_uff
    from ema_pipeline.stages.modes import measured_frfs, modes_of_structure

    run = existing_run(out, effect_files)
    measured = measured_frfs(run)
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EmaError(f"{folder}: cannot be written ({error.strerror}); name another folder") from None
    for name in run.info.configurations:
        modal, frfs = modes_of_structure(run, name), measured.get(name)
        files = [folder / f"{name}.uff", folder / f"{name}_shapes.csv", folder / f"{name}_frfs.csv"]
        write_uff(files[0], frfs, modal)
        write_table(files[1], shapes_table(modal, name))
        if frfs is not None:
            write_frf_csv(files[2], frfs)
        written += [f for f in files if f.exists()]
    return written


def list_model_modes(rig: str, configuration: str | None) -> dict[str, list[dict[str, Any]]]:
    """The model's own modes for one configuration, or for all of them."""
    loaded = checked_rig(rig)
    return {
        name: [
            {"frequency_hz": m.frequency_hz, "damping_ratio": m.damping_ratio, "family": m.family}
            for m in model_modes(loaded, name)
        ]
        for name in ((configuration,) if configuration else loaded.configurations)
    }


def list_effects(rig: str) -> list[dict[str, Any]]:
    """Effects that can sit on a rig, with places, parameters and tell-tale signs."""
    from ema_pipeline.effects.library import shipped_effects

    loaded = checked_rig(rig)
    listed = []
    for effect in shipped_effects().values():
        places = dict.fromkeys(p for c in loaded.configurations for p in effect.places(loaded, c))
        if places:
            parameters = [
                {"name": p.name, "unit": p.unit, "null": p.null, "description": p.description}
                for p in effect.parameters
            ]
            listed.append(
                {
                    "id": effect.id,
                    "title": effect.title,
                    "places": list(places),
                    "parameters": parameters,
                    "signs": effect.signs,
                    "reference": effect.reference,
                }
            )
    return listed


def simulate_raw(
    out: Path,
    rig: str,
    *,
    configurations: list[str],
    effects: list[str],
    effect_files: list[str],
    values: list[str],
    sensors: list[str],
    impacts: list[str],
    settings: list[str],
) -> SimulatedCampaign:
    """Simulate a campaign; values and settings are given as ``"name=value"``."""
    from ema_pipeline.effects.library import effect_library
    from ema_pipeline.simulate.campaign import simulate_campaign

    return simulate_campaign(
        out,
        rig,
        configurations=configurations,
        effects=effects,
        values=_named_values(values, "--value"),
        sensors=sensors,
        impacts=impacts,
        library=effect_library(effect_files),
        **_named_values(settings, "--set"),
    )


def _named_values(texts: list[str], option: str) -> dict[str, Any]:
    named = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or not name.strip():
            raise EmaError(f"{option} {text}: is not of the form name=value")
        named[name.strip()] = toml_value(value.strip())
    return named


@contextlib.contextmanager
def _tidy(out: Path) -> Iterator[None]:
    """Remove a results folder that this run made, if the run fails before it holds a result."""
    existed = out.exists()
    try:
        yield
    except BaseException:
        if not existed and out.is_dir() and {p.name for p in out.iterdir()} <= {".lock"}:
            (out / ".lock").unlink(missing_ok=True)
            out.rmdir()
        raise
