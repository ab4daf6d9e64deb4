"""A changed machine is to be the new normal: what `rtid accept` leaves in the state folder.

The daemon opens no port.  It looks for one small file, takes it away, and answers in its status.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from rtid.trace.state_files import read_bytes, write_bytes

FILE = "accept.json"


@dataclass(frozen=True)
class Acceptance:
    """Who has accepted the change, when and why."""

    at_unix_s: float
    who: str
    reason: str


def ask(folder: Path, request: Acceptance) -> None:
    """Leave a request; OSError where this user may not write there."""
    temporary = folder / f"{FILE}.part"
    write_bytes(temporary, json.dumps(asdict(request)).encode())
    os.replace(temporary, folder / FILE)


def withdraw(folder: Path) -> bool:
    """Take a request back that nobody has heard; False where somebody has."""
    try:
        (folder / FILE).unlink()
    except FileNotFoundError:
        return False
    return True


def taken(folder: Path) -> Acceptance | None:
    """The request that lies there, taken away; what cannot be read is no request.

    OSError where something lies there that cannot be taken away.
    """
    path = folder / FILE
    if not os.path.lexists(path):
        return None
    try:
        content = read_bytes(path, follow=False)
    except OSError:  # a FIFO, a folder, a link, not for us to read
        content = b""
    path.unlink(missing_ok=True)
    try:
        document = json.loads(content)
        return Acceptance(
            float(document["at_unix_s"]), str(document["who"]), str(document["reason"])
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
