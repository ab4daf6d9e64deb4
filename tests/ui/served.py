"""A workbench that runs in a thread of its own, for tests that are its clients."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rtid.ui.server import Workbench, start

PATIENCE_S = 60.0


@contextmanager
def served(**where: Any) -> Iterator[Workbench]:
    """Serve until the block ends; arguments as of `rtid.ui.server.start`."""
    ready: Future[tuple[Workbench, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def run() -> None:
        over = asyncio.Event()
        try:
            bench = start(**where)
        except BaseException as error:
            ready.set_exception(error)
            return
        ready.set_result((bench, asyncio.get_running_loop(), over))
        await over.wait()
        bench.stop()

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    bench, loop, over = ready.result(PATIENCE_S)
    try:
        yield bench
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(PATIENCE_S)


def project_file(folder: Path) -> Path:
    """A project whose page can be opened without a record."""
    from rtid.project import load

    path = Path(__file__).parents[2] / "rtid" / "project" / "examples" / "cylinder.toml"
    load(path)
    return path
