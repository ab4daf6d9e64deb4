"""`rtid mcu`: write the estimator in C for a controller with no computer beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.options import ProjectOption

if TYPE_CHECKING:
    from rtid.mcu.budget import Limited
    from rtid.mcu.c_tables import Sizes
    from rtid.model import Machine
    from rtid.project import Project


def mcu(
    output: Annotated[Path, typer.Argument(help="Folder for the C sources; created if missing.")],
    project: ProjectOption,
    chamber: Annotated[str, typer.Option("--chamber", "-c", help="The chamber to learn.")] = "",
    edge: Annotated[
        list[str] | None, typer.Option("--edge", "-e", help="One of its edges; default: all.")
    ] = None,
    blocks: Annotated[
        int, typer.Option(min=0, help="Blocks that fit in its memory; 0: all of the grids.")
    ] = 0,
    budget: Annotated[
        int, typer.Option(min=0, help="Instructions that no tick may exceed; 0: as declared.")
    ] = 0,
    trace: Annotated[
        Path | None, typer.Option(help="With --budget: a log, to tell what the budget costs on it.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Write the estimator of one chamber in C99, with tables from the project file.

    No heap, no globals; one double or, with -DRTID_ESTIMATOR_FLOAT32, one float per number in the
    update.  The same samples give the sums of `rtid run`.  It learns what the project declares in
    the integral form with Taylor blocks, for ever: no forgetting, no gate by a map held, no modes.

    --budget chooses how many blocks may ring and how much a tick works off, by running the machine
    on emulated Cortex-M boards through motion that no valve makes (a minute or two; needs
    gcc-arm-none-eabi and qemu-system-arm); instructions are not cycles.
    """
    from rtid.mcu.c_tables import sizes_of
    from rtid.mcu.memory import Layout
    from rtid.mcu.valve import one_valve
    from rtid.mcu.write import write_sources
    from rtid.project import load
    from rtid.study.on_board import as_found, is_volume

    loaded = load(project)
    _refuse_estimated(loaded)
    model = one_valve(as_found(loaded), chamber or loaded.model.chambers[0].name, edge or ())
    title = f" of project {loaded.digest}"
    limited = _limited(loaded, model, blocks, budget, trace) if budget else None
    tiles = limited.chosen.tiles if limited else None
    model = limited.chosen.model if limited else model
    written = write_sources(output, model, blocks, title=title, tiles=tiles)
    sizes = sizes_of(model, blocks)
    ram = {
        name: [Layout(sizes, single).estimator.itemsize, Layout(sizes, single).work.itemsize]
        for name, single in (("float64", False), ("float32", True))
    }
    added = [f"{a.effect} at {a.where}" for a in loaded.sections.added if not is_volume(a)]
    if as_json:
        document = {"schema": 1, "written": [str(path) for path in written], "ram_bytes": ram}
        document |= {"chamber": model.chambers[0].name, "blocks": sizes.blocks, "without": added}
        print(json.dumps(document | (limited.document() if limited else {})))
    else:
        _tell(output, model.chambers[0].name, sizes, ram, added)
        if limited:
            print("\n".join(limited.lines()))


def _limited(
    loaded: Project, model: Machine, blocks: int, budget: int, trace: Path | None
) -> Limited:
    from rtid.mcu.budget import limit
    from rtid.mcu.emulated import Record
    from rtid.trace.reading import read_trace

    record = None
    if trace is not None:
        samples = read_trace(loaded, trace).samples
        columns = [samples.names.index(signal.name) for signal in model.signals]
        t_us = samples.t_us - samples.t_us[0]
        record = Record(t_us, samples.values[:, columns], samples.flags.astype(float))
    return limit(model, blocks, budget, record)


def _refuse_estimated(project: Project) -> None:
    """The controller has no trace to take the sensors' noise from."""
    from rtid.mcu.errors import ValveError

    if project.noise_unseen:
        names = ", ".join(f"signals.{name}.noise" for name in project.noise_unseen)
        raise ValveError(f"{project.path}: {names} is to be estimated", "give its value, 1 sigma")


def _tell(output: Path, chamber: str, sizes: Sizes, ram: dict[str, Any], added: list[str]) -> None:
    print(f"wrote {output}: chamber {chamber}, {sizes.edges} edges, {sizes.cells} cells")
    print(f"room for {sizes.blocks} blocks, {sizes.unknowns} unknowns")
    for name, (estimator, work) in ram.items():
        print(f"  {name}: {estimator / 1024:.1f} KiB to learn, {work / 1024:.1f} KiB to solve")
    if added:
        print(f"It learns without {', '.join(added)}: the maps take up what they can of it.")
