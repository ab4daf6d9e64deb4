"""The way to the controller: the one place of rtid that arms a bus for sending.

Only `rtid apply` and the notices of a daemon that `publish.status` has armed come here.
"""

from __future__ import annotations

import fcntl
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import can

from firmware_bridge.frames import EXTENDED
from firmware_bridge.playback import ArmedLink, BusSink, Exchange, SerialSink
from firmware_bridge.sources.live_bus import ON_PORTS
from rtid.apply.answers import SHORT, heard
from rtid.errors import RtidError
from rtid.project import Project
from rtid.trace.described import catalog_of
from rtid.trace.state_files import opened

TEST_BUSES = ("udp_multicast", "virtual")
LOCK_FILE = "lock"  # of the daemon


def identifier(can_id: int) -> int:
    """As in `Frames.can_id`: bit 31 set for 29 bits."""
    return can_id | EXTENDED if can_id > SHORT else can_id


def bus_of(project: Project, bus: str | None = None) -> tuple[str, str]:
    """Interface and channel that maps are sent on.  RtidError if the project has none."""
    section, source = project.sections.publish, project.sections.source
    if bus is not None:
        interface, _, channel = bus.partition(":")
        return interface, channel
    interface = section.interface or source.interface or ""
    if not interface:
        raise RtidError(
            f"{project.path}: source.interface is missing",
            "name a bus: --bus socketcan:can0, or publish.interface and publish.channel",
            2,
        )
    channel = section.channel or source.channel or ""
    if "," in channel:
        raise RtidError(
            f"{project.path}: {channel} are several buses", "name one in publish.channel", 2
        )
    return interface, channel


def check(project: Project) -> None:
    """RtidError where the project declares no way to the controller, or one that is taken."""
    section = project.sections.publish
    if section.can_id is None or section.reply_id is None:
        raise RtidError(
            f"{project.path}: publish.can_id is missing: nothing can be sent to the controller",
            "add [publish] with can_id and reply_id that are free on its bus",
            2,
        )
    catalog = catalog_of(project)
    taken = {catalog.can_id(m.name): m.name for m in project.assembly.messages}
    for key in ("can_id", "reply_id", "status_id"):
        given = getattr(section, key)
        if given is not None and identifier(given) in taken:
            message = taken[identifier(given)]
            raise RtidError(
                f"{project.path}: publish.{key} = 0x{given:X} is that of {message}",
                "give one that is free on the bus",
                2,
            )


@contextmanager
def armed(
    project: Project, interface: str, channel: str, can_id: int, folder: Path | None = None
) -> Iterator[ArmedLink]:
    """Open the bus for sending until the block ends; SendError if it cannot be opened.

    folder: state folder of a daemon that may hold the line, from which then answers come.
    """
    section = project.sections.publish
    reply = identifier(section.reply_id or 0)
    is_held = folder is not None and interface in ON_PORTS and is_running(folder)
    if is_held and interface != "serial":
        raise RtidError(
            f"{interface} {channel}: the daemon has opened this adapter to listen only",
            "stop the daemon, apply, start it again",
        )
    with ExitStack() as stack:
        sink = _sink(project, interface, channel, reply)
        stack.enter_context(sink.armed())
        end: Exchange = sink
        if is_held and folder is not None:
            end = _Overheard(sink, stack.enter_context(heard(folder)), reply)
        yield ArmedLink(end, identifier(can_id), reply, section.frames_per_s)


def _sink(project: Project, interface: str, channel: str, reply: int) -> BusSink | SerialSink:
    if interface == "serial":
        return SerialSink(channel)
    own_speed = interface not in (*TEST_BUSES, "socketcan")
    bitrate = project.sections.source.bitrate if own_speed else None
    return BusSink(interface, channel or None, [reply], bitrate)


def is_running(folder: Path) -> bool:
    """Whether a daemon keeps its state here now."""
    try:
        with opened(folder / LOCK_FILE) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


class _Overheard:
    """Writes to a line that the daemon reads, and hears from the daemon what came back."""

    def __init__(self, sink: Exchange, listening: socket.socket, reply_id: int) -> None:
        self._sink, self._listening, self._reply_id = sink, listening, reply_id

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._sink.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._listening.settimeout(max(timeout or 0.0, 1e-4))
        try:
            data = self._listening.recv(64)
        except TimeoutError:
            return None
        return can.Message(
            arbitration_id=self._reply_id & ~EXTENDED,
            is_extended_id=bool(self._reply_id & EXTENDED),
            data=data,
        )
