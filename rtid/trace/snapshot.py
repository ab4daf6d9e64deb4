"""Snapshots: the estimator's whole memory in one file, with schema, restore key and CRC.

A snapshot continues bit for bit; it is refused where it belongs to another project or schema, or
where a single byte of it is wrong.  The file is an npz without its words of zeros, with its CRC-32
behind it.  `Generations` keeps the last two: whatever happens while one is written, the other one
is whole.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from rtid.errors import RtidError, door
from rtid.estimator.estimator import Estimator
from rtid.estimator.ring import History
from rtid.estimator.state import State, Weights
from rtid.estimator.sums import Sums
from rtid.model import Machine
from rtid.trace import points
from rtid.trace.squeezed import squeezed, unsqueezed
from rtid.trace.state_files import made_folder, name_also, read_bytes, rename, write_whole

SCHEMA = 4
RELEARN = "learn again with `rtid replay` or `rtid run`"
SEAL = struct.Struct("<4sL")  # behind the content: mark, CRC-32 of all bytes before
MARK = b"RTID"
FOLD = ("shared", "blocks", "pairs", "tiles", "noise", "rows", "compliance", "innovation")
WEIGHTS = ("slopes", "compliance", "missed")
WATCH_FILE = "watch.json"  # why nothing is learned, while that is so
ARRAYS = ("engine", "cells", "closed", "blocks", "pairs")


class SnapshotError(RtidError):
    """The file is no snapshot, or one of another project, schema or program version."""


@door
def save(
    path: str | Path,
    estimator: Estimator,
    digest: str,
    serial: int = 0,
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write a snapshot; the file appears whole or not at all, and is on the disk on return.

    serial: number of the snapshot, for `Generations`; notes: JSON that `notes_of` gives back.
    """
    header = {
        "schema": SCHEMA,
        "digest": digest,
        "serial": serial,
        "notes": dict(notes or {}),
        "origin_us": estimator.origin_us,
        "turns": estimator.turns,
        "due_s": -math.inf if estimator.due_us is None else 1e-6 * estimator.due_us,
        "noise": {signal.name: signal.noise for signal in estimator.model.signals},
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
    np.savez(memory, **arrays)
    content = squeezed(memory.getvalue())
    write_whole(Path(path), content + SEAL.pack(MARK, zlib.crc32(content)))


def notes_of(path: Path) -> dict[str, Any]:
    """The notes that a snapshot was saved with.  Raises SnapshotError, FileNotFoundError."""
    notes: dict[str, Any] = _read(path)[0].get("notes", {})
    return notes


@door
def load(path: str | Path, model: Machine, digest: str) -> Estimator:
    """Restore an estimator, with the sensors' noise that it was learned with.

    The project may have left that noise to be estimated from the trace.  Raises SnapshotError with
    the reason, FileNotFoundError.
    """
    path = Path(path)
    header, content = _read(path)
    _check(path, header, digest)
    model = model.with_noise(header.get("noise", {}))
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
    due_s = float(header["due_s"])
    estimator.due_us = round(1e6 * due_s) if math.isfinite(due_s) else None
    estimator.folds = [_fold(content, k) for k in range(model.upkeep.folds)]
    if estimator.history is not None and "history_rows" in content:
        stored = {k: a for k, a in content.items() if k.startswith("history_")}
        kept = {name.removeprefix("history_"): array for name, array in stored.items()}
        estimator.history = History.from_arrays(kept)
    return estimator


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and arrays of a file whose seal is whole."""
    try:
        whole = read_bytes(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise SnapshotError(f"{path}: cannot be read ({error.strerror})", RELEARN) from error
    content, seal = whole[: -SEAL.size], whole[-SEAL.size :]
    if len(seal) < SEAL.size or SEAL.unpack(seal) != (MARK, zlib.crc32(content)):
        raise SnapshotError(f"{path}: not a snapshot of rtid, or damaged", RELEARN)
    try:
        with np.load(io.BytesIO(unsqueezed(content)), allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            return header, {name: file[name] for name in file.files if name != "header"}
    except (ValueError, KeyError, OSError, EOFError, BadZipFile) as error:
        raise SnapshotError(f"{path}: not a snapshot of rtid ({error})", RELEARN) from error


def _of_maps(estimator: Estimator) -> int:
    """A checksum of all that was learned of the maps; standstill adds to the shared part alone."""
    seal = 0
    state = estimator.state
    for blocks, tiles in [
        (state.blocks, state.pairs["gram"]),
        *((fold.blocks, fold.tiles) for fold in estimator.folds),
    ]:
        seal = zlib.crc32(blocks["gram"].tobytes(), seal)
        seal = zlib.crc32(tiles.tobytes(), seal)
    return seal


def _fold(content: dict[str, Any], k: int) -> Sums:
    parts = {name: content[f"fold{k}_{name}"] for name in FOLD}
    return Sums(**parts | {"rows": float(parts["rows"])})


def _check(path: Path, header: dict[str, object], digest: str) -> None:
    if header.get("schema") != SCHEMA:
        raise SnapshotError(f"{path}: schema {header.get('schema')}, this program reads {SCHEMA}")
    if header.get("digest") != digest:
        raise SnapshotError(
            f"{path}: learned with another project (machine, signals, DBC or grid differ)",
            "use the project file that made it, or learn again with `rtid replay`",
        )


@dataclass(frozen=True)
class Restored:
    """What a start found: the estimator or None, in words, and each file that was of no use."""

    estimator: Estimator | None
    text: str
    refused: tuple[str, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)


class Generations:
    """The last two snapshots of a project, `DIGEST/state-0.npz` and `-1`, written in turn.

    Each restore key has a folder of its own in the state folder: a switch to another project, or
    back, deletes nothing.
    """

    def __init__(self, folder: Path, digest: str) -> None:
        self.folder, self._above, self._digest = folder / digest, folder, digest
        self._serial: int | None = None
        self._seal = 0  # of the maps' sums that were last written
        self._shadow_seal: int | None = None

    def path(self, serial: int) -> Path:
        """Where the snapshot of this number goes."""
        return self.folder / f"state-{serial % 2}.npz"

    def save(
        self, estimator: Estimator, if_changed: bool = False, notes: Mapping[str, Any] | None = None
    ) -> Path:
        """Replace the older one; OSError where the disk does not take it.

        if_changed: not where the maps' sums are those of the last one, as at standstill.
        """
        seal = _of_maps(estimator)
        if if_changed and self._serial is not None and seal == self._seal:
            return self.path(self._serial)
        if self._serial is None:
            self._serial = max((serial for serial, _ in self._whole()[0]), default=0)
        made_folder(self.folder)
        path = self.path(self._serial + 1)
        save(path, estimator, self._digest, self._serial + 1, notes)
        self._serial, self._seal = self._serial + 1, seal
        self.drop_shadow()
        return path

    def save_shadow(
        self, estimator: Estimator, notes: Mapping[str, Any], if_changed: bool = False
    ) -> Path:
        """Keep what is learned while the baseline has still to foretell the motion; OSError.

        It goes on from there after a kill, until a snapshot takes its place.
        """
        seal = _of_maps(estimator)
        if not (if_changed and seal == self._shadow_seal):
            made_folder(self.folder)
            save(self.shadow_path, estimator, self._digest, notes=notes)
            self._shadow_seal = seal
        return self.shadow_path

    def drop_shadow(self) -> None:
        """What was learned unproven is not to be gone on with, or a snapshot has it; OSError."""
        self.shadow_path.unlink(missing_ok=True)
        self._shadow_seal = None

    def shadow(self, model: Machine) -> Restored:
        """What was learned without proof, with its notes; of no use without its baseline."""
        return self._beside(self.shadow_path, model)

    @property
    def baseline_path(self) -> Path:
        """Where the state lies that is published, and held against the machine at a start."""
        return self.folder / "baseline.npz"

    @property
    def shadow_path(self) -> Path:
        """Where the state lies that was learned before the baseline had proven itself."""
        return self.folder / "shadow.npz"

    def save_baseline(self, estimator: Estimator, notes: Mapping[str, Any]) -> None:
        """Replace the baseline; OSError."""
        made_folder(self.folder)
        save(self.baseline_path, estimator, self._digest, notes=notes)

    def await_trust(self, path: Path) -> None:
        """Keep a snapshot, which is soon written over, until it is known whether to trust it."""
        name_also(path, self._waiting_path)

    def waiting(self, model: Machine) -> Restored:
        """The snapshot that a run before has kept so."""
        return self._beside(self._waiting_path, model)

    def trust(self) -> None:
        """Make the snapshot that is kept so the baseline: no byte is written again; OSError."""
        rename(self._waiting_path, self.baseline_path)
        self.distrust()  # two names of one file: neither was renamed

    def distrust(self) -> None:
        """Let the snapshot that is kept so go; OSError."""
        self._waiting_path.unlink(missing_ok=True)

    @property
    def _waiting_path(self) -> Path:
        return self.folder / "waiting.npz"

    def baseline(self, model: Machine) -> Restored:
        """The baseline with its notes; none where there is none, or where it is damaged."""
        return self._beside(self.baseline_path, model)

    def _beside(self, path: Path, model: Machine) -> Restored:
        try:
            return Restored(load(path, model, self._digest), path.name, notes=notes_of(path))
        except FileNotFoundError:
            return Restored(None, "none")
        except SnapshotError as error:
            return Restored(None, "none", (str(error),))

    def newest(self) -> Path | None:
        """The newest whole snapshot."""
        whole = self._whole()[0]
        return max(whole)[1] if whole else None

    def keep(self, reason: str) -> Path | None:
        """Make a point in time of the newest whole snapshot; OSError.

        None where there is none, or a young point of that reason.
        """
        now_s = time.time()
        if not points.is_due(self.folder, reason, now_s) or (path := self.newest()) is None:
            return None
        return points.keep(self.folder, path, reason, now_s).path

    def set_aside(self, reason: str) -> None:
        """Keep what there is as a point in time: the next start finds nothing.  OSError."""
        self.keep(reason)
        for path in (self.path(0), self.path(1), self.baseline_path, self.folder / WATCH_FILE):
            path.unlink(missing_ok=True)
        self.distrust()
        self.drop_shadow()

    def go_back(self, point: points.KeptPoint, model: Machine) -> None:
        """Make a point in time the state to go on with, and the baseline.

        What stands is kept as a point itself.  Raises SnapshotError, OSError.
        """
        estimator, notes = load(point.path, model, self._digest), notes_of(point.path)
        self.keep("restore")
        self.save(estimator)
        self.save_baseline(estimator, notes)
        (self.folder / WATCH_FILE).unlink(missing_ok=True)

    def restore(self, model: Machine) -> Restored:
        """The newest whole snapshot of this project; further ones are written behind it.

        Where the run before was ended while its baseline had still to prove itself, its shadow.
        What is damaged, or of another schema, is kept under another name, never overwritten.
        """
        whole, damaged = self._whole()
        for path in damaged:
            os.replace(path, path.with_suffix(".refused.npz"))
        refused = [*damaged.values(), *self._of_before()]
        shadow = self.shadow(model)
        refused += shadow.refused
        if shadow.estimator is not None and self.baseline(model).estimator is not None:
            return Restored(shadow.estimator, shadow.text, tuple(refused), shadow.notes)
        for serial, path in sorted(whole, reverse=True):
            self._serial = max(self._serial or 0, serial)
            try:
                return Restored(load(path, model, self._digest), path.name, tuple(refused))
            except SnapshotError as error:
                refused.append(str(error))
        kept = self.baseline(model)
        if kept.estimator is not None:
            return Restored(kept.estimator, kept.text, tuple(refused))
        return Restored(None, "fresh" + self._others(), tuple(refused))

    def _of_before(self) -> list[str]:
        """Snapshots of a program whose key did not cover what feeds the samples; they stay."""
        return [
            f"{path}: learned before scale, offset, sign and place of the signals were part of its "
            "key: nobody can say whether they were the same"
            for path in sorted(self._above.glob("state-[01].npz"))
        ]

    def _others(self) -> str:
        """Who else keeps a state here."""
        names = sorted(path.parent.name for path in self._above.glob("*/state-[01].npz"))
        others = [name for name in dict.fromkeys(names) if name != self._digest]
        return f"; kept for other project files: {', '.join(others)}" if others else ""

    def _whole(self) -> tuple[list[tuple[int, Path]], dict[Path, str]]:
        """Serials of the snapshots that are whole and ours, and why the others are not."""
        whole: list[tuple[int, Path]] = []
        refused: dict[Path, str] = {}
        for path in (self.path(0), self.path(1)):
            try:
                header, _ = _read(path)
                _check(path, header, self._digest)
                whole.append((int(header["serial"]), path))
            except FileNotFoundError:
                continue
            except SnapshotError as error:
                refused[path] = str(error)
        return whole, refused
