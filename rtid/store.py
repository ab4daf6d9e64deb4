"""Snapshots: the estimator's whole memory in one npz file, with schema and restore key.

A snapshot continues bit for bit; it is refused where it belongs to another project or schema.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.history import History
from rtid.estimator.state import State, Weights
from rtid.estimator.sums import Sums
from rtid.model import Model

SCHEMA = 3
FOLD = ("shared", "blocks", "pairs", "tiles", "noise", "rows", "compliance", "innovation")
WEIGHTS = ("slopes", "compliance", "missed")
ARRAYS = ("engine", "cells", "closed", "blocks", "pairs")


class SnapshotError(RtidError):
    """The file is no snapshot, or one of another project, schema or program version."""


def save(path: Path, estimator: Estimator, digest: str) -> None:
    """Write a snapshot; the file appears whole or not at all."""
    header = {
        "schema": SCHEMA,
        "digest": digest,
        "origin_us": estimator.origin_us,
        "turns": estimator.turns,
        "due_s": estimator.due_s,
    }
    arrays: dict[str, Any] = dict(zip(ARRAYS, estimator.state.arrays, strict=True))
    weights = estimator.weights
    if weights is not None:
        arrays |= {name: getattr(weights, name) for name in WEIGHTS}
        header["lag_s"] = weights.lag_s
    for k, fold in enumerate(estimator.folds):
        arrays |= {f"fold{k}_{name}": getattr(fold, name) for name in FOLD}
    if estimator.history is not None:
        arrays |= {f"history_{k}": a for k, a in estimator.history.to_arrays().items()}
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        arrays["header"] = np.array(json.dumps(header))
        np.savez_compressed(file, **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def load(path: Path, model: Model, digest: str) -> Estimator:
    """Restore an estimator.  Raises SnapshotError with the reason, FileNotFoundError."""
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            content = {name: file[name] for name in file.files if name != "header"}
    except (ValueError, KeyError, OSError, EOFError, BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise SnapshotError(f"{path}: not a snapshot of rtid ({error})") from error
    _check(path, header, digest)
    weights = None
    if "slopes" in content:
        slopes, compliance, missed = (content[name] for name in WEIGHTS)
        weights = Weights(slopes, compliance, float(header["lag_s"]), missed)
    estimator = Estimator(model, weights)
    for name, array in zip(ARRAYS, estimator.state.arrays, strict=True):
        if content[name].dtype != array.dtype:
            raise SnapshotError(f"{path}: {name} has another layout", "learn again with `replay`")
    estimator.state = State(*(content[name] for name in ARRAYS))
    estimator.origin_us, estimator.turns = header["origin_us"], header["turns"]
    estimator.due_s = float(header["due_s"])
    estimator.folds = [_fold(content, k) for k in range(model.upkeep.folds)]
    if estimator.history is not None:
        stored = {k: a for k, a in content.items() if k.startswith("history_")}
        kept = {name.removeprefix("history_"): array for name, array in stored.items()}
        estimator.history = History.from_arrays(kept)
    return estimator


def _fold(content: dict[str, Any], k: int) -> Sums:
    parts = {name: content[f"fold{k}_{name}"] for name in FOLD}
    return Sums(**parts | {"rows": float(parts["rows"])})


def _check(path: Path, header: dict[str, object], digest: str) -> None:
    if header.get("schema") != SCHEMA:
        raise SnapshotError(f"{path}: schema {header.get('schema')}, this program reads {SCHEMA}")
    if header.get("digest") != digest:
        raise SnapshotError(
            f"{path}: learned with another project (geometry, sensors or grid differ)",
            "use the project file that made it, or learn again with `rtid replay`",
        )
