"""J1939: frames are known by their parameter group (PGN), long messages come in parts.

Identifier of 29 bits: priority, PGN, source address; below PDU format 240 the PGN's last byte is a
destination.  Priority and destination say nothing about the content and are masked.  A message's
source address is given, found (the first that sends it) or any; a frame that fits gets the
identifier that the DBC writes, so that all behind here compares whole identifiers.  Packets of the
transport protocol, announced to all (BAM) or to one (RTS/CTS), are joined to one frame with the
stamp of the last packet.  No clock is asked: frames one by one or at once give the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.catalog import Catalog, CatalogError
from firmware_bridge.config import ANY, FOUND, MessageSource
from firmware_bridge.frames import EXTENDED, Frames

REQUEST, ADDRESS_CLAIM, CONTROL, PACKET = 0xEA00, 0xEE00, 0xEC00, 0xEB00
IGNORED = {REQUEST: "j1939_request", ADDRESS_CLAIM: "address_claim"}
REASONS = (*IGNORED.values(), "other_source", "transport_foreign", "transport_broken")
ALL, NO_SOURCE = 0xFF, 0xFE  # destination of a broadcast; what a DBC writes for any source
DESTINED = 240  # PDU formats below hold a destination
ANNOUNCED, REQUESTED = 32, 16  # control bytes: BAM, RTS
ABORTED = 255
PACKET_BYTES = 7
SILENCE_US = 1_250_000  # T2, T3 of J1939-21: after so long nothing more comes
LONGEST = 255  # of a message that can be declared, bytes

Key = tuple[int, int, int]  # channel, source, destination


def pgn_of(can_id: int) -> int:
    """Parameter group of a 29 bit identifier, its destination 0."""
    return int(pgns(np.array([can_id | EXTENDED], np.uint32))[0])


def pgns(can_id: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Groups of identifiers as in Frames.can_id (n,); -1 for one of 11 bits."""
    pgn = (can_id.astype(np.int64) >> 8) & 0x3FFFF
    pgn[((pgn >> 8) & 0xFF) < DESTINED] &= 0x3FF00
    pgn[(can_id & EXTENDED) == 0] = -1
    return pgn


