"""Snapshots: the estimator's whole memory in one file, with schema, restore key and CRC.

A snapshot continues bit for bit; it is refused where it belongs to another project or schema, or
where a single byte of it is wrong.  The file is an npz with its CRC-32 behind it.  `Generations`
keeps the last two: whatever happens while one is written, the other one is whole.
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from dataclasses import dataclass
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

SCHEMA = 4
RELEARN = "learn again with `rtid replay` or `rtid run`"
SEAL = struct.Struct("<4sL")  # behind the npz: mark, CRC-32 of all bytes before
MARK = b"RTID"
FOLD = ("shared", "blocks", "pairs", "tiles", "noise", "rows", "compliance", "innovation")
WEIGHTS = ("slopes", "compliance", "missed")
ARRAYS = ("engine", "cells", "closed", "blocks", "pairs")


class SnapshotError(RtidError):
    """The file is no snapshot, or one of another project, schema or program version."""


def save(path: Path, estimator: Estimator, digest: str, serial: int = 0) -> None:
    """Write a snapshot; the file appears whole or not at all, and is on the disk on return.

    serial: number of the snapshot, for `Generations`.
    """
    header = {
        "schema": SCHEMA,
        "digest": digest,
        "serial": serial,
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
    arrays["header"] = np.array(json.dumps(header))
    memory = io.BytesIO()
    np.savez_compressed(memory, **arrays)
    content = memory.getvalue()
    write_whole(path, content + SEAL.pack(MARK, zlib.crc32(content)))


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file by these bytes, so that after a power cut there is the old one or the new."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path, model: Model, digest: str) -> Estimator:
    """Restore an estimator.  Raises SnapshotError with the reason, FileNotFoundError."""
    header, content = _read(path)
    _check(path, header, digest)
    weights = None
    if "slopes" in content:
        slopes, compliance, missed = (content[name] for name in WEIGHTS)
        weights = Weights(slopes, compliance, float(header["lag_s"]), missed)
    estimator = Estimator(model, weights)
    for name, array in zip(ARRAYS, estimator.state.arrays, strict=True):
        if content[name].dtype != array.dtype:
            raise SnapshotError(f"{path}: {name} has another layout", RELEARN)
    estimator.state = State(*(content[name] for name in ARRAYS))
    estimator.origin_us, estimator.turns = header["origin_us"], int(header["turns"])
    estimator.due_s = float(header["due_s"])
    estimator.folds = [_fold(content, k) for k in range(model.upkeep.folds)]
    if estimator.history is not None and "history_rows" in content:
        stored = {k: a for k, a in content.items() if k.startswith("history_")}
        kept = {name.removeprefix("history_"): array for name, array in stored.items()}
        estimator.history = History.from_arrays(kept)
    return estimator


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and arrays of a file whose seal is whole."""
    whole = path.read_bytes()
    content, seal = whole[: -SEAL.size], whole[-SEAL.size :]
    if len(seal) < SEAL.size or SEAL.unpack(seal) != (MARK, zlib.crc32(content)):
        raise SnapshotError(f"{path}: not a snapshot of rtid, or damaged", RELEARN)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            return header, {name: file[name] for name in file.files if name != "header"}
    except (ValueError, KeyError, OSError, EOFError, BadZipFile) as error:
        raise SnapshotError(f"{path}: not a snapshot of rtid ({error})", RELEARN) from error


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


@dataclass(frozen=True)
class Restored:
    """What a start found: the estimator or None, in words, and each file that was of no use."""

    estimator: Estimator | None
    text: str
    refused: tuple[str, ...] = ()


class Generations:
    """The last two snapshots of a folder, `state-0.npz` and `state-1.npz`, written in turn."""

    def __init__(self, folder: Path, digest: str) -> None:
        self._folder, self._digest = folder, digest
        self._serial: int | None = None

    def path(self, serial: int) -> Path:
        """Where the snapshot of this number goes."""
        return self._folder / f"state-{serial % 2}.npz"

    def save(self, estimator: Estimator) -> Path:
        """Replace the older one; OSError where the disk does not take it."""
        if self._serial is None:
            self._serial = max((serial for serial, _ in self._whole()[0]), default=0)
        path = self.path(self._serial + 1)
        save(path, estimator, self._digest, self._serial + 1)
        self._serial += 1
        return path

    def set_aside(self) -> None:
        """Keep what there is under another name: the next start finds nothing."""
        for path in (self.path(0), self.path(1)):
            if path.exists():
                os.replace(path, path.with_suffix(".before.npz"))

    def restore(self, model: Model) -> Restored:
        """The newest whole snapshot of this project; further ones are written behind it.

        What belongs to another project or schema is kept under another name, never overwritten.
        """
        found, damaged = self._whole()
        for path in damaged:
            os.replace(path, path.with_suffix(".refused.npz"))
        refused = list(damaged.values())
        for serial, path in sorted(found, reverse=True):
            self._serial = max(self._serial or 0, serial)
            try:
                return Restored(load(path, model, self._digest), path.name, tuple(refused))
            except SnapshotError as error:
                refused.append(str(error))
        return Restored(None, "fresh", tuple(refused))

    def _whole(self) -> tuple[list[tuple[int, Path]], dict[Path, str]]:
        """Serials of the snapshots that are whole and ours, and why the others are not."""
        found: list[tuple[int, Path]] = []
        refused: dict[Path, str] = {}
        for path in (self.path(0), self.path(1)):
            try:
                header, _ = _read(path)
                _check(path, header, self._digest)
                found.append((int(header["serial"]), path))
            except FileNotFoundError:
                continue
            except SnapshotError as error:
                refused[path] = str(error)
        return found, refused
