"""The pictures of a report as stills, for `rtid report --png`: no browser is needed."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rtid.diagnose.trials import GAIN
from rtid.pictures.diagnosed import Rank, dependences, errors, flows, ranking
from rtid.report_errors import PARTS, RANKED, can_be_judged, floor, models, steps
from rtid.report_story import Told
from rtid.report_tables import named


def stills(told: Told) -> dict[str, Figure]:
    """The pictures of the page by name, those that this record has."""
    drawn: dict[str, Figure] = {}
    if can_be_judged(told):
        drawn["errors"] = errors(steps(told), floor(told), PARTS[told.judges])
    drawn["flows"] = flows(told.chambers, models(told.before, told.after))
    if told.depends_before:
        depends = models(told.depends_before, told.depends_after or None)
        noise = told.diagnosed.diagnosis.noise_floor_m3s
        drawn["dependences"] = dependences(told.chambers, depends, noise)
    if told.ranking:
        ranks = [Rank(named(r.key), r.before, r.after) for r in told.ranking[:RANKED]]
        drawn["ranking"] = ranking(ranks, float(np.sqrt(GAIN)))
    return drawn
