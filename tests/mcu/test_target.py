"""The estimator in C on emulated controllers: no tick is long, and the result is the desk's."""

from __future__ import annotations

import pytest

from tests.mcu.emulated import Board
from tests.mcu.machine import Reference, beta_in_sd, matrix_apart
from tests.mcu.records import ANYWHERE, CELLS, NAMES, record, valve

WORST = 20_000  # instructions of one tick, of motion that a valve can make
BOUND = 34_000  # of any motion
SECONDS = 6.0
SUMS, BETA_SD = {False: 1e-12, True: 3e-5}, {False: 1e-5, True: 0.05}


@pytest.fixture(scope="module", params=[False, True], ids=["double on M7", "float on M4F"])
def single(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(scope="module", params=CELLS)
def blocks(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(scope="module")
def board(blocks: int, single: bool, tmp_path_factory: pytest.TempPathFactory) -> Board:
    return Board(valve(blocks), tmp_path_factory.mktemp("board"), blocks, single)


@pytest.mark.parametrize("name", NAMES)
def test_no_tick_is_long_and_nothing_is_lost(
    board: Board, blocks: int, single: bool, name: str
) -> None:
    taken = record(name, blocks, SECONDS)
    ticks, reference = board.run(taken), Reference.of(valve(blocks), taken)
    assert ticks.instructions.max() <= WORST
    assert ticks.counts == reference.counts | {"no_room": 0, "busy": 0}
    assert matrix_apart(ticks.normal, reference.normal) <= SUMS[single]
    assert beta_in_sd(ticks.solution, reference.solution) <= BETA_SD[single]


def test_the_tick_is_bounded_whatever_comes(board: Board, blocks: int) -> None:
    """What is too much to be worked off is refused and counted, never done in one tick."""
    ticks = board.run(record(ANYWHERE, blocks, SECONDS))
    assert ticks.instructions.max() <= BOUND
    assert ticks.counts["block_changes"] > 0.2 * ticks.counts["samples"]
