"""What a file is, asked once: by what it begins with, and else by its suffix.

A `Format` reads one kind of file into `Frames` (a log of a bus) or a `Table` (samples).  Ours stand
in `FORMATS`; a package of somebody else's names its own as an entry point of the group
`rtid.formats`, and is asked first.  Our readers of logs are bulk readers, which resynchronise:
damage costs the line or container that it hit, never a wrong frame that the format could tell.
What gzip has packed is unpacked for every format.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import Frames, add_counts
from firmware_bridge.mended import mend
from firmware_bridge.sources import asc, bags, blf, can_csv, candump, gvret, mf4, trc
from firmware_bridge.sources import table_files as tables
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.table import Table
from firmware_bridge.sources.unpacked import Budget
from firmware_bridge.steps import Continuous

PLUGINS = "rtid.formats"  # entry points of other packages: any name = a Format
GZIP, GZIP_MAGIC = ".gz", b"\x1f\x8b"
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".ods")
PACKED = {  # what unpacks them
    ".bz2": "bunzip2 -k",
    ".xz": "unxz -k",
    ".zst": "unzstd",
    ".zip": "unzip",
}
HEAD_BYTES, PIECE_BYTES = 256, 1 << 20
TWICE = 0.25  # share of rows that are the row before once more, from which on that is a rule
LARGEST = 1e30  # of any number in a table

FOREIGN = {  # what nothing here reads, by its first bytes: what to do
    b"PK\x03\x04": "packed, or a spreadsheet; unpack it, or save its sheet as .csv",
    b"\xd0\xcf\x11\xe0": "a spreadsheet; save its sheet as .csv",
    b"\x89HDF\r\n": "HDF5; write its columns as .parquet, .mat (save(..., '-v7')) or .csv",
    b"TDSm": "TDMS; export it as .csv or .mf4",
    b"ARROW1": "Feather; write it as .parquet",
}

Content = Frames | Table


class Unpacked(NamedTuple):
    """A file as its reader sees it, the name that it would have, and what unpacking lost."""

    file: Path
    name: Path
    lost: dict[str, int]


@dataclass(frozen=True)
class Format:
    r"""A kind of file.

    name: in plain words; suffixes: in lower case, with their dot; read: the content of a file,
    LogError if it is none such; look: a regular expression that the first 256 bytes match, found
    anywhere in them (anchor it with \A), b"" where only the suffix tells.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], Content]
    look: bytes = b""


FORMATS = [
    Format("BLF log", (".blf",), blf.read, rb"\ALOGG"),
    Format("MF4", (".mf4",), mf4.read, rb"\A(MDF  |UnFinMF )"),
    Format("candump log", (".log",), candump.read, candump.LOOK),
    Format("ASC log", (".asc",), asc.read, rb"\A(date \w+ \w+ |base (hex|dec))"),
    Format("TRC log", (".trc",), trc.read, rb"\A(;\$FILEVERSION|;#{20})"),
    Format("SavvyCAN log", (".csv",), gvret.read, gvret.LOOK),
    Format("python-can CSV log", (".csv",), can_csv.read, can_csv.LOOK),
    Format("Parquet table", (".parquet",), tables.read_parquet, rb"\APAR1"),
    Format("MATLAB table", (".mat",), tables.read_mat, rb"\AMATLAB \d"),
    Format("MCAP", (".mcap",), bags.read, rb"\A\x89MCAP0\r\n"),
    Format("ROS bag", (".db3", ".bag"), bags.read, rb"\A(#ROSBAG V2|SQLite format 3\x00)"),
    Format("table of text", (".csv", ".tsv", ".txt", ".lvm"), tables.read_text),
]


