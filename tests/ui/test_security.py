"""Fault 26: foreign Host or Origin, POST, sockets without a session, 200 of them, slow readers."""

from __future__ import annotations

import asyncio
import http.client
import re
import socket
import time
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine
from tornado.websocket import WebSocketClientConnection, websocket_connect

from rtid.errors import RtidError
from rtid.ui.release_form import Released
from rtid.ui.security import Door
from rtid.ui.server import MOST_PAGES, MOST_SOCKETS, Workbench, policy
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


def come_in(bench: Workbench) -> str:
    """What a browser that opens the printed address gets to keep, as a Cookie header."""
    page, headers = wait_for_room(bench, path="/?" + urlsplit(bench.url).query, Cookie="")
    assert 'content="0;url=/"' in page
    return headers["Set-Cookie"].split(";")[0]


KEPT: dict[str, str] = {}  # by address


def cookie_of(bench: Workbench) -> str:
    """The cookie of one browser that all tests of a workbench are."""
    if bench.url not in KEPT:
        KEPT[bench.url] = come_in(bench)
    return KEPT[bench.url]


def ask(
    bench: Workbench, method: str = "GET", path: str = "/", **headers: str
) -> tuple[int, str, dict[str, str]]:
    """As a browser that has come in, unless Cookie says otherwise."""
    if "Cookie" not in headers:
        headers["Cookie"] = cookie_of(bench)
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
    known = {"Sec-WebSocket-Protocol": f"bokeh, {token}", "Cookie": cookie_of(bench)} | headers
    return HTTPRequest(f"ws://127.0.0.1:{port_of(bench)}/ws", headers=HTTPHeaders(known))


def test_only_released_files_are_given_and_only_to_friends(
    bench: Workbench, tmp_path: Path
) -> None:
    (tmp_path / "a.dcm").write_bytes(b"table")
    (tmp_path / "b.dcm").write_bytes(b"secret")
    assert ask(bench, path="/release?name=a.dcm")[0] == 404
    bench.session.released = Released((tmp_path / "a.dcm",), (), ())
    status, body, headers = ask(bench, path="/release?name=a.dcm")
    assert (status, body) == (200, "table")
    assert headers["Content-Disposition"].startswith("attachment")
    for name in ("b.dcm", "../a.dcm", "", "%2e%2e%2fb.dcm"):
        assert ask(bench, path=f"/release?name={name}")[0] == 404
    assert ask(bench, path="/release?name=a.dcm", Cookie="")[0] == 401
    bench.session.released = None


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
    assert "default-src 'self'" in policy and "unsafe" not in policy
    own = f"ws://127.0.0.1:{port_of(bench)}"
    assert re.search(rf"connect-src 'self' {own};", policy), "no socket to anywhere else"
    assert "frame-ancestors 'none'" in policy
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
    token = token_of(wait_for_room(bench)[0])

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

    for token in ("guessed", "eyJzZXNzaW9uX2lkIjogImEifQ", token_of(wait_for_room(bench)[0])[:-6]):
        assert done(connect(token)) is None


def test_a_socket_from_our_own_page_is_answered(bench: Workbench) -> None:
    """That the refusals above are not those of a server that refuses all."""
    own = f"http://127.0.0.1:{port_of(bench)}"
    token = token_of(wait_for_room(bench)[0])

    async def connect() -> str | bytes | None:
        request = HTTPRequest(
            own.replace("http", "ws") + "/ws", headers={"Origin": own, "Cookie": cookie_of(bench)}
        )
        opened = await websocket_connect(request, subprotocols=["bokeh", token])
        answer = await asyncio.wait_for(opened.read_message(), 10)
        await closed(opened)
        return answer

    assert "ACK" in str(done(connect()))


async def closed(opened: WebSocketClientConnection) -> None:
    """Close a socket, and wait until the server has closed its end too."""
    opened.close()
    while await asyncio.wait_for(opened.read_message(), 10) is not None:
        pass


