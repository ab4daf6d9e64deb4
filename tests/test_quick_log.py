"""A command that the log writes rows late."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.sources.table import Table, to_samples
from rtid.diagnose.fit import fit, prepare
from rtid.diagnose.revision import Revision
from rtid.model import Lag, Machine
from rtid.plain import FloatArray
from rtid.study.quick_log import is_between_rows, is_likelier
from tests.diagnose.records import record

N = 5_000


def table(u: FloatArray) -> Table:
    t_s = np.linspace(0.0, 1e-3 * (len(u) - 1), len(u))
    return Table(Path("log.csv"), {"t": t_s, "u": u, "x": np.zeros(len(u))}, {"t": "s"})


@pytest.mark.parametrize("late", [0, 1, 3])
def test_rows_that_come_late_are_put_where_they_belong(late: int) -> None:
    sources = SignalSource("u", signal="u", hold="zero", command=True, late_rows=late)
    assembly = Assembly("cycle", (sources, SignalSource("x", signal="x")), (), "x")
    samples, refused = to_samples(table(np.arange(30.0)), assembly)
    assert samples.column("u").tolist() == list(range(late, 30))
    assert samples.t_us.tolist() == [1000 * k for k in range(30 - late)]
    assert refused.get("not_available", 0) == late


def late(chunk: FloatArray, model: Machine, rows: int) -> FloatArray:
    """A record (n, 2 + signals) whose log has its command so many rows late."""
    column = 2 + model.column("u")
    written = chunk.copy()
    written[rows:, column] = chunk[: len(chunk) - rows, column]
    return written


def readings(rows: int) -> tuple[Any, Any]:
    """The studies, as far as they are asked, with a row put right, and as the log has it."""
    model, right, _ = record()
    right = right[:N]
    model = replace(model, lag=Lag(2e-3, 5e-3))  # as quick assumes it
    as_logged, earlier = late(right, model, rows), late(right, model, 0)
    column = 2 + model.column("u")
    earlier[:-1, column] = as_logged[1:, column]
    last, bare = (
        fit(model, chunk, prepare(model, chunk), Revision(), bank=False)
        for chunk in (as_logged, earlier)
    )
    result = SimpleNamespace(last=last)
    first = SimpleNamespace(taught=as_logged, diagnosed=SimpleNamespace(result=result))
    return SimpleNamespace(fitted=bare, machine=model), first


def test_a_command_that_is_written_late_is_likelier_where_it_was() -> None:
    """Of 1.3 ms of lag less than nothing would be left where it acts 2 ms before it is written."""
    assert is_likelier(*readings(2))


def test_a_command_that_is_written_in_time_is_not() -> None:
    assert not is_likelier(*readings(0))


@pytest.mark.parametrize(
    ("name", "alike", "is_so"),
    [
        ("input_delay", (), True),
        ("spool_lag_first_order", ("input_delay",), True),
        ("spool_lag_first_order", (), False),  # a spool may be slow behind a log that is late
        ("internal_leakage_laminar", (), False),
    ],
)
def test_a_row_earlier_and_a_part_of_it_later_is_no_late_log(
    name: str, alike: tuple[str, ...], is_so: bool
) -> None:
    """A healthy machine at 50 rows a second: a row of 20 ms, and a delay of 11."""
    found = SimpleNamespace(effect=name, cannot_be_told_from=alike)
    said: Any = SimpleNamespace(found=(found,))
    assert is_between_rows(said) is is_so
