"""A second of a machine as a table, under any names, in any kind of file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat

from rtid.plain import FloatArray


def machine() -> dict[str, FloatArray]:
    """A second of a machine, by columns in bar and mm; the supply stands at 70 bar."""
    t = 0.001 * np.arange(1000)
    way = np.sin(6 * t)
    columns = {"t": t, "u": 8 * way, "x": 200 + 50 * way, "p_a": 30 + 9 * way, "p_b": 20 - 9 * way}
    return columns | {"p_s": 70 + 0.5 * way, "p_t": 2 + 0.1 * way, "spare": 3 * way}


def written(path: Path, columns: dict[str, FloatArray]) -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    elif path.suffix == ".mat":
        savemat(path, columns)
    else:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
    return path
