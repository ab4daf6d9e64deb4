"""Catalog: what a DBC says, read once with cantools and turned into plain bit layouts."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from firmware_bridge import bits
from firmware_bridge.config import MessageSource
from firmware_bridge.frames import EXTENDED, MAX_LENGTH
from firmware_bridge.jit import Record, Records

CONTROLLER_DBC = Path(__file__).with_name("controller.dbc")
MAX_FILE_BYTES = 16 << 20  # a hostile file must not cost minutes or gigabytes
MAX_SIGNALS = 200_000

_ABSENT = re.compile(r"(sna|n/?a|not[ _-]?avail\w*|signal[ _-]?not[ _-]?avail\w*|invalid)", re.I)


class CatalogError(ValueError):
    """The DBC cannot be read, or does not hold what is asked for; the text names the remedy."""


@dataclass(frozen=True)
class Layouts:
    """Bit layouts of chosen signals of one message.

    rows: LAYOUT (n,), the chosen signals first, then the multiplexers they depend on;
    names: the chosen ones; codes: uint64 (c,), pages and absent codes that the rows point to.
    """

    names: tuple[str, ...]
    rows: Records
    codes: NDArray[np.uint64]

    def decode(self, data: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Values float64 (n, len(names)) of payloads uint8 (n, 8); NaN where not available."""
        words = np.ascontiguousarray(data).view("<u8")[:, 0]
        values = bits.decode_words(words, self.rows, len(self.names), self.codes)
        return cast("NDArray[np.float64]", values.T)

    def encode(self, values: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Payloads uint8 (n, 8) from values (n, len(names)): saturating, NaN = not available."""
        words = np.zeros(len(values), np.dtype("<u8"))
        bits.encode_words(np.asarray(values, np.float64), self.rows, words)
        return words.view(np.uint8).reshape(-1, MAX_LENGTH)


class Catalog:
    """The messages and signals of one DBC."""

    def __init__(self, database: Database) -> None:
        n_signals = sum(len(message.signals) for message in database.messages)
        if n_signals > MAX_SIGNALS:
            raise CatalogError(f"the DBC has {n_signals} signals; the limit is {MAX_SIGNALS}")
        self._messages = {message.name: message for message in database.messages}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all messages."""
        return tuple(self._messages)

    def message(self, name: str) -> Message:
        """The cantools message `name`; CatalogError with the nearest name if there is none."""
        if name not in self._messages:
            raise CatalogError(f"the DBC has no message {name!r}" + _nearest(name, self._messages))
        return self._messages[name]

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
        found = self.message(message)
        return found.frame_id | (EXTENDED if found.is_extended_frame else 0)

    def layouts(self, message: str, signals: Sequence[str] | None = None) -> Layouts:
        """Bit layouts of the named signals of a message (all if None)."""
        found = self.message(message)
        wanted = [s.name for s in found.signals] if signals is None else list(signals)
        names = list(wanted)
        for name in names:  # grows while it runs: selectors may have selectors
            above = self.signal(message, name).multiplexer_signal
            if above is not None and above not in names:
                names.append(above)
        codes: list[int] = []
        rows = np.zeros(len(names), bits.LAYOUT)
        for row, name in zip(rows, names, strict=True):
            _fill_row(row, self.signal(message, name), names, codes, message)
        return Layouts(tuple(wanted), rows, np.array(codes, np.uint64))

    def byte_of(self, message: str, signal: str) -> int:
        """Index of the byte that a checksum fills; CatalogError if it is not one whole byte."""
        row = self.layouts(message, [signal]).rows[0]
        if row["length"] != 8 or row["shift"] % 8:
            raise CatalogError(f"{message}.{signal}: a CRC-8 must fill one whole byte")
        byte = int(row["shift"]) // 8
        return 7 - byte if row["big_endian"] else byte

    def message_source(self, message: str, channel: int | None = None) -> MessageSource:
        """Period and end-to-end protection as the DBC's attributes and signal names tell them.

        GenMsgCycleTime gives the period, E2EDataId the data id; a signal `AliveCounter` is the
        counter and `Crc` the checksum.  Anything absent stays at its default (period 0).
        """
        found = self.message(message)
        names = {s.name for s in found.signals}
        data_id = found.dbc.attributes.get("E2EDataId") if found.dbc else None
        return MessageSource(
            name=message,
            period_s=(found.cycle_time or 0) * 1e-3,
            counter="AliveCounter" if "AliveCounter" in names else None,
            crc="Crc" if "Crc" in names else None,
            data_id=int(data_id.value) if data_id else 0,
            channel=channel,
        )


def load(path: str | Path = CONTROLLER_DBC) -> Catalog:
    """Read a DBC (or any other database that cantools knows); CatalogError if it cannot be."""
    path = Path(path)
    if not path.is_file():
        raise CatalogError(f"{path}: no such file; name an existing DBC")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise CatalogError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB; is this a DBC?")
    try:
        database = cantools.database.load_file(str(path), strict=False)
    except Exception as error:  # cantools' parsers raise whatever their grammar trips over
        raise CatalogError(f"{path}: not a readable DBC: {error}") from error
    if not isinstance(database, Database):
        raise CatalogError(f"{path}: a diagnostics database, not a CAN database; name a DBC")
    try:
        return Catalog(database)
    except CatalogError as error:
        raise CatalogError(f"{path}: {error}") from None


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1, 0.5)
    return f"; did you mean {close[0]!r}?" if close else ""


def _fill_row(
    row: Record, signal: Signal, names: list[str], codes: list[int], message: str
) -> None:
    """Set one LAYOUT row (changed in place) and append its codes."""
    where = f"{message}.{signal.name}"
    row["kind"] = _kind(signal, where)
    row["length"] = signal.length
    row["big_endian"] = signal.byte_order == "big_endian"
    row["shift"] = _shift(signal, where)
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


def _shift(signal: Signal, where: str) -> int:
    """Position of the lowest bit in the word of the signal's own byte order."""
    first = signal.start
    if signal.byte_order == "big_endian":  # DBC names the highest bit, counted within its byte
        first = 8 * (signal.start // 8) + 7 - signal.start % 8
    if first + signal.length > 8 * MAX_LENGTH:
        raise CatalogError(f"{where}: lies beyond byte {MAX_LENGTH}; only classic CAN is supported")
    return 64 - first - signal.length if signal.byte_order == "big_endian" else first


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
