"""Offers a map for `rtid apply` once it has beaten the one held on samples that it has not seen.

A published map becomes the candidate and is frozen; the samples that come behind it, judge_s of
them with motion, judge it beside the map that was last made active (`rtid.apply.judge`).  Then
the next publication is the candidate.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from rtid.apply import offer as offered
from rtid.apply.judge import Judgement, KnownMap, judge
from rtid.apply.offer import Offer
from rtid.apply.versions import Applied
from rtid.daemon.jobs import Publication
from rtid.daemon.log import logger
from rtid.errors import RtidError
from rtid.estimator.solution import Solution
from rtid.maps.files import provenance
from rtid.plain import FloatArray
from rtid.project import Project

PATIENCE = 10  # times judge_s that a candidate waits for motion


class Offering:
    """`published` after each publication, `push` with the samples behind it, in their order."""

    def __init__(self, project: Project, folder: Path) -> None:
        self._project, self._folder = project, folder
        self._candidate: tuple[KnownMap, Solution] | None = None
        self._chunks: list[FloatArray] = []
        self._span_s, self._wait_s = 0.0, 0.0
        self.last: Judgement | None = None

    def published(self, publication: Publication, solution: Solution) -> None:
        """A map is known; it becomes the candidate where none is being judged."""
        if self._candidate is None and self._project.sections.publish.can_id is not None:
            self._candidate = (
                KnownMap(publication.flow_map, np.array(publication.beta_pa)),
                solution,
            )
            self._chunks, self._span_s = [], 0.0
            self._wait_s = self._project.sections.publish.judge_s

    def push(self, chunk: FloatArray) -> Judgement | None:
        """Samples that the candidate has not learned from; a judgement when there are enough.

        chunk (n, 2 + signals), SI.
        """
        if self._candidate is None or not len(chunk):
            return None
        self._chunks.append(chunk)
        self._span_s += float(chunk[-1, 0] - chunk[0, 0])
        if self._span_s < self._wait_s:
            return None
        known, solution = self._candidate
        section = self._project.sections.publish
        content, old = self._held()
        samples = np.concatenate(self._chunks)
        terms, gain_percent = solution.terms_theta, section.gain_percent
        try:
            judgement = judge(self._project.model, samples, old, known, gain_percent, terms)
        except ValueError as error:  # the analyst has more to do than to offer maps
            logger.warning("map not judged: %s", error)
            self._candidate, self._chunks = None, []
            return None
        if judgement.t == 0.0 and self._span_s < PATIENCE * section.judge_s:  # too little motion
            self._wait_s += section.judge_s
            return None
        self._candidate, self._chunks, self.last = None, [], judgement
        if judgement.is_better:
            self._offer(known, solution, judgement, content)
        return judgement

    def _held(self) -> tuple[int | None, KnownMap | None]:
        """What was last made active, and its map."""
        applied = Applied(self._folder)
        try:
            done = [row.content for row in applied.rows() if row.is_active]
            if not done:
                return None, None
            return done[-1], applied.known(done[-1])
        except (RtidError, OSError, KeyError):
            return None, None

    def _offer(
        self, known: KnownMap, solution: Solution, judgement: Judgement, content: int | None
    ) -> None:
        project = self._project
        origin = provenance(solution, project.name, project.digest, "rtid run")
        sd_pa = np.array(solution.beta_sd_pa)
        made = Offer(known, sd_pa, content, judgement.as_json(), origin, time.time())
        offered.write(self._folder, made)
