"""All jobs of a fleet on dask.distributed: a local cluster by default, a scheduler's address else.

A few jobs per worker are under way at a time, so that memory does not grow with their number; a
worker that dies takes one job with it, which gets a row that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from itertools import islice
from typing import Any

from rtid.errors import RtidError
from rtid.fleet.archive import Archive
from rtid.fleet.learning import Outcome, empty_row, outcome
from rtid.fleet.traces import TraceJob

AHEAD = 3  # jobs under way per worker
HERE = "127.0.0.1"

Progress = Callable[[int, int, Outcome], None]


def run(
    jobs: list[TraceJob],
    archive: Archive,
    progress: Progress,
    *,
    workers: int = 2,
    scheduler: str = "",
    with_diagnosis: bool = True,
) -> int:
    """Do every job that has no row yet; how many were done.  Raises RtidError without distributed.

    scheduler: address of a cluster whose workers have rtid and see the traces under the same paths.
    progress is told how many are done, of how many, and the last one.
    """
    known = archive.done()
    waiting = [job for job in jobs if job.key not in known]
    if not waiting:
        return 0
    with connected(min(workers, len(waiting)), scheduler) as client:
        for n, result in enumerate(_outcomes(client, waiting, with_diagnosis), 1):
            archive.keep(result)
            progress(n, len(waiting), result)
    return len(waiting)


@contextmanager
def connected(workers: int, scheduler: str) -> Iterator[Any]:
    """A dask client of the scheduler, or of a cluster of processes on this machine."""
    if find_spec("distributed") is None:
        raise RtidError("a fleet needs dask.distributed", "pip install 'rtid[fleet]'", 2)
    import dask  # noqa: PLC0415 - an extra, and slow to import
    import distributed  # noqa: PLC0415

    cluster: Any = distributed.LocalCluster
    client: Any = distributed.Client
    board = f"{HERE}:0" if find_spec("bokeh") else None
    once = {"distributed.scheduler.allowed-failures": 0}  # a job that killed one worker is enough
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(once))
        if not scheduler:
            local = cluster(
                n_workers=workers, threads_per_worker=1, host=HERE, dashboard_address=board,
                silence_logs="CRITICAL",
            )  # fmt: skip
            scheduler = stack.enter_context(local).scheduler_address
        yield stack.enter_context(_client(client, scheduler))


def _client(make: Any, scheduler: str) -> Any:
    try:
        return make(scheduler, timeout=10, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        remedy = "start one with `dask scheduler`, and workers with `dask worker ADDRESS`"
        raise RtidError(f"no scheduler at {scheduler}", remedy) from error


def _outcomes(client: Any, jobs: list[TraceJob], with_diagnosis: bool) -> Iterator[Outcome]:
    import distributed  # noqa: PLC0415 - an extra

    as_completed: Any = distributed.as_completed
    waiting = iter(jobs)
    of: dict[str, TraceJob] = {}

    def submit(job: TraceJob) -> Any:
        future = client.submit(outcome, job, with_diagnosis, key=f"rtid-{job.key}", pure=False)
        of[future.key] = job
        return future

    at_once = AHEAD * max(1, len(client.scheduler_info()["workers"]))
    begun = [submit(job) for job in islice(waiting, at_once)]
    under_way = as_completed(begun, loop=client.loop)
    for future in under_way:
        job = of.pop(future.key)
        yield future.result() if future.status == "finished" else _lost(job, future)
        future.release()
        for more in islice(waiting, 1):
            under_way.add(submit(more))


def _lost(job: TraceJob, future: Any) -> Outcome:
    """The outcome of a job that took its worker with it."""
    reason = future.exception()
    figures = {
        "error": f"the worker died ({type(reason).__name__})",
        "remedy": "too little memory, or a defect: try `rtid diagnose` on this trace alone",
    }
    return Outcome(job, empty_row(job) | figures)
