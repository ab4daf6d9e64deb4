"""What the fixed-size memory of the kernels can hold, checked before they run without checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rtid.errors import RtidError
from rtid.kernels import layout
from rtid.model import COMMAND_ONLY, DROP_ONLY, MOST_MODE, TAYLOR, Edge, Machine


@dataclass(frozen=True)
class Unfit:
    """One part of a declaration that the kernels cannot hold; `where` is its key in the project."""

    where: str
    problem: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}; {self.remedy}"


class UnfitError(RtidError, ValueError):
    """The kernels cannot hold this declaration; the text names everything that is wrong with it."""

    exit_code = 2


def refuse_unfit(model: Machine) -> None:
    """Raise UnfitError that names everything in the declaration which the kernels cannot hold."""
    faults = unfit(model)
    if faults:
        raise UnfitError("\n".join(str(fault) for fault in faults))


def unfit(model: Machine) -> list[Unfit]:
    """Everything in the declaration which the kernels cannot hold."""
    return [*_sizes(model), *_numbers(model), *_edges(model), *_terms(model), *_upkeep(model)]


def _sizes(model: Machine) -> Iterator[Unfit]:
    for where, what, count, most in (
        ("chambers", "chambers", len(model.chambers), layout.MAX_CHAMBERS),
        ("edges", "edges", len(model.edges), layout.MAX_EDGES),
        ("signals", "signals", len(model.signals), layout.MAX_SIGNALS),
        ("terms", "terms", len(model.terms), layout.MAX_SHARED - len(model.chambers)),
        ("edges", "blocks that are open at once", most_open(model), layout.MAX_OPEN),
    ):
        if count > most:
            yield Unfit(where, f"{count} {what}", f"at most {most} are possible")
    for edge in model.edges:
        borders = max(edge.grid.shape) + 1
        if borders > layout.MAX_BORDERS:
            problem, remedy = f"{borders} borders", f"at most {layout.MAX_BORDERS} are possible"
            yield Unfit(f"edges.{edge.name}", problem, remedy)


def _numbers(model: Machine) -> Iterator[Unfit]:
    """Zero noise would weigh a row infinitely; the filter's formula is that of zeta < 1."""
    if not 0 < model.filter.zeta < 1:
        problem = f"damping {model.filter.zeta:g}: must lie between 0 and 1"
        yield Unfit("filter.damping", problem, "write e.g. 0.8")
    needed = [model.position, *(chamber.pressure for chamber in model.chambers if chamber.pressure)]
    for name in needed:
        signal = model.signals[model.column(name)]
        if not signal.noise * signal.noise + signal.resolution * signal.resolution > 0:
            yield Unfit(
                f"signals.{name}", "noise and resolution are zero", "declare the sensor's noise"
            )
    least = 2 * most_open(model)
    if not least <= model.recent_blocks <= layout.MAX_RECENT:
        problem = (
            f"recent_blocks {model.recent_blocks}: must lie between {least}, twice the blocks that "
            f"can be open at once, and {layout.MAX_RECENT}"
        )
        yield Unfit("estimator.recent_blocks", problem, f"write {layout.MAX_RECENT}")
    if model.mode:
        mode = model.signals[model.column(model.mode)]
        if not (mode.minimum >= 0 and mode.maximum <= MOST_MODE):
            problem, remedy = "its range is too wide", f"it must lie within 0 and {MOST_MODE}"
            yield Unfit(f"signals.{model.mode}", problem, remedy)


def _edges(model: Machine) -> Iterator[Unfit]:
    for edge in model.edges:
        where = f"edges.{edge.name}"
        if edge.shares and model.form != "integral":
            problem = f"a shared map has no {model.form} form"
            yield Unfit(where, problem, 'choose form = "integral" under [estimator]')
        if edge.modes and not model.mode:
            problem = "it has modes, but the model has no mode signal"
            yield Unfit(where, problem, 'add a signal with unit = "mode"')
        if any(not 0 <= m <= MOST_MODE for m in edge.modes):
            problem = f"modes must lie within 0 and {MOST_MODE}"
            yield Unfit(where, problem, "give the modes other numbers")
        if edge.basis != TAYLOR and _crossed(edge):
            problem = f"terms {edge.terms!r} in the {edge.basis} basis need one single interval"
            remedy = 'let the other grid have two borders, or choose basis = "taylor"'
            yield Unfit(where, problem, remedy)


def _terms(model: Machine) -> Iterator[Unfit]:
    """-1 / z has to stay finite over all that the gates let through."""
    for term in (term for term in model.terms if term.shape == "inverse"):
        least = term.constant
        for name, weight in term.weights:
            signal = model.signals[model.column(name)]
            least += min(weight * signal.minimum, weight * signal.maximum)
        if not least > 0:
            yield Unfit(
                f"term {term.name}", "z can be zero", "declare ranges that keep it positive"
            )


def _upkeep(model: Machine) -> Iterator[Unfit]:
    upkeep = model.upkeep
    if upkeep.innovation_sd > 0 and model.form != "integral":
        problem = f"the {model.form} form has no innovation gate"
        yield Unfit("upkeep.innovation_sd", problem, "write 0, or choose the integral form")
    if upkeep.innovation_sd > 0 and upkeep.every_s <= 0:
        problem = "the innovation gate needs every_s > 0, when a map is held"
        yield Unfit("upkeep.innovation_sd", problem, "write every_s = 10, or innovation_sd = 0")
    if upkeep.folds < 1 or upkeep.innovation_rows < 1 or upkeep.every_s < 0:
        problem = "folds and innovation_rows must be at least 1, every_s not negative"
        yield Unfit("upkeep", problem, "correct them")


def _crossed(edge: Edge) -> bool:
    nu, nd = edge.grid.shape
    return (edge.terms == DROP_ONLY and nu > 1) or (edge.terms == COMMAND_ONLY and nd > 1)


def most_open(model: Machine) -> int:
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
