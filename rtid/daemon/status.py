"""What the daemon says of itself: plain dataclasses that a page, a shell or a test can poll.

`Daemon.status` is the newest one in the process; from elsewhere `read` takes it from the file
STATUS_FILE in the state folder, which is replaced each second.  Times are seconds, pressures Pa,
commands V: SI throughout.  Everything is JSON: NaN and infinities are None.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from rtid.errors import RtidError
from rtid.plain import plain
from rtid.trace.state_files import exchange, overwritten, read_settled

SCHEMA = 1
STATUS_FILE = "status.json"
ROOM_BYTES = 8192  # the file grows by so much, with half its length to spare
TO_DECIDE = " If the machine is to stay as it is now: rtid accept"  # ends an alarm that is on
OLD_S = 5.0  # a status of that age is that of a daemon that no longer runs

SignalVerdict = Literal["ok", "silent", "frozen", "out_of_range", "not_available", "implausible"]
Learning = Literal["waiting", "learning", "held", "suspended", "stopped"]


class StatusError(RtidError):
    """There is no status to read, or one of another version."""


@dataclass(frozen=True)
class Distribution:
    """A histogram of durations: counts[k] lie in [edges_us[k], edges_us[k + 1])."""

    count: int = 0
    p50_us: float = 0.0
    p99_us: float = 0.0
    p999_us: float = 0.0
    max_us: float = 0.0
    edges_us: tuple[float, ...] = ()
    counts: tuple[int, ...] = ()


@dataclass(frozen=True)
class LoopHealth:
    """The fixed-rate loop since its start; `*_1s` are of the last second.

    An overrun is a tick that ended after the next one was due; `causes` says why, by count: what
    the loop itself did ("upkeep", "handover", "backlog", "work") or what was done to it ("late").
    """

    rate_hz: float
    ticks: int = 0
    overruns: int = 0
    skipped: int = 0  # deadlines that passed during overruns
    causes: dict[str, int] = field(default_factory=dict)
    lateness: Distribution = Distribution()  # wake-up after its deadline
    work: Distribution = Distribution()  # from wake-up to the end of the tick
    lateness_1s: Distribution = Distribution()
    work_1s: Distribution = Distribution()
    scheduling: str = "other"  # "fifo 60" when promoted
    memory_locked: bool = False


@dataclass(frozen=True)
class BusHealth:
    """Where the frames come from; `refused` by reason: error frames, overruns of the queue, ..."""

    interface: str
    channel: str
    state: Literal["open", "reopening", "failed", "closed"] = "closed"
    frames: int = 0
    frames_per_s: float = 0.0
    queued: int = 0
    reopened: int = 0
    refused: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class MessageHealth:
    """One CAN message over the last second; `refused` counts since the start, by reason."""

    name: str
    can_id: int
    nominal_hz: float
    rate_hz: float = 0.0
    age_s: float | None = None  # since its last good frame; None before the first
    gap_s: float = 0.0  # longest silence of the last second
    verdict: Literal["ok", "silent", "late", "too_fast", "damaged"] = "silent"
    refused: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SignalHealth:
    """One signal of the samples: its newest value and its range over the last second."""

    name: str
    kind: str
    unit: str
    message: str
    value: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    rate_hz: float = 0.0
    age_s: float | None = None
    gap_s: float = 0.0
    verdict: SignalVerdict = "silent"


@dataclass(frozen=True)
class BlockPlane:
    """The blocks of a map: borders, SI, and what became of each, the drops of a command together.

    codes: "v" valid, "l" learning, "." neither; command, source, sink: signals of the working
    point; direction: of the command that opens.
    """

    u_v: tuple[float, ...]
    dp_pa: tuple[float, ...]
    codes: str
    command: str
    source: str
    sink: str
    direction: int = 1


@dataclass(frozen=True)
class Scope:
    """Signals over the last second: smallest and largest value, SI, of each tenth from t_s on."""

    t_s: tuple[float, ...] = ()
    low: dict[str, tuple[float, ...]] = field(default_factory=dict)
    high: dict[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class EdgeHealth:
    """The map of one edge: cells by status, of the blocks and of the published map."""

    name: str
    blocks: dict[str, int] = field(default_factory=dict)  # learning, valid, stale, invalid
    cells: dict[str, int] = field(default_factory=dict)  # valid, learning, extrapolated, ...
    progress: float = 0.0  # mean share of the way to valid, over visited blocks
    plane: BlockPlane | None = None


@dataclass(frozen=True)
class ChamberStatus:
    """Bulk modulus of one chamber with its standard deviation, Pa; None before it is known."""

    name: str
    beta_pa: float | None = None
    beta_sd_pa: float | None = None


@dataclass(frozen=True)
class EffectStatus:
    """What is learned on board of the size of an added effect, with its standard deviation, SI."""

    name: str
    size: float
    sd: float
    unit: str


@dataclass(frozen=True)
class EstimateStatus:
    """What was learned by the last publication; `stale` while its samples are older than allowed.

    version counts publications of a changed map; samples, rows and refused count since the start
    of learning, a restored state included.
    """

    state: Learning = "waiting"
    reason: str = ""
    version: int = 0
    age_s: float | None = None  # of the newest sample that it holds
    stale: bool = True
    samples: int = 0
    rows: int = 0
    rho: float | None = None
    surprise: float | None = None  # mean square of the last rows against the map held, in noise
    chambers: tuple[ChamberStatus, ...] = ()
    edges: tuple[EdgeHealth, ...] = ()
    effects: tuple[EffectStatus, ...] = ()
    refused: dict[str, int] = field(default_factory=dict)  # all gates: bridge, watch, estimator

    @property
    def blocks(self) -> dict[str, int]:
        """Blocks of all edges by what is known of them, in the order of the words."""
        counts = Counter[str]()
        for edge in self.edges:
            counts.update(edge.blocks)
        return dict(sorted(counts.items()))


@dataclass(frozen=True)
class Store:
    """Whether what was learned would survive a power cut."""

    state: Literal["none", "saved", "NOT SAVED"] = "none"
    reason: str = ""
    age_s: float | None = None  # of the newest snapshot on disk
    restored: str = ""  # what the start found: "fresh", or the snapshot that was taken up
    recording: str = ""  # file that frames are written to
    dropped_frames: int = 0  # not recorded, because the disk was too slow


@dataclass(frozen=True)
class Verdict:
    """The last diagnosis; `content` is the JSON of rtid/diagnose/schema.md."""

    at_unix_s: float
    verdict: str
    text: str
    effects: tuple[str, ...] = ()
    over_s: tuple[float, float] = (0.0, 0.0)  # samples it saw, seconds before `at_unix_s`
    content: dict[str, Any] = field(default_factory=dict)
    of_sensor: bool = False  # all that is missing are effects of sensors, not of the machine


@dataclass(frozen=True)
class Advice:
    """What is not known yet, and the motion that would tell it, see `rtid.daemon.advice`.

    blocks: how many, by edge; effects: named ones that cannot be seen well yet; segments: the
    pieces of motion that tell most.
    """

    at_unix_s: float
    text: str
    blocks: dict[str, int] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    segments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Alarm:
    """Something that somebody has to look at; over when `until_unix_s` is set."""

    name: str
    text: str
    since_unix_s: float
    until_unix_s: float | None = None
    kind: Literal["bus", "sensor", "plant", "store", "loop"] = "bus"
    trace: str = ""  # recording of the seconds around it

    @property
    def is_on(self) -> bool:
        """Whether it is not over."""
        return self.until_unix_s is None

    @property
    def words(self) -> str:
        """What it says; once it is over there is nothing to be decided."""
        return self.text if self.is_on else self.text.removesuffix(TO_DECIDE)


@dataclass(frozen=True)
class Status:
    """Everything at one moment."""

    name: str
    pid: int
    started_unix_s: float
    now_unix_s: float
    loop: LoopHealth
    bus: BusHealth
    messages: tuple[MessageHealth, ...] = ()
    signals: tuple[SignalHealth, ...] = ()
    estimate: EstimateStatus = EstimateStatus()
    store: Store = Store()
    verdict: Verdict | None = None
    diagnosing: bool = False
    advice: Advice | None = None
    alarms: tuple[Alarm, ...] = ()  # those that are on, then the last that are over
    rss_anon_mb: float = 0.0
    scope: Scope = Scope()
    schema: int = SCHEMA

    @property
    def on(self) -> tuple[Alarm, ...]:
        """The alarms that are on."""
        return tuple(alarm for alarm in self.alarms if alarm.is_on)

    def has(self, alarm: str) -> bool:
        """Whether an alarm of this name is on."""
        return any(event.name == alarm for event in self.on)

    def to_json(self) -> str:
        """One line of JSON, part by part: a long one at once would hold up the loop."""
        parts = (f"{json.dumps(name)}: {json.dumps(part)}" for name, part in plain(self).items())
        return f"{{{', '.join(parts)}}}"


def from_json(text: str | bytes) -> Status:
    """The status that `to_json` wrote.  Raises StatusError if it is none of this version."""
    try:
        status = _adapter().validate_json(text)
    except ValueError as error:
        raise StatusError("not a status of rtid", "are both of one version?") from error
    if status.schema != SCHEMA:
        raise StatusError(f"status of schema {status.schema}, this program reads {SCHEMA}")
    return status


@cache
def _adapter() -> TypeAdapter[Status]:
    return TypeAdapter(Status)


def write(folder: Path, status: Status) -> None:
    """Replace the status file; no fsync, it says nothing after a power cut.

    Two files change their names and keep their room on the disk, filled up with spaces: a full disk
    is told by the very status that it would not have room for.
    """
    temporary, content = folder / (STATUS_FILE + ".part"), status.to_json().encode()
    with overwritten(temporary) as file:
        size = os.fstat(file.fileno()).st_size
        if len(content) > size:
            size = ROOM_BYTES * (1 + 3 * len(content) // (2 * ROOM_BYTES))
        file.write(content.ljust(size))
    exchange(temporary, folder / STATUS_FILE)


def read(folder: Path) -> Status:
    """The newest status of the daemon that keeps its state in this folder."""
    path = folder / STATUS_FILE
    try:
        content = read_settled(path)
    except FileNotFoundError:
        raise StatusError(f"{path}: no daemon has run here", "start it with `rtid run`") from None
    except OSError as error:
        raise StatusError(f"{path}: {error.strerror}", "take it away; it comes anew") from error
    try:
        return from_json(content)
    except StatusError as error:
        raise StatusError(f"{path}: {error}", error.remedy) from error
