"""Files of a folder, each judged once it is complete."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

from ema_pipeline.watch.arrivals import Arrival, arrivals
from ema_pipeline.watch.session import Session, Told

PATIENCE_S = 0.7
"""A file that cannot be read is given so long after its last change: whoever writes it may only have paused."""


def judged_files(
    session: Session, poll: bool = False, stop: threading.Event | None = None
) -> Iterator[Told | None]:
    """What is said of each file of a session's folder as it becomes complete; None in between.

    Parameters
    ----------
    session : Session
    poll : bool
        For network shares.
    stop : Event, optional
        Ends it.
    """
    unread: dict[str, Arrival] = {}
    for arrival in arrivals(session.folder, poll, stop):
        waiting = list(unread.values())
        if arrival is not None:
            waiting = [arrival]
            unread.pop(arrival.path.name, None)
        for one in waiting:
            told = session.take(one)
            if told.record is None and time.time() - one.ended < PATIENCE_S and one.path.exists():
                unread[one.path.name] = one
                continue
            unread.pop(one.path.name, None)
            yield told
        yield None
