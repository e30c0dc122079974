"""Refits in a process of its own, so that the page stays alive and a refit can be stopped at any moment.

Commands come in as lines of JSON, progress and outcome go out as such. The process waits with everything imported, and
ends when its input ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ema_pipeline.errors import EmaError
from ema_pipeline.pipeline import ShowStage
from ema_pipeline.processes import die_with_parent
from ema_pipeline.run.types import Progress

VERBS = ("add", "remove", "diagnose", "exclude_hit", "exclude_mode", "include_hit", "include_mode")
"""What the page can ask for; the part after the underscore is the option of that verb on the command line."""

Send = Callable[[dict[str, Any]], None]


def act(folder: Path, effect_files: tuple[str, ...], verb: str, label: str, show: ShowStage) -> None:
    """Do what the verb of the command line does.

    Raises
    ------
    EmaError
        As the command line would print it.
    """
    from ema_pipeline.choosing import change_choices, excluding, including
    from ema_pipeline.job import adding, change_effects, removing, run_on

    if verb == "add":
        change_effects(folder, adding([label]), (), show, effect_files)
    elif verb == "remove":
        change_effects(folder, removing(label), (), show, effect_files)
    elif verb == "diagnose":
        run_on(folder, ["diagnose", "report"], (), show, effect_files)
    elif verb in VERBS:
        action, _, what = verb.partition("_")
        change = (excluding if action == "exclude" else including)(**{f"{what}s": [label]})
        change_choices(folder, change, show, effect_files)
    else:
        raise EmaError(f"'{verb}' is no verb of the live page")


def showing(send: Send) -> ShowStage:
    """Progress as messages: when a stage begins, goes on and ends."""

    @contextlib.contextmanager
    def show(label: str) -> Iterator[Progress]:
        send({"stage": label, "done": 0.0})

        def progress(done: float, text: str = "") -> None:
            send({"stage": label, "done": min(max(done, 0.0), 1.0), "text": text})

        yield progress
        send({"finished": label})

    return show


def main() -> None:
    """Serve the process that started this one until it closes our input."""
    import ema_pipeline.job  # noqa: F401
    from ema_pipeline.crash import write_crash_report
    from ema_pipeline.diagnose import diagnosis, rungs  # noqa: F401
    from ema_pipeline.report import html  # noqa: F401
    from ema_pipeline.run import models  # noqa: F401
    from ema_pipeline.stages import correlate, fit, ladder, report  # noqa: F401

    die_with_parent(os.getppid())
    folder, effect_files = Path(sys.argv[1]), tuple(sys.argv[2:])

    def send(message: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()

    for line in sys.stdin:
        command = json.loads(line)
        try:
            act(folder, effect_files, command["verb"], command["label"], showing(send))
            send({"outcome": "done"})
        except EmaError as error:
            send({"outcome": "failed", "why": str(error)})
        except Exception as error:
            write_crash_report(error)
            send({"outcome": "failed", "why": f"a fault in ema itself ({type(error).__name__})"})


if __name__ == "__main__":
    main()
