"""The server of the workbench: Bokeh's documents behind our own door, on one event loop."""

from __future__ import annotations

import asyncio
import gc
import logging
import re
import secrets
import signal
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.embed.server import server_html_page_for_session
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.doc_handler import DocHandler
from bokeh.server.views.static_handler import StaticHandler
from bokeh.util.token import check_token_signature, get_session_id, get_token_payload
from tornado.escape import url_escape
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPMessageDelegate, HTTPServerRequest
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets
from tornado.web import OutputTransform, RequestHandler

from rtid.errors import RtidError
from rtid.plain import give_back
from rtid.ui.arrival import Arrival, choose
from rtid.ui.browser_page import build
from rtid.ui.live_page import Live
from rtid.ui.packing import Packed, Packing
from rtid.ui.parcel import unread
from rtid.ui.release_form import PLACE as RELEASED
from rtid.ui.security import TOKEN, Door, Refusal
from rtid.ui.shared import Session
from rtid.ui.turns import Turns
from rtid.ui.upload import PLACE, Upload
from rtid.ui.worker import Worker

if TYPE_CHECKING:
    from bokeh.protocol import Protocol
    from bokeh.server.connection import ServerConnection
    from bokeh.server.contexts import ApplicationContext
    from bokeh.server.session import ServerSession
    from bokeh.server.views.ws import WSHandler

MOST_PAGES = 24  # that are open at once
MOST_SOCKETS = 2  # of one page: one that comes back after a break has two for a moment
MOST_MESSAGE = 2**20  # bytes that a page may send at once
BODY_S = 10.0  # that the body of a request may take; none is read
TRIM_MS = 5e3  # between two times that freed memory goes back: a picture's message is 20 MB
CSP = "Content-Security-Policy"
WELCOME = """<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><title>rtid</title>
<noscript><meta http-equiv="refresh" content="0;url=/"></noscript>
<script nonce="{nonce}">location.replace("/" + location.hash)</script>"""
PATHS = ("/", "/ws", "/alive", PLACE, RELEASED)
HOST = re.compile(r"[\w.\-\[\]:]+")  # what may stand in a policy


