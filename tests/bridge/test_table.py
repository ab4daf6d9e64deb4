from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.samples import GAP, ROW
from firmware_bridge.sources import LogError, read_table
from firmware_bridge.sources.table import APART, JUMP, between, to_samples

ROLES = Assembly(
    "cycle",
    (
        SignalSource("u_v", signal="u"),
        SignalSource("p_pa", signal="p", factor=1e6),
        SignalSource("tank_pa", constant=1e5),
    ),
    (),
    "u_v",
)


def test_csv_with_units_comments_and_gaps(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(
        "# a comment\nt [ms],u (V),p [MPa],note\n0,1,2,a\n1,1.5,2.5,b\n2,,3,c\n"
        "3,2,3,d\n3,2,3,e\n9,2,3,f\n"
    )
    table = read_table(path)
    assert table.units == {"t": "ms", "u": "V", "p": "MPa"}
    samples, counts = to_samples(table, ROLES)
    assert samples.t_us.tolist() == [0, 1000, 3000, 9000]
    assert samples.values[:2].tolist() == [[1.0, 2e6, 1e5], [1.5, 2.5e6, 1e5]]
    assert counts == {"not_available": 1, "out_of_order": 1, "gap": 1}
    assert samples.flags.tolist() == [ROW | GAP, ROW, ROW, ROW | GAP]


@pytest.mark.parametrize(
    "text", ["t;u;p\n0,0;1,5;2\n0,001;2,5;3\n", "t\tu\tp\n0\t1.5\t2\n0.001\t2.5\t3\n"]
)
def test_other_separators(tmp_path: Path, text: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    samples, _ = to_samples(read_table(path), ROLES)
    assert samples.column("u_v").tolist() == [1.5, 2.5]
    assert samples.t_us.tolist() == [0, 1000]


def test_parquet_scale_offset_unit(tmp_path: Path) -> None:
    fields = [
        pa.field("t", pa.int32(), metadata={"unit": "s", "scale": "0.001", "offset": "0"}),
        pa.field("u", pa.uint16(), metadata={"unit": "V", "scale": "0.5", "offset": "-10"}),
        pa.field("p", pa.float32()),
    ]
    columns = [pa.array([0, 1, 2], f.type) for f in fields]
    pq.write_table(pa.Table.from_arrays(columns, schema=pa.schema(fields)), tmp_path / "t.parquet")
    table = read_table(tmp_path / "t.parquet")
    assert table.units["u"] == "V"
    samples, counts = to_samples(table, ROLES)
    assert samples.column("u_v").tolist() == [-10.0, -9.5, -9.0]
    assert samples.t_us.tolist() == [0, 1000, 2000]
    assert counts == {}


@pytest.mark.parametrize("key", ["unit", "Unit", "units"])
def test_a_unit_in_parquet_is_read_however_its_key_is_spelt(tmp_path: Path, key: str) -> None:
    schema = pa.schema([pa.field("p_a", pa.float64(), metadata={key: "bar"})])
    pq.write_table(pa.Table.from_arrays([pa.array([1.0])], schema=schema), tmp_path / "t.parquet")
    assert read_table(tmp_path / "t.parquet").units == {"p_a": "bar"}


def test_mat(tmp_path: Path) -> None:
    t = np.arange(5) * 1e-3
    savemat(tmp_path / "t.mat", {"t": t[:, None], "u": t * 2, "p": t, "k": 3.0, "m": np.eye(3)})
    table = read_table(tmp_path / "t.mat")
    assert set(table.columns) == {"t", "u", "p"}
    samples, _ = to_samples(table, ROLES)
    np.testing.assert_array_equal(samples.column("u_v"), t * 2)


@pytest.mark.parametrize("is_packed", [True, False])
def test_a_struct_of_vectors(tmp_path: Path, is_packed: bool) -> None:
    t, path = np.arange(5) * 1e-3, tmp_path / "t.mat"
    savemat(path, {"data": {"t": t[:, None], "u": 2 * t, "k": 3.0}}, do_compression=is_packed)
    assert {k: v.tolist() for k, v in read_table(path).columns.items()} == {
        "t": t.tolist(), "u": (2 * t).tolist()
    }  # fmt: skip
    savemat(path, {"a": {"Time": t, "Data": t}, "b": {"Time": t, "Data": 2 * t}})
    assert set(read_table(path).columns) == {"a.Time", "a.Data", "b.Time", "b.Data"}


def test_a_vector_that_is_longer_than_the_time_takes_nothing_away(tmp_path: Path) -> None:
    """Of a file with a longer vector that was all that was read."""
    savemat(tmp_path / "t.mat", {"t": np.arange(5.0), "u": np.arange(5.0), "more": np.arange(9.0)})
    assert set(read_table(tmp_path / "t.mat").columns) == {"t", "u"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"data": np.ones((5, 3))}, "not read: data (a double of 5 x 3)"),
        ({"tout": np.arange(5.0), "yout": np.ones((5, 3))}, "holds 1 vectors; not read: yout"),
        ({"scope": {"time": np.arange(5.0), "signals": {"values": np.ones(5)}}}, "scope (a struct"),
    ],
)
def test_what_is_no_vector_in_mat_is_named(
    tmp_path: Path, content: dict[str, object], words: str
) -> None:
    """It was "holds no numeric column", or a time without signals."""
    savemat(tmp_path / "t.mat", content)
    with pytest.raises(LogError, match=re.escape(words) + r".*; save one vector for each signal"):
        read_table(tmp_path / "t.mat")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"PK\x03\x04" + bytes(99), "packed, or a spreadsheet"),
        ("a.csv", b"\xd0\xcf\x11\xe0" + bytes(99), "a spreadsheet; save its sheet"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(99), "HDF5; write its columns as .parquet"),
        ("a.tdms", b"TDSm" + bytes(99), "TDMS; export it as .csv"),
        ("a.csv", b"\x89PNG\r\n" + bytes(99), "holds bytes that are no text"),
        ("a.mat", b"0.0 1.0\n0.1 2.0\n" * 20, r"save it with save\(..., '-v7'\)"),
        ("a.mdf", b"MDF     3.30    " + bytes(199), r"MDF 3; write it as MF4"),
        ("a.dat", b"DIAEHEADER", "of other tools export .csv or .mf4"),
        ("a.csv", b"t,u\n0,1\n0,5,1,5\n", "decimal commas"),
    ],
)
def test_a_file_of_another_kind_says_what_to_do(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    """Bytes were printed, or "copy the log again" was said of a version."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=words) as refused:
        read_table(tmp_path / name)
    assert str(refused.value).isprintable()


def test_clear_errors(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("t,pump,pp\n0,1,2\n")
    with pytest.raises(LogError, match="no numeric column 'p'; did you mean 'pp'"):
        to_samples(read_table(path), replace(ROLES, signals=ROLES.signals[1:]))
    path.write_text("x,u,p\n0,1,2\n")
    with pytest.raises(LogError, match="no time column"):
        to_samples(read_table(path), ROLES)
    for name in ("a.parquet", "a.mat", "a.csv"):
        (tmp_path / name).write_bytes(b"\x00\x01garbage")
        with pytest.raises(LogError, match=name):
            read_table(tmp_path / name)
    for name, words in (("a.xyz", "unknown suffix"), ("a.xlsx", "a spreadsheet; save its sheet")):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(LogError, match=words):
            read_table(tmp_path / name)


def test_rig_table(shared: Path) -> None:
    names = ("u", "x", "p_A", "p_B", "p_supply", "p_tank")
    roles = Assembly("cycle", tuple(SignalSource(n, signal=n) for n in names), (), "x")
    samples, counts = to_samples(read_table(shared / "data/rig/measured/rig_01.parquet"), roles)
    assert len(samples) == 110_001
    assert counts == {}
    assert (np.diff(samples.t_us) == 1000).all()
    assert 6.9e6 < samples.column("p_supply").mean() < 7.1e6


@pytest.mark.filterwarnings("error")
def test_a_number_that_no_sensor_sends_is_a_missing_value(tmp_path: Path) -> None:
    """1e308 was taken for a pressure, and its square ended the noise estimate in a warning."""
    path = tmp_path / "t.csv"
    path.write_text("t,u,p\n0,1,2\n0.001,1e308,2\n0.002,1,-1e200\n1e29,1,2\n0.003,1,2\n")
    samples, counts = to_samples(read_table(path), ROLES)
    assert samples.t_us.tolist() == [0, 3000]
    assert counts == {"not_available": 2, "out_of_order": 1}
    field = pa.field("p", pa.float64(), metadata={"scale": "1e300", "offset": "nan"})
    pq.write_table(pa.table([[1e300, 2.0]], pa.schema([field])), tmp_path / "t.parquet")
    assert np.isnan(read_table(tmp_path / "t.parquet").columns["p"]).all()


def in_turn(tmp_path: Path, rows: dict[int, str]) -> tuple[list[int], list[list[float]]]:
    """Times in ms and values of the samples of x, p and a command u, each in rows of its own."""
    path = tmp_path / "t.csv"
    path.write_text("t_ms,x,p,u\n" + "".join(f"{t},{row}\n" for t, row in rows.items()))
    command = SignalSource("u", signal="u", command=True, hold="zero")
    sources = SignalSource("x", signal="x"), SignalSource("p", signal="p"), command
    samples, counts = to_samples(read_table(path), Assembly("cycle", sources, (), "x"))
    assert (samples.flags & ROW).all() and counts[APART] == len(rows) - len(samples)
    return (samples.t_us // 1000).tolist(), samples.values.tolist()


def test_rows_that_tell_signals_in_turn(tmp_path: Path) -> None:
    """A pressure on the line to its next, a command by its mean up to the next row."""
    rows = {
        0: ",0,2", 2: ",2,", 3: ",,4", 4: "4,,", 6: ",6,", 7: ",,8", 8: "8,,", 9: ",9,", 10: ",,9",
    }  # fmt: skip
    assert in_turn(tmp_path, rows) == ([4, 8], [[4, 4, 5], [8, 8, 8.0]])


def test_rows_are_those_of_the_sensor_that_comes_most_seldom(tmp_path: Path) -> None:
    """The position on a line between its own: two such rows would tell of no noise."""
    rows = {k: f"{k},," for k in range(0, 20, 2)} | {k: f",{k},3" for k in range(1, 20, 4)}
    t_ms, values = in_turn(tmp_path, dict(sorted(rows.items())))
    assert t_ms == [1, 5, 9, 13, 17]
    assert values == [[t, t, 3] for t in t_ms]


def test_a_command_that_is_a_sample_of_a_faster_one_is_on_a_line(tmp_path: Path) -> None:
    """A row has its mean up to the next one; across a jump nothing is integrated."""
    u = [0.0, 1.0, 2.0, 3.0, 4.1, 5.0, 9.0, 10.1, 11.0, 12.0]
    path = tmp_path / "t.csv"
    path.write_text("t_ms,x,u\n" + "".join(f"{10 * k},{k},{v}\n" for k, v in enumerate(u)))
    signals = (
        SignalSource("x", signal="x"),
        SignalSource("u", signal="u", command=True, hold="linear"),
    )
    samples, counts = to_samples(read_table(path), Assembly("cycle", signals, (), "x"))
    line = [*(0.5 * (a + b) for a, b in pairwise(u)), u[-1]]
    assert samples.column("u").tolist() == pytest.approx(line)
    assert np.flatnonzero(samples.flags & GAP).tolist() == [0, 6]
    assert counts == {JUMP: 1}


def test_no_line_spans_what_is_missing() -> None:
    """A sensor that is silent for long is not known in between."""
    values = np.full(40, np.nan)
    values[::4] = np.arange(0.0, 40.0, 4.0)
    values[12:24] = np.nan
    filled = between(np.arange(40), values)
    known = np.isfinite(filled)
    assert not known[9:24].any() and known[:9].all() and known[24:37].all()
    assert np.array_equal(filled[known], np.arange(40.0)[known])


def test_a_difference_of_two_columns(tmp_path: Path) -> None:
    """A coil for either direction; a name that holds a minus is itself."""
    path = tmp_path / "t.csv"
    path.write_text("t,out [%],in [%],a - b,a - c\n0,30,0,1,5\n1,0,20,2,7\n")
    table = read_table(path)
    assert table.column("out - in").tolist() == [30, -20]
    assert table.units[table.known_as("out - in")] == "%"
    assert table.column("a - b").tolist() == [1, 2]
    assert table.column("a - b - a - c").tolist() == [-4, -5]
    with pytest.raises(LogError, match="no numeric column 'out - off'"):
        table.column("out - off")


def test_a_row_that_is_written_twice_counts_once(tmp_path: Path) -> None:
    """Each sensor "was sent every 0 ms and repeated", and 100 % of the record was missing."""
    path = tmp_path / "t.csv"
    path.write_text("t,u,p\n0,1,\n0,1,\n1,1,2\n1,1,2\n1,1,3\n2,1,3\n")
    table = read_table(path)
    assert table.columns["t"].tolist() == [0, 1, 1, 2]
    path.write_text("u,p\n1,2\n1,2\n")
    assert len(read_table(path).columns["u"]) == 2, "of no time"


@pytest.mark.parametrize("order", [slice(None, None, -1), [3, 1, 4, 0, 5, 2]])
def test_rows_in_no_order_are_refused(tmp_path: Path, order: slice | list[int]) -> None:
    """They were "no two complete samples", or a record of a hundredth of its rows."""
    rows = ["0,1,2", "1,1,2", "2,1,3", "3,1,3", "4,1,3", "5,1,3"]
    chosen = rows[order] if isinstance(order, slice) else [rows[k] for k in order]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(["t,u,p", *chosen]))
    with pytest.raises(LogError, match=r"its time falls \d times in 6 rows; sort the rows"):
        to_samples(read_table(path), ROLES)
