"""Replay = live: the same frames from a log, over a bus or cut in pieces give the same memory."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.frames import Frames
from firmware_bridge.sources import candump, open_log
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.project import Project, load
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.study.replay import replay
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from rtid.trace.reading import read_trace
from rtid.trace.snapshot import SnapshotError
from rtid.trace.snapshot import load as load_snapshot
from rtid.trace.snapshot import save as save_snapshot

DURATION_S = 12.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Project]:
    """A short record of a random machine: its log and its project."""
    run = simulate(draw(3), "rich", 3, DURATION_S)
    trace, _, project = write_run(tmp_path_factory.mktemp("run") / "machine.blf", run, 3, "rich")
    return trace, load(project)


def same_memory(a: Estimator, b: Estimator) -> bool:
    """Every byte of the two estimators' states is equal."""
    pairs = zip(a.state.arrays, b.state.arrays, strict=True)
    return all(np.array_equal(x.view(np.uint8), y.view(np.uint8)) for x, y in pairs)


def learned(project: Project, frames: Frames, size: int) -> Estimator:
    """The estimator after the frames in batches of `size`."""
    learner = Learner(project.model, catalog_of(project), project.assembly)
    for part in frames.chunks(size):
        learner.push(part)
    learner.finish()
    return learner.estimator


@pytest.mark.parametrize("size", [7, 4096])
def test_batches_of_frames_make_no_difference(recorded: tuple[Path, Project], size: int) -> None:
    trace, project = recorded
    frames = open_log(trace)[: 3 * 4000]
    assert same_memory(learned(project, frames, size), learned(project, frames, len(frames)))


def test_bus_and_log_give_the_same_memory(recorded: tuple[Path, Project]) -> None:
    trace, project = recorded
    from_log = replay(project, trace)
    from_bus = replay(project, trace, bus_speed=float("inf"))
    assert from_log.live.counters["rows"] > 11_000
    assert same_memory(from_log.live, from_bus.live)


def test_replay_finds_the_machine(recorded: tuple[Path, Project]) -> None:
    trace, project = recorded
    told: list[tuple[str, float]] = []
    found = replay(project, trace, lambda text, share: told.append((text, share)))
    truth = json.loads(trace.with_suffix(".truth.json").read_text())
    solution = found.fit.solution
    # 9 s of rich motion: the declared modulus is up to 30 % off, the found one below 2 %
    assert np.abs(solution.beta_pa / truth["beta_pa"] - 1).max() < 0.02
    assert np.abs((solution.beta_pa - truth["beta_pa"]) / solution.beta_sd_pa).max() < 4
    assert found.fit.lag_s == pytest.approx(truth["lag_s"], abs=1e-4)
    assert 0.9 < solution.rho < 1.15
    assert told[0][1] == 0.0 and told[-1] == ("done", 1.0)


def test_snapshot_continues_bit_for_bit(recorded: tuple[Path, Project], tmp_path: Path) -> None:
    trace, project = recorded
    samples = read_trace(project, trace).samples
    first, second = samples.between(0, 5), samples.between(5, 9)
    whole = Estimator(project.model)
    whole.update(first)
    save_snapshot(tmp_path / "memory.npz", whole, project.digest)
    restored = load_snapshot(tmp_path / "memory.npz", project.model, project.digest)
    assert same_memory(whole, restored)
    for estimator in (whole, restored):
        estimator.update(second)
    assert same_memory(whole, restored)


def test_snapshot_of_another_project_is_refused(
    recorded: tuple[Path, Project], tmp_path: Path
) -> None:
    _, project = recorded
    save_snapshot(tmp_path / "memory.npz", Estimator(project.model), "another")
    with pytest.raises(SnapshotError, match="another project"):
        load_snapshot(tmp_path / "memory.npz", project.model, project.digest)


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"x" * 99])
def test_damaged_snapshot_is_refused(
    recorded: tuple[Path, Project], tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    _, project = recorded
    path = tmp_path / "memory.npz"
    save_snapshot(path, Estimator(project.model), project.digest)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SnapshotError, match="not a snapshot"):
        load_snapshot(path, project.model, project.digest)


def test_trace_without_a_wanted_frame_says_what_it_holds(
    recorded: tuple[Path, Project], tmp_path: Path
) -> None:
    trace, project = recorded
    frames = open_log(trace)[:300]
    frames.can_id[:] = 0x7FF
    candump.write(tmp_path / "foreign.log", frames)
    with pytest.raises(RtidError, match=r"no complete sample in 300 frames.*0x7FF \(300\)"):
        replay(project, tmp_path / "foreign.log")


def test_bus_needs_frames(recorded: tuple[Path, Project], tmp_path: Path) -> None:
    project = recorded[1]
    run = simulate(draw(3), "rich", 3, 1.0)
    table = write_run(tmp_path / "machine.parquet", run, 3, "rich")[0]
    with pytest.raises(RtidError, match="no frames for a bus"):
        replay(project, table, bus_speed=1.0)
