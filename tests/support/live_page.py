"""A live page as a user starts it, and the browser that opens it."""

from __future__ import annotations

import http.client
import re
import signal
import subprocess
import sys
from pathlib import Path


class Page:
    """A running ``ema view``: its folder, process, port and address with the token."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        command = [
            sys.executable,
            "-c",
            "from ema_pipeline.cli import main; main()",
            "view",
            str(folder),
            "--no-browser",
            *options,
        ]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:(\d+)/\?token=\S+", self.process.stdout.readline())
        assert found is not None
        self.address, self.port = found[0], int(found[1])

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, body: str | None = None, **headers: str
    ) -> http.client.HTTPResponse:
        """One request with these headers, an underscore in a name standing for a dash."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
        return connection.getresponse()

    def enter(self) -> str:
        """The cookie for the token."""
        answer = self.ask("GET", self.address.removeprefix(self.origin))
        assert answer.status == 303
        return str(answer.headers["set-cookie"])

    def stop(self) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=15)


def opened(context, address: str):
    """A tab whose page has started; what its script complains of is kept in ``faults``."""
    tab = context.new_page()
    tab.faults = []
    tab.on("pageerror", lambda error: tab.faults.append(str(error)))
    tab.goto(address)
    tab.wait_for_selector("html[data-ready]", timeout=30_000)
    return tab