def policy(host: str, nonce: str = "") -> str:
    """The Content-Security-Policy of an answer: own files, own socket, own script and style alone.

    nonce: of the page's own script and style; without one nothing inline counts.
    """
    inline = f" 'nonce-{nonce}'" if nonce else ""
    socket = f" ws://{host}" if HOST.fullmatch(host) else ""  # for browsers whose 'self' is http
    return (
        f"default-src 'self'; script-src 'self'{inline}; style-src 'self'{inline}; "
        f"img-src 'self' data: blob:; connect-src 'self'{socket}; frame-ancestors 'none'; "
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


class Download(RequestHandler):
    """Gives the files of the last release, by their names, and no others."""

    def initialize(self, session: Session) -> None:
        """Whose."""
        self._session = session

    def get(self) -> None:
        """One file, to be saved."""
        released, name = self._session.offered, self.get_query_argument("name", "")
        path = next((p for p in released.files if p.name == name), None) if released else None
        if path is None or not path.is_file():
            self.set_status(404)
            self.finish("rtid: no such file was released\n")
            return
        self.set_header("Content-Type", "application/octet-stream")
        self.set_header("Content-Disposition", f"attachment; filename*=UTF-8''{url_escape(name)}")
        self.set_header("Cache-Control", "no-store")
        self.finish(path.read_bytes())


class Welcome(RequestHandler):
    """Gives the browser that has the token a secret of its own, and takes the token out of sight.

    The browser is sent on by the page itself and not by a redirect: behind a link from elsewhere it
    would not bring its new cookie along.
    """

    def get(self) -> None:
        """Go on to the page; the door has seen that the token is the right one."""
        door: Door = self.application.door  # type: ignore[attr-defined]
        secret = door.admit(self.request)
        self.set_cookie(door.cookie, secret, httponly=True, samesite="Strict")
        self.set_header("Cache-Control", "no-store")
        nonce = secrets.token_urlsafe(18)
        self.set_header(CSP, policy(self.request.headers.get("Host", ""), nonce))
        self.finish(WELCOME.format(nonce=nonce))


class Shown(DocHandler):  # type: ignore[misc]
    """A page: what is inline in it has a nonce of its own."""

    async def get(self, *args: Any, **kwargs: Any) -> None:
        """Bokeh's page, by our policy."""
        session = await self.get_session()
        nonce = secrets.token_urlsafe(18)
        variables = session.document.template_variables | {"nonce": nonce}
        page = server_html_page_for_session(
            session,
            resources=self.application.resources(),
            title=session.document.title,
            template=session.document.template,
            template_variables=variables,
        )
        self.set_header("Content-Type", "text/html")
        self.set_header("Cache-Control", "no-store")
        self.set_header(CSP, policy(self.request.headers.get("Host", ""), nonce))
        self.write(page)


class Policy(OutputTransform):
    """Tells the browser, with every answer, to load nothing from elsewhere and to frame nothing."""

    def __init__(self, request: HTTPServerRequest) -> None:
        super().__init__(request)
        self._host = request.headers.get("Host", "")

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the headers."""
        headers.setdefault(CSP, policy(self._host))
        headers["X-Content-Type-Options"] = "nosniff"
        headers["Referrer-Policy"] = "no-referrer"
        return status_code, headers, chunk


class Numbered(Application):  # type: ignore[misc]
    """Tells each page which browser it is shown in."""

    def __init__(self, door: Door, *handlers: Any) -> None:
        super().__init__(*handlers)
        self._door = door

    def process_request(self, request: HTTPServerRequest) -> dict[str, Any]:
        """What the page's signed session knows of the request."""
        return {"browser": self._door.browser(request) or 0}


class Guarded(BokehTornado):  # type: ignore[misc]
    """Bokeh's application, with the door in front of every request, sockets included."""

    def __init__(self, door: Door, app: Application, turns: Turns, **options: Any) -> None:
        self.door, self._turns = door, turns
        self.refused = 0
        super().__init__({"/": app}, transforms=[Policy], **options)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> HTTPMessageDelegate:
        """The handler of a request, or one that refuses it."""
        refusal = (
            self.door.refusal(request)
            or self._elsewhere(request)
            or self._unknown(request)
            or self._full(request)
        )
        if refusal is None and self.door.has_token(request):
            return self.get_handler_delegate(request, Welcome)
        if refusal is None and request.path == "/":
            context = {
                "application_context": self._applications["/"],
                "bokeh_websocket_path": "/ws",
            }
            return self.get_handler_delegate(request, Shown, context)
        if refusal is None:
            return super().find_handler(request, **kwargs)
        self.refused += 1
        return self.get_handler_delegate(request, Refused, {"refusal": refusal})

    def _elsewhere(self, request: HTTPServerRequest) -> Refusal | None:
        known = request.path in PATHS or request.path.startswith("/static/")
        return None if known else Refusal(404, "there is nothing here")

    def _unknown(self, request: HTTPServerRequest) -> Refusal | None:
        """A socket that has no token of a page of ours, or one that is too old."""
        if request.path != "/ws":
            return None
        offered = request.headers.get("Sec-WebSocket-Protocol", "").split(",")
        if len(offered) == 2 and offered[0].strip() == "bokeh" and self._is_ours(offered[1]):
            return None
        return Refusal(403, "a socket belongs to a page of ours: load the page again")

    def _is_ours(self, token: str) -> bool:
        try:
            is_signed = check_token_signature(token.strip(), self.secret_key, self.sign_sessions)
            return is_signed and get_token_payload(token.strip())["session_expiry"] > time.time()
        except (ValueError, TypeError, LookupError, AttributeError, zlib.error):  # no token at all
            return False

    def _full(self, request: HTTPServerRequest) -> Refusal | None:
        pages = {session.id: session for session in self.get_sessions("/")}
        if request.path == "/" and len(pages) >= MOST_PAGES:
            said = f"{len(pages)} pages are open already: close one and wait a moment"
            return Refusal(503, said)
        if request.path == "/ws":
            token = request.headers["Sec-WebSocket-Protocol"].split(",")[1].strip()
            page = pages.get(get_session_id(token))
            if page is not None and page.connection_count >= MOST_SOCKETS:
                return Refusal(503, "too many sockets of this page are open already")
        return None

    def new_connection(
        self,
        protocol: Protocol,
        socket: WSHandler,
        context: ApplicationContext,
        page: ServerSession,
    ) -> ServerConnection:
        """A socket of a page has come."""
        connection = Packed(Packing(self._turns), socket, context, page)
        self._clients.add(connection)
        return connection

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
    turns: Turns
    trimming: PeriodicCallback

    def stop(self) -> None:
        """End server and worker; call from the loop's thread."""
        self.session.worker.stop()
        self.server.stop()
        self.trimming.stop()
        self.turns.stop()
        gc.unfreeze()


def start(
    project: Path | None,
    trace: Path | None = None,
    state: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    sheet: Path | None = None,
    test_bus: bool = False,
    worker: Worker | None = None,
    more: Sequence[Path] = (),
) -> Workbench:
    """Begin to serve on the current event loop; port 0: any that is free.

    project: None where there is none yet; state: folder in which a daemon keeps its state, for the
    live page; test_bus: maps may be sent over a bus that anybody may write to; worker: one that was
    started ahead; more: further records of the same fit.  Raises RtidError where the port is taken.
    """
    worker = worker or Worker()
    logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)  # a tab may be closed
    loop, sockets = IOLoop.current(), _bound(host, port)
    worker.on_loop = loop.add_callback
    session = _session(project, trace, worker, sheet, state, test_bus, more)
    turns = Turns(loop.call_later)
    door = Door(host, port=sockets[0].getsockname()[1])
    guarded = _guarded(door, session, Live(state), turns)
    http = HTTPServer(
        guarded,
        max_header_size=2**14,
        max_body_size=2**16,
        idle_connection_timeout=60,
        body_timeout=BODY_S,
    )
    http.add_sockets(sockets)
    server = BaseServer(loop, guarded, http)
    server.start()
    session.open()
    # Bokeh collects all garbage twice for each page that goes, 0.14 s of the loop each time; what
    # is here already is not looked at again.
    gc.collect()
    gc.freeze()
    if trace is not None or project is None:  # now, not while somebody waits for a picture
        ahead = partial(import_module, "rtid.ui.desk_views")
        threading.Thread(target=ahead, name="rtid-ahead", daemon=True).start()
    url = f"http://{_in_url(host)}:{door.port}/?{TOKEN}={door.token}"
    trimming = PeriodicCallback(_let_go, TRIM_MS)
    trimming.start()
    return Workbench(server, guarded, session, url, turns, trimming)


