"""A designed motion in plain sentences and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from rtid.excite.exciting import Excited
from rtid.excite.prediction import median_ratio
from rtid.excite.stops import NAME as STOPS
from rtid.excite.stops import REST_AT_STOP_S
from rtid.tell.story import Story, Table
from rtid.units import CONVENTION, Z95, limit, scale_of

MOST_SEGMENTS = 12


def story(excited: Excited, see: Sequence[str] = ()) -> Story:
    """What the motion does and what it will tell."""
    tables = _motions(excited), _limits(excited, see), _ranges(excited)
    return Story("", (*_sentences(excited), *tables, CONVENTION))


def _sentences(excited: Excited) -> Iterator[str]:
    design, sweep = excited.design, excited.sweep
    yield (
        f"Designed motion of {design.duration_s:.1f} s in {len(design.segments)} segments, each "
        "from rest to rest in the middle of the stroke."
    )
    ratio = median_ratio(excited.designed, sweep)
    yield (
        f"Beside the paper's sweep (0.1 to 0.5 Hz) of the same length: {excited.designed.valid} "
        f"valid blocks instead of {sweep.valid}, and the median standard error of the map, over "
        f"the blocks of both, is {ratio:.2f} of the sweep's."
    )
    if any(c.segment.name == STOPS for c in design.segments):
        yield (
            f"It ends with {REST_AT_STOP_S:.0f} s against each stop, slowly approached, with the "
            "valves open: each chamber is then joined to the supply and to the tank, and `rtid "
            "diagnose` tells the zeros of the pressure sensors from it."
        )
    if excited.worth < excited.tried:
        yield (
            f"By what is learned already, {excited.worth} of {excited.tried} possible segments are "
            "still worth running."
        )
    names = Counter(c.segment.name for c in design.segments)
    for name, count in list(names.items())[:MOST_SEGMENTS]:
        yield f"  {count} x {name}" if count > 1 else f"  {name}"
    if len(names) > MOST_SEGMENTS:
        yield f"  and {len(names) - MOST_SEGMENTS} more"


def _motions(excited: Excited) -> Table:
    """The motions beside each other."""
    pressure, rows = scale_of("Pa"), []
    for p in excited.predictions:
        sds = [b.sd for b in p.blocks if b.valid]
        median = f"{100 * Z95 * float(np.median(sds)):.3g}" if sds else "-"
        pairs = zip(p.beta_pa, p.beta_sd_pa, strict=True)
        beta = ", ".join(pressure.known(b, sd, 1) for b, sd in pairs)
        rows.append((p.name, str(p.valid), median, beta))
    heads = ("motion", "valid blocks|", "median ±, % of largest flow|", f"beta, {pressure.name}|")
    return Table("Predicted, before the machine moves", heads, rows)


def _limits(excited: Excited, see: Sequence[str]) -> Table:
    """Detection limit of every effect, those asked for first."""
    section = excited.project.sections.excite
    see = (*see, *(section.see if section else ()))
    rows = [
        (
            x.effect,
            x.where,
            *(limit(p.limit(x.effect, x.where), x.unit) for p in excited.predictions),
        )
        for x in sorted(
            excited.designed.limits, key=lambda x: (x.effect not in see, x.effect, x.where)
        )
    ]
    heads = ("effect", "where", *(f"{p.name}|" for p in excited.predictions))
    return Table("Smallest size seen (4 standard deviations)", heads, rows, keys=2)


def _ranges(excited: Excited) -> Table:
    rows = []
    for e in excited.design.extremes:
        scale = scale_of(e.unit)
        numbers = [f"{scale.factor * v:.4g}" for v in (e.low, e.high, e.least, e.most)]
        allowed = f"{numbers[2]} to {numbers[3]} {scale.name}"
        rows.append((e.quantity, numbers[0], numbers[1], allowed))
    heads = ("quantity", "least|", "most|", "allowed|")
    return Table("On the nominal machine", heads, rows)
