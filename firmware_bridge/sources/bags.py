"""ROS bags (.bag, .db3, .mcap) and MCAP with JSON, as tables: topic.field is a column.

Through the libraries rosbags and mcap, an extra: pip install rtid[bags].  Stamps are those
of the log; numbers and lists of numbers are columns, texts and lists of messages are not.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.merged import Channel, merged
from firmware_bridge.sources.table import Table
from firmware_bridge.sources.unpacked import Budget

LONGEST_LIST = 64  # numbers in one field; an image is no signal
NUMBER_BYTES = 8
JSON = "json"

Message = tuple[str, int, Any]  # topic, stamp in ns, content


def read(path: Path) -> Table:
    """All topics of a bag of ROS, or of an MCAP file in JSON; LogError if it holds no numbers."""
    needed = [name for name in ("rosbags", "mcap") if find_spec(name) is None]
    if needed:
        raise LogError(f"{path}: a bag needs {' and '.join(needed)}; pip install 'rtid[bags]'")
    messages = _of_json(path) if _is_json(path) else _of_ros(path)
    return merged(path, _channels(messages, Budget(path)))


def _is_json(path: Path) -> bool:
    if path.suffix.lower() != ".mcap":
        return False
    from mcap.reader import make_reader  # noqa: PLC0415  an extra

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        channels = list(summary.channels.values()) if summary else []
    return any(channel.message_encoding == JSON for channel in channels)


def _of_json(path: Path) -> Iterator[Message]:
    from mcap.reader import make_reader  # noqa: PLC0415

    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.message_encoding != JSON:
                raise LogError(f"{path}: topic {channel.topic} is {channel.message_encoding}")
            yield channel.topic, message.log_time, json.loads(message.data)


def _of_ros(path: Path) -> Iterator[Message]:
    from rosbags.highlevel import AnyReader  # noqa: PLC0415  an extra
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        for connection, stamp_ns, raw in bag.messages():
            yield connection.topic, stamp_ns, bag.deserialize(raw, connection.msgtype)


def _channels(messages: Iterable[Message], budget: Budget) -> list[Channel]:
    """The numbers of all messages by topic and field, the time counted from the first message."""
    stamps: dict[str, list[int]] = {}
    values: dict[str, list[float]] = {}
    for topic, stamp_ns, content in messages:
        for name, value in _numbers(topic.strip("/").replace("/", "."), content):
            budget.take(NUMBER_BYTES)
            stamps.setdefault(name, []).append(stamp_ns)
            values.setdefault(name, []).append(value)
    start_ns = min((column[0] for column in stamps.values()), default=0)
    return [
        Channel(name, "", 1e-9 * (np.array(stamps[name]) - start_ns), np.array(column, np.float64))
        for name, column in values.items()
    ]


def _numbers(name: str, content: Any) -> Iterator[tuple[str, float]]:
    """Name and value of every number in a message."""
    if isinstance(content, bool | int | float | np.number | np.bool_):
        yield name, float(content)
    elif is_dataclass(content):
        for field in fields(content):
            yield from _numbers(f"{name}.{field.name}", getattr(content, field.name))
    elif isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(f"{name}.{key}", value)
    elif isinstance(content, list | np.ndarray) and len(content) <= LONGEST_LIST:
        for k, value in enumerate(content):
            if isinstance(value, int | float | np.number):
                yield f"{name}.{k}", float(value)