def _let_go() -> None:
    """Give back what pictures took while they were drawn."""
    unread()
    give_back()


def _bound(host: str, port: int) -> list[socket]:
    try:
        return bind_sockets(port, host)
    except OSError as error:
        remedy = "another `rtid ui` may be running; --port 0 takes any free port"
        raise RtidError(f"{host}:{port}: {error.strerror}", remedy) from None


def _session(
    project: Path | None,
    trace: Path | None,
    worker: Worker,
    sheet: Path | None,
    state: Path | None,
    test_bus: bool,
    more: Sequence[Path],
) -> Session:
    """Of a project and its trace; without a project, of a file that is made one of."""
    if project is not None:
        return Session(project, trace, worker, sheet, tuple(more), folder=state, test_bus=test_bus)
    folder = trace.resolve().parent if trace else Path.cwd()
    others = tuple(path.resolve() for path in more)
    return Session(
        folder, None, worker, arrival=Arrival(folder, trace and trace.resolve(), more=others)
    )


def _guarded(door: Door, session: Session, live: Live, turns: Turns) -> Guarded:
    """The pages of a session, and what else is served, behind the door."""
    make = partial(build, session=session, live=live, turns=turns)
    return Guarded(
        door,
        Numbered(door, FunctionHandler(make)),
        turns,
        extra_patterns=[
            ("/alive", Alive),
            (RELEASED, Download, {"session": session}),
            *_uploads(session),
        ],
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


def _uploads(session: Session) -> list[tuple[str, type, dict[str, object]]]:
    """Files come as long as there is no project."""
    if session.arrival is None:
        return []

    def folder() -> Path | None:
        return session.arrival.folder if session.arrival else None

    def arrived(path: Path) -> None:
        if session.arrival is not None:
            choose(session, session.arrival, path)

    return [(PLACE, Upload, {"folder": folder, "arrived": arrived})]


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def serve(ready: Callable[[Workbench], None], **where: Any) -> None:
    """Serve until interrupted, SIGTERM or SIGHUP; call it in the main thread.

    `ready` is told once the page can be opened.  A signal that is ignored, as by nohup, stays so.
    """

    async def forever() -> None:
        over = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                asyncio.get_running_loop().add_signal_handler(number, over.set)
        bench = start(**where)
        try:
            ready(bench)
            await over.wait()
        finally:
            bench.stop()

    asyncio.run(forever())


__all__ = ["MOST_PAGES", "Guarded", "Workbench", "serve", "start"]
