"""Why nothing is learned, kept beside the snapshots: a restart must not forget it."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from rtid.daemon.jobs import Foretold
from rtid.daemon.log import logger
from rtid.trace.snapshot import WATCH_FILE
from rtid.trace.state_files import made_folder, read_bytes, write_whole


def remember(folder: Path | None, cause: Foretold | None, is_changed: bool) -> None:
    """Write it, or take it away where the machine does what the map says."""
    if folder is None:
        return
    try:
        if is_changed:
            made_folder(folder)
            words = {"text": cause.text, "of_sensor": cause.of_sensor} if cause else {}
            write_whole(folder / WATCH_FILE, json.dumps(words).encode())
        else:
            (folder / WATCH_FILE).unlink(missing_ok=True)
    except OSError as error:  # the alarm stands; a restart has the baseline to find out again
        logger.warning("the suspension is not kept: %s", error)


def suspended(folder: Path | None) -> Foretold | None:
    """What the run before has left behind; what cannot be read is a reason as well."""
    if folder is None or not (folder / WATCH_FILE).exists():
        return None
    words: object = None
    with contextlib.suppress(OSError, ValueError):
        words = json.loads(read_bytes(folder / WATCH_FILE))
    known = words if isinstance(words, dict) else {}
    return Foretold("contradicted", 0.0, str(known.get("text", "")), bool(known.get("of_sensor")))
