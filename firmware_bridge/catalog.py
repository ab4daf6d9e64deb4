"""Catalog: what a DBC says, read once with cantools and turned into plain bit layouts."""

from __future__ import annotations

import difflib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self, cast

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from firmware_bridge import bits, eds
from firmware_bridge.config import MessageSource
from firmware_bridge.frames import EXTENDED, MAX_LENGTH, WORD
from firmware_bridge.jit import Record, Records

BUILTIN = "builtin:"
CONTROLLER_DBC = Path(__file__).with_name("controller.dbc")
MAX_FILE_BYTES = 16 << 20  # a hostile file must not cost minutes or gigabytes
MAX_SIGNALS = 200_000
MOST_NODE = 127  # of CANopen

_ABSENT = re.compile(r"(sna|n/?a|not[ _-]?avail\w*|signal[ _-]?not[ _-]?avail\w*|invalid)", re.I)


class CatalogError(ValueError):
    """The DBC cannot be read, or does not hold what is asked for; the text names the remedy."""


@dataclass(frozen=True)
class Layouts:
    """Bit layouts of chosen signals of one message.

    rows: LAYOUT (n,), the chosen signals first, then the multiplexers they depend on;
    names: the chosen ones; codes: uint64 (c,), pages and absent codes that the rows point to;
    firsts: where the 8 bytes begin in which each row lies, not 0 only in longer messages.
    """

    names: tuple[str, ...]
    rows: Records
    codes: NDArray[np.uint64]
    firsts: tuple[int, ...]

    @property
    def is_long(self) -> bool:
        """Whether any of the signals lies behind the eighth byte."""
        return any(self.firsts)

    def decode(self, data: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Values float64 (n, names), DBC units, of payloads uint8 (n, bytes); NaN where absent."""
        if not self.is_long:
            values = bits.decode_words(words_of(data), self.rows, len(self.names), self.codes)
            return cast("NDArray[np.float64]", values.T)
        columns = [
            bits.decode_words(words_of(data, first), self.rows[k : k + 1], 1, self.codes)[0]
            for k, first in enumerate(self.firsts)
        ]
        return np.column_stack(columns)

    def packed(self) -> Layouts:
        """The layouts of the same signals in what `pack` makes; CatalogError if it is too much."""
        n_bits = int(self.rows["length"].sum(dtype=np.int64))
        if n_bits > 8 * WORD:
            raise CatalogError(
                f"{', '.join(self.names)} of one long message take {n_bits} bits together; "
                f"{8 * WORD} can be read"
            )
        rows = self.rows.copy()
        rows["shift"], rows["big_endian"] = self._places(), False
        return Layouts(self.names, rows, self.codes, (0,) * len(rows))

    def pack(self, data: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """The bits of the signals side by side in one word, uint64 (n,), of payloads (n, bytes)."""
        packed = np.zeros(len(data), np.uint64)
        for row, first, place in zip(self.rows, self.firsts, self._places(), strict=True):
            words = words_of(data, first)
            words = words.byteswap() if row["big_endian"] else words
            mask = np.uint64(0xFFFF_FFFF_FFFF_FFFF) >> np.uint64(64 - row["length"])
            packed |= ((words >> np.uint64(row["shift"])) & mask) << np.uint64(place)
        return packed

    def _places(self) -> NDArray[np.int64]:
        """Where each signal begins in what `pack` makes."""
        ends = np.cumsum(self.rows["length"], dtype=np.int64)
        return ends - self.rows["length"]

    def encode(self, values: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Payloads uint8 (n, 8) from values (n, names), DBC units: saturating, NaN = no value."""
        words = np.zeros(len(values), np.dtype("<u8"))
        bits.encode_words(np.asarray(values, np.float64), self.rows, words)
        return words.view(np.uint8).reshape(-1, MAX_LENGTH)


def words_of(data: NDArray[np.uint8], first: int = 0) -> NDArray[np.uint64]:
    """Eight bytes of each payload uint8 (n, bytes) as a number, uint64 (n,); 0 behind its end."""
    window = data[:, first : first + WORD]
    if window.shape[1] < WORD:
        window = np.pad(window, ((0, 0), (0, WORD - window.shape[1])))
    words: NDArray[np.uint64] = np.ascontiguousarray(window).view("<u8")[:, 0]
    return words


class Place(NamedTuple):
    """Where a database is, and of which CANopen node it is (None: of none, or a DCF says it)."""

    file: Path
    node: int | None = None

    def named(self, file: str) -> str:
        """The same place by another name of its file, with the node: valve.eds:5."""
        return file if self.node is None else f"{file}:{self.node}"


class Catalog:
    """The messages and signals of the databases of a bus.

    Messages that share a name are told apart by their identifier: `Valve-064`, `Valve-18FF0001`.
    files: a name for each database.
    """

    def __init__(self, *databases: Database, files: Sequence[str] = ("",)) -> None:
        messages = [message for database in databases for message in database.messages]
        n_signals = sum(len(message.signals) for message in messages)
        if n_signals > MAX_SIGNALS:
            raise CatalogError(f"the DBC has {n_signals} signals; the limit is {MAX_SIGNALS}")
        self._messages = _by_name(messages)
        counts = [len(database.messages) for database in databases]
        origins = [name for name, n in zip(files, counts, strict=True) for _ in range(n)]
        self._files = dict(zip(self._messages, origins, strict=True))

    def with_aliases(self, aliases: Mapping[str, str]) -> Self:
        """The same, where messages go by further names: alias -> name.  CatalogError if unknown."""
        other = copy(self)
        other._messages = self._messages | {a: self.message(n) for a, n in aliases.items()}
        other._files = self._files | {a: self._files[n] for a, n in aliases.items()}
        return other

    def file_of(self, message: str) -> str:
        """Name of the file that describes a message."""
        return self._files[message]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all messages."""
        return tuple(self._messages)

    def message(self, name: str) -> Message:
        """The cantools message `name`; CatalogError with the nearest name if there is none."""
        if name in self._messages:
            return self._messages[name]
        alike = [name_of for name_of, message in self._messages.items() if message.name == name]
        if alike:
            text = f"the DBC has {len(alike)} messages {name!r}; name one of {', '.join(alike)}"
            raise CatalogError(text)
        raise CatalogError(f"the DBC has no message {name!r}" + _nearest(name, self._messages))

    def signal(self, message: str, signal: str) -> Signal:
        """One signal; CatalogError with the nearest name if the message has none such."""
        known = {s.name: s for s in self.message(message).signals}
        if signal not in known:
            raise CatalogError(
                f"message {message!r} has no signal {signal!r}{_nearest(signal, known)}"
            )
        return known[signal]

    def can_id(self, message: str) -> int:
        """Identifier as in `Frames.can_id`: bit 31 set for a 29 bit identifier."""
        declared = self.message(message)
        return declared.frame_id | (EXTENDED if declared.is_extended_frame else 0)

    def layouts(self, message: str, signals: Sequence[str] | None = None) -> Layouts:
        """Bit layouts of the named signals of a message (all if None)."""
        declared = self.message(message)
        wanted = [s.name for s in declared.signals] if signals is None else list(signals)
        names = list(wanted)
        for name in names:  # grows while it runs: selectors may have selectors
            above = self.signal(message, name).multiplexer_signal
            if above is not None and above not in names:
                names.append(above)
        codes: list[int] = []
        rows, firsts = np.zeros(len(names), bits.LAYOUT), []
        for row, name in zip(rows, names, strict=True):
            signal, where = self.signal(message, name), f"{message}.{name}"
            _fill_row(row, signal, names, codes, where)
            if self.is_j1939(message):
                _leave_out_indicators(row, signal)
            first, row["shift"] = _place(signal, where)
            firsts.append(first)
        if any(firsts) and (rows["selector"] >= 0).any():
            raise CatalogError(f"{message}: multiplexed signals behind byte 8 cannot be read")
        return Layouts(tuple(wanted), rows, np.array(codes, np.uint64), tuple(firsts))

    def is_j1939(self, message: str) -> bool:
        """Whether the DBC says that a message is a parameter group of J1939."""
        return self.message(message).protocol == "j1939"

    def byte_of(self, message: str, signal: str) -> int:
        """Index of the byte that a checksum fills; CatalogError if it is not one whole byte."""
        layouts = self.layouts(message, [signal])
        row = layouts.rows[0]
        if layouts.is_long or row["length"] != 8 or row["shift"] % 8:
            raise CatalogError(f"{message}.{signal}: a CRC-8 must fill one of the first 8 bytes")
        byte = int(row["shift"]) // 8
        return 7 - byte if row["big_endian"] else byte

    def message_source(self, message: str) -> MessageSource:
        """Period and end-to-end protection as the DBC's attributes and signal names tell them.

        GenMsgCycleTime gives the period, E2EDataId the data id; a signal `AliveCounter` is the
        counter and `Crc` the checksum.  Anything absent stays at its default (period 0).
        """
        declared = self.message(message)
        names = {s.name for s in declared.signals}
        data_id = declared.dbc.attributes.get("E2EDataId") if declared.dbc else None
        return MessageSource(
            name=message,
            period_s=(declared.cycle_time or 0) * 1e-3,
            counter="AliveCounter" if "AliveCounter" in names else None,
            crc="Crc" if "Crc" in names else None,
            data_id=int(data_id.value) if data_id else 0,
        )


def places(named: str | Path = CONTROLLER_DBC, folder: Path = Path()) -> tuple[Place, ...]:
    """The databases of "pump.dbc, valve.eds:5", relative to a folder; "builtin:" is ours."""
    if (folder / named).is_file():  # a comma or colon in its name
        return (Place(folder / named),)
    return tuple(_place_of(name.strip(), folder) for name in str(named).split(","))


def _place_of(name: str, folder: Path) -> Place:
    if name.startswith(BUILTIN):
        return Place(CONTROLLER_DBC.with_name(name.removeprefix(BUILTIN)))
    file, _, node = name.rpartition(":")
    if not file.lower().endswith(eds.SUFFIXES):
        return Place(folder / name)
    if not (node.isdecimal() and 1 <= int(node) <= MOST_NODE):
        raise CatalogError(f"{name}: {node!r} is no node id; give 1 to {MOST_NODE}")
    return Place(folder / file, int(node))


def load(named: str | Path | Sequence[Place] = CONTROLLER_DBC) -> Catalog:
    """Read databases: DBC and what else cantools knows, EDS and DCF, see `places`.

    CatalogError if one cannot be read.
    """
    wanted = places(named) if isinstance(named, str | Path) else named
    databases = [_database(place) for place in wanted]
    shown = ", ".join(str(place.file) for place in wanted)
    try:
        return Catalog(*databases, files=[place.named(place.file.name) for place in wanted])
    except CatalogError as error:
        raise CatalogError(f"{shown}: {error}") from None


def _database(place: Place) -> Database:
    path = place.file
    if not path.is_file():
        raise CatalogError(f"{path}: no such file; name an existing DBC")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise CatalogError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB; is this a DBC?")
    try:
        if path.suffix.lower() in eds.SUFFIXES:
            return eds.load(path, place.node)
        database = cantools.database.load_file(str(path), strict=False)
    except eds.EdsError as error:
        raise CatalogError(f"{path}: {error}") from error
    except Exception as error:  # cantools' parsers raise whatever their grammar trips over
        raise CatalogError(f"{path}: not a readable DBC: {error}") from error
    if not isinstance(database, Database):
        raise CatalogError(f"{path}: a diagnostics database, not a CAN database; name a DBC")
    return database


def _by_name(messages: Sequence[Message]) -> dict[str, Message]:
    """Every message under a name of its own."""
    count = Counter(message.name for message in messages)
    declared: dict[str, Message] = {}
    for message in messages:
        name, digits = message.name, 8 if message.is_extended_frame else 3
        if count[name] > 1:
            name = f"{name}-{message.frame_id:0{digits}X}"
        again = (f"{name}-{k}" for k in itertools.count(2))  # the same message twice
        while name in declared:
            name = next(again)
        declared[name] = message
    return declared


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1, 0.5)
    return f"; did you mean {close[0]!r}?" if close else ""


def _fill_row(row: Record, signal: Signal, names: list[str], codes: list[int], where: str) -> None:
    """Set one LAYOUT row but its shift (changed in place) and append its codes."""
    row["kind"] = _kind(signal, where)
    row["length"] = signal.length
    row["big_endian"] = signal.byte_order == "big_endian"
    row["scale"], row["offset"] = float(signal.scale), float(signal.offset)
    row["minimum"], row["maximum"] = _range(signal)
    row["selector"] = -1
    if signal.multiplexer_signal is not None:
        row["selector"] = names.index(signal.multiplexer_signal)
    pages = [int(page) for page in signal.multiplexer_ids or ()]
    row["pages_first"], row["pages_count"] = len(codes), len(pages)
    codes += pages
    absent = _absent_codes(signal)
    row["absent_first"], row["absent_count"] = len(codes), len(absent)
    codes += absent


def _kind(signal: Signal, where: str) -> int:
    if not signal.is_float:
        return bits.SIGNED if signal.is_signed else bits.UNSIGNED
    if signal.length not in (32, 64):
        raise CatalogError(f"{where}: a float of {signal.length} bits is not supported (32, 64)")
    return bits.FLOAT32 if signal.length == 32 else bits.FLOAT64


def _place(signal: Signal, where: str) -> tuple[int, int]:
    """Where the 8 bytes begin that hold a signal, and its lowest bit in their word.

    The word is in the signal's own byte order; the 8 bytes are the first ones where these will do.
    """
    begin, is_big = signal.start, signal.byte_order == "big_endian"
    if is_big:  # DBC names the highest bit, counted within its byte
        begin = 8 * (begin // 8) + 7 - begin % 8
    if begin < 0:
        raise CatalogError(f"{where}: it begins at bit {signal.start}, before the first")
    first = begin // 8 if begin + signal.length > 8 * WORD else 0
    begin -= 8 * first
    if begin + signal.length > 8 * WORD:
        raise CatalogError(f"{where}: its {signal.length} bits lie across 9 bytes")
    return first, 8 * WORD - begin - signal.length if is_big else begin


def _leave_out_indicators(row: Record, signal: Signal) -> None:
    """Narrow the range (in place) to what J1939-71 calls a measurement.

    Of numbers of 8 bits and more those from 0xFB.. on are errors, reserved or "not available"; of
    smaller ones the two highest.
    """
    if row["kind"] != bits.UNSIGNED or signal.length < 2:
        return
    ones = 1 << signal.length
    end = 0xFB << (signal.length - 8) if signal.length >= 8 else ones - 2
    limit = float(signal.offset) + float(signal.scale) * (end - 0.5)
    if signal.scale > 0:
        row["maximum"] = min(row["maximum"], limit)
    else:
        row["minimum"] = max(row["minimum"], limit)


def _range(signal: Signal) -> tuple[float, float]:
    """Declared range, widened by half a count; infinite where the DBC declares none."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not low < high:
        return -np.inf, np.inf
    half = 0.5 * abs(float(signal.scale)) if not signal.is_float else 0.0
    return float(low) - half, float(high) + half


def _absent_codes(signal: Signal) -> list[int]:
    """Raw bit patterns of named values such as "SNA" or "not available"."""
    mask = (1 << signal.length) - 1
    choices = signal.choices.items() if signal.choices else ()
    return [int(raw) & mask for raw, name in choices if _ABSENT.fullmatch(str(name).strip())]
