"""The live page of a raw folder during a test: what ``ema watch`` says of each file, in a browser."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response, StreamingResponse
from starlette.routing import Route

from ema_pipeline.errors import EmaError
from ema_pipeline.number_text import plain
from ema_pipeline.report.pages import page_templates
from ema_pipeline.view.serving import Listeners, Started, script, serve_guarded, started_soon
from ema_pipeline.watch.judge import LEAST_COHERENCE, JudgedRecord
from ema_pipeline.watch.live import judged_files
from ema_pipeline.watch.session import PointState, Session, Told

SHOWN = 200
"""Files on the page, the last ones; all of them count."""


class HitsPage:
    """Files of a folder judged in a thread, and what the page shows of them.

    Parameters
    ----------
    session : Session
    poll : bool
        For network shares.
    """

    def __init__(self, session: Session, poll: bool = False) -> None:
        self.session, self.listeners = session, Listeners()
        self._poll = poll
        self._stop = threading.Event()
        self._state = self._shown({}, "")

    def state(self) -> dict[str, Any]:
        """All that the page follows, as JSON takes it; replaced as a whole, never changed."""
        return self._state

    def start(self) -> threading.Thread:
        """Begin to judge; tabs are told from the loop that runs now."""
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=self._judge, args=(loop,), daemon=True)
        thread.start()
        return thread

    def stop(self) -> None:
        """Judge no more files."""
        self._stop.set()

    def _judge(self, loop: asyncio.AbstractEventLoop) -> None:
        rows: dict[str, dict[str, Any]] = {}

        def notify(trouble: str = "") -> None:
            self._state = self._shown(rows, trouble)
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self.listeners.notify)

        try:
            for told in judged_files(self.session, self._poll, self._stop):
                if told is not None:
                    rows.pop(told.file, None)  # the last one judged stands on top
                    rows[told.file] = _row(told)
                    notify()
        except KeyboardInterrupt:
            return
        except (EmaError, OSError) as error:
            notify(f"The folder is no longer watched ({error}); start 'ema view' again.")

    def _shown(self, rows: dict[str, dict[str, Any]], trouble: str) -> dict[str, Any]:
        session = self.session
        following = session.to_strike
        return {
            "next": "" if following is None else str(following),
            "done": session.done,
            "wanted": session.wanted,
            "trouble": trouble,
            "points": [_point(p) for p in session.states()],
            "files": list(reversed(rows.values()))[:SHOWN],
            "count": len(rows),
            "good": sum(r["mark"] != "bad" for r in rows.values()),
            "missing": session.missing(),
        }


def _point(state: PointState) -> dict[str, Any]:
    worst = min(state.coherence, key=lambda k: state.coherence[k]) if state.coherence else ""
    value = state.coherence.get(worst)
    return {
        "point": str(state.point), "good": state.good, "wanted": state.wanted, "done": state.good >= state.wanted,
        "coherence": None if value is None else f"{value:.3f}", "channel": worst,
        "low": value is not None and value < LEAST_COHERENCE,
    }  # fmt: skip


def _row(told: Told) -> dict[str, Any]:
    """One file: its mark, point and force, and what is wrong with it."""
    row = {"file": told.file, "at": time.strftime("%H:%M:%S"), "mark": "bad", "point": "", "force": ""}
    record = told.record
    if record is None:
        return row | {"what": told.text.partition(": ")[2]}
    hit = next((h for h in record.hits if h.accepted), record.hits[0])
    return row | {
        "mark": "bad" if not record.good else "care" if record.faults or record.remarks else "good",
        "point": str(record.impact),
        "force": f"{plain(abs(hit.peak_force), 3)} {hit.force_unit}" if hit.peak_force else "",
        "what": "; ".join((*record.faults, *record.remarks) or _agreement(record)),
    }


def _agreement(record: JudgedRecord) -> tuple[str, ...]:
    if not record.coherence:
        return ()
    worst = min(record.coherence, key=lambda k: record.coherence[k])
    return (f"coherence so far {record.coherence[worst]:.3f} or more ({worst})",)


def serve_hits(
    folder: Path,
    points: Sequence[str] = (),
    wanted: int = 3,
    poll: bool = False,
    port: int = 0,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the live page of a raw folder in the making until Ctrl-C.

    Parameters
    ----------
    folder : Path
        With a test.toml that describes the channels.
    points, wanted
        As in `watch.session.Session`.
    poll : bool
        For network shares.
    port, ready
        As in `serving.serve_guarded`.

    Raises
    ------
    EmaError
        If test.toml is wrong, or the port is taken.
    """
    page = HitsPage(Session(folder, points, wanted), poll)
    serve_guarded(lambda started: application(page, started), port, ready)


def application(page: HitsPage, started: Started = lambda: None) -> Starlette:
    """The routes of the page, without the guard before them."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        thread = page.start()
        started_soon(started)
        yield
        page.stop()
        await asyncio.to_thread(thread.join, 2.0)

    async def shell(request: Request) -> Response:
        session = page.session
        text = (
            page_templates()
            .get_template("hits.html.j2")
            .render(
                title=session.test.title or session.folder.resolve().name,
                folder=session.folder,
                wanted=session.wanted,
            )
        )
        return HTMLResponse(text)

    async def events(request: Request) -> Response:
        return StreamingResponse(page.listeners.events(page.state), media_type="text/event-stream")

    async def scripts(request: Request) -> Response:
        return script("hits.js")

    routes = [Route("/", shell), Route("/events", events), Route("/hits.js", scripts)]
    return Starlette(routes=routes, lifespan=lifespan)
