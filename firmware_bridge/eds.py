"""CANopen: the process data (PDOs) of a node from its EDS or DCF, as messages of a database.

Object 0x1800 + n says under which identifier TPDO n + 1 is sent and how often (0x1400: RPDO),
0x1A00 + n (0x1600) which objects lie in it, one behind the other, lowest bit first:

    mapped = index << 16 | subindex << 8 | bits

An EDS is of a type of device: identifiers hold $NODEID.  A DCF is of one and names its node.  Units
are those of the profiles CiA 404 (measuring devices: value / 10^digits of a unit by CiA 303-2) and
CiA 406 (linear encoders: steps of nm, and of 0.01 mm/s); else a number is as it is sent.  An
object's LowLimit and HighLimit are the range of its signal: what lies outside is not available.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from configparser import Error as IniError
from configparser import RawConfigParser
from pathlib import Path
from typing import NamedTuple

from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion

SUFFIXES = (".eds", ".dcf")
KINDS = {"TPDO": (0x1800, 0x1A00), "RPDO": (0x1400, 0x1600)}  # where they are sent, what is in them
MOST_PDOS, MOST_MAPPED, MOST_BITS = 512, 64, 64
COB_ID, EVENT_TIMER_MS = 1, 5  # subindices of the first
SWITCHED_OFF, IS_EXTENDED = 1 << 31, 1 << 29
DUMMIES = 0x1F  # objects up to here only take room
BOOLEAN, REALS = 0x1, (0x8, 0x11)
INTEGERS = {0x2: 8, 0x3: 16, 0x4: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}  # bits
WHOLE = re.compile(r"[-+]?(0[xX][0-9a-fA-F]{1,16}|[1-9][0-9]{0,18}|0)")
NUMBERS = {BOOLEAN, *REALS, *INTEGERS, 0x5, 0x6, 0x7, 0x16, 0x18, 0x19, 0x1A, 0x1B}
MEASURED, FLOAT_MEASURED = (0x7130, 0x9130), 0x6130  # CiA 404: process values
UNIT, DIGITS = 0x6131, 0x6132
POSITIONS, SPEED, STEPS = (0x6004, 0x6020), 0x6030, 0x6005  # CiA 406
PREFIXES = {0: "", 3: "k", 6: "M", 0xFD: "m", 0xFE: "c", 0xFA: "u"}  # powers of ten, CiA 303-2
UNITS = {0x01: "m", 0x04: "A", 0x10: "rad", 0x22: "Pa", 0x26: "V", 0x41: "deg", 0x4E: "bar"}
UNITS |= {0xAB: "psi"}
PER = {0: "", 0x03: "/s"}


class EdsError(ValueError):
    """The file is no EDS, or lacks what a PDO needs; the text names the place."""


class Physical(NamedTuple):
    """Unit and scale of an object's value."""

    unit: str
    scale: float


def load(path: Path, node: int | None = None) -> Database:
    """The PDOs of a node, by `TPDO1` ... `RPDO1` ...; those that are switched off are left out.

    node: 1 to 127, which an EDS needs; a DCF names its own.  Raises EdsError.
    """
    objects = _Objects(path, node)
    return Database([m for kind in KINDS for m in _messages(objects, kind)], strict=False)


class _Objects:
    """The object dictionary: sections such as [1A00sub1], numbers with $NODEID put in."""

    def __init__(self, path: Path, node: int | None) -> None:
        parser = RawConfigParser(strict=False, delimiters=("=",), comment_prefixes=(";",))
        try:
            parser.read_string(path.read_text("latin-1"))
        except IniError as error:
            raise EdsError(f"no EDS: {error.message.splitlines()[0]}") from error
        self._sections = {name.upper(): dict(parser[name]) for name in parser.sections()}
        if "FILEINFO" not in self._sections:
            raise EdsError("no EDS: it has no section [FileInfo]")
        self._node = node or self._named_node()

    def _named_node(self) -> int | None:
        """The node that a DCF is of; the standard spells its section with one m."""
        for name in ("DEVICECOMISSIONING", "DEVICECOMMISSIONING"):
            if "nodeid" in self._sections.get(name, {}):
                return self._number(self._sections[name]["nodeid"], name)
        return None

    @property
    def indices(self) -> list[int]:
        """Indices of all objects."""
        return sorted(int(n, 16) for n in self._sections if re.fullmatch("[0-9A-F]{4}", n))

    def number(self, index: int, sub: int = 0) -> int | None:
        """Value of an object: a DCF's own, else the default; None if there is none."""
        entry = self._entry(index, sub)
        text = entry.get("parametervalue") or entry.get("defaultvalue") or ""
        if not text and sub:  # a compact list
            text = self._sections.get(f"{index:04X}VALUE", {}).get(str(sub), "")
        return self._number(text, f"{index:04X}sub{sub:X}") if text.strip() else None

    def name(self, index: int, sub: int) -> str:
        """What an object is called, as one word."""
        whole = self._whole(index).get("parametername", f"Object {index:04X}")
        part = self._entry(index, sub).get("parametername", "") if self.is_record(index) else ""
        text = whole if not part else part if part.startswith(whole) else f"{whole} {part}"
        return re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")

    def type_of(self, index: int, sub: int) -> int | None:
        """Number of an object's data type; None if it is not said."""
        parts = self._entry(index, sub), self._whole(index)
        text = next((part["datatype"] for part in parts if "datatype" in part), None)
        return self._number(text, f"{index:04X}sub{sub:X}") if text else None

    def limits(self, index: int, sub: int) -> tuple[int, int] | None:
        """Lowest and highest number of an object; None unless both are said.

        Negative ones may be written as the bits that are sent, 0xFF00 for -256.
        """
        entry, kind = self._entry(index, sub), self.type_of(index, sub)
        low, high = (entry.get(key, "").strip() for key in ("lowlimit", "highlimit"))
        if kind in REALS or not (WHOLE.fullmatch(low) and WHOLE.fullmatch(high)):
            return None
        return _signed(int(low, 0), kind), _signed(int(high, 0), kind)

    def is_record(self, index: int) -> bool:
        """Whether an object has parts."""
        return f"{index:04X}SUB0" in self._sections or "compactsubobj" in self._whole(index)

    def _whole(self, index: int) -> dict[str, str]:
        return self._sections.get(f"{index:04X}", {})

    def _entry(self, index: int, sub: int) -> dict[str, str]:
        """What is said of a part, or of an object without parts."""
        if not sub and f"{index:04X}SUB0" not in self._sections:
            return self._whole(index)
        return self._sections.get(f"{index:04X}SUB{sub:X}", {})

    def _number(self, text: str, place: str) -> int:
        total = 0
        for term in re.sub(r"\s", "", text).upper().split("+"):
            if term == "$NODEID" and self._node is None:
                raise EdsError("the EDS of a type of device: add its node id, as in valve.eds:5")
            try:
                total += self._node or 0 if term == "$NODEID" else int(term, 0)
            except ValueError:
                raise EdsError(f"[{place}]: {text!r} is no whole number") from None
        return total


