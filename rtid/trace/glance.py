"""What is in a file that nobody has described: every signal with unit, range and a small curve."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_bridge import catalog as catalogs
from firmware_bridge.frames import Frames
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_file
from firmware_bridge.sources.table import Table
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import guess as proposal
from rtid.trace.described import by_message
from rtid.trace.quick_source import open_source

PIECES = 90  # of a curve
FINE = 600  # of a curve as wide as the page
MOST = 80  # signals that are shown: those that may play a role first


@dataclass(frozen=True)
class Curve:
    """A signal; low, high (pieces,): its least and largest value in each piece of the record.

    unit: as the file says, guessed for a role, or "".
    """

    name: str
    unit: str
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Glance:
    """The signals of a file, and the names of those that may play a role, by role."""

    curves: tuple[Curve, ...]
    roles: dict[str, str]
    left_out: int


def glance(path: Path, dbc: Path | None = None) -> Glance:
    """Look at a table or a CAN log.  Raises RtidError where it cannot be read."""
    source = open_source(path, dbc)
    proposed = proposal.propose(source.signals)
    units = {c.full_name: c.unit for c in (*source.signals, *proposed.values())}
    roles = {role: c.full_name for role, c in proposed.items()}
    signals = [c.full_name for c in source.signals]
    values = dict(_values(path, dbc, signals))
    names = [*roles.values(), *(n for n in signals if n not in roles.values())]
    curves = [
        Curve(n, units.get(n, ""), *extremes(values[n]))
        for n in names[:MOST]
        if n in values and np.isfinite(values[n]).any()
    ]
    return Glance(tuple(curves), roles, max(0, len(names) - MOST))


def glimpse(model: Machine, samples: Samples) -> tuple[Curve, ...]:
    """The signals of a machine in a record, SI."""
    return tuple(
        Curve(signal.name, signal.unit, *extremes(samples.column(signal.name), FINE))
        for signal in model.signals
    )


def extremes(values: FloatArray, most: int = PIECES) -> tuple[FloatArray, FloatArray]:
    """Least and largest finite value (pieces,) of each piece of values (n,), any unit, n > 0."""
    pieces = min(most, len(values))
    at = np.linspace(0, len(values), pieces, endpoint=False).astype(int)
    return np.fmin.reduceat(values, at), np.fmax.reduceat(values, at)


def _values(path: Path, dbc: Path | None, names: list[str]) -> Iterator[tuple[str, FloatArray]]:
    """Values (n,) of every signal, by its full name."""
    content = open_file(path)
    if isinstance(content, Table):
        yield from ((name, content.column(name)) for name in names)
        return
    yield from _of_log(content, dbc)


def _of_log(frames: Frames, dbc: Path | None) -> Iterator[tuple[str, FloatArray]]:
    catalog = catalogs.load(catalogs.places(dbc) if dbc else catalogs.places())
    for message, mine in by_message(frames, catalog).items():
        layouts = catalog.layouts(message)
        columns = layouts.decode(mine.data)
        for k, signal in enumerate(layouts.names):
            yield f"{message}.{signal}", columns[:, k]
