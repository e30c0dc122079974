"""Record files of a folder as they become complete: new ones, and ones that grew again."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ema_pipeline.ingest.description import DESCRIPTION_FILE

SETTLED_S = 0.25
"""A file that has not changed for so long is taken for complete; one that grows later is looked at again."""
EMPTY_S = 2.0
"""A file that is empty for so long stays empty: many programs create a file first and fill it at the end."""
_STEP_MS = 50
_POLL_MS = 100
_SCAN_S = 1.0
"""Time between two looks at the whole folder: network shares do not tell of every change."""

_OTHER = frozenset({".toml", ".tmp", ".part", ".crdownload", ".html", ".json", ".lock"})
"""Endings of files that are no records, or not complete."""


@dataclass(frozen=True)
class Arrival:
    """A file that looks complete, or stays empty.

    Attributes
    ----------
    path : Path
    ended : float
        When it changed last, seconds since the epoch by this machine's clock.
    """

    path: Path
    ended: float


@dataclass
class _State:
    """What is known of one file."""

    size: int
    changed_ns: int
    seen: float
    told: bool = False


def arrivals(
    folder: Path, poll: bool = False, stop: threading.Event | None = None
) -> Iterator[Arrival | None]:
    """Files of a folder when they have stopped to change; None about 20 times a second in between.

    Parameters
    ----------
    folder : Path
    poll : bool
        Look again and again in place of waiting for the system's word: for network shares.
    stop : Event, optional
        Ends it.
    """
    from watchfiles import watch

    known: dict[str, _State] = {}
    scanned = 0.0
    changes = watch(
        folder, recursive=False, force_polling=poll, poll_delay_ms=_POLL_MS, debounce=_STEP_MS, step=_STEP_MS // 2,
        rust_timeout=_STEP_MS, yield_on_timeout=True, stop_event=stop, raise_interrupt=True,
    )  # fmt: skip
    for changed in changes:
        names = {os.path.basename(path) for _, path in changed}
        if time.monotonic() - scanned > _SCAN_S or poll:
            scanned = time.monotonic()
            names |= {entry.name for entry in os.scandir(folder)}
        names |= {name for name, state in known.items() if not state.told}
        for name in sorted(names):
            if _is_record(name) and _settled(folder / name, known):
                yield Arrival(folder / name, known[name].seen)
        yield None


def _is_record(name: str) -> bool:
    return not name.startswith(".") and name != DESCRIPTION_FILE and Path(name).suffix.lower() not in _OTHER


def _settled(path: Path, known: dict[str, _State]) -> bool:
    """True once for each time that a file has stopped to change."""
    try:
        found = path.stat()
    except OSError:  # gone again, or not to be read yet
        known.pop(path.name, None)
        return False
    now, state = time.time(), known.get(path.name)
    if state is None or (state.size, state.changed_ns) != (found.st_size, found.st_mtime_ns):
        known[path.name] = _State(found.st_size, found.st_mtime_ns, now)
        return False
    if state.told or not path.is_file() or now - state.seen < (SETTLED_S if state.size else EMPTY_S):
        return False
    state.told = True
    return True
