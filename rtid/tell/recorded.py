"""What a record says beside what was learned from it, as channels over time: MDF 4 and MCAP.

Groups: the decoded signals; measured, modelled and residual flow of each chamber; block and status
of each edge; bulk moduli and lag with their standard deviations.  All SI, times of the record.
MDF 4 needs asammdf (rtid[mf4]), MCAP mcap (rtid[bags]).
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.kept_out import let_in_asammdf
from firmware_bridge.lookup import STATUS
from rtid.errors import RtidError
from rtid.plain import FloatArray
from rtid.study.compared import compare_trace
from rtid.study.study import Study

NEEDED = {".mf4": ("asammdf", "rtid[mf4]"), ".mcap": ("mcap.writer", "rtid[bags]")}
TOPIC, SOURCE = "/rtid/", "rtid"


@dataclass(frozen=True)
class RecordedChannel:
    """One channel: unit ("" for a number without one), what it is, and its values (n,)."""

    unit: str
    about: str
    values: FloatArray


@dataclass(frozen=True)
class RecordedGroup:
    """Channels of one time base t_s (n,), seconds from the record's beginning."""

    name: str
    t_s: FloatArray
    channels: dict[str, RecordedChannel]


def groups_of(study: Study) -> tuple[RecordedGroup, ...]:
    """All that is recorded of a study.  Raises the errors of `Study`."""
    replay = study.replay
    held = compare_trace(replay).held[0]
    parts, model = list(held.parts.values()), replay.model
    rows_s = np.concatenate([part.t_s for part in parts])
    cells = np.concatenate([part.cell for part in parts])
    flows = {
        word: np.concatenate([getattr(part, f"{word}_m3s") for part in parts])
        for word in ("measured", "modelled", "residual")
    }
    residual = {
        f"{word}_{chamber.name}": RecordedChannel(chamber.unit, f"{word} flow", columns[:, c])
        for word, columns in flows.items()
        for c, chamber in enumerate(model.chambers)
    }
    codes = np.append([STATUS.index(word) for word in held.candidate.status], STATUS.index("shut"))
    blocks = dict[str, RecordedChannel]()
    for i, edge in enumerate(model.edges):
        at, first = cells[:, i], model.first_cells[i]
        blocks[f"block_{edge.name}"] = RecordedChannel(
            "",
            f"block, {edge.grid.shape[1]} per command; -1: shut",
            np.where(at < 0, -1, at - first),
        )
        words = ", ".join(f"{k} {word}" for k, word in enumerate(STATUS))
        blocks[f"status_{edge.name}"] = RecordedChannel("", words, codes[at])
    return (
        _signals(study),
        RecordedGroup("residual", rows_s, residual), RecordedGroup("blocks", rows_s, blocks),
        _estimates(study, rows_s[[0, -1]]),
    )  # fmt: skip


def _signals(study: Study) -> RecordedGroup:
    samples, known = study.trace.samples, study.machine.signals
    channels = {
        signal.name: RecordedChannel(signal.unit, signal.kind, samples.column(signal.name))
        for signal in known
        if signal.name in samples.names
    }
    return RecordedGroup("signals", 1e-6 * (samples.t_us - samples.t_us[0]), channels)


def _estimates(study: Study, span_s: FloatArray) -> RecordedGroup:
    """Constants of the record, at its beginning and end."""
    solution, fit = study.fit.solution, study.fit
    values = {"lag": (fit.lag_s, "s"), "lag_sd": (fit.lag_sd_s, "s")}
    for chamber, beta, sd in zip(
        solution.model.chambers, solution.beta_pa, solution.beta_sd_pa, strict=True
    ):
        if np.isfinite(beta):
            values |= {f"beta_{chamber.name}": (beta, "Pa"), f"beta_{chamber.name}_sd": (sd, "Pa")}
    constant = {
        name: RecordedChannel(unit, name, np.full(2, value))
        for name, (value, unit) in values.items()
    }
    return RecordedGroup("estimates", span_s, constant)


def write_recorded(path: Path, study: Study, provenance: Mapping[str, Any]) -> None:
    """Write a study's channels in the format of the suffix, whole or not at all.

    Raises RtidError where a library is missing, OSError.
    """
    module, extra = NEEDED[path.suffix.lower()]
    let_in_asammdf()
    try:
        import_module(module)
    except ImportError:
        raise RtidError(f"{path}: needs {module.split('.')[0]}", f"pip install '{extra}'") from None
    start_us = int(study.trace.samples.t_us[0])
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        WRITERS[path.suffix.lower()](part, groups_of(study), start_us, json.dumps(dict(provenance)))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _write_mf4(path: Path, groups: tuple[RecordedGroup, ...], start_us: int, about: str) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415 - an extra

    with MDF(version="4.10") as log:
        log.start_time = datetime.fromtimestamp(1e-6 * start_us, UTC)
        log.header.comment = about
        for group in groups:
            signals = [
                Signal(channel.values, group.t_s, channel.unit, name, comment=channel.about)
                for name, channel in group.channels.items()
            ]
            log.append(signals, acq_name=group.name, comment=group.name)
        log.save(path, overwrite=True)


def _write_mcap(path: Path, groups: tuple[RecordedGroup, ...], start_us: int, about: str) -> None:
    from mcap.writer import Writer  # noqa: PLC0415 - an extra

    with path.open("wb") as file:
        log = Writer(file)
        log.start(profile="", library=SOURCE)
        log.add_metadata(SOURCE, {"provenance": about})
        sent = [_topic(log, group) for group in groups]
        rows = [row for k, group in enumerate(groups) for row in _rows(group, k)]
        for t_s, k, number, message in sorted(rows, key=lambda row: row[:3]):
            stamp = 1000 * start_us + round(1e9 * t_s)
            log.add_message(sent[k], stamp, message, stamp, number)
        log.finish()


def _topic(log: Any, group: RecordedGroup) -> int:
    """The channel of a group, with a schema that names units."""
    fields = {
        name: {"type": "number", "description": f"{channel.about} [{channel.unit or '-'}]"}
        for name, channel in group.channels.items()
    }
    schema = json.dumps({"type": "object", "properties": fields}).encode()
    number = log.register_schema(SOURCE + "." + group.name, "jsonschema", schema)
    return int(log.register_channel(TOPIC + group.name, "json", number))


def _rows(group: RecordedGroup, k: int) -> Iterator[tuple[float, int, int, bytes]]:
    """Time, group, number and message of each row; what is no number is left out."""
    names = list(group.channels)
    table = np.column_stack([channel.values for channel in group.channels.values()])
    for number, (t_s, row) in enumerate(zip(group.t_s.tolist(), table.tolist(), strict=True)):
        told = {name: x for name, x in zip(names, row, strict=True) if np.isfinite(x)}
        yield t_s, k, number, json.dumps(told).encode()


Writer = Callable[[Path, tuple[RecordedGroup, ...], int, str], None]
WRITERS: dict[str, Writer] = {".mf4": _write_mf4, ".mcap": _write_mcap}
