"""One check before every answer: who asks, from which page, and under which name of this machine."""

from __future__ import annotations

import hmac
import secrets
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_NOT_YOURS = (
    "This page belongs to whoever started 'ema view'. Open the address that it printed; each opens one browser. "
    "Start 'ema view' again for another.\n"
)


class Guard:
    """Lets in who holds the session's cookie, and hands it out once, for the token in the printed address.

    Parameters
    ----------
    app : ASGIApp
    port : int
        Port that the server listens on; requests must name it with the loopback address.
    """

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app = app
        self._host = f"127.0.0.1:{port}"
        self._origin = f"http://{self._host}"
        self._cookie = f"ema_{port}"  # cookies do not tell ports apart
        self._secret = secrets.token_urlsafe(32)
        self._token: str | None = secrets.token_urlsafe(32)

    @property
    def address(self) -> str:
        """Where a browser gets in, once."""
        return f"{self._origin}/?token={self._token}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or hand on to the application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
            await send(message)

        answer = self._answer(scope)
        await (self._app if answer is None else answer)(scope, receive, guarded)

    def _answer(self, scope: Scope) -> Response | None:
        """What is answered at once; None where the request may pass."""
        headers = Headers(scope=scope)
        if headers.getlist("host") != [self._host] or not self._from_own_page(scope["method"], headers):
            return PlainTextResponse("refused\n", status_code=403)
        known = self._knows(headers)
        if scope["method"] == "GET" and scope["path"] == "/" and scope["query_string"]:
            return self._enter(scope["query_string"].decode("latin-1"), known)
        return None if known else PlainTextResponse(_NOT_YOURS, status_code=403)

    def _from_own_page(self, method: str, headers: Headers) -> bool:
        """True unless the browser says that another page asks; what changes something must say where it comes from."""
        origins = headers.getlist("origin")
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return False
        if method == "GET":
            return origins in ([], [self._origin])
        return origins == [self._origin]

    def _knows(self, headers: Headers) -> bool:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        given = cookies[self._cookie].value if self._cookie in cookies else ""
        return hmac.compare_digest(given.encode(), self._secret.encode())

    def _enter(self, query: str, known: bool) -> Response:
        """The cookie for the token, which is used up by that."""
        given = parse_qs(query).get("token", [""])[0]
        if self._token is not None and hmac.compare_digest(given.encode(), self._token.encode()):
            self._token = None
            response = RedirectResponse("/", status_code=303)
            response.set_cookie(self._cookie, self._secret, path="/", httponly=True, samesite="strict")
            return response
        if known:
            return RedirectResponse("/", status_code=303)
        return PlainTextResponse(_NOT_YOURS, status_code=403)
