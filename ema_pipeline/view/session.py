"""What the live page shows and what is under way: one state for all tabs."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ema_pipeline.choices import options_between
from ema_pipeline.errors import EmaError
from ema_pipeline.number_text import plain
from ema_pipeline.report.commands import command
from ema_pipeline.report.diagnosis import effects_words, model_words
from ema_pipeline.report.moved_modes import Seen, error_words, seen
from ema_pipeline.report.results import RunResults
from ema_pipeline.run.measured import modes_key
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.types import Run
from ema_pipeline.stages.results import load_results
from ema_pipeline.view.serving import Listeners
from ema_pipeline.view.snapshots import Snapshots

PARTS = ("page_top", "candidates", "loop_model", "model_details", "choices", "mode_rows", "moving_shapes")
"""Parts of the page that change with the model, by the names of their templates."""

_LOOK_S = 1.0
"""How often the folder is looked at for changes that somebody else made."""
_SHARES = {"ladder": 0.25, "fit": 0.4, "correlate": 0.2, "report": 0.15, "diagnose": 0.85}
_SHARES_OF_CHOICES = {
    "hits": 0.03, "frf": 0.03, "modal": 0.42, "levels": 0.05, "ladder": 0.18, "fit": 0.06, "correlate": 0.05,
    "report": 0.18,
}  # fmt: skip
"""Shares of the time that stages take, roughly: of a change of the model, and of hits or modes."""


@dataclass
class Job:
    """An action under way: its verb, its stage, how much is done (0 to 1), and whether the page shows its outcome."""

    verb: str
    label: str
    stage: str = "starting"
    text: str = ""
    done: float = 0.0
    before: float = 0.0
    shown_already: bool = False
    began: float = field(default_factory=time.monotonic)

    @property
    def chooses(self) -> bool:
        """True where hits or modes are excluded or included."""
        return self.verb.partition("_")[0] in ("exclude", "include")

    def share(self, stage: str) -> float:
        """Part of the whole that a stage takes."""
        shares = _SHARES_OF_CHOICES if self.chooses else _SHARES
        return shares.get(stage.partition(" ")[0], 0.1)

    def shown(self) -> dict[str, Any]:
        """For the page."""
        seconds = time.monotonic() - self.began
        return {
            "verb": self.verb, "label": self.label, "stage": self.stage, "text": self.text, "done": self.done,
            "seconds": seconds,
        }  # fmt: skip


class Session:
    """A results folder with its page.

    Parameters
    ----------
    folder : Path
    effect_files : sequence of str
        Files with the user's own effects.
    """

    def __init__(self, folder: Path, effect_files: Sequence[str] = ()) -> None:
        self.folder = folder
        self._effect_files = tuple(effect_files)
        self.version = 0
        self.job: Job | None = None
        self.message = ""
        self.commands: list[str] = []
        self.preview: list[dict[str, Any]] | None = None
        self._snapshots = Snapshots(folder)
        self.listeners = Listeners()
        self._worker: asyncio.subprocess.Process | None = None
        self._running: asyncio.Task[None] | None = None
        self._seen: tuple[int, int] = (0, 0)
        self._cancelled = False
        self._moved: tuple[Seen, Seen] | None = None
        self._before = seen(RunResults(""))
        self._changing = asyncio.Lock()
        self.load()

    # what is shown

    def load(self) -> None:
        """Read the folder anew."""
        seen = self._stamp()
        run = existing_run(self.folder, self._effect_files)
        self.results: RunResults = load_results(run)
        self._measured = _measured_key(run)
        self._seen = seen
        self.version += 1

    def state(self) -> dict[str, Any]:
        """Everything small that the page follows."""
        return {
            "version": self.version,
            "job": None if self.job is None else self.job.shown(),
            "message": self.message,
            "commands": self.commands,
            "undo": len(self._snapshots) > 0 and self.job is None,
            "preview": self.preview,
        }

    def page(self) -> str:
        """The page itself."""
        from ema_pipeline.report.html import live_page, page_context

        return live_page(page_context(self.results, live=True, moved=self._moved))

    def model(self) -> dict[str, Any]:
        """What changes with the model: data of the figures, parts of the page, and a key of what was measured."""
        from ema_pipeline.report.html import page_context, page_parts
        from ema_pipeline.report.interactive.data import model_data

        context = page_context(self.results, live=True, moved=self._moved)
        return {
            "version": self.version,
            "measured": self._measured,
            "figures": list(context["figures"]),
            "parts": page_parts(context, PARTS),
            "data": model_data(self.results),
        }

    # what is done

    async def act(self, verb: str, label: str) -> None:
        """Begin an action; what comes of it is told to all tabs.

        Raises
        ------
        EmaError
            If another one is under way.
        """
        if self.job is not None:
            raise EmaError(f"'{self.job.verb}' is under way; wait for it or cancel it")
        self.job = Job(verb, label)
        self.message, self.preview, self._cancelled = "", None, False
        self.listeners.notify()
        self._running = asyncio.create_task(self._run_alone(self.job))

    async def cancel(self) -> None:
        """Stop what is under way; the folder is as it was before."""
        if self.job is not None and self._worker is not None:
            self._cancelled = True
            self._worker.kill()

    async def undo(self) -> None:
        """Bring back the state before the last action.

        Raises
        ------
        EmaError
            If there is none, or an action is under way.
        """
        if self.job is not None or not len(self._snapshots):
            raise EmaError("there is nothing to undo")
        async with self._changing:
            before, self._moved = self.results, None
            await asyncio.to_thread(self._snapshots.restore)
            await asyncio.to_thread(self.load)
            self._log(before, self.results)
        self.message = "Undone."
        self.listeners.notify()

    async def watch(self) -> None:
        """Keep a worker ready, and follow changes that are made on the command line."""
        await self._start_worker()
        while True:
            await asyncio.sleep(_LOOK_S)
            if not self._changing.locked() and self._stamp() != self._seen:
                with contextlib.suppress(EmaError):
                    await asyncio.to_thread(self.load)
                    self._snapshots.clear()
                    self.message = "The results were changed outside this page."
                    self.listeners.notify()

    async def close(self) -> None:
        """Stop what is under way, as `cancel` does, and remove the snapshots."""
        if self._running is not None and not self._running.done():
            self._running.cancel()
            await asyncio.wait([self._running])
        if self._worker is not None and self._worker.returncode is None:
            self._worker.kill()
            await self._worker.wait()
        if self.job is not None and len(self._snapshots):
            self._snapshots.restore()
        self._snapshots.clear()

    async def _run_alone(self, job: Job) -> None:
        async with self._changing:
            await self._run(job)

    async def _run(self, job: Job) -> None:
        before, stamp = self.results, self._stamp()
        self._before = seen(before)
        try:
            self._snapshots.take()
            outcome = await self._work(job)
            if outcome.get("outcome") == "done":
                if job.shown_already:  # but for the report, which is a file of its own
                    self._seen = self._stamp()
                await asyncio.to_thread(self._load_once)
                self._log(before, self.results, job)
                self.message = self._outcome(job)
            else:
                self._moved = None
                if self._stamp() == stamp:
                    self._snapshots.drop()
                else:
                    self._snapshots.restore()
                await asyncio.to_thread(self._load_once)
                self.message = (
                    "Cancelled; nothing was changed." if self._cancelled else outcome.get("why", "")
                )
        except (EmaError, OSError) as error:
            self.message = str(error)
        self.job, self.preview = None, None
        self.listeners.notify()

    async def _work(self, job: Job) -> dict[str, Any]:
        """Have the worker do it; its last message."""
        worker = self._worker
        if worker is None or worker.returncode is not None:
            worker = await self._start_worker()
        assert worker.stdin is not None
        assert worker.stdout is not None
        worker.stdin.write((json.dumps({"verb": job.verb, "label": job.label}) + "\n").encode())
        await worker.stdin.drain()
        while line := await worker.stdout.readline():
            told = json.loads(line)
            if "outcome" in told:
                return dict(told)
            await self._follow(job, told)
        await worker.wait()
        await self._start_worker()
        return {"outcome": "failed", "why": "the refit ended unexpectedly; nothing was changed"}

    async def _follow(self, job: Job, told: dict[str, Any]) -> None:
        stage = str(told.get("finished", told.get("stage")))
        if self.preview is None and (stage == "fit" or told.get("finished") == "ladder"):
            # Known before "fit" begins, be it from the diagnosis.
            rungs = await asyncio.to_thread(self._rungs)
            self.preview = [self._error_before(), *rungs[-1:]] if job.chooses and rungs else rungs
        if "finished" in told:
            job.before = min(job.before + job.share(stage), 1.0)
            job.done = job.before
            # All is there but the report.
            if stage == ("correlate" if self.results.loops is None else "ladder"):
                await asyncio.to_thread(self._load_once)
                job.shown_already = True
        else:
            job.stage, job.text = stage, str(told.get("text", ""))
            job.done = min(job.before + job.share(job.stage) * float(told["done"]), 1.0)
        self.listeners.notify()

    def _error_before(self) -> dict[str, Any]:
        """The error of the model before an action, as a rung of the ladder shows it."""
        held = self._before.heldout_error
        return {"error": self._before.error, "held": held if math.isfinite(held) else None}

    def _outcome(self, job: Job) -> str:
        """What an action has brought, in one line."""
        if job.chooses:
            return error_words(self._before, seen(self.results)) or "Done."
        ladder = self.results.shown_ladder
        if ladder is None or len(ladder.rungs) < 2:
            return "Done."
        first, last = ladder.rungs[0], ladder.rungs[-1]
        held = f"held out {plain(first.heldout_error, 3)} → {plain(last.heldout_error, 3)}"
        added = self.results.added
        if last.effects != added:  # the diagnosis's ladder: nothing of it is in the model
            proposed = effects_words([x for x in last.effects if x not in added])
            return (
                f"In use: {model_words(added)}, error {plain(first.error, 3)}. "
                f"With {proposed}, as proposed, it would be {plain(last.error, 3)} ({held})."
            )
        return f"Error {plain(first.error, 3)} → {plain(last.error, 3)}, {held}."

    def _load_once(self) -> None:
        """Load unless the model on screen is that in the folder already."""
        if self._stamp() != self._seen:
            chosen = self.results.choices
            self.load()
            if self.results.choices != chosen:
                self._moved = self._before, seen(self.results)

    def _rungs(self) -> list[dict[str, Any]]:
        from ema_pipeline.diagnose.types import Ladder
        from ema_pipeline.report.interactive.data import ladder_data
        from ema_pipeline.store import ALL, Store

        return ladder_data(Store(self.folder).find("ladder", ALL, "ladder", Ladder))

    async def _start_worker(self) -> asyncio.subprocess.Process:
        self._worker = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-m", "ema_pipeline.view.worker", str(self.folder), *self._effect_files,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=1 << 20,
            start_new_session=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        return self._worker

    def _log(self, was: RunResults, now: RunResults, job: Job | None = None) -> None:
        """The commands that lead from one list of effects, and from one set of choices, to the other."""
        before, after = was.added, now.added

        def on_folder(verb: str, *words: str) -> str:
            return command(verb, str(self.folder), *words, effect_files=self._effect_files)

        self.commands += [
            on_folder(verb, option, name) for verb, option, name in options_between(was.choices, now.choices)
        ]
        if job is not None and job.verb == "diagnose":
            self.commands.append(on_folder("diagnose"))
            return
        if job is not None and job.verb == "remove":
            self.commands.append(on_folder("remove", job.label))
            return
        common = 0
        while common < min(len(before), len(after)) and before[common] == after[common]:
            common += 1
        self.commands += [on_folder("remove", x) for x in reversed(before[common:])]
        if after[common:]:
            self.commands.append(on_folder("add", *after[common:]))

    def _stamp(self) -> tuple[int, int]:
        found = (self.folder / "ema.h5").stat()
        return found.st_ino, found.st_mtime_ns


def _measured_key(run: Run) -> str:
    """Key of hits, FRFs and modes: an equal key means that a page shows the same measurements."""
    keys = [run.store.key(stage, c) for stage in ("hits", "frf") for c in run.info.configurations]
    return hashlib.sha256(" ".join([*keys, modes_key(run)]).encode()).hexdigest()
