"""A log by the messages of its databases: what each of them takes, and what they leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_bridge.catalog import Catalog, load
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.j1939 import Network
from rtid.errors import RtidError
from rtid.project import Project


def catalog_of(project: Project) -> Catalog:
    """The bit layouts of the project's databases.  RtidError if it names none."""
    if not project.databases:
        raise RtidError(
            f"{project.path}: source.dbc is missing", "name the DBC of the CAN trace", 2
        )
    named = project.sections.messages.items()
    return load(project.databases).with_aliases({n: m.of for n, m in named if m.of is not None})


@dataclass(frozen=True)
class Matched:
    """The frames of each message, () for none, all that no message is, and what J1939 left out."""

    by_name: dict[str, Frames]
    rest: Frames
    refused: dict[str, int]


@dataclass(frozen=True)
class Taken:
    """How many messages a database has, how many of them a log, and their frames."""

    file: str
    messages: int
    present: int
    frames: int


@dataclass(frozen=True)
class Described:
    """What databases take of a log and what they leave.

    left: frames that none describes, by identifier; twice: identifiers that are several messages,
    with their names.
    """

    taken: tuple[Taken, ...]
    left: dict[str, int]
    twice: dict[str, tuple[str, ...]]


def match(frames: Frames, catalog: Catalog) -> Matched:
    """The frames of each message that the databases describe; J1939 by its groups."""
    sources = [catalog.message_source(name) for name in catalog.names]
    matched = Network(catalog, sources).push(frames)
    order = np.argsort(matched.can_id, kind="stable")
    ids, is_left = matched.can_id[order], np.ones(len(order), np.bool_)
    by_name = {}
    for name in catalog.names:
        begin, end = np.searchsorted(ids, np.array([0, 1], np.uint32) + catalog.can_id(name))
        places = order[begin:end]
        fitting = matched.length[places] == catalog.message(name).length
        by_name[name] = matched[places[fitting]]
        is_left[begin:end] &= ~fitting
    rest = matched[np.sort(order[is_left])]
    return Matched(by_name, rest, matched.refused)


def by_message(frames: Frames, catalog: Catalog) -> dict[str, Frames]:
    """The frames of each message that the databases describe, none left out."""
    return match(frames, catalog).by_name


def described(matched: Matched, catalog: Catalog) -> Described:
    """What each database takes, and what all of them leave."""
    files = dict.fromkeys(catalog.file_of(name) for name in catalog.names)
    taken = tuple(_taken(file, matched, catalog) for file in files)
    ids, counts = np.unique(matched.rest.can_id, return_counts=True)
    left = {label(int(i)): int(n) for i, n in zip(ids, counts, strict=True)}
    names: dict[int, list[str]] = {}
    for name, frames in matched.by_name.items():
        if len(frames):
            names.setdefault(catalog.can_id(name), []).append(name)
    twice = {label(i): tuple(several) for i, several in names.items() if len(several) > 1}
    return Described(taken, left, twice)


def on_channels(frames: Frames) -> dict[str, tuple[int, ...]]:
    """Identifiers that come on several channels, with these."""
    keys = np.unique(frames.can_id.astype(np.int64) << 8 | frames.channel)
    channels: dict[int, list[int]] = {}
    for key in keys.tolist():
        channels.setdefault(key >> 8, []).append(key & 0xFF)
    return {label(i): tuple(several) for i, several in channels.items() if len(several) > 1}


def label(can_id: int) -> str:
    """An identifier as people write it, those of 29 bits with eight digits."""
    return f"{can_id & ~EXTENDED:08X}" if can_id & EXTENDED else f"{can_id:03X}"


def _taken(file: str, matched: Matched, catalog: Catalog) -> Taken:
    counts = [len(matched.by_name[n]) for n in catalog.names if catalog.file_of(n) == file]
    return Taken(file, len(counts), sum(n > 0 for n in counts), sum(counts))
