"""`rtid accept`: the machine has changed, and this is how it is to be."""

from __future__ import annotations

import getpass
import time

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import Reason, Where
from rtid.errors import RtidError

WAIT_S = 30.0


def accept(where: Where, reason: Reason = "") -> None:
    """Take a changed machine for the new normal: the running daemon learns on from the change.

    Its maps begin anew with the samples since the change; what was learned before is kept as a
    point in time.  Who accepted it, when and why stands in history.sqlite.  Exit code
    4 where no change has been noticed.
    """
    from rtid.daemon import acceptance
    from rtid.daemon.status import OLD_S, read
    from rtid.project.folder import state_of

    folder = state_of(where)
    status = read(folder)
    if time.time() - status.now_unix_s > OLD_S:
        raise RtidError(f"{folder}: no daemon is running here", "start it with `rtid run`")
    if not status.has("plant_changed"):
        print(f"{status.name}: nothing to accept, the machine does what the map says")
        raise typer.Exit(Exit.NEGATIVE)
    request = acceptance.Acceptance(time.time(), getpass.getuser(), reason)
    acceptance.ask(folder, request)
    end_s = time.monotonic() + WAIT_S
    while read(folder).has("plant_changed"):
        if time.monotonic() > end_s:
            if not acceptance.withdraw(folder):
                print(f"{status.name}: the daemon has heard it, and is learning anew")
                return
            raise RtidError(
                f"{folder}: the daemon has not answered within {WAIT_S:g} s", "see its log"
            )
        time.sleep(0.2)
    print(f"{status.name}: accepted; it learns on from the change, the former state is kept aside")
