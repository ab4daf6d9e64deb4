"""Jobs that wait in the analyst while one is in work."""

from __future__ import annotations

from queue import Queue

from rtid.daemon import jobs

MOST_BYTES = 16 << 20  # of jobs taken from the pipe while one is in work


class Waiting(Queue[jobs.Job | None]):
    """Jobs behind the one in work, bounded by what they hold and not by how many they are.

    A handover is saved as it comes from the pipe: batches that come while a solve takes its time
    must not keep it in there.
    """

    def _init(self, maxsize: int) -> None:
        super()._init(maxsize)
        self._bytes = 0

    def _qsize(self) -> int:
        return self._bytes

    def _put(self, item: jobs.Job | None) -> None:
        super()._put(item)
        self._bytes += _size(item)

    def _get(self) -> jobs.Job | None:
        item = super()._get()
        self._bytes -= _size(item)
        return item


def _size(job: jobs.Job | None) -> int:
    return 1 + (job.size_bytes if isinstance(job, jobs.Batch) else 0)
