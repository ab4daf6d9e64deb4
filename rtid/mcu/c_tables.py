"""rtid_estimator_tables.h: a machine of one chamber as C constants, and the sizes of the memory.

The numbers are those of the record that `rtid.estimator.state.build` makes for the same machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_bridge.c_tables import HEADER, VERSION, bill
from rtid.estimator.limits import most_open
from rtid.estimator.state import Weights, build
from rtid.kernels import layout
from rtid.mcu.errors import ValveError
from rtid.model import Gates, Machine

ALWAYS = 1e30  # stands for no limit: nothing that large passes the gate
FOREVER_S = 1e9
MOST_CELLS = 32_000  # numbers of cells and blocks are kept in 16 bits
MOST_BLOCKS = 2_000
SOURCES = HEADER.parent


def sources() -> list[Path]:
    """The estimator's files, without the tables."""
    return [*sorted(SOURCES.glob("rtid_estimator*.[ch]")), VERSION]


@dataclass(frozen=True)
class Sizes:
    """What fixes the size of the estimator's memory in C."""

    signals: int
    edges: int
    terms: int
    cells: int
    blocks: int  # that can be learned
    open: int  # at once
    recent: int  # open, or ringing in the whitener

    @property
    def unknowns(self) -> int:
        """theta_beta, the shared terms, six terms per block."""
        return 1 + self.terms + layout.TERMS * self.blocks

    @property
    def visits(self) -> int:
        """Visits to blocks at once: those that ring, and those that were settled or continued."""
        return 2 * self.recent + self.open * (self.open + 4)

    @property
    def sums(self) -> int:
        """Products of y and all unknowns: a triangle."""
        return (1 + self.unknowns) * (2 + self.unknowns) // 2


def sizes_of(model: Machine, blocks: int = 0) -> Sizes:
    """Sizes for a machine of `one_valve`; blocks = 0: room for all cells of its grids.

    Raises ValveError for sizes that no memory of a controller holds.
    """
    cells, opened = model.n_cells, most_open(model)
    wanted = min(blocks, cells) if blocks > 0 else cells
    if cells > MOST_CELLS or not opened <= wanted <= MOST_BLOCKS:
        raise ValveError(
            f"{wanted} blocks of {cells} cells: {opened} to {MOST_BLOCKS} blocks of at most "
            f"{MOST_CELLS} cells are possible",
            "coarsen the grid, or give --blocks",
        )
    recent = min(model.recent_blocks, wanted + opened)
    counts = len(model.signals), len(model.edges), len(model.terms)
    return Sizes(*counts, cells, wanted, opened, recent)


@dataclass(frozen=True)
class Tiles:
    """Products of two blocks' terms that a tick may work off, in double and in float."""

    double: int
    single: int


def tables(
    model: Machine,
    blocks: int = 0,
    weights: Weights | None = None,
    title: str = "",
    tiles: Tiles | None = None,
) -> str:
    """Text of rtid_estimator_tables.h for a machine of `one_valve`, nominal weights by default."""
    sizes = sizes_of(model, blocks)
    state = build(model, weights)
    e = state.engine[0]
    learns = f"chamber {_c_name(model.chambers[0].name)}{title}"
    parts = [
        f"/* Written by `rtid mcu`.  Bill of material: {bill(sources())} */",
        "#ifndef RTID_ESTIMATOR_TABLES_H",
        "#define RTID_ESTIMATOR_TABLES_H",
        "",
        f'#define RTID_EST_LEARNS "{learns}"',
        *_sizes(sizes),
        *_tiles(tiles),
        *_signals(model),
        *_chamber(e, model),
        *_edges(e, model),
        *_rows("BORDERS", "upper and lower ends of the blocks: V or A, then Pa", _borders(e)),
        *_rows("CELL_ROWS", "nominal dQ/ddp in m3/s/Pa, missed flow in m6/s", _cells(state.cells)),
        *_terms(e, model),
        "#endif",
    ]
    return "\n".join(parts) + "\n"


def _sizes(sizes: Sizes) -> Iterator[str]:
    names = {
        "N_SIGNALS": sizes.signals,
        "N_EDGES": sizes.edges,
        "N_TERMS": sizes.terms,
        "N_CELLS": sizes.cells,
        "MAX_BLOCKS": sizes.blocks,
        "MAX_OPEN": sizes.open,
        "MAX_RECENT": sizes.recent,
    }
    for name, value in names.items():
        yield f"#define RTID_EST_{name} {value}"
    yield ""


def _tiles(tiles: Tiles | None) -> Iterator[str]:
    if tiles is None:
        return
    yield "#ifdef RTID_ESTIMATOR_FLOAT32"
    yield f"#define RTID_EST_TILES_PER_TICK {tiles.single}"
    yield "#else"
    yield f"#define RTID_EST_TILES_PER_TICK {tiles.double}"
    yield "#endif"
    yield ""


def _signals(model: Machine) -> Iterator[str]:
    """Columns of a sample under the user's names, and the range of each."""
    yield "/* columns of rtid_estimator_sample.values, SI, V or A */"
    names = [f"RTID_EST_COLUMN_{_c_name(signal.name)}" for signal in model.signals]
    for name in names:
        if names.count(name) > 1:
            raise ValveError(f"two signals would be {name} in C", "rename one of them")
    yield f"enum {{ {', '.join(names)} }};"
    ranges = (
        f"{{CAPPED({_number(s.minimum)}), CAPPED({_number(s.maximum)})}}" for s in model.signals
    )
    yield from _rows("RANGES", "values outside are refused", ranges)


