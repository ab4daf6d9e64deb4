"""The estimator in C on emulated controllers: no tick is long, and the result is the desk's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rtid.mcu import budget
from rtid.mcu.c_tables import tables
from rtid.mcu.emulated import Board, absent
from rtid.mcu.errors import ValveError
from tests.mcu.compiled import STRICT
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
    if lacking := absent():
        pytest.skip(f"no {lacking} on this machine: the controller is not emulated")
    return Board(valve(blocks), tmp_path_factory.mktemp("board"), blocks, single, extra=STRICT)


@pytest.mark.first_of(8)
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


@pytest.mark.long
def test_a_budget_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Five boards, built and run: the choice is measured."""
    if lacking := absent():
        pytest.skip(f"no {lacking} on this machine: the controller is not emulated")
    monkeypatch.setattr(budget, "HARD_S", 1.0)
    monkeypatch.setattr(budget, "MOST", 17)
    found = budget.fit(valve(24), 24, WORST, tmp_path)
    assert max(found.worst) <= WORST
    assert found.tiles.double >= budget.ENOUGH[False]
    assert found.tiles.single >= budget.ENOUGH[True]
    text = tables(found.model, 24, tiles=found.tiles)
    assert f"RTID_EST_TILES_PER_TICK {found.tiles.single}\n#else" in text
    with pytest.raises(ValveError, match="a budget of 1000 instructions: with 8 recent blocks"):
        budget.fit(replace(valve(24), recent_blocks=8), 24, 1000, tmp_path)


def test_what_a_budget_costs() -> None:
    """Fewer blocks that ring: what they share is cut off sooner, and less is known."""
    model, taken = valve(96), record("rich", 96, 20.0)
    beta, (median, worst) = budget.deviations(model, replace(model, recent_blocks=8), taken)
    print(f"8 recent blocks of 64: beta {beta:+.1%}, block means {median:+.1%}, {worst:+.1%}")
    assert 0.0 < beta < 0.2
    assert -0.01 < median <= worst
    assert budget.deviations(model, model, taken) == (0.0, (0.0, 0.0))