def _signed(number: int, kind: int | None) -> int:
    """A number of a signed type whose bits were written as those of an unsigned one."""
    bits = INTEGERS.get(kind or 0, 0)
    return number - (1 << bits) if bits and number >> (bits - 1) == 1 else number


def _messages(objects: _Objects, kind: str) -> Iterator[Message]:
    sent, mapped = KINDS[kind]
    for index in objects.indices:
        n = index - sent
        if 0 <= n < MOST_PDOS and objects.number(mapped + n):
            message = _message(objects, f"{kind}{n + 1}", index, mapped + n)
            if message is not None:
                yield message


def _message(objects: _Objects, name: str, sent: int, mapped: int) -> Message | None:
    """One PDO; None if it is switched off."""
    cob_id = objects.number(sent, COB_ID)
    if cob_id is None or cob_id & SWITCHED_OFF:
        return None
    signals, n_bits = _signals(objects, mapped)
    long = bool(cob_id & IS_EXTENDED)
    return Message(
        cob_id & (0x1FFF_FFFF if long else 0x7FF), name, -(-n_bits // 8), signals,
        is_extended_frame=long, cycle_time=objects.number(sent, EVENT_TIMER_MS) or None,
        strict=False,
    )  # fmt: skip


def _signals(objects: _Objects, mapped: int) -> tuple[list[Signal], int]:
    """The numbers that lie in a PDO, and how many bits it has."""
    signals: list[Signal] = []
    begin = 0
    for k in range(min(objects.number(mapped) or 0, MOST_MAPPED)):
        entry = objects.number(mapped, k + 1) or 0
        index, sub, length = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        if begin + length > MOST_BITS:
            raise EdsError(f"[{mapped:04X}]: more than {MOST_BITS} bits are mapped")
        if index > DUMMIES and length and objects.type_of(index, sub) in NUMBERS:
            taken = {signal.name for signal in signals}
            signals.append(_signal(objects, index, sub, begin, length, taken))
        begin += length
    return signals, begin


def _signal(
    objects: _Objects, index: int, sub: int, begin: int, length: int, taken: set[str]
) -> Signal:
    name, kind = objects.name(index, sub), objects.type_of(index, sub)
    unit, scale = _physical(objects, index, sub)
    low, high = objects.limits(index, sub) or (0, 0)  # which is none
    return Signal(
        f"{name}_{index:04X}" if name in taken else name, begin, length,
        is_signed=kind in INTEGERS, unit=unit or None,
        minimum=scale * low, maximum=scale * high,
        conversion=BaseConversion.factory(scale=scale, is_float=kind in REALS),
    )  # fmt: skip


def _physical(objects: _Objects, index: int, sub: int) -> Physical:
    """What a value means by the device's profile; no unit and 1 where it does not say."""
    if index in (*MEASURED, FLOAT_MEASURED):
        code = objects.number(UNIT, sub) or 0
        known = PREFIXES.get(code >> 24), UNITS.get(code >> 16 & 0xFF), PER.get(code >> 8 & 0xFF)
        digits = 0 if index == FLOAT_MEASURED else objects.number(DIGITS, sub) or 0
        unit = "" if None in known else "".join(map(str, known))
        return Physical(unit, 10.0**-digits)
    step = objects.number(STEPS, 2 if index == SPEED else 1)
    if step and index in POSITIONS:
        return Physical("mm", 1e-6 * step)
    return Physical("mm/s", 0.01 * step) if step and index == SPEED else Physical("", 1.0)
