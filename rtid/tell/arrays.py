"""The door for arrays: a record without a file, learned from and diagnosed like any other.

study = rtid.fit(machine="machine.toml", t=t, u=u, p_a=p_a, p_b=p_b, p_s=p_s, x=x)
print(study.diagnosis().verdict, study.map["pa"].flow(5.0, 4e6))
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from firmware_bridge.config import CYCLE, Assembly
from firmware_bridge.samples import GAP, ROW, Samples
from rtid.errors import ArgumentError, RtidError
from rtid.model import COMMAND, POSITION, PRESSURE, VELOCITY, Machine, Signal
from rtid.plain import FloatArray, Progress, silent
from rtid.project import Project, Sections, load
from rtid.project.build import digest
from rtid.project.schema import ProjectSection, SourceSection
from rtid.study.compared import compare_trace
from rtid.study.study import Study
from rtid.trace.reading import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# largest plausible size of each kind in SI, and what a larger one, or a smaller one, looks like
LEAST_PA, MOST_PA, MOST_M, MOST_MPS, MOST_STEP_S = 2e3, 5e8, 20.0, 50.0, 0.5


class ArrayStudy(Study):
    """A study whose record came as arrays; nothing of it is kept in a file."""

    def plot(self) -> Figure:
        """What the learned maps leave of flows and pressures, a matplotlib figure."""
        from rtid.tell import stills  # noqa: PLC0415 - matplotlib takes long
        from rtid.tell.charts.over_time import beside  # noqa: PLC0415

        learned = self.comparison(None).held[0]
        return stills.draw(beside(self.replay.model, {"learned maps": learned.examinations}))

    def to_pandas(self) -> Any:
        """A DataFrame of the filtered rows' flows in m3/s, by time: measured, modelled, residual.

        Index: t_s; column "part": identification or validation.  RtidError without pandas.
        """
        try:
            pd = import_module("pandas")  # no dependency of rtid
        except ImportError:
            raise RtidError("to_pandas needs pandas", "pip install pandas") from None
        frames = []
        for name, part in compare_trace(self.replay).held[0].parts.items():
            columns: dict[str, object] = {"part": name}
            for c, chamber in enumerate(self.replay.model.chambers):
                columns[f"measured_{chamber.name}_m3s"] = part.measured_m3s[:, c]
                columns[f"modelled_{chamber.name}_m3s"] = part.modelled_m3s[:, c]
                columns[f"residual_{chamber.name}_m3s"] = part.residual_m3s[:, c]
            frames.append(pd.DataFrame(columns, index=pd.Index(part.t_s, name="t_s")))
        return pd.concat(frames)


def fit(
    *,
    machine: Project | Machine | str | Path,
    t: ArrayLike,
    u: ArrayLike,
    p_a: ArrayLike,
    p_b: ArrayLike,
    p_s: ArrayLike,
    x: ArrayLike,
    p_t: ArrayLike = 0.0,
    v: ArrayLike | None = None,
    progress: Progress = silent,
) -> ArrayStudy:
    """Learn from arrays in SI; `.map.flow(u, dp)`, `.diagnosis()`, `.plot()`, `.to_pandas()`.

    machine: the project file (`rtid init` writes one), the project, or an `rtid.Machine` made in
    Python: sizes, grids, noise.  t (n,) in s, rising; u (n,), or (n, edges) where every valve has a
    command of its own, in the unit of the grids; pressures of chamber a and b, supply and tank,
    (n,) or one for all, Pa; x (n,) m; v (n,) m/s where the machine has a velocity.  NaN is a gap.
    Raises ArgumentError, which names the argument.
    """
    project = _project(machine)
    times = _times(t)
    given = {"p_a": p_a, "p_b": p_b, "p_s": p_s, "p_t": p_t, "x": x}
    arrays = {name: _series(name, values, len(times)) for name, values in given.items()}
    arrays["v"] = _series("v", np.nan if v is None else v, len(times))
    _refuse_units(arrays)
    commands = _commands(project.model, u, len(times))
    columns = [_column(project.model, s, arrays, commands) for s in project.model.signals]
    study = ArrayStudy(project, Path("arrays"), progress)
    vars(study)["read"] = Trace(Path("arrays"), _samples(project, times, columns), {}, None)
    return study


def _project(machine: Project | Machine | str | Path) -> Project:
    """A project without a file for a machine that was made in Python."""
    if isinstance(machine, Project):
        return machine
    if not isinstance(machine, Machine):
        return load(machine)
    sections = Sections(ProjectSection(name="machine"), SourceSection(), {}, {})
    nothing = Assembly(CYCLE, (), (), machine.position)
    key = digest(machine)
    return Project(Path("machine"), sections, machine, nothing, None, (), {}, (), {}, key, key)


def _times(t: ArrayLike) -> FloatArray:
    times = np.asarray(t, float)
    if times.ndim != 1 or len(times) < 2:
        raise ArgumentError(f"fit: t must have the shape (n,), not {times.shape}")
    steps = np.diff(times)
    if not np.isfinite(times).all():
        raise ArgumentError("fit: t must be known everywhere; a gap is NaN in what was measured")
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0)) + 1
        raise ArgumentError(f"fit: t must rise; t[{k}] = {times[k]:g} does not, sort the record")
    if np.median(steps) > MOST_STEP_S:
        step = f"its steps are {np.median(steps):g}"
        raise ArgumentError(f"fit: t must be in s, {step}: divide milliseconds by 1000")
    return times


def _series(name: str, values: ArrayLike, n: int) -> FloatArray:
    """One argument as (n,)."""
    series = np.asarray(values, float)
    if series.shape not in ((), (n,)):
        wanted = f"({n},) as t" + (" or one number" if name.startswith("p_") else "")
        raise ArgumentError(f"fit: {name} must have the shape {wanted}, not {series.shape}")
    return np.broadcast_to(series, n)


def _refuse_units(arrays: dict[str, FloatArray]) -> None:
    """A pressure in bar, a position in mm: refused before anything is learned from it."""
    for name, series in arrays.items():
        size = float(np.nanmax(np.abs(series), initial=0.0)) if np.isfinite(series).any() else 0.0
        if name in ("p_a", "p_b", "p_s") and not LEAST_PA <= size <= MOST_PA:
            remedy = "1 bar is 1e5 Pa, 1 MPa is 1e6 Pa"
            raise ArgumentError(f"fit: {name} must be in Pa, its largest is {size:g}: {remedy}")
        if name in ("x", "v") and size > (MOST_M if name == "x" else MOST_MPS):
            unit = "m" if name == "x" else "m/s"
            raise ArgumentError(
                f"fit: {name} must be in {unit}, its largest is {size:g}: divide mm by 1000"
            )


def _commands(model: Machine, u: ArrayLike, n: int) -> dict[str, FloatArray]:
    """The command signals' values; several columns are the edges', in their order."""
    values, names = np.asarray(u, float), list(dict.fromkeys(e.command for e in model.edges))
    if values.shape == (n,) and len(names) == 1:
        return {names[0]: values}
    if values.shape == (n, len(model.edges)) and len(names) == len(model.edges):
        return {edge.command: values[:, k] for k, edge in enumerate(model.edges)}
    item = f"({n},)" if len(names) == 1 else f"({n}, {len(model.edges)}), a column per edge"
    raise ArgumentError(
        f"fit: u must have the shape {item} for this machine ({', '.join(names)}), "
        f"not {values.shape}"
    )


def _column(
    model: Machine, signal: Signal, arrays: dict[str, FloatArray], commands: dict[str, FloatArray]
) -> FloatArray:
    """What a signal of the machine is called by an argument."""
    if signal.kind == COMMAND:
        return commands[signal.name]
    if signal.kind in (POSITION, VELOCITY):
        return arrays["x" if signal.kind == POSITION else "v"]
    name = dict(_pressures(model)).get(signal.name) if signal.kind == PRESSURE else None
    if name is None:
        raise ArgumentError(
            f"fit: the machine has a signal {signal.name} ({signal.kind}), which no argument gives"
        )
    return arrays[name]


def _pressures(model: Machine) -> Iterator[tuple[str, str]]:
    """Signal and argument of each pressure: chambers in their order, what feeds, what drains."""
    chambers = [chamber.pressure for chamber in model.chambers]
    for edge in model.edges:
        if edge.source not in chambers:
            yield edge.source, "p_s"
        if edge.sink not in chambers:
            yield edge.sink, "p_t"
    yield from zip(chambers, ("p_a", "p_b"), strict=False)


def _samples(project: Project, times: FloatArray, columns: list[FloatArray]) -> Samples:
    """Complete samples; one that is not is left out, and the next begins anew."""
    names = tuple(signal.name for signal in project.model.signals)
    needed = [c for c, s in zip(columns, project.model.signals, strict=True) if s.kind != VELOCITY]
    complete = np.isfinite(np.stack(needed)).all(axis=0)
    values = np.nan_to_num(np.stack(columns, axis=1)[complete])
    if len(values) < 2:
        raise ArgumentError("fit: no two instants at which every argument is known")
    kept = np.flatnonzero(complete)
    flags = np.where(np.diff(kept, prepend=kept[0]) > 1, ROW | GAP, ROW).astype(np.uint8)
    t_us = np.rint(1e6 * (times[complete] - times[0])).astype(np.int64)
    return Samples(names, t_us, values, flags)
