"""`rtid run`: the on-board daemon, beside a real controller for months."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import TestBus
from rtid.errors import RtidError

if TYPE_CHECKING:
    from firmware_bridge.sources.live import Source
    from rtid.project import Project

TEST_BUSES = ("udp_multicast", "virtual")  # nobody on them can be trusted: they ask for a word
LOG_SERVICE_S = 60.0


def run(
    project: Annotated[Path, typer.Argument(help="Project file.")],
    bus: Annotated[
        str | None,
        typer.Option(help="INTERFACE[:CHANNEL] in place of the file's, e.g. socketcan:can0."),
    ] = None,
    for_s: Annotated[
        float | None, typer.Option("--for", min=0.1, help="Seconds to run; until stopped without.")
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", min=1, max=20_000, help="Of the loop, Hz.")
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help="Folder of snapshots, history, alarms; else the file's.")
    ] = None,
    test_bus: TestBus = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Do not go on with what the folder holds.")
    ] = False,
    page: Annotated[
        bool, typer.Option("--ui", help="Also serve the live page, from a process of its own.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the last status as JSON at the end.")
    ] = False,
) -> None:
    """Learn on board: listen to the bus, keep state, raise alarms, offer maps, diagnose.

    It sends nothing, but for its status where the project file says publish.status = true.

    One line of statistics each second on a terminal, each minute in a log; `rtid status` tells more
    from another shell.  SIGTERM, SIGHUP and Ctrl-C end it in good order, with what was
    learned stored; exit code 4 where that is not on the disk.
    """
    from rtid.daemon import log
    from rtid.daemon.daemon import Bus, Daemon, stopped_by_signals
    from rtid.project import load
    from rtid.project.folder import configured, state_folder

    log.set_up()
    loaded = configured(load(project), rate_hz)
    _note_untrusted(loaded)
    _refuse_unfit_prior(loaded)
    source = loaded.sections.source
    wanted = bus or f"{source.interface or ''}:{source.channel or ''}"
    interface, _, channel = wanted.partition(":")
    _refuse_untrusted(interface, project, test_bus)
    folder = state or state_folder(loaded)
    chosen = Bus(interface, channel, _opener(loaded, interface, channel))
    daemon = Daemon(loaded, chosen, folder, 1.0 if sys.stderr.isatty() else LOG_SERVICE_S, fresh)
    with _served(project, folder) if page else nullcontext(), stopped_by_signals(daemon):
        last = daemon.run(for_s)
    if as_json:
        print(last.to_json())
    if not daemon.is_saved:
        raise typer.Exit(Exit.NEGATIVE)


@contextmanager
def _served(project: Path, state: Path) -> Iterator[None]:
    """The page beside the daemon: it reads one small file, and comes after everything else."""
    command = [sys.executable, "-m", "rtid", "ui", str(project), "--state", str(state), "--no-open"]
    served = subprocess.Popen(["nice", "-n", "10", *command])
    try:
        yield
    finally:
        served.terminate()
        served.wait()


def _note_untrusted(loaded: Project) -> None:
    """It learns without: the effects in Python are candidates of the diagnosis alone."""
    from rtid.daemon.log import logger
    from rtid.project.trust import NotTrustedError

    if loaded.untrusted is not None:
        error = NotTrustedError(loaded.path, loaded.untrusted)
        logger.warning("%s: the diagnosis does without its effects (%s)", error, error.remedy)


def _refuse_unfit_prior(loaded: Project) -> None:
    """Here, not in the log: the helper that publishes would have nobody to tell."""
    if loaded.sections.prior is not None:
        from rtid.maps.prior_map import find_prior

        find_prior(loaded)


def _refuse_untrusted(interface: str, project: Path, test_bus: bool) -> None:
    if not interface:
        raise RtidError(
            f"{project}: source.interface is missing",
            "name a bus: --bus socketcan:can0",
            Exit.USAGE,
        )
    if interface in TEST_BUSES and not test_bus:
        raise RtidError(
            f"{interface}: anybody may write to it, and nobody signs what he writes",
            "add --test-bus if that is what you want",
            Exit.USAGE,
        )


def _opener(loaded: Project, interface: str, channel: str) -> Callable[[], Source]:
    """How to open the bus, listening only, with the frames of the project alone."""
    from firmware_bridge.j1939 import Network
    from firmware_bridge.sources.live_bus import open_live
    from rtid.trace.described import catalog_of

    catalog = catalog_of(loaded)
    messages = loaded.assembly.messages
    can_ids = [catalog.can_id(message.name) for message in messages]
    takes_all = interface in ("serial", "slcan") or Network(catalog, messages).is_needed
    bitrate = loaded.sections.source.bitrate
    fd = {"fd": True} if loaded.sections.source.fd else {}
    return lambda: open_live(
        interface,
        channel or None,
        bitrate=bitrate if interface not in (*TEST_BUSES, "serial", "socketcan") else None,
        can_ids=None if takes_all else can_ids,
        reopen_s=math.inf,
        **fd,
    )
