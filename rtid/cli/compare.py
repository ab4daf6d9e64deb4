"""`rtid compare`: hold the learned map and a data sheet against a trace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import refuse_truncated

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rtid.compare import Comparison, Deviation
    from rtid.comparing import TraceComparison

LPM, MPA = 6e4, 1e-6
WORST = 12  # blocks in the printed table; --json gives all
WIDTH = 110  # where the output is no terminal


def compare(
    trace: Annotated[Path, typer.Argument(help="CAN log or table.")],
    project: Annotated[Path, typer.Option("--project", "-p", help="Project file.")],
    sheet: Annotated[
        Path | None, typer.Option("--map", help="Data sheet (CSV) to hold beside the learned map.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for pictures of residual, maps and slices.")
    ] = None,
    picture_format: Annotated[str, typer.Option(help="png or svg.")] = "png",
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Say whether a data sheet explains this trace, and whether the learned map does.

    Learns from the identification part, then holds every map against both parts: what is left of
    the chamber flows, where, and how far the data sheet is from the learned map.
    """
    from rtid.comparing import as_json as plain
    from rtid.comparing import compare_trace, find_reference
    from rtid.project import load
    from rtid.replay import replay

    loaded = load(project)
    reference = find_reference(loaded, sheet)
    found = compare_trace(replay(loaded, trace), reference)
    written = _draw(found, pictures, picture_format) if pictures else []
    if as_json:
        print(json.dumps(plain(found) | {"pictures": [str(path) for path in written]}))
    else:
        _print(found, written)
    refuse_truncated(trace, found.replay.trace.counters)


def _draw(found: TraceComparison, folder: Path, suffix: str) -> list[Path]:
    """Residual of every map, the learned map, and slices beside the reference."""
    from rtid.pictures import maps, residual, save, slices

    folder.mkdir(parents=True, exist_ok=True)
    model = found.replay.model
    drawn = {f"residual_{h.name}": residual(model, h.parts) for h in found.held}
    drawn["maps"] = maps(found.flowmap)
    name = found.reference.name if found.reference else ""
    drawn["slices"] = slices(found.flowmap, found.reference, reference_name=name)
    return [save(figure, folder / f"{name}.{suffix}") for name, figure in drawn.items()]


def _print(found: TraceComparison, written: list[Path]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH)
    _print_answer(console, found)
    console.print(_residuals(found))
    for table in (_blocks(found), _differences(found.deviations)):
        if table.row_count:
            console.print(table)
    for path in written:
        console.print(f"wrote {path}")


def _print_answer(console: Console, found: TraceComparison) -> None:
    """One sentence per map, on the part that the fit has not seen where there is one."""
    names = [chamber.name for chamber in found.replay.model.chambers]
    for held in found.held:
        title, part = list(held.parts.items())[-1]
        if not len(part.t_s):
            console.print(f"The {title} part holds no row: nothing to compare.")
            continue
        shares = zip(part.residual_share, names, strict=True)
        text = " and ".join(f"{100 * share:.2g} % in chamber {name}" for share, name in shares)
        console.print(f"With the {held.name} map, {text} of the flow stay unexplained ({title}).")
    console.print()


def _residuals(found: TraceComparison) -> Table:
    from rich.table import Table

    from rtid.comparing import share_on_own_data

    heads = (
        "map",
        "part",
        "chamber",
        "beta MPa",
        "flow L/min",
        "residual L/min",
        "%",
        "rho",
        "valid",
    )
    table = Table(*heads, title="Equation residual, rms", title_justify="left", box=None)
    table.columns[0].min_width = max(len(held.name) for held in found.held)
    for held in found.held:
        for title, part in held.parts.items():
            own = f"{100 * share_on_own_data(part):.0f} %" if held is found.held[0] else ""
            for c, chamber in enumerate(found.replay.model.chambers):
                beta = f"{held.beta_pa[c] * MPA:.1f}"
                table.add_row(held.name, title, chamber.name, beta, *_numbers(part, c), own)
    return table


def _numbers(part: Comparison, chamber: int) -> tuple[str, ...]:
    if not len(part.t_s):
        return ("-",) * 4
    flow, residual = part.flow_rms_m3s[chamber] * LPM, part.residual_rms_m3s[chamber] * LPM
    share, rho = 100 * part.residual_share[chamber], part.rho[chamber]
    return f"{flow:.2f}", f"{residual:.4f}", f"{share:.2f}", f"{rho:.3g}"


def _blocks(found: TraceComparison) -> Table:
    from rich.table import Table

    heads = ("edge", "u V", "dp MPa", "rows", "flow L/min", "sd", "residual", "condition", "status")
    title = f"The {WORST} blocks with the largest residual"
    table = Table(*heads, title=title, title_justify="left", box=None)
    known = [row for row in found.blocks if row.residual_rms_m3s >= 0]
    for row in sorted(known, key=lambda row: -row.residual_rms_m3s)[:WORST]:
        table.add_row(
            row.edge,
            f"{row.u_v[0]:g}..{row.u_v[1]:g}",
            f"{row.dp_pa[0] * MPA:g}..{row.dp_pa[1] * MPA:g}",
            str(row.rows),
            f"{row.flow_m3s * LPM:.3f}",
            f"{row.sd_m3s * LPM:.3f}",
            f"{row.residual_rms_m3s * LPM:.3f}",
            f"{row.condition:.1e}",
            row.reason or row.status,
        )
    return table


def _differences(found: list[Deviation]) -> Table:
    from rich.table import Table

    heads = ("edge", "valid blocks", "mean %", "largest %", "at u V", "dp MPa", "learned", "sheet")
    title = "Learned map minus data sheet, % of the largest flow, valid blocks"
    table = Table(*heads, title=title, title_justify="left", box=None)
    for d in found:
        if not d.valid.any():
            table.add_row(d.edge, "0")
            continue
        share = abs(d.share_of_largest[d.valid]) * 100
        worst = share.argmax()
        at = [a[d.valid][worst] for a in (d.w_v, d.dp_pa, d.flow_m3s, d.reference_m3s)]
        scaled = (f"{v * f:.4g}" for v, f in zip(at, (1, MPA, LPM, LPM), strict=True))
        count = str(int(d.valid.sum()))
        table.add_row(d.edge, count, f"{share.mean():.2f}", f"{share.max():.2f}", *scaled)
    return table
