"""Instructions per tick of the controller's estimator on emulated boards, into docs/controller.md.

python -m benchmarks.controller
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.table import replace_between
from rtid.mcu.emulated import Board
from tests.mcu.records import ANYWHERE, CELLS, NAMES, record, valve

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


if __name__ == "__main__":
    PAGE.write_text(replace_between(PAGE.read_text("utf-8"), "ticks", "\n".join(rows())), "utf-8")
    print(f"{PAGE}: instructions of each tick written")