def done(answer: Coroutine[Any, Any, T]) -> T:
    """The answer, from a thread of its own: a browser may keep a loop running in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, answer).result()


def wait_for_room(bench: Workbench, **asked: str) -> tuple[str, dict[str, str]]:
    """The page and its headers, as soon as pages that nobody looked at have been forgotten."""
    for _ in range(60):
        status, page, headers = ask(bench, **asked)
        if status == 200:
            return page, headers
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
    token = token_of(wait_for_room(bench)[0])

    async def connect() -> list[int]:
        answers, kept = [], []
        for _ in range(200):
            request = HTTPRequest(
                own.replace("http", "ws") + "/ws",
                headers={"Origin": own, "Cookie": cookie_of(bench)},
            )
            try:
                kept.append(await websocket_connect(request, subprotocols=["bokeh", token]))
                answers.append(101)
            except HTTPClientError as refusal:
                answers.append(refusal.code)
        for one in kept:
            await closed(one)
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


NOBODYS = ("", "bokeh", "bokeh, \xff", "bokeh, a", "bokeh, a.b", "bokeh, YWJj.x", "x, y, z")
PATHS_OF_STRANGERS = (
    *("/static/%00", "/static/a%00b.js", "/static/js/%00", "/static/%ff%fe", "/static/", "/%00"),
    *("/static/js", "/static/%2e%2e/%2e%2e/etc/passwd", "/static//etc/passwd", "/static/%", "/%ff"),
    *("/static/" + "a" * 5000, "/static/" + "a/" * 3000, "/static/js/bokeh.min.js?v=%00", "*"),
    *("/?bokeh-token=abc", "/?bokeh-token=%ff", "/?bokeh-session-id=a.%C3%BF", "/?token=%ff"),
    *("/?token=%0d%0aX:1", "/?token=%E2%82%AC", "/?" + "a=1&" * 3000, "/?a=" + "b" * 14_000),
    *("/?%00", "/?<script>", "/ws?x=%00", "/alive?%ff", "//", "/..;/", "http://evil/", "/\xff"),
)
HEADERS_OF_STRANGERS = (
    *("Origin: http://[", "Origin: \xff", "Origin: ", "Sec-WebSocket-Origin: http://[::"),
    *("Bokeh-Session-Id: a.\xff", "Cookie: \xff=\xff; a", "Cookie: " + "a=b;" * 2000),
    *("Range: bytes=zz", "Range: bytes=9999999999-", "If-Modified-Since: no", "Content-Length: y"),
    *("Content-Length: -1", "Content-Length: x", "Content-Length: 99999999999", "Host: ["),
    *("If-None-Match: \xff", "Expect: nothing"),
    *(f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
      f"Sec-WebSocket-Key: a\r\nSec-WebSocket-Protocol: {words}" for words in NOBODYS),
)  # fmt: skip
METHODS = ("POST", "PUT", "HEAD", "TRACE", "CONNECT", "PROPFIND", "get", "G\0T", "")
ROUTES = ("/", "/static/js/bokeh.min.js", "/ws", "/alive")


def status_of(bench: Workbench, method: str, path: str, header: str = "") -> int:
    """Of the answer to a request as it is typed; 0: the connection was closed without one."""
    head = "" if header.startswith("Host:") else f"Host: 127.0.0.1:{port_of(bench)}\r\n"
    head += "" if header.startswith("Cookie:") else f"Cookie: {cookie_of(bench)}\r\n"
    asked = f"{method} {path} HTTP/1.1\r\n{head}Connection: close\r\n{header}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port_of(bench)), 10) as raw:
        raw.sendall(asked.encode("latin-1"))
        words = raw.recv(100).split()
    return int(words[1]) if len(words) > 1 else 0


def test_whatever_a_stranger_asks_is_answered_without_a_fault_of_the_server(
    bench: Workbench, caplog: pytest.LogCaptureFixture
) -> None:
    """Odd bytes, long paths, wrong methods, hostile queries and headers, bodies without end."""
    wait_for_room(bench)
    asked = [("GET", path, "") for path in PATHS_OF_STRANGERS]
    asked += [("GET", path, header) for path in ROUTES for header in HEADERS_OF_STRANGERS]
    asked += [(method, path, "") for path in (*ROUTES, "/static/%00") for method in METHODS]
    for method, path, header in asked:
        status = status_of(bench, method, path, header)
        assert status == 0 or 200 <= status < 500 or status == 503, (method, path, header)
    faults = [line for line in caplog.records if line.exc_info]
    assert [line.getMessage() for line in faults] == []
    assert wait_for_room(bench)


def _request(host: str, path: str = "/", **headers: str) -> HTTPServerRequest:
    line = RequestStartLine("GET", path, "HTTP/1.1")
    known = HTTPHeaders({"Host": f"{host}:5006"} | headers)
    return HTTPServerRequest(start_line=line, headers=known)


def test_a_token_is_needed_everywhere() -> None:
    for host in ("device", "127.0.0.1"):
        door, request = Door(host, "secret-token", 5006), partial(_request, host)
        secret = door.admit(request("/?token=secret-token"))
        assert (refusal := door.refusal(request())) is not None and refusal.status == 401
        assert door.refusal(request("/?token=secret-token")) is None
        for path in ("/?token=another", "/?token=", "/ws?token=secret-token", "/alive"):
            assert door.refusal(request(path)) is not None
        assert door.refusal(request(Cookie=f"rtid-browser-5006={secret}")) is None
        for cookie in (f"rtid-browser={secret}", "rtid-browser-5006=", "rtid-browser-5006=x"):
            assert door.refusal(request(Cookie=cookie)) is not None
        own = request(Cookie=f"rtid-browser-5006={secret}", Origin="http://evil.example")
        assert door.refusal(own) is not None


def test_another_user_of_this_machine_gets_nothing(bench: Workbench) -> None:
    """Loopback is open to everybody here: page, socket, scripts and /alive need the token."""
    for path in ("/", "/ws", "/static/js/bokeh.min.js", "/alive", "/?token=guessed"):
        status, page, headers = ask(bench, path=path, Cookie="")
        assert status == 401 and "token" not in headers.get("Set-Cookie", ""), path
        assert "printed" in page


def test_each_browser_has_a_secret_of_its_own(bench: Workbench) -> None:
    first, second = come_in(bench), come_in(bench)
    assert first != second and bench.app.door.token not in first + second
    path = "/?" + urlsplit(bench.url).query
    again = ask(bench, path=path, Cookie=first)[2]["Set-Cookie"]
    assert again.split(";")[0] == first, "one that comes again stays what it was"
    assert "HttpOnly" in again and "SameSite=Strict" in again


def test_no_more_browsers_are_known_than_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtid.ui.security.MOST_BROWSERS", 3)
    door = Door("device", "secret-token")
    secrets = [door.admit(_request("device", "/?token=secret-token")) for _ in range(5)]
    assert list(door.browsers) == secrets[2:]


def test_what_is_inline_in_a_page_has_its_nonce_and_another_page_another(bench: Workbench) -> None:
    nonces = set()
    for _ in range(2):
        page, headers = wait_for_room(bench)
        told = re.search(r"script-src 'self' 'nonce-([^']+)'", headers["Content-Security-Policy"])
        assert told is not None
        inline = re.findall(r"<(script|style)([^>]*)>", page)
        run = [more for _, more in inline if "src=" not in more and "application/json" not in more]
        assert len(run) >= 3
        assert all('nonce="' in more for more in run), run
        nonces |= {more.split('nonce="')[1].split('"')[0] for more in run}
        html = re.sub(r"(?s)<(script|style).*?</\1>", "", page)
        assert "<body" in html and " style=" not in html and " onclick=" not in html
    assert len(nonces) == 2


def test_a_host_that_is_no_name_stands_in_no_policy() -> None:
    assert "evil" not in policy("127.0.0.1:1;script-src evil")
    assert "ws://[::1]:5006" in policy("[::1]:5006")


def test_a_taken_port_is_said_in_words(bench: Workbench, tmp_path: Path) -> None:
    taken = served(project=project_file(tmp_path), port=port_of(bench))
    with pytest.raises(RtidError, match="in use") as refusal, taken:
        pass
    assert "--port" in refusal.value.remedy


def test_the_page_names_no_other_host(bench: Workbench) -> None:
    page, _ = wait_for_room(bench)
    loaded = re.findall(r'(?:src|href)\s*=\s*"([^"]+)"', page)
    assert [uri.split("?")[0] for uri in loaded if "/static/" in uri] == ["/static/js/bokeh.min.js"]
    assert all(not re.match(r"(?:https?:)?//", uri) for uri in loaded)
