"""Has the plant changed?  Judgements of the map held, one per second of motion, in; events out.

The level of a healthy plant is learned: its median surprise, at least 1.  Five of eight judgements
beyond FACTOR times that level are a change; ten in a row that are not, and it is over.  A slow
drift moves the level and the map with it.  Innovations show what is far too small to matter: warm
oil, another motion.  So none is held against the plant where the baseline's guard, which weighs
what matters and knows what a healthy day may change, has judged the same motion: it answers.
"""

from __future__ import annotations

from collections import deque
from statistics import median

from rtid.daemon.jobs import HandoverJudgement

FACTOR = 2.0
RECENT, BAD = 8, 5
HEALTHY = 10
LEVEL = 60  # healthy judgements that the level is the median of
LEAST_LEVEL = 30  # before so many nothing is judged: the first maps are rough
CLEAN_S = 3.0  # so long a map must have been foretelling well to be trusted


class PlantWatch:
    """`changed` from the judgement that shows a change to the one that shows it is over."""

    def __init__(self) -> None:
        self.changed = False
        self.contradicted = False  # by the baseline, which alone can take it back
        self.since_s = 0.0  # sample time at which the change began, as far as is known
        self.surprise: float | None = None
        self.trusted = 0  # number of the last handover that is surely older than the change
        self._levels: deque[float] = deque(maxlen=LEVEL)
        self._recent: deque[tuple[float, bool]] = deque(maxlen=RECENT)
        self._well = 0
        self._first_s: dict[int, float] = {}  # first judgement of each handover
        self._before = 0

    @property
    def level(self) -> float:
        """Surprise of the healthy plant."""
        return max(1.0, median(self._levels)) if self._levels else 1.0

    @property
    def is_ready(self) -> bool:
        """Whether the level is known well enough to judge."""
        return len(self._levels) >= LEAST_LEVEL

    def push(self, judgement: HandoverJudgement) -> bool:
        """Take a judgement; whether `changed` has changed."""
        self.surprise = judgement.surprise
        if self.contradicted:
            return False
        is_large = judgement.surprise > FACTOR * self.level
        bad = self.is_ready and is_large and not judgement.is_guarded
        if self.changed:
            return self._await_health(bad)
        self._follow(judgement)
        self._recent.append((judgement.t_s, bad))
        if not bad:
            self._levels.append(judgement.surprise)
        times = [t_s for t_s, was_bad in self._recent if was_bad]
        if len(times) < BAD:
            return False
        self.since_s = times[0] - 1.0
        if self.since_s - self._first_s[judgement.number] < CLEAN_S:
            self.trusted = self._before
        self.changed, self._well = True, 0
        return True

    def contradict(self, since_s: float) -> None:
        """The baseline does not foretell the motion since this sample time."""
        self.changed = self.contradicted = True
        self.since_s = since_s

    def accept(self) -> None:
        """Take the plant as it is now for healthy."""
        self.changed = self.contradicted = False
        self._levels.clear()
        self._recent.clear()

    def _follow(self, judgement: HandoverJudgement) -> None:
        if judgement.number != self.trusted:
            self._before, self.trusted = self.trusted, judgement.number
            self._first_s = {judgement.number: judgement.t_s}

    def _await_health(self, bad: bool) -> bool:
        self._well = 0 if bad else self._well + 1
        if self._well < HEALTHY:
            return False
        self.changed = False
        self._recent.clear()
        return True
