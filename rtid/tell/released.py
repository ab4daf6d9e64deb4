"""Which tables go to a controller: their sizes, what they miss, how they differ from what is there.

In lines for the terminal, and as a sheet to be signed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from firmware_bridge.lookup import STATUS
from rtid.maps.flashed import FlashedDifference
from rtid.maps.gridded import Gridded, Tables
from rtid.tell.html import table, text
from rtid.tell.words import named
from rtid.units import LPM, MPA, with_unit

HEADS = ("map", "nodes|", "bytes|", "largest flow|", "off by|", "on data|", "ranges")
CHANGED = ("map", "largest difference|", "of the largest flow|", "at", "rms|")
STYLE = (
    "body{font:14px/1.45 system-ui,sans-serif;max-width:52em;margin:2em auto;color:#22272b}"
    "table{border-collapse:collapse;width:100%}th,td{text-align:left;padding:3px 10px 3px 0;"
    "border-bottom:1px solid #d9dde0}.n{text-align:right}dl{display:grid;"
    "grid-template-columns:auto 1fr;gap:2px 14px}dd{margin:0;overflow-wrap:anywhere}"
    ".sign{display:grid;grid-template-columns:1fr 1fr;gap:3em;margin-top:4em}"
    ".sign p{border-top:1px solid #22272b}"
)


def rows(tables: Tables) -> Iterator[tuple[str, ...]]:
    """A row per table, under HEADS."""
    for g in tables:
        yield (
            g.name,
            f"{len(g.u_v)} x {len(g.dp_pa)}",
            f"{g.n_bytes}",
            f"{LPM * abs(g.flow_m3s).max():.3g} L/min",
            f"{100 * g.miss:.2g} %",
            f"{100 * _on_data(g):.0f} %",
            f"{g.u_v[0]:.3g} to {g.u_v[-1]:.3g} V, {MPA * g.dp_pa[0]:.3g} to "
            f"{MPA * g.dp_pa[-1]:.3g} MPa",
        )


def _on_data(g: Gridded) -> float:
    return float((g.code == STATUS.index("valid")).mean())


def changed_rows(differences: Sequence[FlashedDifference]) -> Iterator[tuple[str, ...]]:
    """A row per map, under CHANGED."""
    for d in differences:
        yield (
            d.edge,
            f"{LPM * d.largest_m3s:+.3g} L/min",
            f"{100 * d.share:.2g} %",
            f"{d.u_v:.3g} V, {MPA * d.dp_pa:.3g} MPa",
            f"{LPM * d.rms_m3s:.2g} L/min",
        )


def said(tables: Tables, differences: Sequence[FlashedDifference]) -> Iterator[str]:
    """Lines for the terminal; none where there is no table."""
    for name, nodes, size, _, miss, known, _ in rows(tables):
        yield f"  {name}: {nodes} nodes, {size} bytes, off by {miss} of its largest flow at most; "\
              f"{known} of the nodes stand on data"  # fmt: skip
    if tables:
        yield f"  together {sum(g.n_bytes for g in tables)} bytes as 16-bit numbers"
    for name, largest, share, place, rms in changed_rows(differences):
        yield f"  {name} against what is there: {largest} at most ({share}), at {place}; rms {rms}"


def sheet(
    output: str,
    tables: Tables,
    differences: Sequence[FlashedDifference],
    provenance: Mapping[str, Any],
) -> str:
    """The sheet as one HTML page; output: the file that it is about."""
    facts = "".join(
        f"<dt>{text(name)}</dt><dd>{text(words)}</dd>" for name, words in _facts(provenance)
    )
    parts = [_table(HEADS, rows(tables))]
    if differences:
        parts += ["<h2>Against what is there now</h2>", _table(CHANGED, changed_rows(differences))]
    return (
        f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>Release of {text(output)}'
        f"</title><style>{STYLE}</style><h1>Release of {text(output)}</h1><dl>{facts}</dl>"
        f"<h2>Tables</h2>{''.join(parts)}<p>Off by: the largest distance of straight lines between "
        "the nodes from the learned map, of its largest flow. On data: nodes whose block was "
        "learned; the others are the orifice law or the prior.</p>"
        '<div class="sign"><p>made, date</p><p>released, date</p></div></html>\n'
    )


def _facts(provenance: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What the maps come from, in the words and units of the report."""
    for key, value in provenance.items():
        if key == "beta_pa":
            sds = provenance.get("beta_sd_pa") or [None] * len(value)
            if moduli := [_modulus(b, sd) for b, sd in zip(value, sds, strict=True) if b]:
                yield "bulk modulus", ", ".join(moduli)
        elif key == "effects":
            yield "learned beside", "; ".join(map(_effect, value)) or "no effect"
            if value:
                yield "in the project file", ", ".join(effect["effect"] for effect in value)
        elif key == "rho":
            yield "residual variance", f"{value:.3g} times the noise's"
        elif key != "beta_sd_pa":
            yield key.replace("_", " "), str(value)


def _modulus(beta_pa: float, sd_pa: float | None) -> str:
    return with_unit(beta_pa, "Pa", math.nan if sd_pa is None else sd_pa)


def _effect(effect: Mapping[str, Any]) -> str:
    """With its sizes; an older file has effects without their place or parameters."""
    sizes = [
        f"{name.replace('_', ' ')} {with_unit(v['value'], v['unit'], _sd(v))}"
        for name, v in effect.get("parameters", {}).items()
    ]
    name = named((effect["effect"], effect.get("where", "")))
    return f"{name}: {', '.join(sizes)}" if sizes else name


def _sd(value: Mapping[str, Any]) -> float:
    """None stands for a number that JSON does not know."""
    return math.nan if value.get("std") is None else float(value["std"])


def _table(heads: Sequence[str], lines: Iterator[tuple[str, ...]]) -> str:
    return table(heads, ([text(word) for word in line] for line in lines))
