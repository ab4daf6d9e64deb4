"""Frames: a batch of received CAN frames as arrays, in the order of arrival.

Time stamps are integer microseconds: they are rounded here, at the door, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import can
import numpy as np
from numpy.typing import NDArray

EXTENDED = 0x8000_0000  # bit 31 of can_id: 29 bit identifier
MAX_LENGTH, MAX_FD_LENGTH = 8, 64  # classic CAN, CAN FD
WORD = 8  # payloads are kept in words of so many bytes


@dataclass(frozen=True)
class Frames:
    """A batch of n data frames.

    t_us: int64 (n,), microseconds; channel: uint8 (n,); can_id: uint32 (n,), bit 31 set for a
    29 bit identifier; length: uint8 (n,), bytes of payload; data: uint8 (n, 8), zero behind the
    payload, or wider, by whole words, where a message is longer (CAN FD, transport protocols).
    `refused` counts what the source had to leave out, by reason.
    """

    t_us: NDArray[np.int64]
    channel: NDArray[np.uint8]
    can_id: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    refused: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, index: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Frames:
        """The chosen frames, without `refused`."""
        return Frames(
            self.t_us[index],
            self.channel[index],
            self.can_id[index],
            self.length[index],
            self.data[index],
        )

    def chunks(self, size: int) -> Iterator[Frames]:
        """The same frames in batches of at most `size`; the first carries `refused`."""
        for start in range(0, len(self), size):
            part = self[start : start + size]
            if start == 0:
                part.refused.update(self.refused)
            yield part


def empty(n: int, length: int = MAX_LENGTH) -> Frames:
    """Room for n frames of so many bytes, all zero."""
    return Frames(
        np.zeros(n, np.int64),
        np.zeros(n, np.uint8),
        np.zeros(n, np.uint32),
        np.zeros(n, np.uint8),
        np.zeros((n, _width(length)), np.uint8),
    )


def _width(length: int) -> int:
    """Columns of `Frames.data` that hold so many bytes: whole words of 8."""
    return max(1, -(-length // WORD)) * WORD


def concatenate(parts: Sequence[Frames]) -> Frames:
    """One batch from several, in the given order; the `refused` counts are added up."""
    if not parts:
        return empty(0)
    refused: dict[str, int] = {}
    for part in parts:
        add_counts(refused, part.refused)
    return Frames(
        np.concatenate([part.t_us for part in parts]),
        np.concatenate([part.channel for part in parts]),
        np.concatenate([part.can_id for part in parts]),
        np.concatenate([part.length for part in parts]),
        _stacked([part.data for part in parts]),
        refused,
    )


def narrowed(frames: Frames) -> Frames:
    """The same frames, as wide as the longest of them needs; without `refused`."""
    width = _width(int(frames.length.max(initial=0)))
    if frames.data.shape[1] == width:
        return frames
    data = frames.data[:, :width].copy()
    return Frames(frames.t_us, frames.channel, frames.can_id, frames.length, data)


def _stacked(parts: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Payloads one below the other, as wide as the widest."""
    width = max(data.shape[1] for data in parts)
    if all(data.shape[1] == width for data in parts):
        return np.concatenate(parts)
    return np.concatenate([np.pad(data, ((0, 0), (0, width - data.shape[1]))) for data in parts])


def by_time(frames: Frames) -> Frames:
    """The same frames sorted by time stamp; equal stamps keep their order."""
    ordered = frames[np.argsort(frames.t_us, kind="stable")]
    ordered.refused.update(frames.refused)
    return ordered


def add_counts(total: dict[str, int], more: dict[str, int]) -> None:
    """Add the counts of `more` to `total` (changed in place), dropping zeros."""
    for reason, count in more.items():
        if count:
            total[reason] = total.get(reason, 0) + count


def channel_number(channel: int | str | Sequence[int] | None) -> int:
    """0..255 for a python-can channel: 3 and "can3" are 3, a name without a number is 0."""
    if isinstance(channel, int):
        return channel & 0xFF
    name = channel if isinstance(channel, str) else ""
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) & 0xFF if digits else 0


def from_messages(messages: Iterable[can.Message]) -> Frames:
    """Frames from python-can messages; error and remote frames are counted, not kept."""
    refused: dict[str, int] = {}
    kept = []
    for message in messages:
        reason = _refusal(message)
        if reason:
            refused[reason] = refused.get(reason, 0) + 1
        else:
            kept.append(message)
    ids = [m.arbitration_id | (EXTENDED if m.is_extended_id else 0) for m in kept]
    width = _width(max((len(m.data) for m in kept), default=0))
    data = b"".join([bytes(m.data).ljust(width, b"\0") for m in kept])
    return Frames(
        np.array([round(m.timestamp * 1e6) for m in kept], np.int64),
        np.array([channel_number(m.channel) for m in kept], np.uint8),
        np.array(ids, np.uint32),
        np.array([len(m.data) for m in kept], np.uint8),
        np.frombuffer(bytearray(data), np.uint8).reshape(-1, width),  # writable
        refused,
    )


def _refusal(message: can.Message) -> str:
    if message.is_error_frame:
        return "error_frame"
    if message.is_remote_frame:
        return "remote_frame"
    if len(message.data) > MAX_FD_LENGTH:
        return "fd_frame"
    return "" if len(message.data) == message.dlc else "short_frame"


def to_messages(frames: Frames) -> Iterator[can.Message]:
    """The frames as python-can messages, one by one."""
    for k in range(len(frames)):
        can_id = int(frames.can_id[k])
        yield can.Message(
            timestamp=float(frames.t_us[k]) * 1e-6,
            arbitration_id=can_id & 0x1FFF_FFFF,
            is_extended_id=bool(can_id & EXTENDED),
            channel=int(frames.channel[k]),
            is_fd=bool(frames.length[k] > MAX_LENGTH),
            data=bytes(frames.data[k, : frames.length[k]]),
        )
