"""The results folder of a fleet: written row by row, so that a run goes on where it was stopped.

    runs/machine=NAME/KEY.parquet    one row per trace: verdict, effects, beta, or the error
    sums/KEY.npz                     its accumulators
    machines.parquet                 one row per machine and declaration
    maps/MACHINE-DIGEST.npz          its map from all its traces: `rtid.maps.files.read_map`
    typical-DIGEST.csv               typical map of a type and its spread: a reference map

pandas, polars and DuckDB read `runs/` as one table partitioned by machine.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.dataset import partitioning

from rtid.estimator.sums import Sums
from rtid.fleet.learning import Outcome, unpacked
from rtid.trace.state_files import write_whole

STRINGS, NUMBERS = pa.list_(pa.string()), pa.list_(pa.float64())
SCHEMA = pa.schema(
    [
        ("key", pa.string()), ("trace", pa.string()), ("digest", pa.string()),
        ("start_us", pa.int64()), ("duration_s", pa.float64()), ("rows", pa.int64()),
        ("rho", pa.float64()), ("beta_pa", NUMBERS), ("beta_sd_pa", NUMBERS),
        ("verdict", pa.string()), ("effects", STRINGS), ("places", STRINGS), ("sizes", NUMBERS),
        ("units", STRINGS), ("heldout_before_pct", pa.float64()),
        ("heldout_after_pct", pa.float64()), ("truncated", pa.bool_()), ("cpu_s", pa.float64()),
        ("error", pa.string()), ("remedy", pa.string()),
    ]
)  # fmt: skip


class Archive:
    """A results folder; it is made where there is none."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("runs", "sums", "maps"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def done(self) -> set[str]:
        """Keys of the traces that have their row."""
        return {path.stem for path in (self.folder / "runs").glob("machine=*/[!.]*.parquet")}

    def keep(self, outcome: Outcome) -> None:
        """Keep one outcome: the sums first, so that whoever has a row has them."""
        if outcome.sums:
            write_whole(self._sums(outcome.job.key), outcome.sums)
        path = self._run(outcome.job.machine, outcome.job.key)
        path.parent.mkdir(exist_ok=True)
        row = {name: [outcome.row[name]] for name in SCHEMA.names}
        part = path.with_name(f".{path.name}")  # what begins with a dot belongs to no data set
        pq.write_table(pa.table(row, SCHEMA), part)
        os.replace(part, path)

    def forget_errors(self) -> int:
        """Take the rows of failed traces away, so that they are tried again; how many."""
        failed = [row for row in self.rows() if row["error"]]
        for row in failed:
            self._run(row["machine"], row["key"]).unlink()
        return len(failed)

    def rows(self) -> list[dict[str, Any]]:
        """All rows, in the order of machines and time."""
        if not self.done():
            return []
        machines = partitioning(pa.schema([("machine", pa.string())]), flavor="hive")
        rows = pq.read_table(self.folder / "runs", partitioning=machines).to_pylist()
        return sorted(rows, key=lambda r: (r["machine"], r["start_us"], r["key"]))

    def sums(self, keys: Sequence[str]) -> Iterator[Sums]:
        """The sums of traces, one by one: they are large together."""
        for key in keys:
            yield unpacked(self._sums(key).read_bytes())

    def keep_machines(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the table of machines."""
        table = pa.Table.from_pylist([dict(row) for row in rows])
        pq.write_table(table, self.folder / "machines.parquet")

    def _run(self, machine: str, key: str) -> Path:
        return self.folder / "runs" / f"machine={quote(machine, safe='')}" / f"{key}.parquet"

    def _sums(self, key: str) -> Path:
        return self.folder / "sums" / f"{key}.npz"
