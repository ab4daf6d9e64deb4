"""Measured and modelled flow or pressure over time, what is left below, part by part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtid.compare import FREE_RUN, Comparison, Examination, Simulation
from rtid.diagnose.residual import Residual
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.tell.colours import BLUE, HELD_OUT, INK, ORANGE, SEEN
from rtid.tell.story import Chart, Line, Panel, Remark, Shade
from rtid.units import KPA, MPA, flow_name, lpm

LIMIT = 0.998  # quantile of the errors that a common scale shows
FLOWS = "Measured and modelled flow"
PARTS = ("identification", "held out")


@dataclass(frozen=True)
class _Piece:
    """One part of a record: t_s (n,), the others (n, chambers) as they are shown.

    remarks: one per chamber, above what is left.
    """

    t_s: FloatArray
    measured: FloatArray
    modelled: FloatArray
    left: FloatArray
    remarks: list[str]


Pieces = Mapping[str, _Piece]  # by the part's name; the first one taught the model


def residual(model: Machine, parts: Mapping[str, Comparison], name: str = "residual") -> Chart:
    """Flows of every chamber and what is left of them; parts: by title, the first one taught."""
    pieces = {
        title: _Piece(
            part.t_s,
            part.measured_m3s * lpm(), part.modelled_m3s * lpm(), part.residual_m3s * lpm(),
            [f"{lpm() * rms:.3g} {flow_name()} rms, {100 * share:.2g} % of the flow" for rms, share
             in zip(part.residual_rms_m3s, part.residual_share, strict=True)],
        )
        for title, part in parts.items() if len(part.t_s)
    }  # fmt: skip
    return _chart(name, FLOWS, _names(model), {"": pieces}, f"flow in {flow_name()}", "residual")


def flows(chambers: Sequence[str], models: Mapping[str, Sequence[Residual]], caption: str) -> Chart:
    """The same of a diagnosis: one column for each model, by title."""
    columns = {
        title: {
            name: _Piece(
                part.t_s, part.measured * lpm(),
                (part.measured - part.left) * lpm(), part.left * lpm(),
                [f"rms {rms:.3g} {flow_name()}"
                 for rms in lpm() * np.sqrt(np.mean(part.left**2, axis=0))],
            )
            for name, part in zip(PARTS, parts, strict=True) if len(part.t_s)
        }
        for title, parts in models.items()
    }  # fmt: skip
    made = _chart(
        "flows", FLOWS, chambers, columns, f"flow in {flow_name()}", f"residual in {flow_name()}"
    )
    return replace(made, caption=caption)


def pressures(
    model: Machine, parts: Mapping[str, Mapping[str, Simulation]], run: str = FREE_RUN
) -> Chart:
    """Simulated pressures and their errors; parts: simulations by name for each part."""
    pieces = {
        title: _Piece(
            r.t_s, r.measured_pa * MPA,
            np.where(r.predicted[:, None], r.simulated_pa, np.nan) * MPA, r.error_pa * KPA,
            [f"{title}: fit {fit:.1f} %, {rms * KPA:.1f} kPa rms"
             for fit, rms in zip(r.fit_percent, r.rms_pa, strict=True)],
        )
        for title, runs in parts.items() if run in runs and len((r := runs[run]).t_s)
    }  # fmt: skip
    heading = f"Measured and simulated pressure, {run}"
    words = "pressure in MPa", "error in kPa"
    return _chart("pressure", heading, _names(model), {"": pieces}, *words)


def beside(model: Machine, studies: Mapping[str, Mapping[str, Examination]]) -> Chart:
    """What two or more models leave of flow and pressure: one column each, common scales.

    studies: examinations by part; the first part was seen by the fit.  The scale of a row may cut
    the largest errors of the worst model.
    """
    rows: list[tuple[Panel, ...]] = []
    for c, chamber in enumerate(_names(model)):
        of_flow = {title: _flow_left(parts, c) for title, parts in studies.items()}
        of_pressure = {title: _pressure_left(parts, c) for title, parts in studies.items()}
        rows.append(_row(of_flow, f"chamber {chamber}\nflow in {flow_name()}", is_titled=c == 0))
        rows.append(_row(of_pressure, f"chamber {chamber}\npressure in kPa", is_titled=False))
    caption = "What each model leaves of the measured flow and of the pressures that it runs."
    size = 5.2, 1.75
    return Chart("beside", "What is left", tuple(rows), caption, "row", "", size, is_timed=True)


Left = list[tuple[FloatArray, FloatArray, str]]  # times, values as shown and a remark, by part


def _flow_left(parts: Mapping[str, Examination], c: int) -> Left:
    equations = [result.equation for result in parts.values()]
    return [
        (e.t_s, e.residual_m3s[:, c] * lpm(), f"{100 * e.residual_share[c]:.2g} % of the flow")
        for e in equations
        if len(e.t_s)
    ]


def _pressure_left(parts: Mapping[str, Examination], c: int) -> Left:
    runs = [result.simulations.get(FREE_RUN) for result in parts.values()]
    return [
        (run.t_s, run.error_pa[:, c] * KPA, f"fit {run.fit_percent[c]:.1f} %")
        for run in runs
        if run is not None and len(run.t_s)
    ]


def _row(lefts: Mapping[str, Left], label: str, is_titled: bool) -> tuple[Panel, ...]:
    sizes = [np.abs(y[np.isfinite(y)]) for rest in lefts.values() for _, y, _ in rest]
    largest = [float(np.quantile(size, LIMIT)) for size in sizes if len(size)]
    panels = []
    for title, rest in lefts.items():
        parts = dict(zip(PARTS, rest, strict=False))
        lines = tuple(Line("", t, y, BLUE, 0.5) for t, y, _ in rest)
        remarks = tuple(Remark(float(0.5 * (t[0] + t[-1])), words) for t, _, words in rest)
        shades = _shades({name: t for name, (t, _, _) in parts.items()})
        limit = 1.15 * max(largest, default=0.0)
        heading = f"{title}\n" if is_titled else ""
        panels.append(Panel(heading, "time in s", label, lines, (), shades, remarks, limit=limit))
    return tuple(panels)


def _names(model: Machine) -> list[str]:
    return [chamber.name for chamber in model.chambers]


def _chart(
    name: str, heading: str, chambers: Sequence[str], columns: Mapping[str, Pieces],
    upper: str, lower: str,
) -> Chart:  # fmt: skip
    """Two rows for each chamber, a column for each model; every row has one scale."""
    rows: list[tuple[Panel, ...]] = []
    for c, chamber in enumerate(chambers):
        both = [_both(pieces, c, chamber, title, upper, lower) for title, pieces in columns.items()]
        rows += zip(*both, strict=True)
    wide = 10.0 if len(columns) == 1 else 5.2
    return Chart(name, heading, tuple(rows), "", "row", "", (wide, 1.3), is_timed=True)


def _both(
    pieces: Pieces, c: int, chamber: str, title: str, upper: str, lower: str
) -> tuple[Panel, Panel]:
    """What was measured and modelled, and what is left."""
    t_s = np.concatenate([p.t_s for p in pieces.values()] or [np.empty(0)])

    def column(which: str) -> FloatArray:
        return np.concatenate([getattr(p, which)[:, c] for p in pieces.values()] or [np.empty(0)])

    shades = _shades({name: piece.t_s for name, piece in pieces.items()})
    remarks = tuple(
        Remark(float(0.5 * (p.t_s[0] + p.t_s[-1])), p.remarks[c]) for p in pieces.values()
    )
    heading = f"chamber {chamber}" + (f", {title}" if title else "")
    lines = (
        Line("measured", t_s, column("measured"), INK, 1.5),
        Line("model", t_s, column("modelled"), ORANGE, 0.9),
    )
    rest = (Line("measured less model", t_s, column("left"), BLUE, 0.6),)
    return (
        Panel(heading, "time in s", upper, lines, (), shades, has_zero=False, height=1.8),
        Panel("", "time in s", lower, rest, (), shades, remarks),
    )


def _shades(times: Mapping[str, FloatArray]) -> tuple[Shade, ...]:
    return tuple(
        Shade(name, float(t[0]), float(t[-1]), SEEN if k == 0 else HELD_OUT)
        for k, (name, t) in enumerate(times.items())
    )