@dataclass
class Target:
    """A declared message: what is taken for it; `source` is set when the first one is found."""

    pgn: int
    can_id: int
    length: int
    channel: int | None
    source: int | None
    is_any: bool

    def meets(self, other: Target) -> bool:
        """Whether a frame may be of either, but for who sends it."""
        apart = None not in (self.channel, other.channel) and self.channel != other.channel
        return self.pgn == other.pgn and not apart

    def fits(self, frames: Frames, pgn: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which frames are of its group and channel, bool (n,), whoever sends them."""
        fitting = pgn == self.pgn
        return fitting if self.channel is None else fitting & (frames.channel == self.channel)


@dataclass
class Transfer:
    """A message on its way: what is announced, and the packets that have come."""

    pgn: int
    size: int
    last_us: int
    packets: dict[int, bytes] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Packets that it takes."""
        return -(-self.size // PACKET_BYTES)

    @property
    def payload(self) -> bytes:
        """All bytes, once every packet is there."""
        return b"".join(self.packets[k + 1] for k in range(self.count))[: self.size]


class Network:
    """Frames of declared J1939 messages under the identifiers of the DBC; all others as they are.

    What is no content (`IGNORED`), what another address sends, packets of messages that nobody has
    declared, and broken transfers are left out and counted, see `REASONS`.
    """

    def __init__(self, catalog: Catalog, messages: Sequence[MessageSource]) -> None:
        self._targets = [
            _target(catalog, message) for message in messages if is_group(catalog, message)
        ]
        self._transfers: dict[Key, Transfer] = {}

    @property
    def is_needed(self) -> bool:
        """Whether any declared message is one of J1939."""
        return bool(self._targets)

    def push(self, frames: Frames) -> Frames:
        """The same frames, matched; in order of arrival."""
        if not self._targets or not len(frames):
            return frames
        pgn = pgns(frames.can_id)
        counts = {name: int((pgn == number).sum()) for number, name in IGNORED.items()}
        is_packet = (pgn == CONTROL) | (pgn == PACKET)
        joined, places = self._join(frames, np.flatnonzero(is_packet), pgn, counts)
        can_id, keep = frames.can_id.copy(), ~is_packet & ~np.isin(pgn, list(IGNORED))
        for target in self._targets:
            self._match(target, frames, pgn, can_id, keep)
        counts["other_source"] = int((~keep & ~is_packet).sum()) - sum(
            counts[name] for name in IGNORED.values()
        )
        kept = Frames(frames.t_us, frames.channel, can_id, frames.length, frames.data)[keep]
        out = _merged(kept, np.flatnonzero(keep), joined, places)
        fr.add_counts(out.refused, frames.refused)
        fr.add_counts(out.refused, counts)
        return out

    def _match(
        self, target: Target, frames: Frames, pgn: NDArray[np.int64],
        can_id: NDArray[np.uint32], keep: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Give a message's frames its identifier, and drop those of others (in place)."""
        fitting = target.fits(frames, pgn)
        rivals = [t for t in self._targets if t is not target and target.meets(t)]
        given = {t.source for t in rivals}
        sources = frames.can_id & 0xFF
        fitting &= ~np.isin(sources, [s for s in given if s is not None])
        if not fitting.any():
            return
        if target.source is None and not target.is_any:
            target.source = int(sources[fitting][0])
        mine = fitting if target.is_any else fitting & (sources == target.source)
        can_id[mine] = target.can_id
        keep[fitting & ~mine] = False

    def _join(
        self, frames: Frames, packets: NDArray[np.intp], pgn: NDArray[np.int64],
        counts: dict[str, int],
    ) -> tuple[Frames, list[int]]:  # fmt: skip
        """Messages that these packets complete, and the place of the last packet of each."""
        done: list[tuple[int, Target, bytes]] = []
        for k in packets.tolist():
            whole = self._packet(frames, k, bool(pgn[k] == CONTROL), counts)
            target = whole and self._target_of(whole, frames, k)
            if whole is not None and target:
                done.append((k, target, whole.payload))
            elif whole is not None:
                fr.add_counts(counts, {"transport_foreign": 1})
        places = [k for k, _, _ in done]
        out = fr.empty(len(done), max((len(payload) for _, _, payload in done), default=0))
        out.t_us[:], out.channel[:] = frames.t_us[places], frames.channel[places]
        for row, (_, target, payload) in enumerate(done):
            out.can_id[row], out.length[row] = target.can_id, len(payload)
            out.data[row, : len(payload)] = np.frombuffer(payload, np.uint8)
        return out, places

    def _packet(
        self, frames: Frames, k: int, is_control: bool, counts: dict[str, int]
    ) -> Transfer | None:
        """Take one packet; the transfer that is complete with it."""
        data, t_us = frames.data[k, : frames.length[k]].tobytes(), int(frames.t_us[k])
        key = (
            int(frames.channel[k]),
            int(frames.can_id[k]) & 0xFF,
            int(frames.can_id[k]) >> 8 & 0xFF,
        )
        if len(data) < 8:
            fr.add_counts(counts, {"transport_broken": 1})
            return None
        if is_control:
            self._control(data, key, t_us, counts)
            return None
        transfer = self._transfers.get(key)
        if transfer is None or t_us - transfer.last_us > SILENCE_US:
            broken = self._transfers.pop(key, None)
            fr.add_counts(counts, {"transport_broken": int(broken is not None)})
            return None
        transfer.packets[data[0]], transfer.last_us = data[1:], t_us
        if len(transfer.packets) < transfer.count or data[0] > transfer.count:
            return None
        return self._ended(key, counts)

    def _ended(self, key: Key, counts: dict[str, int]) -> Transfer | None:
        """The transfer, if each of its packets is there; one that is not is broken."""
        transfer = self._transfers.pop(key)
        if set(transfer.packets) == set(range(1, transfer.count + 1)):
            return transfer
        fr.add_counts(counts, {"transport_broken": 1})
        return None

    def _control(self, data: bytes, key: Key, t_us: int, counts: dict[str, int]) -> None:
        """Open a transfer, or end one that is given up."""
        kind, size = data[0], int.from_bytes(data[1:3], "little")
        if kind in (ANNOUNCED, REQUESTED):
            broken = self._transfers.pop(key, None)
            fr.add_counts(counts, {"transport_broken": int(broken is not None)})
            self._transfers[key] = Transfer(int.from_bytes(data[5:8], "little"), size, t_us)
        elif kind == ABORTED:  # by either side
            channel, source, destination = key
            for side in (key, (channel, destination, source)):
                broken = self._transfers.pop(side, None)
                fr.add_counts(counts, {"transport_broken": int(broken is not None)})

    def _target_of(self, whole: Transfer, frames: Frames, k: int) -> Target | None:
        """The declared message that a transfer carries; None if there is none of this length."""
        source, channel = int(frames.can_id[k]) & 0xFF, int(frames.channel[k])
        pgn = pgn_of(whole.pgn << 8)
        for target in self._targets:
            fits = target.pgn == pgn and target.channel in (None, channel)
            if not fits or target.length != whole.size:
                continue
            if target.source is None and not target.is_any:
                target.source = source
            if target.is_any or target.source == source:
                return target
        return None


def known_as(catalog: Catalog, message: MessageSource) -> int:
    """The identifier that a message has behind the `Network`: with its address, where it is given.

    So one message of a DBC may be taken from several senders.
    """
    can_id = catalog.can_id(message.name)
    return can_id & ~0xFF | message.address if isinstance(message.address, int) else can_id


def is_group(catalog: Catalog, message: MessageSource) -> bool:
    """Whether a message is matched by its group: the DBC says J1939, or its address is given."""
    return message.address is not None or catalog.is_j1939(message.name)


def _target(catalog: Catalog, message: MessageSource) -> Target:
    can_id, length = catalog.can_id(message.name), catalog.message(message.name).length
    if not can_id & EXTENDED:
        raise CatalogError(f"message {message.name!r} has 11 bits: it has no source address")
    if length > LONGEST:
        raise CatalogError(f"message {message.name!r} has {length} bytes; {LONGEST} can be read")
    written = can_id & 0xFF
    source = message.address if isinstance(message.address, int) else None
    if message.address is None and written != NO_SOURCE:
        source = written
    is_any = message.address == ANY
    assert is_any or message.address in (None, FOUND) or source is not None
    known = known_as(catalog, message)
    return Target(pgn_of(can_id), known, length, message.channel, source, is_any)


def _merged(
    kept: Frames, kept_places: NDArray[np.intp], joined: Frames, places: list[int]
) -> Frames:
    """Both in the order of their places."""
    if not places:
        return kept
    order = np.argsort(np.concatenate([kept_places, places]), kind="stable")
    return fr.concatenate([kept, joined])[order]
