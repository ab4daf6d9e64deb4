"""Residual tables for other programs: CSV, Parquet or MATLAB .mat, one row per row of the filter.

Columns: map, part, t_s; per chamber measured_, modelled_ and residual_NAME_m3s; the signals through
the same filter, NAME_UNIT; the block of each edge, block_NAME_u and block_NAME_dp (-1: shut); and
per chamber the pressure at that instant, measured and of the free run and k steps ahead.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtid.compare import Comparison, Simulation
from rtid.errors import RtidError
from rtid.model import Machine
from rtid.study.compared import Held, TraceComparison
from rtid.trace.state_files import replacing

FORMATS = (".csv", ".parquet", ".mat")
Columns = dict[str, np.ndarray]


class TableFormatError(RtidError):
    """A file name that tells no known format."""


def refuse_format(path: Path) -> None:
    """Raise TableFormatError where the suffix names no format, before any work is done."""
    if path.suffix.lower() not in FORMATS:
        remedy = f"end the name in {', '.join(FORMATS)}"
        raise TableFormatError(f"{path}: unknown format of a table", remedy, 2)


def residual_columns(studies: Sequence[TraceComparison]) -> Columns:
    """All maps and parts one below the other, as columns of equal length.

    A column that one model does not have is NaN there.
    """
    blocks = [
        _part(comparison.replay.model, tested, title)
        for comparison in studies
        for tested in comparison.held
        for title in tested.parts
    ]
    names = list(dict.fromkeys(name for block in blocks for name in block))
    lengths = [len(block["t_s"]) for block in blocks]
    return {
        name: np.concatenate(
            [b.get(name, np.full(n, np.nan)) for b, n in zip(blocks, lengths, strict=True)]
        )
        for name in names
    }


def write_residuals(path: Path, studies: Sequence[TraceComparison]) -> Path:
    """Write `residual_columns` in the format of the suffix; whole or not at all."""
    refuse_format(path)
    write = {".csv": _csv, ".parquet": _parquet, ".mat": _mat}[path.suffix.lower()]
    with replacing(path) as part:
        write(part, residual_columns(studies))
    return path


def _part(model: Machine, tested: Held, title: str) -> Columns:
    part = tested.parts[title]
    n = len(part.t_s)
    columns: Columns = {"map": np.full(n, tested.name), "part": np.full(n, title), "t_s": part.t_s}
    for c, chamber in enumerate(model.chambers):
        columns[f"measured_{chamber.name}_m3s"] = part.measured_m3s[:, c]
        columns[f"modelled_{chamber.name}_m3s"] = part.modelled_m3s[:, c]
        columns[f"residual_{chamber.name}_m3s"] = part.residual_m3s[:, c]
    for k, signal in enumerate(model.signals):
        unit = signal.unit.replace("/", "p").casefold()
        columns[f"{signal.name}_{unit}" if unit else signal.name] = part.signals[:, k]
    columns |= _blocks(model, part)
    if title in tested.examinations:
        for name, run in tested.examinations[title].simulations.items():
            columns |= _pressures(model, part, name, run)
    return columns


def _blocks(model: Machine, part: Comparison) -> Columns:
    columns: Columns = {}
    for k, edge in enumerate(model.edges):
        cell = part.cell[:, k]
        i, j = np.divmod(cell - model.first_cells[k], edge.grid.shape[1])
        columns[f"block_{edge.name}_u"] = np.where(cell >= 0, i, -1)
        columns[f"block_{edge.name}_dp"] = np.where(cell >= 0, j, -1)
    return columns


def _pressures(model: Machine, part: Comparison, name: str, run: Simulation) -> Columns:
    at = np.clip(np.searchsorted(run.t_s, part.t_s - 1e-7), 0, max(len(run.t_s) - 1, 0))
    word, columns = re.sub(r"\W+", "_", name), {}
    for c, chamber in enumerate(model.chambers):
        columns[f"{chamber.pressure}_measured_pa"] = run.measured_pa[at, c]
        columns[f"{chamber.pressure}_{word}_pa"] = run.simulated_pa[at, c]
    return columns


def _csv(path: Path, columns: Columns) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        texts = [
            column.tolist() if column.dtype.kind != "f" else [f"{v:.9g}" for v in column.tolist()]
            for column in columns.values()
        ]
        writer.writerows(zip(*texts, strict=True))


def _parquet(path: Path, columns: Columns) -> None:
    import pyarrow as pa  # noqa: PLC0415 - only where a Parquet file is wanted
    import pyarrow.parquet as pq  # noqa: PLC0415

    pq.write_table(pa.table({name: pa.array(column) for name, column in columns.items()}), path)


def _mat(path: Path, columns: Columns) -> None:
    from scipy.io import savemat  # noqa: PLC0415 - only where a .mat file is wanted

    def value(column: np.ndarray) -> np.ndarray:
        return column.astype(object) if column.dtype.kind == "U" else column

    named = {re.sub(r"\W", "_", name): value(column) for name, column in columns.items()}
    savemat(
        str(path), named, appendmat=False, long_field_names=True, do_compression=True,
        oned_as="column",
    )  # fmt: skip
