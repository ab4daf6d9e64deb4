"""A budget of instructions per tick: how many blocks may ring, and how much a tick works off.

Measured, not reckoned: the machine at hand runs on the emulated boards through motion that no valve
makes, and the largest ration is taken with which no tick is over the budget.  Instructions are not
cycles: memory that waits and units that stall cost more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rtid.estimator.blocks import Block
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import build
from rtid.mcu.c_tables import Tiles, sizes_of
from rtid.mcu.emulated import Board, Record, Ticks
from rtid.mcu.errors import ValveError
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray

ENOUGH = {False: 16, True: 8}  # tiles with which a valve that chatters at a corner keeps up
MOST = 48
Records = tuple[Record, ...]
RECENT = (64, 32, 16, 8)
HARD_S = 3.0
NUMBERS, BOARDS = ("float64", "float32"), ("Cortex-M7", "Cortex-M4")
TICK_US = 1000


@dataclass(frozen=True)
class Chosen:
    """What fits into the budget: blocks that may ring, tiles of a tick, the worst tick of each."""

    model: Machine  # with its recent_blocks
    tiles: Tiles
    worst: tuple[int, int]  # double, float


def fit(
    model: Machine, blocks: int, budget: int, folder: Path, logs: tuple[Record, ...] = ()
) -> Chosen:
    """The machine of `one_valve` with as many recent blocks as the budget has room for.

    Raises ValveError where no choice fits, and where no controller can be emulated.
    """
    sizes = sizes_of(model, blocks)
    records, least = (hardest(model, sizes.blocks, HARD_S), *logs), 2 * sizes.open
    recent, worst = 0, 0
    for recent in (model.recent_blocks, *(n for n in RECENT if least <= n < model.recent_blocks)):
        tried = replace(model, recent_blocks=recent)
        rations = [_ration(tried, blocks, budget, folder, single, records) for single in ENOUGH]
        if all(tiles for tiles, _ in rations):
            (double, slow), (single, slower) = rations
            return Chosen(tried, Tiles(double, single), (slow, slower))
        worst = max(tick for _, tick in rations)
    raise ValveError(
        f"a budget of {budget} instructions: with {recent} recent blocks and the least that a tick "
        f"must work off, {worst} are needed",
        "give more, or coarsen the grid",
    )


def _ration(
    model: Machine, blocks: int, budget: int, folder: Path, single: bool, records: Records
) -> tuple[int, int]:
    """The most tiles that fit and the worst tick with them; 0 and the tick where too few fit."""
    low = ENOUGH[single]
    worst = _worst(model, blocks, folder, single, low, records)
    if worst > budget:
        return 0, worst
    high = MOST
    while high - low > 1:
        middle = (low + high) // 2
        tick = _worst(model, blocks, folder, single, middle, records)
        if tick <= budget:
            low, worst = middle, tick
        else:
            high = middle
    return low, worst


def _worst(
    model: Machine, blocks: int, folder: Path, single: bool, tiles: int, records: Records
) -> int:
    board = Board(model, folder, blocks, single, Tiles(tiles, tiles))
    return max(board.run(record).worst for record in records)


def hardest(model: Machine, blocks: int, duration_s: float) -> Record:
    """Every millisecond another block; chatter at a corner of four; bursts and rest; restarts.

    Within so many cells about the middle of the grids as blocks can be learned.
    """
    rng, n = np.random.default_rng(5), int(duration_s * 1e6 / TICK_US)
    t_us, part, first = TICK_US * np.arange(n), 4 * np.arange(n) // n, model.edges[0]
    room = max(4, int(0.7 * blocks / len(model.edges)))
    along_u = max(2, min(len(first.grid.u_v) - 1, int(np.sqrt(room))))
    command = _wander(first.grid.u_v, along_u, part == 1, rng)
    drop = _wander(first.grid.dp_pa, max(2, room // along_u), part == 1, rng)
    command *= np.where((part == 1) | (rng.random(n) < 0.5), 1.0, -1.0) * first.direction
    command[(part == 2) & (t_us % 500_000 > 200_000)] = 0.0
    supply = float(first.grid.dp_pa[-1])
    signals = {model.position: 0.25 + 0.05 * np.sin(10e-6 * t_us)}
    for edge in model.edges:
        signals |= {edge.source: np.full(n, supply), edge.sink: np.zeros(n), edge.command: command}
    own = first.sink if first.sign(model.chambers[0]) > 0 else first.source
    signals[own] = supply - drop if own == first.sink else drop
    values = [
        np.clip(signals.get(s.name, np.zeros(n)), s.minimum, s.maximum) for s in model.signals
    ]
    lost = (part == 3) & (np.arange(n) % 97 == 0)
    return Record(t_us, np.column_stack(values), np.where(lost, 3.0, 1.0))


def _wander(
    border: FloatArray, cells: int, near: BoolArray, rng: np.random.Generator
) -> FloatArray:
    """Anywhere in so many cells about the middle border, or about it by a third of a block."""
    middle, last, drawn = len(border) // 2, len(border) - 1, rng.random(len(near))
    low = max(0, middle - cells // 2)
    start, end = border[low], border[min(last, low + cells)]
    about = border[middle] + 0.6 * (drawn - 0.5) * (border[middle] - border[middle - 1])
    return np.where(near, about, start + drawn * (end - start))


@dataclass(frozen=True)
class Cost:
    """What a budget does to a record: ticks in double and in float, and deviations that grow.

    beta: of the bulk modulus; maps: of block means, median and worst; each in shares of what it is
    with all the recent blocks that the project declares.
    """

    ticks: tuple[Ticks, Ticks]
    beta: float
    maps: tuple[float, float]


def deviations(model: Machine, less: Machine, record: Record) -> tuple[float, tuple[float, float]]:
    """How much those of beta and of block means (median, worst) grow from one to another."""
    a, b = (_learned(m, record) for m in (model, less))
    ratio = np.array([other.mean_sd_m3s / block.mean_sd_m3s for block, other in _blocks(a, b)])
    beta = np.sqrt(b.compliance_cov[0, 0] / a.compliance_cov[0, 0])
    return float(beta) - 1.0, (float(np.median(ratio)) - 1.0, float(ratio.max()) - 1.0)


def _learned(model: Machine, record: Record) -> Solution:
    state = build(model, None)
    state.advance(record.chunk)
    return solve(model, state, float(record.t_us[-1]) * 1e-6)


def _blocks(full: Solution, less: Solution) -> Iterator[tuple[Block, Block]]:
    """The same block in both, where it was known."""
    others = {(b.edge, b.i, b.j): b for b in less.blocks}
    for block in full.blocks:
        other = others.get((block.edge, block.i, block.j))
        if other is not None and block.rows >= full.model.gates.min_rows:
            yield block, other


@dataclass(frozen=True)
class Limited:
    """A budget, what fits into it, and what it costs on a record (None: without one)."""

    budget: int
    declared: int  # recent blocks
    chosen: Chosen
    stack: tuple[tuple[int, int], tuple[int, int]]  # update and solve, in double and in float
    cost: Cost | None

    def document(self) -> dict[str, Any]:
        """For --json."""
        out: dict[str, Any] = {
            "budget": self.budget,
            "recent_blocks": self.chosen.model.recent_blocks,
        }
        for k, name in enumerate(NUMBERS):
            tiles = (self.chosen.tiles.double, self.chosen.tiles.single)[k]
            told = {
                "tiles": tiles,
                "worst_tick": self.chosen.worst[k],
                "stack_bytes": self.stack[k],
            }
            if self.cost:
                ticks = self.cost.ticks[k]
                told["on_trace"] = {
                    "mean_tick": float(ticks.instructions.mean()),
                    "worst_tick": ticks.worst,
                    "busy": ticks.counts["busy"],
                }
            out[name] = told
        if self.cost:
            out["deviation"] = {"beta": self.cost.beta, "maps": self.cost.maps}
        return out

    def lines(self) -> Iterator[str]:
        """For people."""
        recent = self.chosen.model.recent_blocks
        yield f"{self.budget:,} instructions a tick (emulated; not cycles):"
        yield f"  recent_blocks {recent} of {self.declared}"
        for k, (name, told) in enumerate((n, self.document()[n]) for n in NUMBERS):
            update, solving = told["stack_bytes"]
            yield f"  {name} on {BOARDS[k]}: {told['tiles']} tiles a tick, at most"
            yield f"    {told['worst_tick']:,}; stack {update} bytes to update, {solving} to solve"
            if self.cost:
                on = told["on_trace"]
                mean, worst = on["mean_tick"], on["worst_tick"]
                yield f"    on the log: mean {mean:,.0f}, worst {worst:,}, {on['busy']} too much"
        yield from self._deviations()

    def _deviations(self) -> Iterator[str]:
        if self.cost is None:
            yield "  what it costs in deviations: give a log with --trace"
            return
        median, worst = self.cost.maps
        yield f"  deviation of beta {self.cost.beta:+.1%}; of block means {median:+.1%} in the"
        yield f"    median, {worst:+.1%} at worst, against {self.declared} recent blocks"


def limit(model: Machine, blocks: int, budget: int, record: Record | None) -> Limited:
    """The budget for the machine of `one_valve`, and what it costs on a record.

    Raises ValveError where no choice fits, and where no controller can be emulated.
    """
    with TemporaryDirectory() as name:
        folder = Path(name)
        found = fit(model, blocks, budget, folder, (record,) if record else ())
        pair = [
            Board(found.model, folder / word, blocks, single, found.tiles)
            for word, single in zip(NUMBERS, ENOUGH, strict=True)
        ]
        boards = pair[0], pair[1]
        stack = boards[0].stack, boards[1].stack
        if record is None:
            return Limited(budget, model.recent_blocks, found, stack, None)
        ticks = boards[0].run(record), boards[1].run(record)
    told = Cost(ticks, *deviations(model, found.model, record))
    return Limited(budget, model.recent_blocks, found, stack, told)
