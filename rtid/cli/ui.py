"""`rtid ui`: a record and its model in the browser, on this machine alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.exits import refuse_without_bokeh
from rtid.errors import RtidError


def ui(
    project: Annotated[Path, typer.Argument(help="Project file.")],
    trace: Annotated[
        Path | None, typer.Argument(help="CAN log or table; without it, the live page alone.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 5006,
    host: Annotated[
        str, typer.Option(help="Address to serve on; beyond 127.0.0.1 it takes a token.")
    ] = "127.0.0.1",
    state: Annotated[
        Path | None,
        typer.Option(help="State folder of a running daemon, for the live page; else the file's."),
    ] = None,
    sheet: Annotated[
        Path | None,
        typer.Option("--map", help="Data sheet or exported map to hold beside the learned one."),
    ] = None,
    open_page: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Compare a record with its model in the browser: where it fails, why, and add what is missing.

    The page is served to this machine alone and loads nothing from anywhere else.  From another
    machine: ssh -L 5006:127.0.0.1:5006 DEVICE.
    """
    for path in (project, trace):
        if path is not None and not path.exists():
            raise RtidError(f"{path}: no such file", "rtid ui PROJECT [TRACE]")
    refuse_without_bokeh()
    from rtid.daemon.configure import state_folder
    from rtid.project import load
    from rtid.ui.server import Workbench, serve

    folder = state or state_folder(load(project))

    def ready(bench: Workbench) -> None:
        print(f"{bench.url}  (Ctrl-C ends it)", flush=True)
        if open_page:
            typer.launch(bench.url)

    serve(
        ready,
        project=project,
        trace=trace,
        state=folder,
        host=host,
        port=port,
        sheet=sheet,
    )
