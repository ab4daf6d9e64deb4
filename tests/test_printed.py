"""What a person reads: tables at 80 columns, ± for 95 %, display units or SI, once per output."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.cli.exits import Exit
from rtid.daemon import status
from rtid.daemon.status import (
    BusHealth,
    ChamberStatus,
    EffectStatus,
    EstimateStatus,
    LoopHealth,
    MessageHealth,
    SignalHealth,
    Status,
)
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.tell.terminal import Printed, make_console
from rtid.units import CONVENTION, System, limit, range_of, scale_of, show_in, with_unit
from tests.command import ends
from tests.eighty import eighty, lines_of, require_whole  # noqa: F401
from tests.replays import shared_replays  # noqa: F401

ROOT = Path(__file__).parents[1]
WORD = st.text("abcxyz0123456789.±-", min_size=1, max_size=14)


@st.composite
def tables(draw_: st.DrawFn) -> Printed:
    marks = draw_(st.lists(st.sampled_from(["", "|", "~"]), min_size=1, max_size=14))
    heads = tuple(" ".join(draw_(st.lists(WORD, max_size=3))) + mark for mark in marks)
    row = st.tuples(*(st.lists(WORD, max_size=8 if m == "~" else 2).map(" ".join) for m in marks))
    rows = draw_(st.lists(row, max_size=4))
    return Printed("A title", heads, rows, keys=draw_(st.integers(1, min(2, len(marks)))))


@given(tables())
def test_no_table_loses_a_figure_at_80_columns(table: Printed) -> None:
    require_whole(table)


def test_brackets_and_colons_in_names_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    table = Printed("[bold]", ("where", "say [x]~"), [("[excite]", "[/red] a")])
    shown = "\n".join(lines_of(table))
    assert all(word in shown for word in ("[bold]", "say [x]", "[excite]", "[/red] a"))
    make_console().print("[excite] :warning:")
    assert capsys.readouterr().out == "[excite] :warning:\n"


def test_all_tables_are_of_this_kind() -> None:
    """Nobody else imports rich's table, which cuts what does not fit."""
    users = [p for p in (ROOT / "rtid").rglob("*.py") if "from rich.table" in p.read_text()]
    assert [path.name for path in users] == ["terminal.py"]


@pytest.fixture
def si() -> Iterator[None]:
    show_in(System.SI)
    yield
    show_in(System.DISPLAY)


@pytest.mark.parametrize(
    ("unit", "name", "factor"),
    [
        ("m3/s/Pa", "L/min/MPa", 6e10),
        ("m3/s/Pa/V", "L/min/MPa/V", 6e10),
        ("m3/s/Pa/m", "L/min/MPa/mm", 6e7),
        ("Pa/s", "Pa/s", 1.0),
        ("m/s", "mm/s", 1e3),
        ("V", "V", 1.0),
        ("rad/s", "rad/s", 1.0),
    ],
)
def test_units_of_effects_are_those_of_the_workshop(unit: str, name: str, factor: float) -> None:
    found = scale_of(unit)
    assert found.name == name
    assert found.factor == pytest.approx(factor)


def test_a_size_is_told_with_its_95_percent_interval() -> None:
    assert with_unit(850e6, "Pa", 1e6) == "850 ± 2 MPa"
    assert with_unit(-2728e6, "Pa", 60.7e6) == "-2728 ± 120 MPa"
    assert with_unit(0.02, "1") == "0.02"
    assert range_of(0.0, 20.0, "s") == "0 to 20 s"


def test_si_is_told_where_it_is_asked_for(si: None) -> None:
    assert with_unit(2e-12, "m3/s/Pa", 1e-14) == "2e-12 ± 2e-14 m3/s/Pa"
    assert limit(1.234e-5, "m3/s") == "1.2e-05 m3/s"
    assert scale_of("m3/s").known(1.5e-4, 1e-6, 2) == "0.00015 ± 2e-06"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 s of a machine with a leak, and its project file."""
    machine = hide_wish(draw(3), "internal_leakage_laminar=strong")
    folder = tmp_path_factory.mktemp("record")
    trace, _, _ = write_run(folder / "run.blf", simulate(machine, "rich", 3, 40.0), 3, "rich")
    return trace


IMPOSSIBLE = Exit.NEGATIVE  # the leak bends the modulus beyond all bounds, and that is said


class Told(Protocol):
    """The output of a command line; RUN and PROJECT stand for the record's files."""

    def __call__(self, line: str, code: int = Exit.OK) -> str: ...


