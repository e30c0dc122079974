"""Answers the browser, on this machine only."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from ema_pipeline.errors import EmaError
from ema_pipeline.report import html
from ema_pipeline.view.serving import script, serve_guarded, started_soon
from ema_pipeline.view.session import Session
from ema_pipeline.view.worker import VERBS

_LARGEST_BODY = 4096
_LONGEST_LABEL = 300
_BEAT_S = 1.0
"""How often the time of a running action is told anew."""
_QUIET_S = 15.0


def serve(session: Session, port: int = 0, ready: Callable[[str], None] | None = None) -> None:
    """Serve the live page of a results folder until Ctrl-C.

    Parameters
    ----------
    session : Session
    port : int
        0 takes a free one.
    ready : callable or None
        Called with the address once it answers.

    Raises
    ------
    EmaError
        If the port is taken.
    """
    serve_guarded(lambda started: application(session, started), port, ready)


def application(session: Session, started: Callable[[], None] = lambda: None) -> Starlette:
    """The routes of the page, without the guard before them."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        watching = asyncio.create_task(session.watch())
        started_soon(started)
        yield
        watching.cancel()
        await asyncio.wait([watching])
        await session.close()

    async def page(request: Request) -> Response:
        return HTMLResponse(await asyncio.to_thread(session.page))

    async def measured(request: Request) -> Response:
        return _json(await asyncio.to_thread(html.live_data, session.results))

    async def model(request: Request) -> Response:
        return _json(html.script_json(await asyncio.to_thread(session.model)))

    async def events(request: Request) -> Response:
        return StreamingResponse(
            session.listeners.events(session.state, lambda: _BEAT_S if session.job else _QUIET_S),
            media_type="text/event-stream",
        )

    async def scripts(request: Request) -> Response:
        return script(request.url.path.removeprefix("/"))

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
            Route("/bokeh.js", scripts),
            Route("/numbers.js", scripts),
            Route("/figures.js", scripts),
            Route("/page.js", scripts),
            Route("/live.js", scripts),
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


def _json(text: str) -> Response:
    return Response(text, media_type="application/json")
