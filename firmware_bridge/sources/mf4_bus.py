"""The frames of an MF4 log of a bus: the channel group CAN_DataFrame, with its fields, of each bus.

Records of several groups may stand mixed in one stream, each behind its number (unsorted); payloads
of CAN FD may stand apart (VLSD), where a record has their offset.  Stamps are rounded to 1 us.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, kernel
from firmware_bridge.sources.mf4_blocks import FIRST, Block, Blocks, DamagedError, Stream

DATA_FRAME = "CAN_DataFrame"
COUNTED = {  # groups without data frames
    "CAN_ErrorFrame": "error_frame",
    "CAN_RemoteFrame": "remote_frame",
    "CAN_OverloadFrame": "other_event",
}
VLSD, MASTER, VIRTUAL_MASTER, VIRTUAL = 1, 2, 3, 6  # types of channels
VLSD_GROUP = 1  # flag
LINEAR, TABLES, TEXTS = 1, (4, 5), (0, 7, 8, 9, 10, 11)  # conversions; of texts the number is read
AT_ONCE = 1 << 17  # records
MAX_STANDARD, MAX_EXTENDED = 0x7FF, 0x1FFF_FFFF
MAX_NUMBER = 2.0**62
LONGEST_S = 1e10  # of a stamp: three hundred years
Bytes = NDArray[np.uint8]


class Field(NamedTuple):
    """A channel: where its bits stand in a record, and what its number means."""

    kind: int
    data_kind: int
    bit: int
    byte: int
    bits: int
    data: int  # link to values that stand apart
    conversion: Block | None


class BusGroup(NamedTuple):
    """A channel group: where it stands, its number, size of a record, flags and fields by name."""

    place: int
    number: int
    cycles: int
    size: int
    flags: int
    fields: dict[str, Field]


class Records(NamedTuple):
    """Where records begin in a stream, (n,), and of which group they are."""

    stream: Stream
    groups: NDArray[np.int64]
    begins: NDArray[np.int64]


def read(blocks: Blocks) -> Frames | None:
    """All data frames, in the order of the file; None if it is no log of a bus.

    `refused` counts what else there is.  Raises DamagedError.
    """
    parts, refused, is_bus = [], dict[str, int](), False
    head = blocks.at(FIRST, b"##HD")
    start_us = (struct.unpack_from("<Q", head.data)[0] + 500) // 1000
    for block in blocks.chain(head.links[0], b"##DG"):
        groups = [_group(blocks, group) for group in blocks.chain(block.links[1], b"##CG")]
        if not any(_event(group) for group in groups):
            continue
        is_bus = True
        records = _records(blocks, block, groups, refused)
        for k, group in enumerate(groups):
            begins = records.begins[records.groups == k]
            if _event(group) != DATA_FRAME:
                fr.add_counts(refused, {COUNTED.get(_event(group), ""): len(begins)})
                continue
            payloads = _payloads(blocks, groups, records, group)
            parts += [
                _frames(records.stream.text, begins[n : n + AT_ONCE], group, payloads, start_us)
                for n in range(0, len(begins), AT_ONCE)
            ]
    frames = fr.concatenate(parts)
    refused.pop("", None)
    fr.add_counts(frames.refused, refused)
    return frames if is_bus else None


def _event(group: BusGroup) -> str:
    """Which event of a bus a group holds; "" if none."""
    return next((name for name in (DATA_FRAME, *COUNTED) if name in group.fields), "")


def _group(blocks: Blocks, block: Block) -> BusGroup:
    number, count, flags, size, invalid = struct.unpack_from("<QQH6xII", block.data)
    return BusGroup(
        block.place, number, count, size + invalid, flags, dict(_fields(blocks, block.links[1]))
    )


def _fields(blocks: Blocks, place: int, depth: int = 0) -> Iterator[tuple[str, Field]]:
    """Channels of a group by the last word of their names, those that others consist of too.

    The master is called "t", and an event by its whole name.
    """
    for block in blocks.chain(place, b"##CN"):
        kind, _, data_kind, bit, byte, bits = struct.unpack_from("<4BII", block.data)
        conversion = blocks.at(block.links[4], b"##CC") if block.links[4] else None
        field = Field(kind, data_kind, bit, byte, bits, block.links[5], conversion)
        name = blocks.text(block.links[2])
        yield "t" if kind in (MASTER, VIRTUAL_MASTER) else name.rpartition(".")[2], field
        if depth == 0 and block.links[1] and blocks.at(block.links[1]).kind == b"##CN":
            yield from _fields(blocks, block.links[1], 1)


def _records(
    blocks: Blocks, block: Block, groups: list[BusGroup], refused: dict[str, int]
) -> Records:
    """Where the records of a data group begin, less those that a hole has hit; counts holes."""
    stream, id_bytes = blocks.stream(block.links[2]), block.data[0]
    size = len(stream.text)
    if id_bytes == 0:
        n = size // groups[0].size if groups[0].size else 0
        if blocks.is_finished and groups[0].cycles * groups[0].size != size:
            n = min(n, groups[0].cycles)
            fr.add_counts(refused, {"bad_container": 1})
        begins = np.arange(n) * groups[0].size
        kinds, ends = np.zeros(n, np.int64), begins + groups[0].size
    else:
        end = stream.holes[0][0] if stream.holes else size
        kinds, begins, ends, stop = _walked(stream.text[:end], id_bytes, groups)
        fr.add_counts(refused, {"bad_container": int(stop and not stream.holes)})
    clean = np.ones(len(begins), bool)
    for begin, end in stream.holes:
        clean &= (ends <= begin) | (begins >= end)
    fr.add_counts(refused, {"bad_container": len(stream.holes)})
    fr.add_counts(refused, {"truncated": int(stream.is_cut and blocks.is_finished)})
    return Records(stream, kinds[clean], begins[clean])


def _walked(
    text: Bytes, id_bytes: int, groups: list[BusGroup]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], bool]:
    """BusGroup, begin (behind the number) and end of each record; whether the walk was stopped."""
    order = np.argsort([group.number for group in groups])
    numbers = np.array([groups[k].number for k in order], np.int64)
    sizes = np.array([-1 if g.flags & VLSD_GROUP else g.size for g in groups], np.int64)[order]
    room = len(text) // id_bytes + 1
    if not (sizes == 0).any():
        room = len(text) // (id_bytes + int(np.where(sizes < 0, 4, sizes).min())) + 1
    kinds, begins, ends = (np.zeros(room, np.int64) for _ in range(3))
    n, is_stopped = walk(text, id_bytes, numbers, sizes, kinds, begins, ends)
    return order[kinds[:n]], begins[:n], ends[:n], is_stopped


@kernel
def walk(
    text: Bytes, id_bytes: Integer, numbers: NDArray[np.int64], sizes: NDArray[np.int64],
    kinds: NDArray[np.int64], begins: NDArray[np.int64], ends: NDArray[np.int64],
) -> tuple[Integer, bool]:  # fmt: skip
    """Records from the first to the last whole one, into the last three arrays (changed in place).

    text (bytes,); numbers, sizes (groups,): the sizes in bytes of the groups with these numbers,
    which rise; -1: four bytes say it.  Returns how many records there are, and whether one with a
    number that no group has ended the walk.
    """
    pos, n = 0, 0
    while pos + id_bytes <= len(text):
        number = np.int64(0)
        for k in range(id_bytes):
            number |= np.int64(text[pos + k]) << (8 * k)
        kind = np.searchsorted(numbers, number)
        if kind == len(numbers) or numbers[kind] != number:
            return n, True
        begin, size = pos + id_bytes, sizes[kind]
        if size < 0:
            if begin + 4 > len(text):
                break
            size = np.int64(4)
            for k in range(4):
                size += np.int64(text[begin + k]) << (8 * k)
        pos = begin + size
        if pos > len(text):
            break
        kinds[n], begins[n], ends[n] = kind, begin, pos
        n += 1
    return n, False


def _payloads(
    blocks: Blocks, groups: list[BusGroup], records: Records, group: BusGroup
) -> tuple[Bytes, NDArray[np.int64]] | None:
    """Where payloads stand that are not in the records: text, and (m, 2): offset, first byte."""
    field = group.fields.get("DataBytes")
    if field is None or field.kind != VLSD:
        return None
    apart = [k for k, other in enumerate(groups) if other.place == field.data]
    if not apart:
        stream = blocks.stream(field.data)
        if stream.holes:
            raise DamagedError("the payloads of its long frames are damaged")
        return stream.text, np.zeros((0, 2), np.int64)
    begins = records.begins[records.groups == apart[0]]
    sizes = 4 + _numbers(records.stream.text, begins, 4)
    return records.stream.text, np.stack([np.cumsum(sizes) - sizes, begins], axis=1)


def _frames(
    text: Bytes, begins: NDArray[np.int64], group: BusGroup,
    payloads: tuple[Bytes, NDArray[np.int64]] | None, start_us: int,
) -> Frames:  # fmt: skip
    """Frames of some records; those longer than CAN FD's, or without a stamp, are counted."""
    rows, fields = text[begins[:, None] + np.arange(group.size)], group.fields
    stamps, can_id = _values(rows, fields["t"]), _integers(rows, fields["ID"])
    length = _integers(rows, fields.get("DataLength") or fields["DLC"])
    is_extended = (can_id > MAX_STANDARD) | (can_id & fr.EXTENDED > 0)
    if "IDE" in fields:
        is_extended |= _integers(rows, fields["IDE"]) != 0
    if payloads is None:
        field = fields["DataBytes"]
        data = rows[:, field.byte : field.byte + field.bits // 8]
    else:
        data = _apart(*payloads, _integers(rows, fields["DataBytes"]), length)
    is_short = (length <= fr.MAX_FD_LENGTH) & (length >= 0)
    is_sound = is_short & (np.abs(stamps) < LONGEST_S)
    frames = fr.empty(len(rows), int(length[is_sound].max(initial=0)))
    width = min(frames.data.shape[1], data.shape[1])
    frames.data[:, :width] = data[:, :width]
    frames.data[np.arange(frames.data.shape[1]) >= length[:, None]] = 0
    frames.t_us[:] = start_us + np.rint(np.where(is_sound, stamps, 0.0) * 1e6).astype(np.int64)
    frames.channel[:] = (
        _integers(rows, fields["BusChannel"]) & 0xFF if "BusChannel" in fields else 0
    )
    frames.can_id[:] = (can_id & MAX_EXTENDED) | np.where(is_extended, fr.EXTENDED, 0)
    frames.length[:] = np.where(is_sound, length, 0)
    kept = frames[is_sound]
    wrong = {"fd_frame": int((~is_short).sum()), "bad_object": int((is_short & ~is_sound).sum())}
    fr.add_counts(kept.refused, wrong)
    return kept


def _apart(
    text: Bytes, table: NDArray[np.int64], offsets: NDArray[np.int64], length: NDArray[np.int64]
) -> Bytes:
    """Payloads at offsets of a stream, (n, longest); a table says where its pieces stand."""
    if len(table):
        k = np.minimum(np.searchsorted(table[:, 0], offsets), len(table) - 1)
        offsets = table[k, 1]
    width = int(np.clip(length.max(initial=0), 0, fr.MAX_FD_LENGTH))
    places = offsets[:, None] + 4 + np.arange(width)
    if len(offsets) and not 0 <= places.min() <= places.max() < len(text) + width:
        raise DamagedError("the payloads of its long frames lie behind its end")
    return text[np.minimum(places, len(text) - 1)]


def _integers(rows: Bytes, field: Field) -> NDArray[np.int64]:
    """A field of each record as a whole number, -1 where it is none."""
    values = _values(rows, field)
    return np.where(np.abs(values) < MAX_NUMBER, values, -1).astype(np.int64)


def _values(rows: Bytes, field: Field) -> NDArray[np.int64] | NDArray[np.float64]:
    """A field of each record, (n,), converted."""
    if field.kind in (VIRTUAL_MASTER, VIRTUAL):
        return _converted(np.arange(len(rows)), field.conversion)
    size = -(-(field.bit + field.bits) // 8)
    if not 0 < size <= 8 or field.byte + size > rows.shape[1]:
        raise DamagedError("its index is damaged: a channel lies outside of its records")
    raw = rows[:, field.byte : field.byte + size]
    raw = raw[:, ::-1] if field.data_kind in (1, 3, 5) else raw
    if field.data_kind in (4, 5):
        if size not in (4, 8):
            raise DamagedError(f"its index is damaged: a float of {size} bytes")
        return _converted(np.ascontiguousarray(raw).view(f"<f{size}")[:, 0], field.conversion)
    words = np.zeros((len(rows), 8), np.uint8)
    words[:, :size] = raw
    numbers = words.view("<u8")[:, 0] >> np.uint64(field.bit)
    mask = np.uint64((1 << field.bits) - 1)
    return _converted((numbers & mask).astype(np.int64), field.conversion)


def _numbers(text: Bytes, begins: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Little-endian numbers of so many bytes, which begin there."""
    rows = text[begins[:, None] + np.arange(size)].astype(np.int64)
    return (rows << (8 * np.arange(size))).sum(axis=1)


def _converted(
    values: NDArray[np.int64] | NDArray[np.float64], conversion: Block | None
) -> NDArray[np.int64] | NDArray[np.float64]:
    if conversion is None:
        return values
    kind, _, _, _, n = struct.unpack_from("<BBHHH", conversion.data)
    numbers = np.array(struct.unpack_from(f"<{n}d", conversion.data, 24))
    if kind == LINEAR:
        return numbers[0] + numbers[1] * values
    if kind in TABLES:
        keys, meant = numbers[: n // 2 * 2].reshape(-1, 2).T
        nearest = np.minimum(np.searchsorted(keys, values), len(keys) - 1)
        return meant[nearest]
    if kind not in TEXTS:
        raise DamagedError(f"a conversion of type {kind} is not read")
    return values
