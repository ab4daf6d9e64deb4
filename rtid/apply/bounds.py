"""What speaks against sending a map: limits of one apply, and limits of any map at all.

A first apply has nothing to be compared with, so every map is also held against the size that the
edge is declared with.  Q(u, dp) may not pass a share of

    rated flow * sqrt(max(|dp|, rated dp) / rated dp),

what the look-up table is off by, mostly its rounding to 16 bits, may not pass a share of the rated
flow, and where the map stands on data it may not be too far from the prior that the project names.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from firmware_bridge.lookup import STATUS, Table, table_of
from rtid.apply.plan import Prepared, Review, slots
from rtid.apply.versions import Applied
from rtid.maps.prior_map import find_prior
from rtid.model import Edge
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.project.schema import PublishSection
from rtid.units import with_unit


def objections(project: Project, applied: Applied, review: Review, prepared: Prepared) -> list[str]:
    """What the limits of the project have against it; empty if nothing."""
    return [
        *_of_the_size(project, prepared),
        *_of_the_table(project.sections.publish, prepared, project.model.maps),
        *_of_the_prior(project, prepared),
        *_of_the_change(project.sections.publish, review),
        *_of_the_time(project.sections.publish, applied),
    ]


def _of_the_change(section: PublishSection, review: Review) -> Iterator[str]:
    for change in review.differences:
        if change.believed_percent > section.max_change_percent:
            yield (
                f"{change.edge}: the flow changes by {with_unit(change.believed_m3s, 'm3/s')} "
                f"({change.believed_percent:.1f} % of the rated flow) at "
                f"{_place(change.believed_u_v, change.believed_dp_pa)}; "
                f"publish.max_change_percent is {section.max_change_percent:g}: raise it for this "
                "apply if the change is right"
            )


def _of_the_time(section: PublishSection, applied: Applied) -> Iterator[str]:
    last = applied.newest()
    since_s = time.time() - last.unix_s if last is not None else np.inf
    if since_s < section.least_interval_s:
        yield (
            f"the last apply was {max(since_s, 0.0):.0f} s ago; publish.least_interval_s is "
            f"{section.least_interval_s:g}"
        )


def _of_the_size(project: Project, prepared: Prepared) -> Iterator[str]:
    """Flows that no valve of this size gives."""
    most = project.sections.publish.max_flow_percent
    for edge, table in _tables(project, prepared):
        share = np.abs(table.flow_m3s) / _lawful(edge, table.dp_pa)
        i, j = np.unravel_index(share.argmax(), share.shape)
        if not 100 * share[i, j] <= most:
            at = _place(table.direction * float(table.w_v[i]), float(table.dp_pa[j]))
            yield (
                f"{edge.name}: {with_unit(float(table.flow_m3s[i, j]), 'm3/s')} at {at} is "
                f"{share[i, j]:.3g} times what a valve of its rated flow gives there; "
                f"publish.max_flow_percent is {most:g}: correct rated_q of this edge, or raise it"
            )


def _of_the_table(
    section: PublishSection, prepared: Prepared, edges: tuple[Edge, ...]
) -> Iterator[str]:
    """Tables too coarse for their map: too little room, or one flow that dwarfs the others."""
    rated_m3s = {edge.name: edge.rated_q_m3s for edge in edges}
    for sampled in prepared.sampled:
        percent = 100 * sampled.error_max_m3s / rated_m3s[sampled.edge]
        if not percent <= section.max_error_percent:
            yield (
                f"{sampled.edge}: the look-up table is off by {percent:.3g} % of the rated flow at "
                f"{_place(sampled.error_u_v, sampled.error_dp_pa)} (one step of its 16 bits is "
                f"{100 * sampled.table.scale / rated_m3s[sampled.edge]:.3g} %); "
                f"publish.max_error_percent is {section.max_error_percent:g}: give the controller "
                "more room, or look for a flow that is far too large"
            )


def _of_the_prior(project: Project, prepared: Prepared) -> Iterator[str]:
    """Flows on data that are far from what was known before."""
    prior, most = find_prior(project), project.sections.publish.max_prior_percent
    known = {edge.name: edge for edge in prior.flowmap.edges} if prior is not None else {}
    for edge, table in _tables(project, prepared):
        if edge.name not in known:
            continue
        w, s = (0.5 * (node[1:] + node[:-1]).astype(float) for node in (table.w_v, table.s))
        dp = s * np.abs(s)
        expected = known[edge.name].flow(w[:, None], dp)
        off = np.abs(table.flow(table.direction * w[:, None], dp)[0] - expected)
        off = np.where((table.status == STATUS.index("valid")) & np.isfinite(off), off, 0.0)
        share = off / _lawful(edge, dp)
        i, j = np.unravel_index(share.argmax(), share.shape)
        if 100 * share[i, j] > most:
            yield (
                f"{edge.name}: the flow is {with_unit(float(off[i, j]), 'm3/s')} from the prior's "
                f"at {_place(table.direction * float(w[i]), float(dp[j]))}, where the map stands "
                f"on data; publish.max_prior_percent is {most:g}: one of the two is wrong"
            )


def _tables(project: Project, prepared: Prepared) -> Iterator[tuple[Edge, Table]]:
    for edge, slot in zip(project.model.maps, slots(project), strict=False):
        yield edge, table_of(prepared.images[slot])


def _lawful(edge: Edge, dp_pa: FloatArray) -> FloatArray:
    """The flow of an orifice of the rated size, m3/s (n,)."""
    drop = np.maximum(np.abs(dp_pa), edge.rated_dp_pa) / edge.rated_dp_pa
    return np.asarray(edge.rated_q_m3s * np.sqrt(drop))


def _place(u_v: float, dp_pa: float) -> str:
    return f"{u_v:.2f} V, dp = {with_unit(dp_pa, 'Pa')}"
