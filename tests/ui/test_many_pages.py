"""Twenty pages at once: each gets its document, packed beside the loop, which goes on answering."""

from __future__ import annotations

import asyncio
import gc
import json
import threading
import time
import warnings
from asyncio import events
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from bokeh.protocol import Protocol
from tornado.websocket import websocket_connect

from rtid.ui.packing import Packed, Packing
from rtid.ui.server import Workbench
from rtid.ui.turns import Turns
from tests.ui.served import project_file, served
from tests.ui.test_security import ask, closed, done, socket_request, token_of

PAGES = 20
MOST_S = 0.05  # of processor time that the loop may take in one go


@contextmanager
def longest(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """Processor time of each piece of work of event loops in other threads, s."""
    run, here, spent = events.Handle._run, threading.get_ident(), list[float]()

    def timed(handle: events.Handle) -> None:
        begin_s = time.thread_time()
        run(handle)
        if threading.get_ident() != here:
            spent.append(time.thread_time() - begin_s)

    with monkeypatch.context() as patched:
        patched.setattr(events.Handle, "_run", timed)
        yield spent


async def pulled(bench: Workbench, token: str) -> str:
    """The document of a page, as its browser asks for it."""
    own = bench.url.split("/?")[0]
    request = socket_request(bench, token, Origin=own)
    opened = await websocket_connect(request, subprotocols=["bokeh", token])
    for _ in range(3):  # the server is ready: ACK
        await asyncio.wait_for(opened.read_message(), 60)
    for part in ('{"msgid": "1", "msgtype": "PULL-DOC-REQ"}', "{}", "{}"):
        await opened.write_message(part)
    parts: list[str] = []
    while not any('"roots"' in part for part in parts):
        parts.append(str(await asyncio.wait_for(opened.read_message(), 60)))
    await closed(opened)
    return parts[-1]


def test_twenty_pages_are_served_at_once(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(project=project_file(tmp_path_factory.mktemp("ui"))) as bench:
        tokens = [token_of(ask(bench)[1]) for _ in range(PAGES)]

        async def all_of_them() -> list[str]:
            return await asyncio.gather(*(pulled(bench, token) for token in tokens))

        with longest(monkeypatch) as spent:
            documents = done(all_of_them())
            assert ask(bench, path="/alive")[0] == 204
        assert len({json.loads(text)["doc"]["title"] for text in documents}) == 1
        assert len(documents) == PAGES and max(spent) < MOST_S


def test_what_changes_before_a_page_has_its_document_is_sent_with_it_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pictures that are made while the browser still loads went twice, 3.5 MB each time."""
    sent = list[str]()

    class Socket:
        async def send_message(self, message: str) -> None:
            sent.append(message)

    async def packed(self: Packing, kind: str, *_: object) -> str:
        return kind

    monkeypatch.setattr(Packing, "packed", packed)

    async def main() -> None:
        turns = Turns(asyncio.get_running_loop().call_later)
        connection = Packed(Packing(turns), Socket(), None, SimpleNamespace(subscribe=id))
        await connection.send_patch_document(None)
        assert not sent
        await connection.protocol.create("PULL-DOC-REPLY", "1", None)
        await connection.send_patch_document(None)
        turns.stop()

    done(main())
    assert sent == ["PATCH-DOC"]


def test_a_change_that_a_server_leaves_behind_as_it_ends_has_not_begun() -> None:
    """A coroutine would tell at its end that nobody has awaited it."""

    async def main() -> None:
        turns = Turns(asyncio.get_running_loop().call_later)
        connection = Packed(Packing(turns), None, None, SimpleNamespace(subscribe=id))
        connection.send_patch_document(None)
        turns.stop()

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        done(main())
        gc.collect()
    assert not said


def test_a_document_is_packed_in_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """While it is, the loop is free; what is short is made at once."""
    packed_in, loop_in = list[int](), list[int]()

    class Content:
        @property
        def content_json(self) -> str:
            packed_in.append(threading.get_ident())
            return "{}"

    monkeypatch.setattr(Protocol, "create", lambda *_, **__: Content())

    async def main() -> None:
        loop_in.append(threading.get_ident())
        turns = Turns(asyncio.get_running_loop().call_later)
        packing = Packing(turns)
        await packing.create("PULL-DOC-REPLY", "1", None)
        await packing.packed("PATCH-DOC", [])
        assert isinstance(packing.create("OK", "1"), Content)
        turns.stop()

    done(main())
    assert len(packed_in) == 2 and loop_in[0] not in packed_in
