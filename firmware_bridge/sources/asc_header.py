"""The header of an ASC log: when it begins, base of the numbers, kind of the time stamps.

date Thu Apr 28 10:44:52.480 am 2022
base hex  timestamps absolute
Begin TriggerBlock Thu Apr 28 10:44:52.480 am 2022
"""

from __future__ import annotations

import datetime
import re
from difflib import get_close_matches
from typing import NamedTuple

# English and German, without what is not ASCII
_MONTHS = {
    "jan": 1, "feb": 2, "mar": 3, "mr": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6, "jul": 7,
    "aug": 8, "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12,
}  # fmt: skip
_DATE = re.compile(
    r"(\w{2,3})\w*\.? +(\d+) +(\d+):(\d+):(\d+)(?:\.(\d+))?(?: +([ap])m)? +(\d{4})", re.IGNORECASE
)


class Header(NamedTuple):
    """What the header says.

    start_us: microseconds since 1970, 0 if unknown; base: 10, 16, or 0 if it is not stated
    readably; has_end_mark: the log will end with "End TriggerBlock".
    """

    start_us: int
    has_bad_date: bool
    has_bad_base: bool
    base: int
    is_relative: bool
    has_end_mark: bool


def header(raw: bytes) -> Header:
    """Read the header from the first bytes of a log."""
    head = raw.decode("ascii", "ignore")
    words = re.findall("[a-z]+", re.sub("//.*", "", head.lower()))
    stated = re.search(r"base +(hex|dec)\b", head, re.IGNORECASE)
    block = re.search(r"begin +triggerblock +(\w.*)", head, re.IGNORECASE)
    named = block or re.search(r"^\s*date +(\w.*)", head, re.IGNORECASE | re.MULTILINE)
    start_us = _start_us(named[1]) if named else 0
    return Header(
        start_us or 0,
        start_us is None,
        stated is None and bool(get_close_matches("base", words, 1, 0.7)),
        {"hex": 16, "dec": 10}[stated[1].lower()] if stated else 0,
        bool(get_close_matches("relative", words, 1, 0.8)),  # one letter may be damaged
        block is not None,
    )


def _start_us(date: str) -> int | None:
    """Microseconds since 1970 of a date in local time; None if it is none."""
    match = _DATE.search(date)
    if not match:
        return None
    month, day, hour, minute, second, milli, half, year = match.groups()
    if half:
        hour = int(hour) % 12 + 12 * (half.lower() == "p")
    try:
        start = datetime.datetime(
            int(year), _MONTHS[month.lower()], int(day), int(hour), int(minute), int(second)
        ).timestamp()
    except (KeyError, ValueError, OverflowError):  # a damaged year may have forty digits
        return None
    # three digits, which python-can writes without their leading zeros
    milli = round(int(milli) * 10.0 ** min(0, 3 - len(milli))) if milli else 0
    return round(start) * 1_000_000 + milli * 1000