def _c_name(name: str) -> str:
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name).upper()


def _chamber(e: np.void, model: Machine) -> Iterator[str]:
    yield f"/* chamber {_c_name(model.chambers[0].name)} */"
    yield f"#define RTID_EST_X {int(e['x_column'])}"
    if model.chambers[0].pressure:
        yield f"#define RTID_EST_P {int(e['p_column'][0])}"
    numbers = {
        "AREA": (e["area_m2"][0], "m2, signed"),
        "V0": (e["v0_m3"][0], "m3"),
        "X_VAR": (e["x_var_m2"], "m2"),
        "P_VAR": (e["p_var_pa2"][0], "Pa2"),
        "COMPLIANCE": (e["compliance"][0], "nominal 1 / beta, 1/Pa"),
        "Q_FLOOR": (e["q_floor"][0], "least flow noise, m6/s"),
        "P_PERIOD": (e["p_period_s"], "s, of the pressures; 0: every sample"),
        "LAG": (e["lag_s"], "s, of the spool"),
        "HYSTERESIS": (e["hysteresis"], "share of a block's width"),
    }
    for name, (value, unit) in numbers.items():
        yield f"#define RTID_EST_{name} {_number(value)} /* {unit} */"
    yield from _gates(model.gates)
    yield ""


def _gates(gates: Gates) -> Iterator[str]:
    for name, seconds in (
        ("MAX_GAP_US", gates.max_gap_s),
        ("RECOVERY_US", gates.recovery_s),
        ("STALE_US", gates.stale_s),
    ):
        yield f"#define RTID_EST_{name} INT64_C({round(min(seconds, FOREVER_S) * 1e6)})"
    yield f"#define RTID_EST_MIN_ROWS {max(0, gates.min_rows)}u"
    yield f"#define RTID_EST_MAX_SD_SHARE {_number(gates.max_sd_share)}"
    yield f"#define RTID_EST_CONDITION_LIMIT {_number(gates.condition_limit)}"


def _edges(e: np.void, model: Machine) -> Iterator[str]:
    what = (
        "source, sink, command; direction, safe band, sign, rated flow, variance of dp; blocks "
        "along u and dp, some terms masked; first border of u and dp, first cell; terms"
    )
    yield from _rows("EDGE_ROWS", what, _edge_rows(e, model))


def _edge_rows(e: np.void, model: Machine) -> Iterator[str]:
    first, nothing = 0, len(model.signals)
    for i, edge in enumerate(model.edges):
        columns = (int(e[name][i]) for name in ("source", "sink", "command"))
        numbers = [e["direction"][i], e["safe_v"][i], e["sign"][i, 0]]
        numbers += [e["scale_m3s"][i], e["dp_var_pa2"][i]]
        nu, nd = edge.grid.shape
        words = [str(min(column, nothing)) for column in columns]
        words += [_real(value) for value in numbers]
        words += [str(n) for n in (nu, nd, int(e["masked"][i]))]
        words += [str(n) for n in (first, first + nu + 1, int(e["first_cell"][i]))]
        yield f"/* {_c_name(edge.name)} */ {{{', '.join([*words, _row(e['mask'][i])])}}}"
        first += nu + nd + 2


def _borders(e: np.void) -> Iterator[str]:
    for i in range(int(e["n_edges"])):
        yield ", ".join(_real(x) for x in e["u_border"][i, : int(e["n_u"][i]) + 1])
        yield ", ".join(_real(x) for x in e["dp_border"][i, : int(e["n_dp"][i]) + 1])


def _cells(cells: np.ndarray) -> Iterator[str]:
    for cell in cells:
        yield _row([cell["slope"], cell["missed"]])


def _terms(e: np.void, model: Machine) -> Iterator[str]:
    soft = sum(
        bool(t.rate and dict(t.weights).get(model.chambers[0].pressure)) for t in model.terms
    )
    yield f"#define RTID_EST_SOFT_TERMS {soft}"
    if not model.terms:
        return
    what = "shape, rate, times V; scale, sign, constant, weights of the columns"
    yield from _rows("TERM_ROWS", what, _term_rows(e, model))


def _term_rows(e: np.void, model: Machine) -> Iterator[str]:
    for k, term in enumerate(model.terms):
        shape, volume = int(e["term_shape"][k]), int(e["term_volume"][k])
        words = [str(shape), str(int(volume != layout.FLOW)), str(int(volume >= 0))]
        numbers = e["term_scale"][k], e["term_sign"][k, 0], e["term_constant"][k]
        words += [_real(value) for value in numbers]
        weights = _row(e["term_weight"][k, : len(model.signals)])
        yield f"/* {_c_name(term.name)} */ {{{', '.join([*words, weights])}}}"


def _rows(name: str, what: str, rows: Iterable[str]) -> Iterator[str]:
    yield f"/* {what} */"
    yield f"#define RTID_EST_{name} \\"
    yield ", \\\n".join(f"    {row}" for row in rows)
    yield ""


def _row(values: Iterable[float]) -> str:
    return "{" + ", ".join(_real(value) for value in values) + "}"


def _real(value: float) -> str:
    """A number of the type that the estimator computes with."""
    return f"R({_number(value)})"


def _number(value: float) -> str:
    """As many digits as a double has; no limit is a large number."""
    limited = min(max(float(value), -ALWAYS), ALWAYS)
    return repr(limited)
