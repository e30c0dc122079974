"""What every live page needs: a guarded server on the loopback address that notifies all tabs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Callable
from importlib import resources
from typing import Any

import uvicorn
from starlette.responses import Response
from starlette.types import ASGIApp

from ema_pipeline.errors import EmaError
from ema_pipeline.report import html
from ema_pipeline.report.summary_files import finite
from ema_pipeline.view.guard import Guard

Started = Callable[[], None]
"""Called by an application once it answers."""

_SCRIPT = "text/javascript; charset=utf-8"
_QUIET_S = 15.0
"""How often the state is told anew where nothing changes, so that a tab that was closed is noticed."""


class Listeners:
    """Tabs that follow a state."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[None]] = set()

    def notify(self) -> None:
        """Say that the state has changed."""
        for queue in self._queues:
            with contextlib.suppress(asyncio.QueueFull):
                queue.put_nowait(None)

    async def events(
        self, state: Callable[[], dict[str, Any]], beat_s: Callable[[], float] = lambda: _QUIET_S
    ) -> AsyncIterator[str]:
        """The state as server-sent events: now, whenever it changes, and after `beat_s` without a change."""
        queue: asyncio.Queue[None] = asyncio.Queue(maxsize=1)
        self._queues.add(queue)
        try:
            while True:
                yield f"data: {json.dumps(finite(state()))}\n\n"
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(queue.get(), beat_s())
        finally:
            self._queues.discard(queue)


def serve_guarded(
    application: Callable[[Started], ASGIApp], port: int = 0, ready: Callable[[str], None] | None = None
) -> None:
    """Serve an application to one browser on this machine until Ctrl-C.

    Parameters
    ----------
    application : callable
        Makes it from what it is to call once it answers.
    port : int
        0 takes a free one.
    ready : callable, optional
        Called with the address once it answers.

    Raises
    ------
    EmaError
        If the port is taken.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except OSError as error:
        raise EmaError(f"port {port} cannot be used ({error.strerror}); leave --port out") from None
    guard = Guard(application(lambda: ready(guard.address) if ready else None), listener.getsockname()[1])
    config = uvicorn.Config(
        guard,
        ws="none",
        log_level="critical",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(listener):
        uvicorn.Server(config).run(sockets=[listener])


def started_soon(started: Started) -> None:
    """Call it when the socket listens, shortly after the application has started."""
    asyncio.get_running_loop().call_later(0.2, started)


def script(name: str) -> Response:
    """A script of the package; only names of routes come here."""
    text = (
        html.bokeh_script()
        if name == "bokeh.js"
        else resources.files("ema_pipeline.report").joinpath("templates", name).read_text(encoding="utf-8")
    )
    return Response(text, media_type=_SCRIPT)
