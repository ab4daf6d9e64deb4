"""The estimator in C as a folder to be compiled into a firmware: its sources and its tables."""

from __future__ import annotations

from pathlib import Path

from rtid.estimator.state import Weights
from rtid.mcu.c_tables import Tiles, sources, tables
from rtid.model import Machine
from rtid.trace.state_files import replacing

TABLES = "rtid_estimator_tables.h"


def write_sources(
    folder: Path,
    model: Machine,
    blocks: int = 0,
    weights: Weights | None = None,
    title: str = "",
    tiles: Tiles | None = None,
) -> list[Path]:
    """Write tables and sources for a machine of `one_valve`; the files, each whole or not there.

    blocks: how many can be learned, 0: all of the grids; tiles: work of a tick.
    Raises ValveError, OSError.
    """
    texts = {TABLES: tables(model, blocks, weights, title, tiles)}
    texts |= {path.name: path.read_text(encoding="utf-8") for path in sources()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with replacing(folder / name) as part:
            part.write_text(text, encoding="utf-8")
    return [folder / name for name in texts]
