"""Fault 26: foreign Host or Origin, POST, sockets without a session, 200 of them, slow readers."""

from __future__ import annotations

import asyncio
import http.client
import re
import socket
import time
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine
from tornado.websocket import websocket_connect

from rtid.errors import RtidError
from rtid.ui.security import Door
from rtid.ui.server import MOST_PAGES, MOST_SOCKETS, Workbench
from tests.ui.served import project_file, served

EVIL = ("http://evil.example", "http://localhost:1", "null", "https://127.0.0.1.evil.example")
MOST_MB = 30
T = TypeVar("T")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    with served(project=project_file(tmp_path_factory.mktemp("ui"))) as running:
        yield running


def port_of(bench: Workbench) -> int:
    return urlsplit(bench.url).port or 0


def ask(
    bench: Workbench, method: str = "GET", path: str = "/", **headers: str
) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(bench), timeout=20)
    host = headers.pop("Host", f"127.0.0.1:{port_of(bench)}")
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.putheader("Content-Length", "0")
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read().decode("utf-8", "replace"), dict(answer.getheaders())


def token_of(page: str) -> str:
    found = re.search(r'"token":\s*"([^"]+)"', page)
    assert found
    return found.group(1)


def socket_request(bench: Workbench, token: str, **headers: str) -> HTTPRequest:
    known = {"Sec-WebSocket-Protocol": f"bokeh, {token}"} | headers
    return HTTPRequest(f"ws://127.0.0.1:{port_of(bench)}/ws", headers=HTTPHeaders(known))


def test_it_is_bound_to_this_machine_alone(bench: Workbench) -> None:
    addresses = {s.getsockname()[0] for s in bench.server._http._sockets.values()}
    assert addresses == {"127.0.0.1"}


def test_the_page_is_served_under_the_names_of_this_machine(bench: Workbench) -> None:
    for name in ("127.0.0.1", "localhost", "[::1]"):
        assert ask(bench, Host=f"{name}:{port_of(bench)}")[0] == 200
    assert ask(bench, Host="localhost:9999")[0] == 200  # the near end of an SSH tunnel


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "localhost.evil", "["]
)
@pytest.mark.parametrize("path", ["/", "/ws", "/static/js/bokeh.min.js", "/alive"])
def test_a_foreign_name_is_refused(bench: Workbench, host: str, path: str) -> None:
    assert ask(bench, path=path, Host=host)[0] in (400, 403)


@pytest.mark.parametrize("path", ["/", "/alive", "/static/js/bokeh.min.js", "/nothing"])
def test_every_answer_tells_the_browser_to_load_nothing_from_elsewhere(
    bench: Workbench, path: str
) -> None:
    headers = ask(bench, path=path)[2]
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe-eval" not in policy
    assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize("origin", EVIL)
def test_a_foreign_page_is_refused(bench: Workbench, origin: str) -> None:
    assert ask(bench, Origin=origin)[0] == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_nothing_but_get_is_served(bench: Workbench, method: str) -> None:
    assert ask(bench, method)[0] == 405


@pytest.mark.parametrize(
    "path", ["/metadata", "/autoload.js", "/../etc/passwd", "/static/../../x", "/add", "/index"]
)
def test_no_other_path_leads_anywhere(bench: Workbench, path: str) -> None:
    assert ask(bench, path=path)[0] in (400, 403, 404)


def test_a_get_changes_nothing(bench: Workbench) -> None:
    before = (bench.session.state, len(bench.session.revisions), bench.session.note)
    for query in ("/?do=save", "/?asked=%7B%22do%22:%22save%22%7D", "/?effect=x&do=add"):
        assert ask(bench, path=query)[0] in (200, 503)
    assert (bench.session.state, len(bench.session.revisions), bench.session.note) == before


@pytest.mark.parametrize("origin", EVIL)
def test_a_socket_from_a_foreign_page_is_refused(bench: Workbench, origin: str) -> None:
    token = token_of(wait_for_room(bench))

    async def connect() -> None:
        with pytest.raises(HTTPClientError) as refusal:
            await websocket_connect(socket_request(bench, token, Origin=origin))
        assert refusal.value.code == 403

    done(connect())


def test_a_socket_without_a_page_of_ours_learns_nothing(bench: Workbench) -> None:
    async def connect(token: str) -> str | bytes | None:
        try:
            opened = await websocket_connect(
                socket_request(bench, token, Origin=f"http://127.0.0.1:{port_of(bench)}"),
                subprotocols=["bokeh", token],
            )
        except HTTPClientError:
            return None
        return await asyncio.wait_for(opened.read_message(), 10)

    for token in ("guessed", "eyJzZXNzaW9uX2lkIjogImEifQ", token_of(wait_for_room(bench))[:-6]):
        assert done(connect(token)) is None


