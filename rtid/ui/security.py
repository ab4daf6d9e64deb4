"""Who may come in: this machine's own pages, and whoever has the token where others may call.

A bare server answers any Host, so that a foreign page may reach it under a name of its own (DNS
rebinding), and any page may open a socket to it.  Here the Host must be ours, an Origin must be the
page's own, only GET is served, GET does nothing but show, and what acts comes through a socket that
only a page served by us can open (signed session).
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from urllib.parse import urlsplit

from tornado.httputil import HTTPServerRequest

LOOPBACK = ("localhost", "127.0.0.1", "::1")
COOKIE = "rtid-token"
TOKEN = "token"


@dataclass(frozen=True)
class Refusal:
    """An HTTP status and the reason in words."""

    status: int
    reason: str


@dataclass(frozen=True)
class Door:
    """host: the name or address that the server is bound to; token: needed unless it is loopback.

    Loopback names are accepted under any port: an SSH tunnel has its own.
    """

    host: str
    token: str = ""

    @property
    def is_local(self) -> bool:
        """True where nobody but this machine can reach the server."""
        return self.host in LOOPBACK

    def refusal(self, request: HTTPServerRequest) -> Refusal | None:
        """Why a request is not served; None where it is."""
        if request.method not in ("GET", "HEAD"):
            return Refusal(405, "only GET is served; actions need the page's own socket")
        host = request.headers.get("Host", "")
        if _name(host) not in self._names:
            return Refusal(403, "this server does not go by that name (Host)")
        origins = request.headers.get_list("Origin") + request.headers.get_list(
            "Sec-Websocket-Origin"
        )
        if any(urlsplit(origin).netloc.lower() != host.lower() for origin in origins):
            return Refusal(403, "a page of another origin may not ask")
        if not self.is_local and not self._has_token(request):
            return Refusal(401, "open the address that `rtid ui` has printed, with its token")
        return None

    @property
    def _names(self) -> tuple[str, ...]:
        return LOOPBACK if self.is_local else (*LOOPBACK, self.host.lower())

    def _has_token(self, request: HTTPServerRequest) -> bool:
        given = [value.decode("utf-8", "replace") for value in request.arguments.get(TOKEN, [])]
        if COOKIE in request.cookies:
            given.append(request.cookies[COOKIE].value)
        return any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given)


def _name(host: str) -> str:
    """Name or address of a Host header, without the port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
