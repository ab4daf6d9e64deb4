"""Learned maps as a Modelica package: a function and a block per edge, without any library.

The tables are those of `gridded`: bilinear in the opening command and the pressure drop, within
0.1 % of the largest flow; beyond their ends the value there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rtid.errors import RtidError
from rtid.maps.gridded import Gridded, Tables
from rtid.plain import FloatArray

PER_LINE = 8
INDEX = """
  function place "Index of the interval that holds x, and the share of its end"
    input Real[:] nodes;
    input Real x;
    output Integer i;
    output Real share;
  algorithm
    i := 1;
    while i < size(nodes, 1) - 1 and x >= nodes[i + 1] loop
      i := i + 1;
    end while;
    share := min(1.0, max(0.0, (x - nodes[i]) / (nodes[i + 1] - nodes[i])));
  end place;
"""


class NoModelicaError(RtidError):
    """Maps that cannot become Modelica; the text names the edge."""


def write_mo(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write the package, called as its file.  Raises NoModelicaError, OSError."""
    name = _word(path.name.partition(".")[0])
    lines = list(_lines(name, tables, provenance))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _lines(name: str, tables: Tables, provenance: Mapping[str, Any]) -> Iterator[str]:
    said = json.dumps(dict(provenance), sort_keys=True).replace("\\", "\\\\").replace('"', '\\"')
    yield f'package {name} "Flow maps learned by rtid"'
    yield INDEX
    taken: set[str] = set()
    for g in tables:
        edge = _word(g.name)
        if edge in taken:
            raise NoModelicaError(f"edge {g.name}: another one is called {edge} too", "rename it")
        taken.add(edge)
        yield from _edge(edge, g)
    yield f'  annotation(Documentation(info="{said}"));'
    yield f"end {name};"


def _edge(edge: str, g: Gridded) -> Iterator[str]:
    nu, nd = g.flow_m3s.shape
    yield f'  function flow_{edge} "Flow of edge {edge}"'
    yield '    input Real u(unit = "V") "opening command";'
    yield '    input Real dp(unit = "Pa") "pressure drop";'
    yield '    output Real q(unit = "m3/s");'
    yield "  protected"
    yield from _array(f"constant Real us[{nu}]", g.u_v)
    yield from _array(f"constant Real ps[{nd}]", g.dp_pa)
    yield from _array(f"constant Real qs[{nu}, {nd}]", g.flow_m3s)
    yield "    Integer i;"
    yield "    Integer j;"
    yield "    Real a;"
    yield "    Real b;"
    yield "  algorithm"
    yield "    (i, a) := place(us, u);"
    yield "    (j, b) := place(ps, dp);"
    yield "    q := (1 - a) * ((1 - b) * qs[i, j] + b * qs[i, j + 1])"
    yield "       + a * ((1 - b) * qs[i + 1, j] + b * qs[i + 1, j + 1]);"
    yield f"  end flow_{edge};"
    yield ""
    yield f'  block Edge_{edge} "Flow of edge {edge}"'
    yield '    input Real u(unit = "V") "opening command";'
    yield '    input Real dp(unit = "Pa") "pressure drop";'
    yield '    output Real q(unit = "m3/s");'
    yield "  equation"
    yield f"    q = flow_{edge}(u, dp);"
    yield f"  end Edge_{edge};"
    yield ""


def _array(head: str, values: FloatArray) -> Iterator[str]:
    rows = values if values.ndim == 2 else values[None, :]
    yield f"    {head} = " + ("{" if values.ndim == 2 else "")
    for k, row in enumerate(rows):
        words = [f"{x:.9g}" for x in row]
        lines = [", ".join(words[n : n + PER_LINE]) for n in range(0, len(words), PER_LINE)]
        end = "," if k + 1 < len(rows) else "}" if values.ndim == 2 else ""
        yield "      {" + ",\n       ".join(lines) + "}" + end
    yield "    ;"


def _word(name: str) -> str:
    """A name that Modelica takes."""
    word = re.sub(r"\W", "_", name, flags=re.ASCII)
    return word if word[:1].isalpha() else f"m_{word}"
