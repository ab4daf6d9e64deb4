"""When to ask the coach: soon after the first snapshot, then now and then while the machine learns.

The coach tries every segment on the nominal machine: about a minute of a processor, in a process of
its own (`rtid.daemon.advice`).  Without a section [excite] no limits are known, and there is
nothing to try: then each publication tells which valve is known least.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from rtid.daemon.diagnosing import Asking, newest
from rtid.daemon.jobs import Answer, Coach, Coached, Publication
from rtid.daemon.log import logger
from rtid.daemon.status import Advice, EdgeHealth
from rtid.estimator.estimator import Estimator
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import Project

SNAPSHOTS = "state-[01].npz"
LIMIT_S = 900.0  # a coach that takes longer is given up


class Coaching(Asking):
    """`advice` is the newest answer."""

    what, limit_s = "coach", LIMIT_S

    def __init__(self, project: Project, folder: Path, answer: Callable[[Answer], None]) -> None:
        super().__init__(project, answer)
        self._folder, self._section = folder, project.sections.excite
        self._every_s = project.sections.daemon.coach_s
        self._next_s = 0.0
        self.advice: Advice | None = None

    def published(self, publication: Publication) -> None:
        """Another map is known."""
        if self._section is None:
            self.advice = by_valve(self._project.model, publication.edges)

    def look(self, estimator: Estimator) -> None:
        """Ask if it is time and there is a snapshot; give up a coach that takes too long."""
        now_s = time.monotonic()
        if self._is_busy() or self._section is None or now_s < self._next_s:
            return
        result = (path for path in self._folder.glob(SNAPSHOTS) if path.is_file())
        snapshots = sorted(result, key=lambda path: path.stat().st_mtime)
        if snapshots:
            self._next_s = now_s + self._every_s
            job = Coach(str(snapshots[-1]), self._samples(estimator))
            self._ask(job, Coached(None, "the coach has ended"))

    def take(self, coached: Coached) -> None:
        """An answer has come."""
        self.stop()
        if coached.advice is None:
            logger.info("no advice: %s", coached.reason)
            return
        self.advice = coached.advice
        logger.info("coach text=%r", coached.advice.text)

    def _samples(self, estimator: Estimator) -> FloatArray:
        """The newest samples, where an effect is to be seen that snapshots do not tell of."""
        history, section = estimator.history, self._section
        if history is None or section is None or not section.see:
            return np.empty((0, 0))
        return newest(history, history.span_s)[:, : 2 + len(self._project.model.signals)]


def by_valve(model: Machine, edges: Iterable[EdgeHealth]) -> Advice | None:
    """Which valve is known least, and how it is moved; all that can be said without limits."""
    known = {edge.name: edge for edge in model.edges}
    rows = [e for e in edges if e.name in known]
    if not rows:
        return None
    poorest = min(rows, key=lambda e: (e.progress, e.blocks.get("valid", 0)))
    edge = known[poorest.name]
    low, high = max(edge.safe_band_v, float(edge.grid.u_v[0])), float(edge.grid.u_v[-1])
    sign = "positive" if edge.direction > 0 else "negative"
    missing = sum(poorest.blocks.values()) - poorest.blocks.get("valid", 0)
    text = (
        f"Valve {edge.name} knows least. Move with {sign} {edge.command} between {low:.3g} and "
        f"{high:.3g} V: hold each level for a second, then step to the next; repeat with another "
        "load or supply pressure, so that its pressure drop changes."
    )
    if missing:
        text += f" {missing} of its visited blocks only need more time where they are."
    text += " With a section [excite] in the project file the coach names the motion."
    return Advice(time.time(), text, {edge.name: missing} if missing else {})