def test_a_socket_from_our_own_page_is_answered(bench: Workbench) -> None:
    """That the refusals above are not those of a server that refuses all."""
    own = f"http://127.0.0.1:{port_of(bench)}"
    token = token_of(wait_for_room(bench))

    async def connect() -> str | bytes | None:
        request = HTTPRequest(own.replace("http", "ws") + "/ws", headers={"Origin": own})
        opened = await websocket_connect(request, subprotocols=["bokeh", token])
        return await asyncio.wait_for(opened.read_message(), 10)

    assert "ACK" in str(done(connect()))


def done(answer: Coroutine[Any, Any, T]) -> T:
    """The answer, from a thread of its own: a browser may keep a loop running in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, answer).result()


def wait_for_room(bench: Workbench) -> str:
    """The page, as soon as pages that nobody looked at have been forgotten."""
    for _ in range(60):
        status, page, _ = ask(bench)
        if status == 200:
            return page
        assert status == 503
        time.sleep(0.5)
    raise AssertionError("unused pages are never forgotten")


def rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def test_many_sockets_and_pages_are_bounded(bench: Workbench) -> None:
    """200 raw connections that say nothing and 200 that ask for a page: memory stays, page too."""
    wait_for_room(bench)
    before = rss_mb()
    idle = [socket.create_connection(("127.0.0.1", port_of(bench)), 10) for _ in range(200)]
    statuses = [ask(bench)[0] for _ in range(200)]
    assert set(statuses) <= {200, 503}
    assert statuses.count(200) <= 3 * MOST_PAGES
    assert ask(bench, path="/alive")[0] == 204
    assert rss_mb() - before < MOST_MB
    for one in idle:
        one.close()
    assert wait_for_room(bench)


def test_the_sockets_of_one_page_are_bounded(bench: Workbench) -> None:
    """200 sockets with the token of one page of ours: a few are served, memory stays."""
    own, before = f"http://127.0.0.1:{port_of(bench)}", rss_mb()
    token = token_of(wait_for_room(bench))

    async def connect() -> list[int]:
        answers, kept = [], []
        for _ in range(200):
            request = HTTPRequest(own.replace("http", "ws") + "/ws", headers={"Origin": own})
            try:
                kept.append(await websocket_connect(request, subprotocols=["bokeh", token]))
                answers.append(101)
            except HTTPClientError as refusal:
                answers.append(refusal.code)
        for one in kept:
            one.close()
        return answers

    answers = done(connect())
    assert set(answers) == {101, 503}
    assert answers.count(101) <= MOST_SOCKETS + 1
    assert rss_mb() - before < MOST_MB
    assert wait_for_room(bench)


def test_a_header_or_message_without_end_is_cut(bench: Workbench) -> None:
    with socket.create_connection(("127.0.0.1", port_of(bench)), 10) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 40_000)
        assert raw.recv(100)[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 431")


def request(path: str = "/", **headers: str) -> HTTPServerRequest:
    line = RequestStartLine("GET", path, "HTTP/1.1")
    known = HTTPHeaders({"Host": "device:5006"} | headers)
    return HTTPServerRequest(start_line=line, headers=known)


def test_beyond_this_machine_a_token_is_needed() -> None:
    door = Door("device", "secret-token")
    assert (refusal := door.refusal(request())) is not None
    assert refusal.status == 401
    assert door.refusal(request(Cookie="rtid-token=secret-token")) is None
    assert door.refusal(request(Cookie="rtid-token=secret-tokem")) is not None
    assert door.refusal(request(Cookie="rtid-token=")) is not None
    assert door.refusal(request("/?token=secret-token")) is None
    assert door.refusal(request("/?token=another")) is not None
    foreign = request(Cookie="rtid-token=secret-token", Origin="http://evil.example")
    assert door.refusal(foreign) is not None


def test_the_token_leaves_the_address_at_once(tmp_path: Path) -> None:
    with served(project=project_file(tmp_path), host="0.0.0.0") as bench:
        host = f"127.0.0.1:{port_of(bench)}"
        assert ask(bench, Host=host)[0] == 401
        path = "/?" + urlsplit(bench.url).query
        status, _, headers = ask(bench, path=path, Host=host)
        assert status == 302
        assert headers["Location"] == "/"
        cookie = headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert ask(bench, Host=host, Cookie=cookie.split(";")[0])[0] == 200


def test_a_taken_port_is_said_in_words(bench: Workbench, tmp_path: Path) -> None:
    taken = served(project=project_file(tmp_path), port=port_of(bench))
    with pytest.raises(RtidError, match="in use") as refusal, taken:
        pass
    assert "--port" in refusal.value.remedy


def test_the_page_names_no_other_host(bench: Workbench) -> None:
    page = wait_for_room(bench)
    loaded = re.findall(r'(?:src|href)\s*=\s*"([^"]+)"', page)
    assert [uri.split("?")[0] for uri in loaded if "/static/" in uri] == ["/static/js/bokeh.min.js"]
    assert all(not re.match(r"(?:https?:)?//", uri) for uri in loaded)
