"""Any captured CAN log as one batch of frames; the suffix chooses the reader.

BLF and candump logs have bulk readers of our own; ASC, TRC and CSV go through python-can's.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path

import can

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import blf, candump, mf4
from firmware_bridge.sources.errors import LogError

READERS: dict[str, Callable[[Path], Frames]] = {
    ".blf": blf.read,
    ".log": candump.read,
    ".mf4": mf4.read,
}
PYTHON_CAN = {".asc": can.ASCReader, ".trc": can.TRCReader, ".csv": can.CSVReader}
SUFFIXES = (*READERS, *PYTHON_CAN)


def open_log(path: str | Path) -> Frames:
    """All data frames of a log, in file order; `refused` says what was left out and why.

    Raises LogError if the file is absent, empty, or not of the kind that its suffix says.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    suffix = path.suffix.lower()
    if suffix in READERS:
        return READERS[suffix](path)
    if suffix in PYTHON_CAN:
        return _read_with_python_can(path, suffix)
    raise LogError(f"{path}: unknown suffix {suffix!r}; known are {', '.join(SUFFIXES)}")


def _read_with_python_can(path: Path, suffix: str) -> Frames:
    """Frames until the end, or until the reader trips over a damaged line (counted)."""
    text = path.read_text(encoding="utf-8", errors="replace")
    whole = text[: text.rfind("\n") + 1]  # a cut last line may look like a shorter frame
    failures: list[Exception] = []
    found = fr.from_messages(_messages(whole, suffix, failures))
    if failures and len(found) == 0:
        raise LogError(f"{path}: not a readable {suffix} log: {failures[0]}") from failures[0]
    if failures or len(whole) < len(text):
        fr.add_counts(found.refused, {"truncated": 1})
    return found


def _messages(text: str, suffix: str, failures: list[Exception]) -> Iterator[can.Message]:
    try:
        with PYTHON_CAN[suffix](io.StringIO(text)) as reader:
            yield from reader
    except Exception as error:  # python-can's text readers raise whatever a damaged line causes
        failures.append(error)
