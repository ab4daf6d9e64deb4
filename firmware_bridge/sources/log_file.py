"""Any captured CAN log as one batch of frames; the suffix chooses the reader.

All readers but that of MF4 are bulk readers of our own, which resynchronise: damage costs the line
or container that it hit, never a wrong frame that the format could tell.  MF4 goes through asammdf.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.frames import Frames
from firmware_bridge.sources import asc, blf, can_csv, candump, mf4, trc
from firmware_bridge.sources.errors import LogError
from firmware_bridge.steps import Continuous

READERS: dict[str, Callable[[Path], Frames]] = {
    ".blf": blf.read,
    ".log": candump.read,
    ".asc": asc.read,
    ".trc": trc.read,
    ".csv": can_csv.read,
    ".mf4": mf4.read,
}
LOOKS = {  # how files begin
    ".blf": rb"LOGG",
    ".mf4": rb"MDF  |UnFinMF ",
    ".log": rb"\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#",
    ".trc": rb";\$FILEVERSION|;#{20}",
    ".csv": rb"timestamp,arbitration_id,",
    ".asc": rb"date \w+ \w+ |base (hex|dec)",
}
HEAD_BYTES = 256


def open_log(path: str | Path) -> Frames:
    """All data frames of a log, in file order; `refused` says what was left out and why.

    "truncated" in `refused`: the file ends within a line, container or block, or before its end
    mark; "clock_step": the recorder's clock was set back, which became a gap.  Raises LogError if
    the file is absent, empty, a folder, or not of the kind that its suffix says.
    """
    path = Path(path)
    if path.is_dir():
        raise LogError(f"{path}: a folder; name one log file in it")
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    suffix, looks = path.suffix.lower(), _looks_like(path)
    hint = f"; it looks like {looks}: give it that suffix" if looks else ""
    if suffix not in READERS:
        raise LogError(f"{path}: unknown suffix {suffix!r}; known are {', '.join(READERS)}{hint}")
    if looks and looks != suffix:
        raise LogError(f"{path}: not a {suffix} log{hint}")
    return Continuous().push(READERS[suffix](path))


def _looks_like(path: Path) -> str:
    """The suffix that the first bytes of a file speak for; "" if none."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return next((kind for kind, look in LOOKS.items() if re.match(look, head)), "")
