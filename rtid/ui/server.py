"""The server of the workbench: Bokeh's documents behind our own door, on one event loop."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.static_handler import StaticHandler
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPMessageDelegate, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets
from tornado.web import OutputTransform, RequestHandler

from rtid.errors import RtidError
from rtid.ui.live import Live
from rtid.ui.page import build
from rtid.ui.security import COOKIE, TOKEN, Door, Refusal
from rtid.ui.session import Session
from rtid.ui.worker import Worker

MOST_PAGES = 8  # that are open at once
MOST_SOCKETS = 2 * MOST_PAGES  # a page that comes back after a break has two for a moment
MOST_MESSAGE = 2**20  # bytes that a page may send at once
PATHS = ("/", "/ws", "/alive")
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self' ws: wss:; frame-ancestors 'none'; "
    "form-action 'none'; base-uri 'none'; object-src 'none'"
)


class Refused(RequestHandler):
    """Says why a request is not served."""

    def initialize(self, refusal: Refusal) -> None:
        """Take the reason."""
        self.refusal = refusal

    def prepare(self) -> None:
        """Answer, whatever was asked."""
        self.set_status(self.refusal.status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"rtid: {self.refusal.reason}\n")


class Alive(RequestHandler):
    """Tells a page that the server is there."""

    def get(self) -> None:
        """Nothing but the answer itself."""
        self.set_status(204)


class Welcome(RequestHandler):
    """Puts the token of the address into a cookie, and out of sight."""

    def get(self) -> None:
        """Go on to the page."""
        token = self.get_argument(TOKEN)
        self.set_cookie(COOKIE, token, httponly=True, samesite="Strict")
        self.redirect("/")


class Policy(OutputTransform):
    """Tells the browser, with every answer, to load nothing from elsewhere and to frame nothing."""

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the headers."""
        headers["Content-Security-Policy"] = POLICY
        headers["X-Content-Type-Options"] = "nosniff"
        headers["Referrer-Policy"] = "no-referrer"
        return status_code, headers, chunk


class Guarded(BokehTornado):  # type: ignore[misc]
    """Bokeh's application, with the door in front of every request, sockets included."""

    def __init__(self, door: Door, app: Application, **options: Any) -> None:
        self.door = door
        self.refused = 0
        super().__init__({"/": app}, transforms=[Policy], **options)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> HTTPMessageDelegate:
        """The handler of a request, or one that refuses it."""
        refusal = self.door.refusal(request) or self._elsewhere(request) or self._full(request)
        if refusal is None and request.path == "/" and TOKEN in request.arguments:
            return self.get_handler_delegate(request, Welcome)
        if refusal is None:
            return super().find_handler(request, **kwargs)
        self.refused += 1
        return self.get_handler_delegate(request, Refused, {"refusal": refusal})

    def _elsewhere(self, request: HTTPServerRequest) -> Refusal | None:
        known = request.path in PATHS or request.path.startswith("/static/")
        return None if known else Refusal(404, "there is nothing here")

    def _full(self, request: HTTPServerRequest) -> Refusal | None:
        sessions = list(self.get_sessions("/"))
        sockets = sum(session.connection_count for session in sessions)
        if request.path == "/" and len(sessions) >= MOST_PAGES:
            said = f"{len(sessions)} pages are open already: close one and wait a moment"
            return Refusal(503, said)
        if request.path == "/ws" and sockets >= MOST_SOCKETS:
            return Refusal(503, "too many sockets are open already")
        return None

    def resources(self, absolute_url: str | bool | None = None) -> Resources:
        """Bokeh's scripts from this server, and of these only the one that our pages need."""
        version = StaticHandler.append_version
        return Resources("server", components=["bokeh"], root_url="/", path_versioner=version)

    def log_request(self, handler: RequestHandler) -> None:
        """Nothing: a desk is no web shop."""


@dataclass(frozen=True)
class Workbench:
    """A running server; `url` opens it."""

    server: BaseServer
    app: Guarded
    session: Session
    url: str

    def stop(self) -> None:
        """End server and worker; call from the loop's thread."""
        self.session.worker.stop()
        self.server.stop()


def start(
    project: Path,
    trace: Path | None = None,
    state: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    sheet: Path | None = None,
) -> Workbench:
    """Begin to serve on the current event loop; port 0: any that is free.

    state: folder in which a daemon keeps its state, for the live page.  Raises RtidError where the
    port is taken.
    """
    if trace is not None:
        import_module("rtid.ui.desk_views")  # now, not while somebody waits for a picture
    loop = IOLoop.current()
    worker = Worker(loop.add_callback)
    session = Session(project, trace, worker, sheet)
    door = Door(host, "" if Door(host).is_local else secrets.token_urlsafe(24))
    live = Live(state)
    app = Application(FunctionHandler(partial(build, session=session, live=live)))
    guarded = Guarded(
        door,
        app,
        extra_patterns=[("/alive", Alive)],
        extra_websocket_origins=["*"],  # the door is stricter
        secret_key=secrets.token_bytes(32),
        sign_sessions=True,
        use_index=False,
        redirect_root=False,
        keep_alive_milliseconds=20_000,
        unused_session_lifetime_milliseconds=10_000,
        check_unused_sessions_milliseconds=2_000,
        websocket_max_message_size_bytes=MOST_MESSAGE,
        include_headers=[],
        include_cookies=[],
    )
    try:
        sockets = bind_sockets(port, host)
    except OSError as error:
        worker.stop()
        remedy = "another `rtid ui` may be running; --port 0 takes any free port"
        raise RtidError(f"{host}:{port}: {error.strerror}", remedy) from None
    http = HTTPServer(
        guarded, max_header_size=2**14, max_body_size=2**16, idle_connection_timeout=60
    )
    http.add_sockets(sockets)
    server = BaseServer(loop, guarded, http)
    server.start()
    session.open()
    url = f"http://{_in_url(host)}:{sockets[0].getsockname()[1]}/"
    return Workbench(
        server, guarded, session, url + (f"?{TOKEN}={door.token}" if door.token else "")
    )


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def serve(ready: Callable[[Workbench], None], **where: Any) -> None:
    """Serve until interrupted; `ready` is told once the page can be opened."""

    async def forever() -> None:
        bench = start(**where)
        ready(bench)
        try:
            await asyncio.Event().wait()
        finally:
            bench.stop()

    asyncio.run(forever())


__all__ = ["COOKIE", "MOST_PAGES", "Guarded", "Workbench", "serve", "start"]
