"""A file that was dropped on the page, as it comes: into a folder, under a name that is free."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tornado.web import RequestHandler, stream_request_body

PLACE = "/arrive"
MOST_BYTES = 2**32
PATIENCE_S = 600.0  # that a file may take to come
DATABASES = (".dbc", ".eds", ".dcf")


def is_welcome(name: str) -> bool:
    """Whether a file of that name can be a log, a table or a database."""
    from firmware_bridge.sources.formats import suffixes  # noqa: PLC0415 - it brings all readers

    return name.lower().endswith((*suffixes(), *(f"{s}.gz" for s in suffixes()), *DATABASES))


def free_name(wanted: Path) -> Path:
    """The path, or one beside it with a number, where nothing is yet."""
    path, k = wanted, 2
    while path.exists():
        path, k = wanted.with_name(f"{wanted.stem}-{k}{wanted.suffix}"), k + 1
    return path


@stream_request_body
class Upload(RequestHandler):
    """Takes one file; `arrived` is called with its path once all of it is there.

    folder: where to; None: a project is open, and none is wanted.
    """

    def initialize(
        self, folder: Callable[[], Path | None], arrived: Callable[[Path], None]
    ) -> None:
        """Where to."""
        self._folder, self._arrived = folder, arrived
        self._part: Path | None = None

    def prepare(self) -> None:
        """Refuse what is no log before it has come."""
        name, folder = Path(self.get_query_argument("name", "")).name, self._folder()
        if folder is None:
            self._refuse(409, "a project is open already")
            return
        if not is_welcome(name):
            self._refuse(415, f"{name or 'this'} is no log, table or database that rtid reads")
            return
        self.request.connection.set_max_body_size(MOST_BYTES)  # type: ignore[union-attr]
        self.request.connection.set_body_timeout(PATIENCE_S)  # type: ignore[union-attr]
        self._path = free_name(folder / name)
        self._part = self._path.with_name(f".{self._path.name}.part")
        try:
            self._file = self._part.open("wb")
        except OSError as error:
            self._part = None
            self._refuse(507, f"{folder}: {error.strerror}")

    def _refuse(self, status: int, reason: str) -> None:
        self.set_status(status)
        self.finish(f"{reason}\n")

    def data_received(self, chunk: bytes) -> None:
        """A piece of it."""
        if self._part is not None:
            self._file.write(chunk)

    def post(self) -> None:
        """All of it is there."""
        if self._part is None:
            return
        self._file.close()
        self._part.rename(self._path)
        self._part = None
        self._arrived(self._path)
        self.set_status(204)

    def on_finish(self) -> None:
        """Leave no part behind."""
        self._drop()

    def on_connection_close(self) -> None:
        """The browser has gone in the middle."""
        self._drop()

    def _drop(self) -> None:
        if self._part is not None:
            self._file.close()
            self._part.unlink(missing_ok=True)
            self._part = None
