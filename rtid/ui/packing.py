"""What a page is sent is packed beside the loop: a document with its pictures takes 0.15 s.

Bokeh makes its messages on the event loop.  Here the loop waits for the studio's thread, while the
document stays locked: the order of messages is the same, and others are answered meanwhile.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from bokeh.protocol import Protocol
from bokeh.server.connection import ServerConnection

from rtid.ui.turns import Turns

if TYPE_CHECKING:
    from bokeh.document.events import DocumentPatchedEvent
    from bokeh.protocol.message import Message


class Packing(Protocol):  # type: ignore[misc]
    """Makes messages; a whole document is waited for."""

    def __init__(self, turns: Turns) -> None:
        super().__init__()
        self._turns = turns
        self.has_given = False  # the whole document, on which every change rests

    def create(self, msgtype: Any, *args: Any, **metadata: Any) -> Any:
        """A message, or what is to be awaited for one: its caller, the session, does so."""
        if msgtype == "PULL-DOC-REPLY":
            self.has_given = True
            return self.packed(msgtype, *args, **metadata)
        return super().create(msgtype, *args, **metadata)

    async def packed(self, msgtype: Any, *args: Any, **metadata: Any) -> Message[Any]:
        """A message whose text is made already."""
        make = partial(super().create, msgtype, *args, **metadata)

        def pack() -> Message[Any]:
            message = make()
            _ = message.content_json  # kept in the message
            return message

        return await self._turns.packed(pack)


@dataclass(frozen=True)
class Later:
    """What begins when it is awaited: a server that ends leaves changes that nobody awaits."""

    begin: Callable[[], Coroutine[Any, Any, None]]

    def __await__(self) -> Generator[Any, None, None]:
        """Begin, and wait for the end."""
        return self.begin().__await__()


class Packed(ServerConnection):  # type: ignore[misc]
    """A connection whose changes of the document are packed when it is their turn.

    What changes before the page has fetched its document is part of that: pictures that are made
    while the browser is still loading would otherwise be sent twice.
    """

    def send_patch_document(self, event: DocumentPatchedEvent) -> Awaitable[None]:
        """Pack and send it; the document is locked until that is done."""
        return Later(partial(self._send, event))

    async def _send(self, event: DocumentPatchedEvent) -> None:
        if not self.protocol.has_given:
            return
        await self._socket.send_message(await self.protocol.packed("PATCH-DOC", [event]))
