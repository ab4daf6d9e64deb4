"""Metrics over HTTP, in a process beside the daemon: it reads the status file, and nothing else.

The daemon itself opens no port, so a scraper cannot reach its loop, whatever it sends.  Only
`GET /metrics` is answered, one request after the other.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from rtid.daemon.metrics import exposition
from rtid.daemon.status import StatusError, read
from rtid.errors import RtidError

PATIENCE_S = 5.0  # that a request may take to come
KIND = "text/plain; version=0.0.4; charset=utf-8"
LOOPBACK = "127.0.0.1"


class Scraped(BaseHTTPRequestHandler):
    """Answers a scraper."""

    timeout = PATIENCE_S

    def __init__(self, folder: Path, clock: Callable[[], float], *request: Any) -> None:
        self._folder, self._clock = folder, clock
        super().__init__(*request)

    def do_GET(self) -> None:
        """The metrics of now; 503 where no daemon has told anything."""
        if self.path.partition("?")[0] != "/metrics":
            self._answer(404, "there is /metrics\n")
            return
        try:
            status = read(self._folder)
        except StatusError as error:
            self._answer(503, f"{error}\n")
            return
        self._answer(200, exposition(status, self._clock() - status.now_unix_s))

    def _answer(self, code: int, text: str) -> None:
        data = text.encode()
        self.send_response(code)
        self.send_header("Content-Type", KIND)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_words: object) -> None:
        """Nothing: a scraper asks every few seconds."""


def server(folder: Path, place: str, clock: Callable[[], float] = time.time) -> HTTPServer:
    """A server that is bound, for `serve_forever`; place: PORT or HOST:PORT, of this machine alone.

    Raises RtidError where the place is none, or is taken.
    """
    host, _, port = place.rpartition(":")
    try:
        return HTTPServer((host or LOOPBACK, int(port)), partial(Scraped, folder, clock))
    except (ValueError, OverflowError):
        raise RtidError(f"{place!r} is no PORT or HOST:PORT", "--serve 9465", 2) from None
    except OSError as error:
        raise RtidError(f"{place}: {error.strerror}", "name another port") from None
