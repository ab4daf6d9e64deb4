"""Offers a map for `rtid apply` once it has beaten the one held on samples that it has not seen.

A published map becomes the candidate and is frozen; the samples that come behind it, judge_s of
them with motion, judge it beside the map that was last made active (`rtid.judging`).  Then the next
publication is the candidate.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from rtid import offered
from rtid.applied import DONE, Applied
from rtid.daemon.jobs import Publication
from rtid.daemon.log import logger
from rtid.errors import RtidError
from rtid.estimator.solution import Solution
from rtid.judging import Judgement, Known, judge
from rtid.mapfiles import provenance
from rtid.model import FloatArray
from rtid.offered import Offer
from rtid.project import Project

PATIENCE = 10  # times judge_s that a candidate waits for motion


class Offering:
    """`published` after each publication, `push` with the samples behind it, in their order."""

    def __init__(self, project: Project, folder: Path) -> None:
        self._project, self._folder = project, folder
        self._candidate: tuple[Known, Solution] | None = None
        self._chunks: list[FloatArray] = []
        self._span_s, self._wait_s = 0.0, 0.0
        self.last: Judgement | None = None

    def published(self, found: Publication, solution: Solution) -> None:
        """A map is known; it becomes the candidate where none is being judged."""
        if self._candidate is None and self._project.sections.publish.can_id is not None:
            self._candidate = Known(found.flow_map, np.array(found.beta_pa)), solution
            self._chunks, self._span_s = [], 0.0
            self._wait_s = self._project.sections.publish.judge_s

    def push(self, chunk: FloatArray) -> Judgement | None:
        """Samples that the candidate has not learned from; a judgement when there are enough."""
        if self._candidate is None or not len(chunk):
            return None
        self._chunks.append(chunk)
        self._span_s += float(chunk[-1, 0] - chunk[0, 0])
        if self._span_s < self._wait_s:
            return None
        known, solution = self._candidate
        section = self._project.sections.publish
        content, held = self._held()
        samples = np.concatenate(self._chunks)
        terms, gain_percent = solution.terms_theta, section.gain_percent
        try:
            found = judge(self._project.model, samples, held, known, gain_percent, terms)
        except ValueError as error:  # the analyst has more to do than to offer maps
            logger.warning("map not judged: %s", error)
            self._candidate, self._chunks = None, []
            return None
        if found.t == 0.0 and self._span_s < PATIENCE * section.judge_s:  # too little motion
            self._wait_s += section.judge_s
            return None
        self._candidate, self._chunks, self.last = None, [], found
        if found.is_better:
            self._offer(known, solution, found, content)
        return found

    def _held(self) -> tuple[int | None, Known | None]:
        """What was last made active, and its map."""
        applied = Applied(self._folder)
        done = [row.content for row in applied.rows() if row.outcome == DONE]
        if not done:
            return None, None
        try:
            return done[-1], applied.known(done[-1])
        except (RtidError, OSError, KeyError):
            return None, None

    def _offer(
        self, known: Known, solution: Solution, found: Judgement, content: int | None
    ) -> None:
        project = self._project
        told = provenance(solution, project.name, project.digest, "rtid run")
        sd_pa = np.array(solution.beta_sd_pa)
        made = Offer(known, sd_pa, content, found.as_json(), told, time.time())
        offered.write(self._folder, made)
