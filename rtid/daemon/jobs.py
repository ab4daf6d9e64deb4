"""What the loop hands to its helper processes, and what they answer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from queue import Queue
from typing import Literal

from firmware_bridge.frames import Frames
from rtid.daemon.acceptance import Acceptance
from rtid.daemon.status import Advice, Alarm, EdgeHealth, EffectStatus, Verdict
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.wear import Wear
from rtid.model import Machine
from rtid.plain import FloatArray

MOST_BYTES = 16 << 20  # of jobs taken from the pipe while one is in work


@dataclass(frozen=True)
class Handover:
    """The estimator as it was at one moment, without its ring of samples: solve it, and store it.

    number: grows by one; publish = False only stores; is_last: stored also where nothing is new;
    is_proving: the baseline has still to foretell the motion, so that this is its shadow; made_s:
    on the monotonic clock of all processes.
    """

    number: int
    estimator: Estimator
    publish: bool
    store: bool
    is_last: bool = False
    is_proving: bool = False
    made_s: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Batch:
    """Samples to judge by the map held, rows as in `to_chunk`, and frames to record."""

    chunk: FloatArray
    frames: Frames | None

    @property
    def size_bytes(self) -> int:
        """What it holds in memory, about."""
        return self.chunk.nbytes + (24 * len(self.frames) if self.frames is not None else 0)


@dataclass(frozen=True)
class Note:
    """An alarm for the history; with `keep` its trace is kept as well."""

    alarm: Alarm
    keep: bool


@dataclass(frozen=True)
class Recall:
    """Give back the newest estimator that is no younger than this handover.

    before_s: it must be older than this sample time as well, else it is the baseline; the oldest
    one there is where there is no baseline yet.
    """

    number: int
    before_s: float


@dataclass(frozen=True)
class Relearn:
    """A change of the plant was accepted: learn from these samples alone, rows as in `to_chunk`.

    The snapshots of before are set aside.
    """

    chunk: FloatArray
    origin_us: int | None
    acceptance: Acceptance


@dataclass(frozen=True)
class Diagnose:
    """Samples to diagnose, rows as in `to_chunk`."""

    model: Machine
    chunk: FloatArray


@dataclass(frozen=True)
class Coach:
    """What is still missing after this snapshot?  chunk: the newest samples, for effects."""

    snapshot: str
    chunk: FloatArray


@dataclass(frozen=True)
class Check:
    """A recording to hold the project file against: units, signs, swapped signals."""

    recording: str


@dataclass(frozen=True)
class Ready:
    """The helper has compiled everything, or is done with a handover: it takes the next one.

    A handover is saved and solved apart from each other: which of them is done.
    """

    to_save: bool = True
    to_solve: bool = True


@dataclass(frozen=True)
class Publication:
    """What a handover says once it is solved."""

    number: int
    flow_map: FlowMap
    beta_pa: FloatArray
    beta_sd_pa: FloatArray
    rho: float
    t_s: float  # of the newest sample in it, as in `to_chunk`
    edges: tuple[EdgeHealth, ...]
    solved_s: float  # how long that took
    effects: tuple[EffectStatus, ...] = ()


@dataclass(frozen=True)
class HandoverJudgement:
    """How well the map of handover `number` foretells the samples that came behind it.

    surprise: mean square of whitened innovations over `rows` of them; 1 is noise.  is_guarded:
    the baseline is held against the same motion by what would matter, and answers for it.
    """

    number: int
    surprise: float
    rows: int
    t_s: float
    is_guarded: bool = False


@dataclass(frozen=True)
class Foretold:
    """How the baseline stands to the motion.

    "proving": it has still to foretell it, nothing learned counts; "proven"; "contradicted" since a
    sample time, text: by what, of_sensor: by no change of the machine; "named": text and of_sensor
    of a contradiction that had none; "refused": a first map that cannot be, text: why.
    """

    state: Literal["proving", "proven", "contradicted", "named", "refused"]
    since_s: float = 0.0
    text: str = ""
    of_sensor: bool = False


@dataclass(frozen=True)
class Worn:
    """The machine has changed slowly: what was learned is to be carried over."""

    wear: Wear


@dataclass(frozen=True)
class Recalled:
    """Answer to Recall, the oldest one there is where the wanted one is not; or to Relearn."""

    estimator: Estimator
    is_accepted: bool = False


@dataclass(frozen=True)
class SavedSnapshot:
    """A snapshot is on the disk.  made_s: of the handover; what came behind it would be lost."""

    number: int
    path: str
    made_s: float


@dataclass(frozen=True)
class NotSaved:
    """The disk did not take it; what was learned is still in memory."""

    what: str  # "snapshot", "recording" or "history"
    reason: str


@dataclass(frozen=True)
class SavedAgain:
    """The disk takes this now: what it has refused of it is over, and nothing else is."""

    what: str


@dataclass(frozen=True)
class RecorderState:
    """Where frames go now, and the folder in which an alarm's trace was kept."""

    path: str
    kept: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class VerdictAnswer:
    """Answer to Diagnose: a verdict, or the reason why there is none."""

    verdict: Verdict | None
    reason: str = ""


@dataclass(frozen=True)
class Checked:
    """Answer to Check: what would be learnt wrongly, each with the signal's name."""

    errors: tuple[str, ...]


@dataclass(frozen=True)
class Coached:
    """Answer to Coach: advice, or the reason why there is none."""

    advice: Advice | None
    reason: str = ""


Job = (
    Handover | Batch | Note | Recall | Relearn | Diagnose | Coach | Check | VerdictAnswer | Checked
)
Answer = (
    Ready
    | Publication
    | HandoverJudgement
    | Recalled
    | Worn
    | Foretold
    | SavedSnapshot
    | NotSaved
    | SavedAgain
    | RecorderState
    | VerdictAnswer
    | Coached
    | Checked
)


class Waiting(Queue[Job | None]):
    """Jobs behind the one in work, bounded by what they hold and not by how many they are.

    A handover is saved as it comes from the pipe: batches that come while a solve takes its time
    must not keep it in there.
    """

    def _init(self, maxsize: int) -> None:
        super()._init(maxsize)
        self._bytes = 0

    def _qsize(self) -> int:
        return self._bytes

    def _put(self, item: Job | None) -> None:
        super()._put(item)
        self._bytes += _size(item)

    def _get(self) -> Job | None:
        item = super()._get()
        self._bytes -= _size(item)
        return item


def _size(job: Job | None) -> int:
    return 1 + (job.size_bytes if isinstance(job, Batch) else 0)
