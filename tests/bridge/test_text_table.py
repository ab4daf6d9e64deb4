"""Tables of text as others write them: preambles, rows of units, dates, spreadsheets' encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from firmware_bridge.sources import LogError, read_table
from firmware_bridge.sources.table import Table

LABVIEW = "LabVIEW Measurement\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\n"


def read(tmp_path: Path, text: str | bytes, name: str = "t.csv") -> Table:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_table(path)


def columns(table: Table) -> dict[str, list[float]]:
    return {name: column.tolist() for name, column in table.columns.items()}


@pytest.mark.parametrize(
    "text",
    [
        "Zeit;Druck;Weg\ns;bar;mm\n0;1,5;2\n0,002;2,5;3\n",
        "Zeit;Druck;Weg\n[s];[bar];[mm]\n0;1,5;2\n0,002;2,5;3\n",
        "Zeit;Druck;Weg\n(s);(bar);(mm)\n0,000;1,5;2\n0,002;2,5;3\n",
    ],
)
def test_a_row_of_units(tmp_path: Path, text: str) -> None:
    table = read(tmp_path, text)
    assert table.units == {"Zeit": "s", "Druck": "bar", "Weg": "mm"}
    assert columns(table) == {"Zeit": [0, 0.002], "Druck": [1.5, 2.5], "Weg": [2, 3]}


@pytest.mark.parametrize("null", ["NA", "#N/A", "null"])
def test_a_first_row_without_values_is_no_row_of_units(tmp_path: Path, null: str) -> None:
    table = read(tmp_path, f"t,p,q\n0,{null},{null}\n1,2,3\n2,4,5\n")
    assert columns(table)["t"] == [0, 1, 2] and table.units["t"] == ""


@pytest.mark.parametrize("comment", ["\tComment", ""])
@pytest.mark.parametrize("end", ["\t", ""])
def test_a_preamble_and_a_title_without_values(tmp_path: Path, comment: str, end: str) -> None:
    rows = f"0.000\t1.5{end}\n0.001\t2.5{end}\n"
    if end and not comment:
        rows = rows.replace("\t\n", "\n")
    table = read(tmp_path, f"{LABVIEW}\nX_Value\tVoltage{comment}\n{rows}", "t.txt")
    assert columns(table) == {"X_Value": [0, 0.001], "Voltage": [1.5, 2.5]}
    assert table.t_us().tolist() == [0, 1000]


def test_both_headers_of_labview(tmp_path: Path) -> None:
    """The second tells the units; its "Channels 2" was taken for the names."""
    text = (
        f"{LABVIEW}\t\nChannels\t2\t\nSamples\t2\t2\nY_Unit_Label\tVolts\tbar\n"
        "X0\t0.0E+0\t0.0E+0\n***End_of_Header***\t\t\nX_Value\tu\tp\tComment\n"
        "0.000\t1.5\t2\n0.001\t2.5\t3\n"
    )
    table = read(tmp_path, text, "t.lvm")
    assert columns(table) == {"X_Value": [0, 0.001], "u": [1.5, 2.5], "p": [2, 3]}
    assert table.units["u"] == "Volts" and table.units["p"] == "bar"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2026-03-01T08:00:00.000", "2026-03-01T08:00:00.002"),
        ("2026-03-01 08:00:00.000000", "2026-03-01 08:00:00.002000"),
        ("2026-03-01T08:00:00.000Z", "2026-03-01T08:00:00.002Z"),
        ("01.03.2026 08:00:00,000", "01.03.2026 08:00:00,002"),
        ("3/1/2026 08:00:00.000", "3/1/2026 08:00:00.002"),
        ("08:00:00.000", "08:00:00.002"),
        ("23:59:59.999", "00:00:00.001"),
        ("28.02.2026 23:59:59.999", "01.03.2026 00:00:00.001"),
        ("28.02.26 23:59:59.999", "01.03.26 00:00:00.001"),
    ],
)
def test_dates_and_times_of_day(tmp_path: Path, first: str, second: str) -> None:
    """Two milliseconds, whatever they are written as, over midnight too."""
    table = read(tmp_path, f"timestamp;u\n{first};1\n{second};2\n")
    assert np.diff(table.t_us()).tolist() == [2000]
    assert table.units["timestamp"] == "s"


@pytest.mark.parametrize(
    ("title", "first", "per_ms", "turn"),
    [
        ("time_ms", 86_399_000, 1, 86_400_000),  # since midnight
        ("t [s]", 86_399.0, 1e-3, 86_400.0),
        ("t_ms", 65_000, 1, 1 << 16),
        ("t_us", 0, 1000, 1 << 16),  # over and over
        ("t_us", (1 << 32) - 10_000, 1000, 1 << 32),
        ("Zeit [d]", 45_352.5, 1 / 86_400_000, 1e9),  # as a spreadsheet keeps a date
    ],
)
def test_a_time_that_begins_again_goes_on(
    tmp_path: Path, title: str, first: float, per_ms: float, turn: float
) -> None:
    """A row each 4 ms; half of a record behind midnight was out of its order, and left out."""
    stamps = (first + 4 * per_ms * np.arange(1000)) % turn
    table = read(tmp_path, f"{title};u\n" + "".join(f"{t:.17g};1\n" for t in stamps))
    steps = np.diff(table.t_us())
    assert np.abs(steps - 4000).max() <= 2  # a double has days to 0.6 us


def test_a_time_that_goes_back_by_anything_else_stays(tmp_path: Path) -> None:
    """A second record behind the first, or rows out of their order."""
    stamps = [*range(0, 60_000, 4), *range(0, 60_000, 4)]
    table = read(tmp_path, "t_ms;u\n" + "".join(f"{t};1\n" for t in stamps))
    assert table.t_us().tolist() == [1000 * t for t in stamps]


def test_seconds_of_a_day_alone(tmp_path: Path) -> None:
    """pyarrow takes them for a type of its own."""
    assert np.diff(read(tmp_path, "Time,u\n08:00:00,1\n08:00:01,2\n").t_us()).tolist() == [10**6]


def test_a_frame_of_pandas(tmp_path: Path) -> None:
    """Its index of dates is a column of the file, in nanoseconds."""
    stamps = pa.array(
        [1_772_352_000_000_000_000 + 2_000_000 * k for k in range(3)], pa.timestamp("ns")
    )
    pq.write_table(pa.table({"u": [1.0, 2.0, 3.0], "timestamp": stamps}), tmp_path / "t.parquet")
    table = read_table(tmp_path / "t.parquet")
    assert np.diff(table.t_us()).tolist() == [2000, 2000]
    assert table.columns["u"].tolist() == [1, 2, 3]


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_a_spreadsheet_s_encoding(tmp_path: Path, code: str) -> None:
    table = read(tmp_path, "Zeit [s];Öl [°C];Text\n0;40;für\n0,5;41;ß\n".encode(code))
    assert columns(table) == {"Zeit": [0, 0.5], "Öl": [40, 41]}
    assert table.units == {"Zeit": "s", "Öl": "°C"}


def test_words_of_a_logger_for_nothing_are_missing_values(tmp_path: Path) -> None:
    table = read(tmp_path, "t,p_a,p_b\n0,1,---\n1,OL,2\n2,3,#NV\n3,None,4\n4,<NA>,5\n5,6,#NUM!\n")
    assert np.isnan(table.columns["p_a"]).tolist() == [False, True, False, True, True, False]
    assert np.isnan(table.columns["p_b"]).tolist() == [True, False, True, False, False, True]


def test_two_columns_of_one_name(tmp_path: Path) -> None:
    assert columns(read(tmp_path, "t,u,u\n0,1,2\n")) == {"t": [0], "u": [1], "u.2": [2]}


@pytest.mark.parametrize("text", ["# a\n# b\n", "words\nand more\n", "t,u\n"])
def test_what_holds_no_numbers_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(LogError, match=r"comments|numeric"):
        read(tmp_path, text)


def test_numbers_above_which_no_names_stand(tmp_path: Path) -> None:
    """As before: the first line is taken for the names."""
    assert columns(read(tmp_path, "0,1\n1,2\n2,3\n")) == {"0": [1, 2], "1": [2, 3]}


def test_a_time_that_is_a_number_goes_before_one_that_is_written(tmp_path: Path) -> None:
    """A date of whole seconds beside the time that counts."""
    text = "timestamp,t_ms,u\n2026-03-01 08:00:00,0,1\n2026-03-01 08:00:00,2,2\n"
    table = read(tmp_path, text)
    assert table.time_name() == "t_ms" and table.t_us().tolist() == [0, 2000]


def test_rows_that_end_in_a_delimiter(tmp_path: Path) -> None:
    assert columns(read(tmp_path, "t;u\n0;1,5;\n1;2,5;\n")) == {"t": [0, 1], "u": [1.5, 2.5]}


def test_a_line_without_end_is_no_table(tmp_path: Path) -> None:
    """It was cut into lines of their own, and the numbers began in its middle."""
    with pytest.raises(LogError, match="more than a million characters"):
        read(tmp_path, "t,u," + "x," * 600_000 + "\n0,1\n")


@pytest.mark.parametrize(
    "stamps",
    [
        ("11:59:59.500 AM", "12:00:00.000 PM"),
        ("3/1/2026 11:59:59.500 am", "3/1/2026 12:00:00.000 pm"),
        ("11:59:59:500", "12:00:00:000"),
    ],
)
def test_halves_of_a_day_and_colons_before_milliseconds(
    tmp_path: Path, stamps: tuple[str, str]
) -> None:
    table = read(tmp_path, f"Time,p\n{stamps[0]},1\n{stamps[1]},2\n")
    first, second = table.seconds("Time")
    assert first % 86_400 == 43_199.5 and second - first == 0.5


@pytest.mark.parametrize("word", ["Bad", "*", "########", " ", "∞", "1.#INF", "NaN (Ind)"])
@pytest.mark.parametrize("comma", [True, False])
def test_words_among_numbers_are_missing_values(tmp_path: Path, word: str, comma: bool) -> None:
    text = f"t;p\n0.5;1.5\n1.5;{word}\n2.5;2.5\n3.5;3.5\n"
    text = text.replace(".5", ",5") if comma else text
    np.testing.assert_array_equal(read(tmp_path, text).columns["p"], [1.5, np.nan, 2.5, 3.5])


@pytest.mark.parametrize(
    ("text", "written", "line"),
    [
        ('t,p [Pa]\n0,950.5\n1,bad\n2,"1,234.5"\n', "1,234.5", 4),
        ("t;p [Pa]\n0,5;950,5\n1,5;1.234,5\n", "1.234,5", 3),
        ("t;p [Pa]\n0,5;950,5\n1,5;1.234\n", "1.234", 3),
        ("# of the rig\nt;p [Pa]\n\n0.5;2 Pa\n1.5;3 Pa\n", "2 Pa", 4),
    ],
)
def test_a_number_that_is_none_is_named_with_its_line(
    tmp_path: Path, text: str, written: str, line: int
) -> None:
    table = read(tmp_path, text)
    assert table.unread == {"p [Pa]": f"{written!r} in line {line} is no number"}
    with pytest.raises(LogError, match=r"column 'p \[Pa\]': .* is no number"):
        table.column("p")


def test_words_alone_are_a_text_and_nothing_that_is_missed(tmp_path: Path) -> None:
    table = read(tmp_path, "t,state\n0,idle\n1,step 2\n2,idle\n")
    assert not table.unread and set(table.columns) == {"t"}


def test_columns_that_are_parted_by_strokes(tmp_path: Path) -> None:
    assert columns(read(tmp_path, "t|p\n0|1.5\n1|2.5\n")) == {"t": [0, 1], "p": [1.5, 2.5]}
