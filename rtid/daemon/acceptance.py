"""A changed machine is to be the new normal: what `rtid accept` leaves in the state folder.

The daemon opens no port.  It looks for one small file, takes it away, and answers in its status.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

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
    temporary.write_text(json.dumps(asdict(request)), "utf-8")
    os.replace(temporary, folder / FILE)


def withdraw(folder: Path) -> None:
    """Take a request back that nobody has heard."""
    (folder / FILE).unlink(missing_ok=True)


def taken(folder: Path) -> Acceptance | None:
    """The request that lies there, taken away; one that cannot be read is no request."""
    path = folder / FILE
    try:
        content = json.loads(path.read_bytes())
        path.unlink()
        return Acceptance(float(content["at_unix_s"]), str(content["who"]), str(content["reason"]))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        path.unlink(missing_ok=True)
        return None
