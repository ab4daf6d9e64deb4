"""What the fixed-size memory of the kernels can hold, checked before they run without checks."""

from __future__ import annotations

from collections.abc import Iterator

from rtid.kernels import layout
from rtid.model import Model


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
        ("edges that are open at once", most_open(model), layout.MAX_OPEN),
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
    needed = [model.position, *(chamber.pressure for chamber in model.chambers)]
    for name in needed:
        signal = model.signals[model.column(name)]
        if not signal.noise**2 + signal.resolution**2 > 0:
            yield f"signal {name}: noise and resolution are zero; declare the sensor's noise"


def most_open(model: Model) -> int:
    """Largest number of edges that can be open at once.

    Edges of one command that open in opposite directions exclude each other, unless their safe
    band reaches below zero.
    """
    total = 0
    for command in {edge.command for edge in model.edges}:
        mine = [edge for edge in model.edges if edge.command == command]
        always = sum(edge.safe_band_v < 0 for edge in mine)
        ways = [sum(e.safe_band_v >= 0 and e.direction == way for e in mine) for way in (1, -1)]
        total += always + max(ways)
    return total
