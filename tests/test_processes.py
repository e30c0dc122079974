"""Work shared among processes and threads: same results, nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from ema_pipeline import keys, pipeline
from ema_pipeline.errors import EmaError
from ema_pipeline.processes import Send, aside, side_by_side, spread
from ema_pipeline.run.opening import describe_run, new_run, save_info
from ema_pipeline.run.settings import PipelineSettings
from ema_pipeline.run.types import Progress, Run
from ema_pipeline.store import Store
from ema_pipeline.threads import cores, in_order, over_rows, share_cores

pytestmark = pytest.mark.usefixtures("all_cores")


def test_jobs_are_done_in_processes_of_their_own_and_what_they_tell_is_heard() -> None:
    heard: list[tuple[str, int, int]] = []

    def job(item: str, send: Send) -> None:
        for k in range(3):
            send((item, k, os.getpid()))

    side_by_side(job, ["a", "b", "c"], 2, heard.append)
    for item in "abc":
        own = [(k, process) for name, k, process in heard if name == item]
        assert [k for k, _ in own] == [0, 1, 2]
        assert os.getpid() not in {process for _, process in own}


def test_never_more_processes_run_than_allowed() -> None:
    running, most = set(), [0]

    def hear(message: tuple[str, str]) -> None:
        what, item = message
        (running.add if what == "begins" else running.discard)(item)
        most[0] = max(most[0], len(running))

    def job(item: str, send: Send) -> None:
        send(("begins", item))
        time.sleep(0.05)
        send(("ends", item))

    side_by_side(job, list("abcdef"), 2, hear)
    assert most[0] == 2


def test_the_first_item_that_fails_is_told_and_the_others_are_done() -> None:
    done: list[str] = []

    def job(item: str, send: Send) -> None:
        if item in "bc":
            raise EmaError(f"{item} is wrong")
        send(item)

    with pytest.raises(EmaError, match="b is wrong"):
        side_by_side(job, list("abdc"), 2, done.append)
    assert sorted(done) == ["a", "d"]


@pytest.mark.parametrize("processes", [1, 2, None])
def test_a_job_is_done_aside_while_this_process_goes_on(processes: int | None) -> None:
    begun = time.monotonic()

    def job() -> tuple[int, float, float]:
        beginning = time.monotonic()
        time.sleep(0.2)
        return os.getpid(), beginning, time.monotonic()

    with aside(job, processes) as result:
        time.sleep(0.2)
        middle = time.monotonic()
        process, beginning, _ = result()
    alone = processes == 1
    assert (process == os.getpid()) is alone
    assert begun <= beginning
    assert (beginning >= middle) is alone


def test_what_fails_aside_is_told_where_it_is_asked_for() -> None:
    def job() -> None:
        raise EmaError("no modes")

    with aside(job, 2) as result, pytest.raises(EmaError, match="no modes"):
        result()
    killed = aside(lambda: os.kill(os.getpid(), signal.SIGKILL), 2)
    with killed as result, pytest.raises(MemoryError, match="ended unexpectedly"):
        result()


def test_what_is_not_asked_for_is_broken_off() -> None:
    begun = time.monotonic()
    with aside(lambda: time.sleep(20), 2):
        pass
    with pytest.raises(ZeroDivisionError), aside(lambda: time.sleep(20), 2):
        _ = 1 // 0
    assert time.monotonic() - begun < 10


def test_a_worker_that_is_killed_is_an_error_and_no_hang() -> None:
    def job(item: int, send: Send) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(MemoryError, match="ended unexpectedly"):
        side_by_side(job, [1], 2, lambda message: None)


@pytest.mark.parametrize(
    ("processes", "least", "shared"), [(2, 2, True), (2, 4, False), (1, 2, False), (2, 3, True)]
)
def test_items_are_shared_from_as_many_as_are_worth_it(processes: int, least: int, shared: bool) -> None:
    found = list(spread(lambda item: (item, os.getpid()), "abc", processes, least))
    assert [item for item, _ in found] == list("abc")
    assert all((process != os.getpid()) == shared for _, process in found)


def test_a_process_that_is_killed_among_those_that_share_items_is_an_error_and_no_hang() -> None:
    with pytest.raises(MemoryError, match="ended unexpectedly"):
        list(spread(lambda item: os.kill(os.getpid(), signal.SIGKILL), range(4), 2))
    assert list(spread(lambda item: item + 1, range(4), 2)) == [1, 2, 3, 4]  # nothing is left of it


def test_processes_that_share_items_share_the_processors() -> None:
    here = cores()
    assert set(spread(lambda item: cores(), range(4), 2)) == {max(1, here // 2)}
    assert cores() == here


def test_an_interruption_ends_the_workers() -> None:
    workers: list[int] = []

    def job(item: int, send: Send) -> None:
        send(os.getpid())
        time.sleep(60)

    def hear(message: int) -> None:
        workers.append(message)
        if len(workers) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        side_by_side(job, [1, 2], 2, hear)
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)


def test_rows_in_threads_and_in_one_are_the_same() -> None:
    values = np.random.default_rng(1).normal(size=(37, 5000))
    sums = []
    for numbers in (values.size * 100, 0):  # worth a thread, and not
        out = np.full(len(values), np.nan)

        def work(rows: slice, out: np.ndarray = out) -> None:
            out[rows] = values[rows].sum(axis=1)

        with over_rows(len(values), numbers) as each:
            each(work)
        sums.append(out)
    assert np.array_equal(*sums)


def test_threads_that_all_work_start_none_of_their_own() -> None:
    if cores() < 2:
        pytest.skip("one processor")
    together = threading.Barrier(cores(), timeout=30)

    def inner(item: int) -> set[int]:
        together.wait()
        threads = set(in_order(lambda _: threading.get_ident(), range(8)))
        together.wait()
        return threads

    assert all(len(threads) == 1 for threads in in_order(inner, range(cores())))


def test_a_thread_shares_its_work_with_those_that_have_none_left() -> None:
    if cores() < 2:
        pytest.skip("one processor")
    together = threading.Barrier(cores(), timeout=30)

    def alone(item: int) -> int:
        return together.wait() + item  # all of its own threads are there, or the barrier breaks

    def inner(item: int) -> list[int]:
        if not item:
            return []
        time.sleep(0.2)  # until the others are done
        return list(in_order(alone, [item] * cores()))

    found = list(in_order(inner, [0] * cores() + [1]))[-1]
    assert sorted(found) == [1 + k for k in range(cores())]


def test_processes_beside_each_other_share_the_processors() -> None:
    seen: list[int] = []

    def job(item: int, send: Send) -> None:
        share_cores(2)
        send(cores())

    side_by_side(job, [1], 2, seen.append)
    assert seen == [max(1, cores() // 2)]


@pytest.mark.parametrize(("processes", "apart"), [(None, True), (1, False)])
def test_one_configuration_alone_has_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: int | None, apart: bool
) -> None:
    class Stage:
        NAME, NEEDS, PER_CONFIGURATION, NEEDS_RIG = "ingest", (), True, False

        def inputs(self, run: Run, configuration: str) -> str:
            return ""

        def work(self, run: Run, configuration: str, progress: Progress) -> dict[str, object]:
            return {"process": os.getpid()}

    monkeypatch.setattr(pipeline, "stage_module", lambda name: Stage())
    monkeypatch.setattr(keys, "stage_module", lambda name: Stage())
    settings = PipelineSettings(processes=processes)
    info = describe_run("hammer", tmp_path, "", "", "", ("default",), (), settings)
    store = Store(tmp_path)
    save_info(store, info)
    with store.lock():
        assert pipeline.run_stages(new_run(store, info), ["ingest"]) == ["ingest (default)"]
    assert (store.load("ingest", "default", "process", int) != os.getpid()) == apart


@pytest.mark.slow
def test_configurations_side_by_side_give_the_digits_of_one_after_the_other(tmp_path: Path) -> None:
    sample = Path(__file__).parents[1] / "sample_data" / "hidden_effect"
    tables = []
    for processes in ("1", "2"):
        out = tmp_path / processes
        code = "import sys; from ema_pipeline.cli import main; sys.argv[0] = 'ema'; main()"
        stages = 'stages=["ingest", "hits", "frf", "modal", "levels", "report"]'
        command = ["run", str(sample), "--out", str(out), "--set", f"processes={processes}", "--set", stages]
        done = subprocess.run(
            [sys.executable, "-c", code, *command], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        for configuration in ("no_ring", "with_ring"):
            own = [x.split(" (")[0] for x in done.stderr.splitlines() if f"({configuration})" in x]
            assert own == ["ingest", "hits", "frf", "modal", "levels"]
        tables.append((out / "modes.csv").read_bytes())
    assert tables[0] == tables[1]
