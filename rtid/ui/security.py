"""Who may come in: a browser that has opened the printed address, with its token.

A bare server answers any Host, so that a foreign page may reach it under a name of its own (DNS
rebinding), any page may open a socket to it, and on a machine with several users each of them may
call.  Here the Host must be ours, an Origin must be the page's own, only GET is served, GET does
nothing but show, and what acts comes through a socket that only a page served by us can open
(signed session).  The token of the address is answered with a secret of the browser's own, which
also says which browser it is.
"""

from __future__ import annotations

import hmac
import secrets
from dataclasses import dataclass, field
from urllib.parse import unquote_to_bytes, urlsplit

from tornado.httputil import HTTPServerRequest

from rtid.ui.upload import PLACE

LOOPBACK = ("localhost", "127.0.0.1", "::1")
COOKIE = "rtid-browser"  # and the port: browsers keep one jar for all ports of a host
TOKEN = "token"
MOST_BROWSERS = 1000  # that are known; the oldest has to open the address again
BOKEHS_OWN = "bokeh-"  # arguments and headers by which a page may name its session: ours do not


@dataclass(frozen=True)
class Refusal:
    """An HTTP status and the reason in words."""

    status: int
    reason: str


@dataclass
class Door:
    """host: the name or address that the server is bound to; browsers: their numbers by secret.

    Loopback names are accepted under any port: an SSH tunnel has its own.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    port: int = 0
    browsers: dict[str, int] = field(default_factory=dict)
    _admitted: int = 0

    @property
    def cookie(self) -> str:
        """Name of the cookie that holds a browser's secret."""
        return f"{COOKIE}-{self.port}"

    def admit(self, request: HTTPServerRequest) -> str:
        """The secret of the browser that has come with the token: the one it has, or a new one."""
        given = self._secret(request)
        if given in self.browsers:
            return given
        self._admitted += 1
        secret = secrets.token_urlsafe(24)
        self.browsers[secret] = self._admitted
        while len(self.browsers) > MOST_BROWSERS:
            del self.browsers[next(iter(self.browsers))]
        return secret

    def browser(self, request: HTTPServerRequest) -> int | None:
        """Which browser asks; None for a stranger."""
        return self.browsers.get(self._secret(request))

    @property
    def is_local(self) -> bool:
        """True where nobody but this machine can reach the server."""
        return self.host in LOOPBACK

    def refusal(self, request: HTTPServerRequest) -> Refusal | None:
        """Why a request is not served; None where it is."""
        if request.method not in ("GET", "HEAD") and not _is_upload(request):
            return Refusal(405, "only GET is served; actions need the page's own socket")
        host = request.headers.get("Host", "")
        if _name(host) not in self._names:
            return Refusal(403, "this server does not go by that name (Host)")
        origins = request.headers.get_list("Origin") + request.headers.get_list(
            "Sec-Websocket-Origin"
        )
        if any(_netloc(origin) != host.lower() for origin in origins):
            return Refusal(403, "a page of another origin may not ask")
        if not self.has_token(request) and self.browser(request) is None:
            return Refusal(401, "open the address that `rtid ui` has printed, with its token")
        return _strange(request)

    @property
    def _names(self) -> tuple[str, ...]:
        return LOOPBACK if self.is_local else (*LOOPBACK, self.host.lower())

    def has_token(self, request: HTTPServerRequest) -> bool:
        """Whether the page is asked for by the printed address."""
        given = request.arguments.get(TOKEN, []) if request.path == "/" else []
        return any(hmac.compare_digest(value, self.token.encode()) for value in given)

    def _secret(self, request: HTTPServerRequest) -> str:
        return request.cookies[self.cookie].value if self.cookie in request.cookies else ""


def _is_upload(request: HTTPServerRequest) -> bool:
    """Whether a file of the page itself comes: a browser says from which page it posts."""
    return request.method == "POST" and request.path == PLACE and "Origin" in request.headers


def _strange(request: HTTPServerRequest) -> Refusal | None:
    """Why a request of a friend is not served: what Bokeh's handlers would trip over."""
    named = (*request.arguments, *request.headers)
    if any(name.lower().startswith(BOKEHS_OWN) for name in named):
        return Refusal(400, "a page does not choose its session")
    if b"\0" in unquote_to_bytes(request.path):
        return Refusal(404, "there is nothing here")
    return None


def _netloc(origin: str) -> str:
    """Name and port of an Origin header, "" where it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _name(host: str) -> str:
    """Name or address of a Host header, without the port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
