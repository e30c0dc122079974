"""Runs the stages of a pipeline over one store; what is unchanged is skipped."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import groupby
from typing import cast

from ema_pipeline.keys import Keys
from ema_pipeline.kinds import stages_of
from ema_pipeline.processes import Send, can_fork, one_store_of_memory, release_memory, side_by_side
from ema_pipeline.run.types import Progress, Run, silent
from ema_pipeline.stages.base import Stage, configurations_of, stage_module
from ema_pipeline.store import ALL
from ema_pipeline.threads import cores, share_cores

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
    for each, group in groupby(_stages(run, names), key=lambda stage: stage.PER_CONFIGURATION):
        chain = list(group)
        apart = each and can_fork() and run.settings.processes != 1
        computed += _side_by_side(chain, run, keys, show) if apart else _in_turn(chain, run, keys, show)
    return computed


def out_of_date(run: Run, names: Iterable[str]) -> list[str]:
    """What `run_stages` would compute."""
    names = tuple(names)
    return [_label(stage, c) for stage, c, _ in _stale(_stages(run, names), run, Keys(run, names))]


def _stages(run: Run, names: Iterable[str]) -> list[Stage]:
    """The stages of these names that a run of this kind has."""
    there = stages_of(run)
    return [stage_module(name) for name in names if name in there]


def _stale(stages: Iterable[Stage], run: Run, keys: Keys) -> Iterator[tuple[Stage, str, str]]:
    """Stages that are out of date, with configuration and key, each asked about when it is its turn."""
    for stage in stages:
        for configuration in configurations_of(stage, run):
            key = keys(stage.NAME, configuration)
            if not _up_to_date(stage, run, configuration, key):
                yield stage, configuration, key


def _in_turn(stages: list[Stage], run: Run, keys: Keys, show: ShowStage | None) -> list[str]:
    """Run the stages that are out of date one after the other."""
    computed = []
    for stage, configuration, key in _stale(stages, run, keys):
        label = _label(stage, configuration)
        _run_one(stage, run, configuration, key, label, show)
        computed.append(label)
    return computed


def _side_by_side(stages: list[Stage], run: Run, keys: Keys, show: ShowStage | None) -> list[str]:
    """Run the stages that are out of date, each configuration in a process of its own.

    No configuration asks for results of another, so that all are the same as one after the other. One alone has its own
    process, too: what its stages needed does not burden those that follow.
    """
    todo = list(_stale(stages, run, keys))
    names = list(dict.fromkeys(c for _, c, _ in todo))
    processes = min(run.settings.processes or cores(), len(names))

    def job(configuration: str, send: Send) -> None:
        share_cores(processes)
        one_store_of_memory()

        @contextmanager
        def show_stage(label: str) -> Iterator[Progress]:
            send((label, "begins"))
            yield lambda share, text: send((label, (share, text)))
            send((label, "ends"))

        for stage, c, key in todo:
            if c == configuration:
                _run_one(stage, run, c, key, _label(stage, c), show_stage if show else None)

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
    settings = run.settings.of(stage.NAME).model_dump_json()

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