@pytest.fixture
def story(record: Path, capsys: pytest.CaptureFixture[str]) -> Told:

    def call(line: str, code: int = Exit.OK) -> str:
        files = {"RUN": str(record), "PROJECT": str(record.with_suffix(".toml"))}
        assert ends(*[files.get(word, word) for word in line.split()]) == code, line
        return capsys.readouterr().out

    return call


@pytest.mark.parametrize(
    "line",
    [
        "check PROJECT RUN",
        "check RUN --bus-only",
        "replay RUN -p PROJECT",
        "compare RUN -p PROJECT",
        "compare RUN -p PROJECT --span 3:5",
        "diagnose RUN -p PROJECT",
        "effects",
        "effects supply_sag",
    ],
)
@pytest.mark.usefixtures("eighty")
def test_every_table_of_a_command_is_whole_at_80_columns(story: Told, line: str) -> None:
    shown = story(line, IMPOSSIBLE if line.startswith("replay") else Exit.OK)
    assert shown.count(CONVENTION) == ("±" in shown)
    assert "+-" not in shown


@pytest.mark.long
@pytest.mark.usefixtures("eighty")
def test_the_history_is_whole_and_an_effect_reads_alike_before_and_after(story: Told) -> None:
    """The same residual has the same words in what `add` follows and in what follows it."""
    before = " ".join(story("diagnose RUN -p PROJECT").split())
    leak = r"coefficient [\d.]+ ± [\d.e-]+ L/min/MPa"
    assert re.search(leak, before)
    try:
        shown = " ".join(story("add RUN -p PROJECT").split())
        assert re.search(leak, shown) and shown.count(CONVENTION) == 1
        after = " ".join(story("diagnose RUN -p PROJECT").split())
        story("history -p PROJECT")
        words = "Something remains beyond the noise, and is immaterial"
        assert (words in before) == (words in after)
        assert "Something else remains" not in before + after
    finally:
        story("undo -p PROJECT")


def test_si_is_what_the_option_says_and_json_does_not_change(story: Told) -> None:
    before = story("diagnose RUN -p PROJECT")
    assert "L/min/MPa" in before and "m3/s" not in before
    shown = story("diagnose RUN -p PROJECT --units si")
    assert "m3/s/Pa" in shown and "L/min" not in shown.partition("not found")[2]
    assert story("diagnose RUN -p PROJECT") == before, "the next command is not touched"
    one, other = (story(f"diagnose RUN -p PROJECT --json {w}") for w in ("", "--units si"))
    found = [json.loads(text) for text in (one, other)]
    for each in found:
        each.pop("advice"), each.pop("doubts")  # sentences for people
    assert found[0] == found[1]
    assert found[0]["found"][0]["parameters"]["coefficient"]["unit"] == "m3/s/Pa"
    shown = story("replay RUN -p PROJECT --units si", IMPOSSIBLE)
    assert "MPa" not in shown and "L/min" not in shown and " ms" not in shown


@pytest.mark.usefixtures("eighty")
def test_the_status_tells_95_percent_and_is_whole(tmp_path: Path, story: Told) -> None:
    chambers = ChamberStatus("a", 900e6, 1e6), ChamberStatus("b", 900e6, 2e6)
    name, leak = (
        "a_message_with_a_very_long_name_",
        EffectStatus("leak a-b", 5e-12, 1e-13, "m3/s/Pa"),
    )
    written = Status(
        "boom", 7, 1.0, 2.0, LoopHealth(1000.0, 10, 1, 0, {"late": 1}), BusHealth("virtual", "x"),
        messages=(MessageHealth(name, 0x101, 998.0, 1000.0, 0.002, 0.004, "damaged",
                                {"crc": 7, "counter": 12, "length": 3, "not_available": 123}),),
        signals=(SignalHealth("p_a", "pressure", "Pa", name, 2.5e6, 1e5, 12345678.0),),
        estimate=EstimateStatus(chambers=chambers, effects=(leak,)),
    )  # fmt: skip
    status.write(tmp_path, written)
    shown = story(f"status {tmp_path}", Exit.NEGATIVE)
    assert "a 900.0 ± 2.0 MPa, b 900.0 ± 3.9 MPa" in shown
    assert "effects leak a-b 0.3000 ± 0.0118 L/min/MPa" in shown
    assert shown.count(CONVENTION) == 1 and "12.3457" in shown