def open_file(path: str | Path, *, mended: bool = True) -> Content:
    """What a file holds: the frames of a log, their stamps mended where that can be, or a table.

    "truncated" in a log's `refused`: the file ends within a line, container or block, or before its
    end mark; "clock_step": the recorder's clock was set back, which became a gap.  Raises LogError
    if the file is absent, empty, a folder, or of no known format.
    """
    path = Path(path)
    _check_place(path)
    try:
        with _unpacked(path) as inner:
            content = _read(_known(inner), inner.file, path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    content = _with_loss(content, inner)
    return mend(content).frames if mended and isinstance(content, Frames) else content


def open_log(path: str | Path, *, mended: bool = True) -> Frames:
    """All data frames of a log, see `open_file`; LogError also for a table."""
    content = open_file(path, mended=mended)
    if isinstance(content, Table):
        raise LogError(f"{path}: a table of samples is no log of frames; name a log")
    return content


def read_table(path: str | Path) -> Table:
    """Read a table, see `open_file`; LogError also for a log of frames."""
    content = open_file(path)
    if isinstance(content, Frames):
        raise LogError(f"{path}: a log of frames is no table of samples; name a table")
    return content


def suffixes() -> tuple[str, ...]:
    """Suffixes of all formats, those of plug-ins included."""
    return tuple(dict.fromkeys(s for known in _formats()[0] for s in known.suffixes))


def has_known_suffix(path: Path) -> bool:
    """Whether a file is a log or a table by its name alone, less .gz."""
    return _by_suffix(_plain_name(path)) is not None


def format_of(path: Path) -> Format | None:
    """The format of a file by its beginning or its suffix; None if it is not known, or no file."""
    if not path.is_file():
        return _by_suffix(path)
    try:
        with _unpacked(path, HEAD_BYTES) as inner:
            return _by_head(inner.file) or _by_suffix(inner.name)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error


def _check_place(path: Path) -> None:
    """LogError unless there is a file that holds something."""
    if path.is_dir():
        raise LogError(f"{path}: a folder; name one log file in it")
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    if path.suffix.lower() in PACKED:
        unpack = PACKED[path.suffix.lower()]
        raise LogError(f"{path}: packed; unpack it first: {unpack} {path.name}")


@cache
def plugins() -> tuple[tuple[Format, ...], tuple[str, ...]]:
    """The formats of other packages, and what is wrong with those that do not load."""
    formats, wrong = [], []
    for plugin in entry_points(group=PLUGINS):
        try:
            loaded = plugin.load()
        except Exception as error:  # it runs somebody else's code
            wrong.append(f"the plug-in {plugin.value} does not load: {error}")
            continue
        if isinstance(loaded, Format):
            formats.append(loaded)
        else:
            wrong.append(f"the plug-in {plugin.value} is no Format")
    return tuple(formats), tuple(wrong)


def _formats() -> tuple[tuple[Format, ...], tuple[str, ...]]:
    formats, wrong = plugins()
    return (*formats, *FORMATS), wrong


def _known(inner: Unpacked) -> Format:
    """The format of a file; LogError if none fits."""
    known = _by_head(inner.file)
    if known is None:
        _refuse_foreign(inner)
        known = _by_suffix(inner.name)
    if known is None:
        wrong = "".join(f"; {text}" for text in _formats()[1])
        suffix, all_known = inner.name.suffix, ", ".join(suffixes())
        if suffix.lower() in SPREADSHEETS:
            raise LogError(f"{inner.name}: a spreadsheet; save its sheet as .csv")
        export = "of other tools export .csv or .mf4, and call a table of text .csv"
        known_are = f"known are {all_known}{wrong}; {export}"
        raise LogError(f"{inner.name}: unknown suffix {suffix!r}; {known_are}")
    return known


def _refuse_foreign(inner: Unpacked) -> None:
    """LogError for what is no format of ours whatever its suffix says, with what to do."""
    with inner.file.open("rb") as file:
        head = file.read(HEAD_BYTES)
    remedy = next((text for magic, text in FOREIGN.items() if head.startswith(magic)), None)
    if remedy and inner.name.suffix.lower() not in SPREADSHEETS:
        raise LogError(f"{inner.name}: {remedy}")


def _by_head(path: Path) -> Format | None:
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    fitting = (known for known in _formats()[0] if known.look and re.search(known.look, head))
    return next(fitting, None)


def _by_suffix(name: Path) -> Format | None:
    """Of several formats with this suffix the one that shows no sign by which it could be known."""
    fitting = [known for known in _formats()[0] if name.suffix.lower() in known.suffixes]
    return min(fitting, key=lambda known: bool(known.look), default=None)


def _read(known: Format, file: Path, path: Path) -> Content:
    """Read the file, which is what `path` holds; errors name the latter."""
    try:
        content = known.read(file)
    except LogError as error:
        raise LogError(str(error).replace(str(file), str(path))) from error
    except Exception as error:  # libraries and plug-ins raise whatever a damaged file causes
        if isinstance(error, OSError) and error.strerror:
            raise
        raise LogError(f"{path}: not a readable {known.name}: {error}") from error
    if isinstance(content, Table):
        return _checked(replace(content, path=path))
    if isinstance(content, Frames):
        return Continuous().push(content)
    raise LogError(f"{path}: the reader of {known.name} returned neither Frames nor a Table")


def _checked(table: Table) -> Table:
    """The table with NaN, a missing value, for what no sensor sends: its square must be finite."""
    if not table.columns:
        raise LogError(f"{table.path}: holds no numeric column{table.unread_said}")
    return _once(replace(table, columns={n: _believable(c) for n, c in table.columns.items()}))


def _once(table: Table) -> Table:
    """The table of a logger that writes rows twice, their time too, without the second ones.

    A few are counted as what comes too late (`to_samples`).
    """
    columns = table.columns.values()
    if table.time_name() is None or len(next(iter(columns))) < 2:
        return table
    again = np.logical_and.reduce(
        [(c[1:] == c[:-1]) | (np.isnan(c[1:]) & np.isnan(c[:-1])) for c in columns]
    )
    if again.mean() <= TWICE:
        return table
    kept = np.append(True, ~again)
    return replace(table, columns={name: c[kept] for name, c in table.columns.items()})


def _believable(column: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.abs(column) <= LARGEST, column, np.nan)


def _with_loss(content: Content, inner: Unpacked) -> Content:
    """The content, with what unpacking lost counted; LogError for a table, which counts nothing."""
    if isinstance(content, Frames):
        add_counts(content.refused, inner.lost)
    elif inner.lost:
        raise LogError(f"{content.path}: gzip's data is cut or damaged; copy the file again")
    return content


def _plain_name(path: Path) -> Path:
    return path.with_suffix("") if path.suffix.lower() == GZIP else path


@contextmanager
def _unpacked(path: Path, at_most: int | None = None) -> Iterator[Unpacked]:
    """A file that holds what gzip has packed, or the file itself; at_most: only so many bytes.

    LogError where it unpacks to too much.
    """
    with path.open("rb") as file:
        is_packed = file.read(2) == GZIP_MAGIC
    if not is_packed:
        yield Unpacked(path, path, {})
        return
    name = _plain_name(path)
    with TemporaryDirectory(prefix="rtid-") as folder:
        inner = Path(folder, name.name)
        with gzip.open(path) as packed, inner.open("wb") as plain:
            lost = _inflate(packed, plain, path, at_most)
        if not inner.stat().st_size:
            raise LogError(f"{path}: gzip has packed nothing, or it is damaged from its beginning")
        yield Unpacked(inner, name, lost)


def _inflate(
    packed: gzip.GzipFile, plain: BinaryIO, path: Path, at_most: int | None
) -> dict[str, int]:
    """Unpack up to the end or to where it is damaged; what was lost."""
    budget = Budget(path)
    try:
        while piece := packed.read1(at_most or PIECE_BYTES):
            budget.take(len(piece))
            plain.write(piece)
            if at_most:
                break
    except (EOFError, zlib.error):
        return {"truncated": 1}
    except gzip.BadGzipFile:  # its checksum, at the end: nothing is missing, something is wrong
        return {"bad_container": 1}
    return {}


@contextmanager
def spooled(stream: BinaryIO) -> Iterator[Path]:
    """A file that holds all of a stream for as long as it is needed: `-`, the standard input.

    What does not show what it is, is taken for a table of text.
    """
    with TemporaryDirectory(prefix="rtid-") as folder:
        path = Path(folder, "stdin")
        with path.open("wb") as file:
            copyfileobj(stream, file)
        yield path if format_of(path) else path.rename(path.with_suffix(".csv"))
