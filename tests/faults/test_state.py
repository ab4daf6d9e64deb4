"""Faults of the stored state: torn, damaged, of another schema, grid or machine."""

from __future__ import annotations

import io
import os
import random
import signal
import time
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rtid.estimator.estimator import Estimator
from rtid.trace import snapshot as store
from rtid.trace.snapshot import Generations
from rtid.trace.squeezed import unsqueezed
from tests.faults.conftest import Figure
from tests.faults.harness import drift, machine

SLOTS = ("state-0.npz", "state-1.npz")


@cache
def learned() -> Estimator:
    """After 5 s, without the ring of samples, as the daemon stores it."""
    estimator = machine().learned(machine().frames[:15_000]).estimator
    estimator.history = None
    return estimator


def fill(folder: Path) -> tuple[Generations, list[Path]]:
    """Two generations; the paths, the older first."""
    generations = Generations(folder, machine().project.digest)
    return generations, [generations.save(learned()) for _ in range(2)]


def restored(folder: Path) -> store.Restored:
    return Generations(folder, machine().project.digest).restore(machine().project.model)


def same(result: store.Restored) -> bool:
    return (
        result.estimator is not None
        and result.estimator.state.memory.tobytes() == learned().state.memory.tobytes()
    )


def test_what_is_restored_goes_on_bit_for_bit(tmp_path: Path) -> None:
    fill(tmp_path)
    found = restored(tmp_path)
    assert same(found) and found.text == SLOTS[0]  # the second one written has number 2
    rest = machine().frames[15_000:20_000]
    whole, again = machine().learner(), machine().learner()
    for learner, estimator in ((whole, learned().copy()), (again, found.estimator)):
        assert estimator is not None
        learner.estimator = estimator
        learner.push(rest)
    assert whole.estimator.state.memory.tobytes() == again.estimator.state.memory.tobytes()


def test_a_snapshot_of_a_program_before_is_read(tmp_path: Path) -> None:
    """It was an npz that was deflated."""
    _, (_, newest) = fill(tmp_path)
    whole = newest.read_bytes()
    with np.load(io.BytesIO(unsqueezed(whole[: -store.SEAL.size]))) as file:
        deflated = io.BytesIO()
        np.savez_compressed(deflated, **file)
    content = deflated.getvalue()
    newest.write_bytes(content + store.SEAL.pack(store.MARK, zlib.crc32(content)))
    assert same(restored(tmp_path)) and len(whole) < 1.2 * len(content)


def test_row_17_cut_every_512_bytes(tmp_path: Path, figure: Figure) -> None:
    _, (_, newest) = fill(tmp_path)
    content, lost = newest.read_bytes(), 0
    for size in range(0, len(content), 512):
        newest.write_bytes(content[:size])
        try:
            store._read(newest)
            lost += 1
        except store.SnapshotError:
            continue
    figure(17, f"of {len(content) // 512} cuts taken for whole", lost, 0)
    newest.write_bytes(content[: len(content) // 2])
    found = restored(tmp_path)
    assert same(found) and found.text == SLOTS[1] and len(found.refused) == 1


def test_row_17_flipped_bytes(tmp_path: Path, figure: Figure) -> None:
    _, (_, newest) = fill(tmp_path)
    content, rng, taken = newest.read_bytes(), np.random.default_rng(17), 0
    for at in rng.choice(len(content), 500, replace=False):
        wrong = bytearray(content)
        wrong[at] ^= int(rng.integers(1, 256))
        newest.write_bytes(wrong)
        try:
            store._read(newest)
            taken += 1
        except store.SnapshotError:
            pass
    figure(17, "of 500 flipped bytes taken for whole", taken, 0)


@pytest.mark.faults
def test_row_17_killed_while_saving(tmp_path: Path, figure: Figure) -> None:
    """200 times: a child saves as fast as it can and is killed at random."""
    generations, _ = fill(tmp_path)
    chance, unusable, behind = random.Random(17), 0, 0
    told = tmp_path / "told"
    for _ in range(200):
        child = os.fork()
        if child == 0:  # only saves: no pytest, no exit handlers
            try:
                while True:
                    path = generations.save(learned())
                    told.write_text(str(generations._serial))
                    assert path.exists()
            finally:
                os._exit(1)
        time.sleep(chance.uniform(0.0, 0.12))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = Generations(tmp_path, machine().project.digest)
        whole, _ = found._whole()
        newest = max((serial for serial, _ in whole), default=0)
        unusable += not whole
        last_told = told.read_text() if told.exists() else ""
        behind += bool(last_told) and newest < int(last_told)
        generations._serial = newest
    figure(17, "of 200 kills without a whole snapshot", unusable, 0)
    figure(17, "of 200 kills that lost more than the snapshot in the making", behind, 0)
    assert same(restored(tmp_path))


@pytest.mark.parametrize("other", ["schema", "grid", "machine", "garbage", "empty"])
def test_row_19_state_of_another(
    other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    """Nothing is taken silently: the refusal has a reason, and the file is kept aside."""
    model, digest = machine().project.model, machine().project.digest
    path = Generations(tmp_path, digest).path(1)
    path.parent.mkdir()
    if other == "schema":
        monkeypatch.setattr(store, "SCHEMA", store.SCHEMA + 1)
        store.save(path, learned(), digest, 1)
        monkeypatch.undo()
    elif other == "grid":
        from rtid.project.build import digest as digest_of

        edges = (replace(model.edges[0], rated_q_m3s=2 * model.edges[0].rated_q_m3s),
                 *model.edges[1:])  # fmt: skip
        store.save(path, learned(), digest_of(replace(model, edges=edges)), 1)
    elif other == "machine":
        store.save(path, learned(), "0" * 16, 1)
    else:
        path.write_bytes(b"" if other == "empty" else os.urandom(10_000))
    found = restored(tmp_path)
    figure(19, f"silent loads ({other})", int(found.estimator is not None), 0)
    assert len(found.refused) == 1 and str(path) in found.refused[0]
    assert path.with_suffix(".refused.npz").exists()


def test_row_17_restarts_lose_what_was_not_saved(figure: Figure) -> None:
    """Saved every 6 s, killed twice 1 s after a save: the map is nearly as without a kill."""
    whole = machine().learned(machine().frames).estimator.solution()
    learner = machine().learner()
    saved = learner.estimator.copy()
    for k, part in enumerate(machine().frames.chunks(18_000)):
        if k in (3, 6):
            learner = machine().learner()
            learner.estimator = saved
            learner.push(part[3000:])
        else:
            learner.push(part)
        saved = learner.estimator.copy()
    figure(17, "drift with 2 restarts that lost 1 s each",
           drift(whole, learner.estimator.solution()), 0.01)  # fmt: skip
