"""The coach's words: what is not known yet, and the pieces of motion that would tell it.

The rule is that of `rtid excite --after`, see `rtid.excite.excitable.start`.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import numpy as np

from rtid.daemon.status import Advice
from rtid.excite.excitable import Start, start
from rtid.plain import FloatArray
from rtid.project import Project

PIECES = 3  # of motion that are named
NOTHING = "No motion within the limits of [excite] would tell much more."


def advise(project: Project, snapshot: Path, chunk: FloatArray) -> Advice:
    """What is missing after a snapshot, by the design's own rule.

    chunk: the newest samples (n, 2 + signals), SI, which tell of effects.  Raises RtidError.
    """
    return _advice(start(project, after=snapshot, chunk=chunk), snapshot)


def _advice(begun: Start, snapshot: Path) -> Advice:
    missing = begun.missing
    if missing is None or not missing.segments:
        return Advice(time.time(), NOTHING)
    model, first = begun.machine.model, np.array(begun.machine.model.first_cells)
    names = [model.edges[k].name for k in np.searchsorted(first, missing.cells, "right") - 1]
    blocks, effects = dict(Counter(names)), tuple(f"{name} ({at})" for name, at in missing.effects)
    pieces = [f"{c.segment.name} (tells of {n})" for c, n in missing.pieces(PIECES)]
    open_ = [f"{n} blocks of {name}" for name, n in blocks.items()]
    text = (
        f"Not known well enough: {', '.join([*open_, *effects])}. {len(missing.segments)} of "
        f"{len(begun.pool)} pieces of motion are worth running, above all: {'; '.join(pieces)}. "
        f"`rtid excite --after {snapshot}` makes one motion of them."
    )
    return Advice(time.time(), text, blocks, effects, tuple(pieces))
