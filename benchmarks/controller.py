"""Instructions per tick of the controller's estimator on emulated boards, into docs/controller.md.

python -m benchmarks.controller
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.table import replace_between
from rtid.mcu.emulated import Board
from tests.mcu.compiled import Outcome, Program
from tests.mcu.records import ANYWHERE, CELLS, NAMES, record, repeated, valve

PAGE = Path("docs/controller.md")


def rows() -> Iterator[str]:
    """A line per record: mean, 99.9 % and worst tick at each size, in double and in float."""
    heads = [f"{b} blocks, {what}" for b in CELLS for what in ("M7 double", "M4F float")]
    yield f"| 20 s at 1 kHz | {' | '.join(heads)} |"
    yield "|---" * (1 + len(heads)) + "|"
    with TemporaryDirectory() as folder:
        boards = [
            (b, Board(valve(b), Path(folder) / f"{b}{single}", b, single))
            for b in CELLS
            for single in (False, True)
        ]
        for name in (*NAMES, ANYWHERE):
            cells = [_cell(board, name, blocks) for blocks, board in boards]
            yield f"| {name} | {' | '.join(cells)} |"


def _cell(board: Board, name: str, blocks: int) -> str:
    ticks = board.run(record(name, blocks))
    n, busy = ticks.instructions, ticks.counts["busy"]
    refused = f", {busy} refused" if busy else ""
    return f"{n.mean():,.0f}; {np.quantile(n, 0.999):,.0f}; {n.max():,}{refused}"


LENGTHS_S = (60, 600, 3600)
CONDITIONS = (1.0, 1e4, 1e6, 1e8, 1e10, 1e12)


def float_rows() -> Iterator[str]:
    """Float beside double, both on this host, on one record: the largest differences."""
    model, taken = valve(24), repeated(float(LENGTHS_S[-1]))
    columns = []
    with TemporaryDirectory() as folder:
        pair = [Program(model, Path(folder) / str(k), 24, single=k) for k in (False, True)]
        for seconds in LENGTHS_S:
            n = 1000 * seconds
            double, single = (
                p.run(p.samples(taken.t_us[:n], taken.values[:n], taken.flags[:n])) for p in pair
            )
            columns.append(_apart(double, single, model.edges[0].rated_q_m3s))
    yield f"| float beside double, 24 blocks | {' | '.join(f'{s} s' for s in LENGTHS_S)} |"
    yield "|---" * (1 + len(LENGTHS_S)) + "|"
    for name in columns[0]:
        yield f"| {name} | {' | '.join(column[name] for column in columns)} |"


def _apart(double: Outcome, single: Outcome, rated: float) -> dict[str, str]:
    a, b = double.maps, single.maps
    valid = b["status"] > 0
    off = np.abs(a["mean_m3s"] - b["mean_m3s"])[valid]
    terms = np.abs(a["theta"] - b["theta"]).max(axis=1) / np.abs(a["theta"]).max()
    beta = abs(single.solution["shared"][0] / double.solution["shared"][0] - 1)
    told = {
        "beta": f"{beta:.1e}",
        "deviation of beta that double states": _relative_sd(double),
        "deviation of beta that float states": _relative_sd(single),
        "means of valid blocks, share of the rated flow": f"{off.max() / rated:.1e}",
        "in deviations that double states": f"{(off / a['mean_sd_m3s'][valid]).max():.2f}",
        "in deviations that float states": f"{(off / b['mean_sd_m3s'][valid]).max():.2f}",
    }
    for low, high in pairwise(CONDITIONS):
        inside = (a["condition"] > low) & (a["condition"] <= high)
        largest = f"{terms[inside].max():.0e}" if inside.any() else "no block"
        told[f"terms, share of the largest: condition {low:.0e} to {high:.0e}"] = largest
    return told | {"directions that were raised": str(single.solution["raised"])}


def _relative_sd(outcome: Outcome) -> str:
    return f"{outcome.solution['shared_sd'][0] / outcome.solution['shared'][0]:.1e}"


if __name__ == "__main__":
    text = replace_between(PAGE.read_text("utf-8"), "ticks", "\n".join(rows()))
    PAGE.write_text(replace_between(text, "floats", "\n".join(float_rows())), "utf-8")
    print(f"{PAGE}: ticks, and float beside double, written")
