"""A designed motion in plain sentences and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from rtid.excite.prediction import median_ratio
from rtid.exciting import Excited

WIDTH = 110  # where the output is no terminal
MOST_SEGMENTS = 12


def show(found: Excited, see: Sequence[str] = ()) -> None:
    """Print what the motion does and what it will tell."""
    console = Console(width=None if Console().is_terminal else WIDTH, highlight=False)
    for line in _story(found):
        console.print(line)
    console.print(_motions(found))
    console.print(_limits(found, see))
    console.print(_ranges(found))


def _story(found: Excited) -> Iterator[str]:
    design, sweep = found.design, found.sweep
    yield (
        f"Designed motion of {design.duration_s:.1f} s in {len(design.segments)} segments, each "
        "from rest to rest in the middle of the stroke."
    )
    ratio = median_ratio(found.designed, sweep)
    yield (
        f"Beside the paper's sweep (0.1 to 0.5 Hz) of the same length: {found.designed.valid} "
        f"valid blocks instead of {sweep.valid}, and the median standard error of the map, over "
        f"the blocks of both, is {ratio:.2f} of the sweep's."
    )
    if found.worth < found.tried:
        yield (
            f"By what is learned already, {found.worth} of {found.tried} possible segments are "
            "still worth running."
        )
    names = Counter(c.segment.name for c in design.segments)
    for name, count in list(names.items())[:MOST_SEGMENTS]:
        yield f"  {count} x {name}" if count > 1 else f"  {name}"
    if len(names) > MOST_SEGMENTS:
        yield f"  and {len(names) - MOST_SEGMENTS} more"


def _motions(found: Excited) -> Table:
    """The motions beside each other."""
    table = Table("motion", title="Predicted, before the machine moves", title_justify="left")
    for head in ("valid blocks", "median sd, % of largest flow", "beta, MPa"):
        table.add_column(head, justify="right")
    for p in found.predictions:
        sds = [b.sd for b in p.blocks if b.valid]
        median = f"{100 * float(np.median(sds)):.3g}" if sds else "-"
        beta = ", ".join(
            f"{1e-6 * b:.0f} +- {1e-6 * sd:.2g}"
            for b, sd in zip(p.beta_pa, p.beta_sd_pa, strict=True)
        )
        table.add_row(p.name, str(p.valid), median, beta)
    return table


def _limits(found: Excited, see: Sequence[str]) -> Table:
    """Detection limit of every effect, those asked for first."""
    section = found.project.sections.excite
    see = (*see, *(section.see if section else ()))
    table = Table("effect", "where", title="Smallest size seen (4 sd)", title_justify="left")
    for p in found.predictions:
        table.add_column(p.name, justify="right")
    table.add_column("unit")
    for x in sorted(found.designed.limits, key=lambda x: (x.effect not in see, x.effect, x.where)):
        values = [f"{p.limit(x.effect, x.where):.2g}" for p in found.predictions]
        table.add_row(x.effect, x.where, *values, x.unit)
    return table


def _ranges(found: Excited) -> Table:
    table = Table(
        "quantity", "least", "most", "allowed", title="On the nominal machine", title_justify="left"
    )
    for e in found.design.extremes:
        allowed = f"{e.least:.4g} to {e.most:.4g} {e.unit}"
        table.add_row(e.quantity, f"{e.low:.4g}", f"{e.high:.4g}", allowed)
    return table
