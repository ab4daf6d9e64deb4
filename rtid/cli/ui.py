"""`rtid ui`: a record and its model in the browser, on this machine alone."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from rtid.cli.exits import refuse_without_bokeh
from rtid.cli.options import AnyProject, told_apart
from rtid.errors import RtidError


def ui(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[TRACE...] [PROJECT]",
            help="CAN log or table, and project file; of several records, one fit.  Without a "
            "project the page makes one, without a trace it is the live page.",
        ),
    ] = None,
    project: AnyProject = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 5006,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    state: Annotated[
        Path | None,
        typer.Option(help="State folder of a running daemon, for the live page; else the file's."),
    ] = None,
    sheet: Annotated[
        Path | None,
        typer.Option("--map", help="Data sheet or exported map to hold beside the learned one."),
    ] = None,
    test_bus: Annotated[
        bool, typer.Option("--test-bus", help="Apply over udp_multicast too: no authentication.")
    ] = False,
    open_page: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Compare a record with its model in the browser: where it fails, why, and add what is missing.

    Without a project, the page looks at a file that is dropped on it, and makes one.
    The page is served to this machine alone, to whoever has the printed address with its token,
    and loads nothing from anywhere else.  Of several browsers one works, the others follow.  From
    another machine: ssh -L 5006:127.0.0.1:5006 DEVICE.  Ctrl-C, SIGTERM and SIGHUP end it.
    """
    traces, project = told_apart(files or [], project, "ui", most=None)
    for path in (project, *traces):
        if path is not None and not path.exists():
            raise RtidError(f"{path}: no such file", "rtid ui TRACE -p PROJECT")
    refuse_without_bokeh()
    from firmware_bridge.compiling import do_without
    from rtid.ui.worker import started

    do_without()  # the worker computes, the server shows

    is_record = bool(traces) and project is not None
    # the worker imports beside the server
    with TemporaryDirectory(prefix="rtid-ui-") as scrap, started(ahead=is_record) as worker:
        from rtid.project import load
        from rtid.project.folder import state_folder
        from rtid.ui.server import Workbench, serve

        def ready(bench: Workbench) -> None:
            print(f"{bench.url}  (Ctrl-C ends it)", flush=True)
            if open_page:
                typer.launch(_doorstep(bench.url, Path(scrap)).as_uri())

        folder = state or (state_folder(load(project)) if project else None)
        serve(
            ready,
            project=project,
            trace=traces[0] if traces else None,
            more=traces[1:],
            state=folder,
            host=host,
            port=port,
            sheet=sheet,
            test_bus=test_bus,
            worker=worker,
        )


def _doorstep(url: str, folder: Path) -> Path:
    """A file of the user's own that leads to the page.

    The arguments of a browser that is started with the address can be read by everybody.
    """
    path = folder / "open.html"
    path.write_text(f'<!DOCTYPE html><meta http-equiv="refresh" content="0;url={url}">', "utf-8")
    path.chmod(0o600)
    return path
