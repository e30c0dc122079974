"""Ctrl-C: one line that says what is kept and how to go on, and an end within a second."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable
from contextvars import ContextVar
from types import FrameType

from ema_pipeline.plain_text import printable

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended: 128 and the number of the signal."""

PATIENCE_S = 0.6
"""Time to tidy up; then the process ends as it stands. The results file is whole at any moment."""

_KEEPING = frozenset(
    {"run", "ingest", "hits", "frf", "modal", "fit", "correlate", "report", "levels", "diagnose", "compare"}
)
"""Verbs whose finished stages are kept, so that the same command goes on from there."""

_ending: ContextVar[Callable[[], str] | None] = ContextVar("ending", default=None)
_go_on: ContextVar[str] = ContextVar("go_on", default="")


def go_on_with(command: str) -> None:
    """From here on an interrupted command is finished by `command` rather than by typing it once more."""
    _go_on.set(command)


def end_by_ctrl_c(ending: Callable[[], str]) -> None:
    """From here on Ctrl-C is how the command ends: `ending` gives what is said, nothing while work is under way."""
    _ending.set(ending)


def answer_ctrl_c(program: str) -> None:
    """Answer the first Ctrl-C with a line and a tidy end, and see to it that the end comes.

    Parameters
    ----------
    program : str
        The command ``ema`` as the user can type it.
    """
    own = os.getpid()

    def end(number: int, frame: FrameType | None) -> None:
        if os.getpid() != own:  # a worker, which its parent outlives by no more than this
            os._exit(INTERRUPTED)
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
        ending = _ending.get()
        told = (ending and ending()) or f"interrupted; {_how_to_go_on(program)}"
        line = f"{_fresh_line()}ema: {printable(told)}\n"
        os.write(
            2, line.encode(errors="replace")
        )  # not through sys.stderr, which may be in the middle of a line
        code = INTERRUPTED if ending is None else 0  # where Ctrl-C is how the command ends, it ends well
        timer = threading.Timer(PATIENCE_S, os._exit, (code,))
        timer.daemon = True
        timer.start()
        sys.unraisablehook = lambda _: None  # raised in a callback, the interrupt would print a traceback
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, end)


def _how_to_go_on(program: str) -> str:
    if command := _go_on.get():
        return f"go on with: {program} {command}"
    words = sys.argv[1:]
    if words and words[0] in _KEEPING:
        return f"finished stages are kept, go on with: {program} {shlex.join(words)}"
    return "nothing was changed"


def _fresh_line() -> str:
    """Leaves the line of a progress bar."""
    return "\n" if sys.stderr.isatty() else ""
