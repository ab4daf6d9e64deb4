"""Tells the controller how rtid is, once a second, where `publish.status` has armed it.

The only frames that a daemon sends by itself; firmware_bridge/download.md describes them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from firmware_bridge import protocol
from firmware_bridge.playback import SendError
from rtid.apply import offer as offered
from rtid.apply import reach
from rtid.daemon.log import logger
from rtid.daemon.status import Status
from rtid.project import Project

EVERY_S = 1.0
RETRY_S = 10.0
LEARNING = ("waiting", "learning", "held", "suspended", "stopped")
VERDICTS = ("", "matches", "missing", "ambiguous", "unknown", "insufficient_data")
STALE, IS_OFFERED = 1, 2


def frames_of(status: Status, is_offered: bool, counter: int) -> list[bytes]:
    """STATUS, then BETA of each chamber whose bulk modulus is known."""
    estimate = status.estimate
    verdict = status.verdict.verdict if status.verdict is not None else ""
    blocks, edges = estimate.blocks, [edge for edge in estimate.edges if edge.blocks]
    progress = sum(edge.progress for edge in edges) / max(1, len(edges))
    frame = protocol.status_frame(
        LEARNING.index(estimate.state),
        VERDICTS.index(verdict) if verdict in VERDICTS else 0,
        len(status.on),
        round(100 * progress),
        round(100 * blocks.get("valid", 0) / max(1, sum(blocks.values()))),
        STALE * estimate.stale + IS_OFFERED * is_offered,
        counter,
    )
    return [frame] + [
        protocol.beta_frame(k, chamber.beta_pa, chamber.beta_sd_pa or 0.0)
        for k, chamber in enumerate(estimate.chambers)
        if chamber.beta_pa is not None
    ]


@contextmanager
def telling(
    project: Project, bus: tuple[str, str], folder: Path, status: Callable[[], Status | None]
) -> Iterator[None]:
    """Tell until the block ends, from a thread; nothing at all unless publish.status is true."""
    section = project.sections.publish
    if not section.status or section.status_id is None:
        yield
        return
    reach.check(project)
    chosen = reach.bus_of(project) if section.interface else bus
    stopped = threading.Event()
    args = (project, chosen, folder, status, stopped)
    thread = threading.Thread(target=_tell, args=args, name="rtid-notices", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join(RETRY_S)


def _tell(
    project: Project,
    bus: tuple[str, str],
    folder: Path,
    status: Callable[[], Status | None],
    stopped: threading.Event,
) -> None:
    can_id, counter = project.sections.publish.status_id or 0, 0
    while not stopped.is_set():
        try:
            with reach.armed(project, *bus, can_id) as link:
                logger.info("telling status on %s %s as 0x%X", *bus, can_id)
                while not stopped.wait(EVERY_S):
                    now, counter = status(), counter + 1
                    if now is not None:
                        for data in frames_of(now, offered.exists(folder), counter):
                            link.tell(data)
        except SendError as error:
            logger.warning("status not told: %s", error)
            stopped.wait(RETRY_S)
