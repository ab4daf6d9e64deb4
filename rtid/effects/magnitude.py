"""How large a machine is beside the one that the ranges of the pages are written for.

What a chamber stores grows with its volume, what leaks or is let out with what the valves pass: at
ten times the volume and the flow everything is the same at the same pressures and times.  A range
of such a size is widened for a larger machine, at its upper end, and for a smaller one at its
lower; nothing becomes impossible that the page calls possible.
"""

from __future__ import annotations

from dataclasses import replace

from rtid.effects.page import Effect, Parameter
from rtid.model import Machine

USUAL_M3, USUAL_M3S = 2e-3, 5e-4  # largest chamber, and rated flow, that the pages are written for


def volume_times(model: Machine) -> float:
    """The machine's largest chamber, as declared, in units of the pages' own."""
    return max((c.v0_m3 for c in model.chambers), default=0.0) / USUAL_M3


def flow_times(model: Machine) -> float:
    """The machine's largest rated flow in units of the pages' own."""
    return max((edge.rated_q_m3s for edge in model.edges), default=0.0) / USUAL_M3S


SCALES = {"volume": volume_times, "flow": flow_times}


def page_for(page: Effect, model: Machine) -> Effect:
    """The page with the ranges that it has for a machine; itself where none grows with one.

    A page that has been made for the machine stays as it is.
    """
    if not model.has_pressures or not any(p.scale for p in page.parameters):
        return page
    return replace(page, parameters=tuple(_widened(p, model) for p in page.parameters))


def _widened(p: Parameter, model: Machine) -> Parameter:
    if not p.scale:
        return p
    times = SCALES[p.scale.removeprefix("1/")](model)
    if p.scale.startswith("1/"):
        times = 1.0 / times if times > 0.0 else 1.0
    return replace(p, low=p.low * min(1.0, times), high=p.high * max(1.0, times), scale="")
