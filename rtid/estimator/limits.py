"""What the fixed-size memory of the kernels can hold, checked before they run without checks."""

from __future__ import annotations

from collections.abc import Iterator

from rtid.kernels import layout
from rtid.model import COMMAND_ONLY, DROP_ONLY, MOST_MODE, TAYLOR, Edge, Model


def refuse_unfit(model: Model) -> None:
    """Raise ValueError that names everything in the declaration which the kernels cannot hold."""
    faults = [*_sizes(model), *_numbers(model), *_edges(model), *_terms(model), *_upkeep(model)]
    if faults:
        raise ValueError("; ".join(faults))


def _sizes(model: Model) -> Iterator[str]:
    for what, count, most in (
        ("chambers", len(model.chambers), layout.MAX_CHAMBERS),
        ("edges", len(model.edges), layout.MAX_EDGES),
        ("signals", len(model.signals), layout.MAX_SIGNALS),
        ("shared terms", len(model.terms), layout.MAX_SHARED - len(model.chambers)),
        ("blocks that are open at once", most_open(model), layout.MAX_OPEN),
    ):
        if count > most:
            yield f"{count} {what}, at most {most} are possible"
    for edge in model.edges:
        borders = max(edge.grid.shape) + 1
        if borders > layout.MAX_BORDERS:
            yield f"edge {edge.name}: {borders} borders, at most {layout.MAX_BORDERS} are possible"


def _numbers(model: Model) -> Iterator[str]:
    """Zero noise would weigh a row infinitely; the filter's formula is that of zeta < 1."""
    if not 0 < model.filter.zeta < 1:
        yield f"filter damping {model.filter.zeta:g}: must lie between 0 and 1, e.g. 0.8"
    needed = [model.position, *(chamber.pressure for chamber in model.chambers if chamber.pressure)]
    for name in needed:
        signal = model.signals[model.column(name)]
        if not signal.noise**2 + signal.resolution**2 > 0:
            yield f"signal {name}: noise and resolution are zero; declare the sensor's noise"
    least = 2 * most_open(model)
    if not least <= model.recent_blocks <= layout.MAX_RECENT:
        yield (
            f"recent_blocks {model.recent_blocks}: must lie between {least}, twice the blocks that "
            f"can be open at once, and {layout.MAX_RECENT}"
        )
    if model.mode:
        mode = model.signals[model.column(model.mode)]
        if not (mode.minimum >= 0 and mode.maximum <= MOST_MODE):
            yield f"mode signal {model.mode}: its range must lie within 0 and {MOST_MODE}"


def _edges(model: Model) -> Iterator[str]:
    for edge in model.edges:
        if edge.modes and not model.mode:
            yield f"edge {edge.name}: it has modes, but the model has no mode signal"
        if any(not 0 <= m <= MOST_MODE for m in edge.modes):
            yield f"edge {edge.name}: modes must lie within 0 and {MOST_MODE}"
        if edge.basis != TAYLOR and _crossed(edge):
            yield (
                f"edge {edge.name}: terms {edge.terms!r} in the {edge.basis} basis need one "
                "single interval along the other axis"
            )


def _terms(model: Model) -> Iterator[str]:
    """-1 / z has to stay finite over all that the gates let through."""
    for term in (term for term in model.terms if term.shape == "inverse"):
        least = term.constant
        for name, weight in term.weights:
            signal = model.signals[model.column(name)]
            least += min(weight * signal.minimum, weight * signal.maximum)
        if not least > 0:
            yield f"term {term.name}: z can be zero; declare ranges that keep it positive"


def _upkeep(model: Model) -> Iterator[str]:
    upkeep = model.upkeep
    if upkeep.innovation_sd > 0 and model.form != "integral":
        yield f"upkeep: the {model.form} form has no innovation gate, only the integral form"
    if upkeep.innovation_sd > 0 and upkeep.every_s <= 0:
        yield "upkeep: the innovation gate needs every_s > 0, when a map is held"
    if upkeep.folds < 1 or upkeep.innovation_rows < 1 or upkeep.every_s < 0:
        yield "upkeep: folds and innovation_rows must be at least 1, every_s not negative"


def _crossed(edge: Edge) -> bool:
    nu, nd = edge.grid.shape
    return (edge.terms == DROP_ONLY and nu > 1) or (edge.terms == COMMAND_ONLY and nd > 1)


def most_open(model: Model) -> int:
    """Largest number of blocks that can be open at once.

    One per open edge, up to four where windows overlap.  Edges of one command that open in opposite
    directions exclude each other, unless their safe band reaches below zero, or modes shut them one
    by one: with a lag one closes while the other opens.
    """
    total = 0
    for command in {edge.command for edge in model.edges}:
        mine = [edge for edge in model.edges if edge.command == command]
        if any(edge.modes for edge in mine):
            total += sum(_windows(edge) for edge in mine)
            continue
        always = sum(_windows(e) for e in mine if e.safe_band_v < 0)
        ways = [
            sum(_windows(e) for e in mine if e.safe_band_v >= 0 and e.direction == way)
            for way in (1, -1)
        ]
        total += always + max(ways)
    return total


def _windows(edge: Edge) -> int:
    nu, nd = edge.grid.shape
    return min(nu, 2) * min(nd, 2) if edge.basis != TAYLOR else 1
