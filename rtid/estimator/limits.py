"""What the fixed-size memory of the kernels can hold, checked before they run without checks."""

from __future__ import annotations

from collections.abc import Iterator

from rtid.kernels import layout
from rtid.model import COMMAND_ONLY, DROP_ONLY, TAYLOR, Edge, Model

MOST_MODE = 62  # a set of modes is kept as bits of one integer


def refuse_unfit(model: Model) -> None:
    """Raise ValueError that names everything in the declaration which the kernels cannot hold."""
    faults = [*_sizes(model), *_numbers(model)]
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
    if model.mode:
        mode = model.signals[model.column(model.mode)]
        if not (mode.minimum >= 0 and mode.maximum <= MOST_MODE):
            yield f"mode signal {model.mode}: its range must lie within 0 and {MOST_MODE}"
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


def _crossed(edge: Edge) -> bool:
    nu, nd = edge.grid.shape
    return (edge.terms == DROP_ONLY and nu > 1) or (edge.terms == COMMAND_ONLY and nd > 1)


def most_open(model: Model) -> int:
    """Largest number of blocks that can be open at once.

    One per open edge, up to four where windows overlap.  Edges of one command that open in opposite
    directions exclude each other, unless their safe band reaches below zero.
    """
    total = 0
    for command in {edge.command for edge in model.edges}:
        mine = [edge for edge in model.edges if edge.command == command]
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
