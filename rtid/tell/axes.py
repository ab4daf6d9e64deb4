"""What a map is over, in words and in the units of the page: of every chart, sentence and table."""

from __future__ import annotations

from rtid.model import NONE, Axes, Edge, Machine
from rtid.units import LPM, PRACTICAL, Scale, flow_name, lpm

HYDRAULIC = Axes()


def axes_of(model: Machine) -> dict[str, Axes]:
    """Of every map of a machine, by its name."""
    return {edge.name: model.axes(edge) for edge in model.maps}


def second(axes: Axes) -> Scale:
    """Scale of the second quantity, whatever the system of units: charts keep theirs."""
    return Scale(*PRACTICAL.get(axes.second, (axes.second, 1.0)))


def labels(axes: Axes) -> tuple[str, str]:
    """Of both axes of a map; the second is empty where it is over the command alone."""
    if axes.over is None:
        return f"opening command in {axes.command}", f"pressure drop in {second(axes).name}"
    return f"command in {axes.command}", _named(axes)


def common_labels(model: Machine) -> tuple[str, str]:
    """Of a picture of all maps."""
    pairs = [labels(axes) for axes in axes_of(model).values()]
    return joined([pair[0] for pair in pairs]), joined([pair[1] for pair in pairs])


def joined(names: list[str]) -> str:
    """Names of what several maps are over, each once."""
    return " / ".join(dict.fromkeys(name for name in names if name))


def _named(axes: Axes) -> str:
    if axes.over == NONE:
        return ""
    unit = second(axes).name
    return f"{axes.over} in {unit}" if unit not in ("", "1") else f"{axes.over}"


def place(axes: Axes, u: tuple[float, float], dp: tuple[float, float]) -> str:
    """A block in words; u, dp: its borders in the units of the model."""
    words = f"{u[0]:.4g} to {u[1]:.4g} {axes.command}"
    if axes.over == NONE:
        return words
    scale = second(axes)
    unit = "" if scale.name in ("", "1") else f" {scale.name}"
    over = f"{axes.over} " if axes.over else ""
    return f"{words}, {over}{scale.factor * dp[0]:.3g} to {scale.factor * dp[1]:.3g}{unit}"


def heading(edge: Edge, axes: Axes) -> str:
    """What flows where, or of which signals a rate is the function."""
    if axes.over is None:
        return f"{edge.name}: {edge.source} → {edge.sink}"
    command = edge.command.rstrip("+-")  # of a machine that is split by direction
    return f"{edge.name} of {command}" + (f" and {axes.over}" if axes.over else "")


def small_flow() -> Scale:
    """Scale of what a model leaves of a flow: of liters mL/min, of any other rate its own."""
    is_flow = flow_name() == PRACTICAL["m3/s"][0]
    return Scale("mL/min", 1e3 * LPM) if is_flow else Scale(flow_name(), lpm())
