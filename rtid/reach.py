"""The way to the controller: the one place of rtid that arms a bus for sending.

Only `rtid apply` and the notices of a daemon that `publish.status` has armed come here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from firmware_bridge.frames import EXTENDED
from firmware_bridge.playback import ArmedLink, BusSink, SerialSink
from rtid.errors import RtidError
from rtid.live import catalog_of
from rtid.project import Project

TEST_BUSES = ("udp_multicast", "virtual")
SHORT = 0x7FF  # larger identifiers have 29 bits


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
def armed(project: Project, interface: str, channel: str, can_id: int) -> Iterator[ArmedLink]:
    """Open the bus for sending until the block ends; SendError if it cannot be opened."""
    section, bitrate = project.sections.publish, project.sections.source.bitrate
    reply = identifier(section.reply_id or 0)
    sink: BusSink | SerialSink
    if interface == "serial":
        sink = SerialSink(channel)
    else:
        own_speed = interface not in (*TEST_BUSES, "socketcan")
        sink = BusSink(interface, channel or None, [reply], bitrate if own_speed else None)
    with sink.armed() as open_sink:
        yield ArmedLink(open_sink, identifier(can_id), reply, section.frames_per_s)
