"""The part of the reader of MF4 measurements that runs as a program of its own.

    python mf4_child.py log.mf4 SECONDS BYTES

SECONDS of processor time and BYTES that the log may unpack to are all that it gets.

A flipped bit in the index of a file has made asammdf's compiled part overwrite memory and abort
the process; in a child this costs the log and not the program.  The child knows nothing of this
package, so that it starts fast.  It writes the channels to stdout, a file, as .npz.
"""

from __future__ import annotations

import logging
import resource
import signal
import sys
from typing import Any

import numpy as np

FAILED, TOO_MUCH = 3, 4  # exit codes; stderr says why it failed
OUT_OF_TIME = signal.SIGXCPU  # what ends it then
WORKING_BYTES = 384 << 20  # beside what it unpacks: asammdf itself, and a block while it is read
Columns = dict[str, Any]  # NDArray each


def extract(path: str, max_bytes: int) -> Columns:
    """Every channel of numbers; MemoryError if its records have more than max_bytes."""
    from asammdf import MDF  # noqa: PLC0415  an extra

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # it prints what it then raises
    with MDF(path, process_bus_logging=False) as mdf:
        heads = [group.channel_group for group in mdf.groups]
        if sum(int(head.cycles_nr) * int(head.samples_byte_nr) for head in heads) > max_bytes:
            raise MemoryError
        return _channels(mdf)


def _channels(mdf: Any) -> Columns:
    """Every channel of numbers: titles, units (m,), and each one's stamps t0, t1, .. and values."""
    titles: list[str] = []
    units: list[str] = []
    columns: Columns = {}
    for k, group in enumerate(mdf.groups):
        for index, channel in enumerate(group.channels):
            values = None if index == mdf.masters_db.get(k) else _numbers(mdf, k, index)
            if values is None or not len(values):
                continue
            columns |= {f"t{len(titles)}": mdf.get_master(k), f"values{len(titles)}": values}
            titles.append(channel.name)
            units.append(channel.unit or "")
    return columns | {"titles": np.array(titles), "units": np.array(units)} if titles else {}


def _numbers(mdf: Any, k: int, index: int) -> Any:
    """Values of one channel, float64 (n,), NaN where invalid; None if it holds no numbers."""
    signal = mdf.get(group=k, index=index)
    values = np.asarray(signal.samples)
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        return None
    values = values.astype(np.float64)
    if signal.invalidation_bits is not None:
        values[np.asarray(signal.invalidation_bits, bool)] = np.nan
    return values


def main() -> int:
    """Extract the log that the command line names; an exit code."""
    path, cpu_s, max_bytes = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    for kind, limit in (
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_DATA, WORKING_BYTES + max_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        most = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (most, hard))
    try:
        columns = extract(path, max_bytes)
    except MemoryError:
        return TOO_MUCH
    except Exception as error:  # asammdf raises whatever a damaged block causes
        sys.stderr.write(f"{error}\n")
        return FAILED
    np.savez(sys.stdout.buffer, **columns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
