"""Answers the browser, on this machine only."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from ema_pipeline.errors import EmaError
from ema_pipeline.report import html
from ema_pipeline.report.summary_files import finite
from ema_pipeline.view.guard import Guard
from ema_pipeline.view.session import Session
from ema_pipeline.view.worker import VERBS

_LARGEST_BODY = 4096
_LONGEST_LABEL = 300
_BEAT_S = 1.0
"""How often the time of a running action is told anew."""
_SCRIPT = "text/javascript; charset=utf-8"


def serve(
    folder: Path, effect_files: Sequence[str] = (), port: int = 0, ready: Callable[[str], None] | None = None
) -> None:
    """Serve the live page of a results folder until Ctrl-C.

    Parameters
    ----------
    folder : Path
    effect_files : sequence of str
        Files with the user's own effects.
    port : int
        0 takes a free one.
    ready : callable or None
        Called with the address once it answers.

    Raises
    ------
    EmaError
        If the folder holds no results, or the port is taken.
    """
    session = Session(folder, effect_files)
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except OSError as error:
        raise EmaError(f"port {port} cannot be used ({error.strerror}); leave --port out") from None
    guard = Guard(
        application(session, lambda: ready(guard.address) if ready else None), listener.getsockname()[1]
    )
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


def application(session: Session, started: Callable[[], None] = lambda: None) -> Starlette:
    """The routes of the page, without the guard before them."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        watching = asyncio.create_task(session.watch())
        asyncio.get_running_loop().call_later(0.2, started)  # the socket listens already
        yield
        watching.cancel()
        await asyncio.wait([watching])
        await session.close()

    async def page(request: Request) -> Response:
        return HTMLResponse(await asyncio.to_thread(html.live_page, session.results))

    async def measured(request: Request) -> Response:
        return _json(await asyncio.to_thread(html.live_data, session.results))

    async def model(request: Request) -> Response:
        return _json(html.script_json(await asyncio.to_thread(session.model)))

    async def events(request: Request) -> Response:
        return StreamingResponse(_events(session), media_type="text/event-stream")

    async def script(request: Request) -> Response:
        return Response(_asset(request.url.path.removeprefix("/")), media_type=_SCRIPT)

    async def commands(request: Request) -> Response:
        return PlainTextResponse("#!/bin/sh\nset -e\n" + "".join(f"{c}\n" for c in session.commands))

    async def action(request: Request) -> Response:
        try:
            verb, label = await _wanted(request)
            if verb == "cancel":
                await session.cancel()
            elif verb == "undo":
                await session.undo()
            else:
                await session.act(verb, label)
        except EmaError as error:
            return JSONResponse({"error": str(error)}, status_code=409)
        return JSONResponse({}, status_code=202)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/measured", measured),
            Route("/model", model),
            Route("/events", events),
            Route("/commands", commands),
            Route("/bokeh.js", script),
            Route("/numbers.js", script),
            Route("/page.js", script),
            Route("/live.js", script),
            Route("/action", action, methods=["POST"]),
        ],
        lifespan=lifespan,
    )


async def _wanted(request: Request) -> tuple[str, str]:
    """Verb and label of an action.

    Raises
    ------
    EmaError
        For anything but a small JSON object with a known verb.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise EmaError("an action is a JSON object")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _LARGEST_BODY:
            raise EmaError("an action is a small JSON object")
    try:
        wanted: Any = json.loads(body)
        verb, label = wanted["verb"], wanted.get("label", "")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise EmaError("an action is a JSON object with 'verb'") from None
    if verb not in (*VERBS, "cancel", "undo") or not isinstance(label, str) or len(label) > _LONGEST_LABEL:
        raise EmaError("this page does not know that verb")
    return verb, label


async def _events(session: Session) -> AsyncIterator[str]:
    """The session's state whenever it changes, and every second while something runs."""
    queue = session.listen()
    try:
        while True:
            yield f"data: {json.dumps(finite(session.state()))}\n\n"
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(queue.get(), _BEAT_S if session.job else 15.0)
    finally:
        session.leave(queue)


def _json(text: str) -> Response:
    return Response(text, media_type="application/json")


def _asset(name: str) -> str:
    """A script of the page; only names of the routes come here."""
    if name == "bokeh.js":
        return html.bokeh_script()
    return resources.files("ema_pipeline.report").joinpath("templates", name).read_text(encoding="utf-8")
