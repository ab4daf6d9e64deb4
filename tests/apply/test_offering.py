"""What is offered: only what has beaten the held map on samples that neither has learned from."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from firmware_bridge.lookup import crc32
from rtid.apply import offer as offered
from rtid.apply.judge import KnownMap, judge
from rtid.apply.plan import ApplyError, prepare
from rtid.apply.session import ANY_ROOM, Plan, apply_map
from rtid.apply.versions import DONE, Applied, VersionRow
from rtid.apply.wish import Wish
from rtid.daemon.jobs import Publication
from rtid.daemon.offering import Offering
from rtid.errors import RtidError
from rtid.estimator.chunk import to_chunk
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.maps.files import provenance, write_map
from rtid.plain import FloatArray
from rtid.project import Project, load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.described import catalog_of
from rtid.trace.learner import Learner
from tests.replays import shared_replays  # noqa: F401

SECONDS, ROUGH_S, GOOD_S = 56.0, 8.0, 30.0


@dataclass(frozen=True)
class Machine:
    """A project with a short judge_s, two solutions, and the samples that are behind both."""

    project: Project
    rough: Solution
    good: Solution
    known: FloatArray
    unseen: FloatArray


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    folder = tmp_path_factory.mktemp("machine")
    run = simulate(SimulatedPlant(), "rich", seed=4, duration_s=SECONDS)
    write_run(folder / "m.parquet", run, 4, "rich")
    path = folder / "m.toml"
    document = tomlkit.parse(path.read_text("utf-8"))
    document.add("publish", tomlkit.item({"can_id": 0x700, "reply_id": 0x701, "judge_s": 20.0}))
    path.write_text(tomlkit.dumps(document), "utf-8")
    project = load(path)
    learner = Learner(project.model, catalog_of(project), project.assembly)
    chunk = to_chunk(project.model, run.samples, int(run.samples.t_us[0]))
    solutions, at_s = [], 0.0
    for end_s in (ROUGH_S, GOOD_S):
        part = chunk[(chunk[:, 0] >= at_s) & (chunk[:, 0] < end_s)]
        learner.estimator.advance(part)
        solutions.append(learner.estimator.solution())
        at_s = end_s
    seen = chunk[:, 0] < GOOD_S
    rough, good = solutions
    return Machine(project, rough, good, chunk[seen], chunk[~seen])


def known(solution: Solution) -> KnownMap:
    return KnownMap(publish(solution), solution.beta_pa)


def publication(solution: Solution) -> Publication:
    return Publication(
        1, publish(solution), solution.beta_pa, solution.beta_sd_pa, 1.0, 0.0, (), 0.0
    )


def hold(folder: Path, version: int, project: Project, solution: Solution) -> None:
    """Write down that this is what the controller holds."""
    it, applied = known(solution), Applied(folder)
    images = prepare(project, it, solution.beta_sd_pa, ANY_ROOM).images
    applied.keep(version, images, it.flow_map, {"beta_pa": it.beta_pa.tolist()})
    crcs = {slot: crc32(data) for slot, data in images.items()}
    applied.note(VersionRow(time.time(), version, version, "me", crcs, DONE, {}))


def pieces(chunk: FloatArray) -> list[FloatArray]:
    return [chunk[k : k + 200] for k in range(0, len(chunk), 200)]


def test_the_better_map_wins_and_the_same_or_a_worse_one_does_not(machine: Machine) -> None:
    model, rough, good = machine.project.model, known(machine.rough), known(machine.good)
    better = judge(model, machine.unseen, rough, good, 1.0)
    worse = judge(model, machine.unseen, good, rough, 1.0)
    same = judge(model, machine.unseen, good, good, 1.0)
    print(f"\nbetter: {better.reason}; worse: {worse.reason}")
    assert better.is_better and better.blocks > 20 and better.t > 3
    assert not worse.is_better and worse.t < 0
    assert not same.is_better and same.gain_percent == 0
    assert judge(model, machine.unseen, None, rough, 1.0).is_better
    assert not judge(model, machine.unseen, rough, good, 99.9).is_better


def test_standstill_judges_nothing(machine: Machine) -> None:
    still = machine.unseen.copy()
    still[:, 2:] = still[0, 2:]
    noise = np.random.default_rng(0).standard_normal(len(still))
    still[:, 2 + machine.project.model.column("x")] += 1e-5 * noise
    found = judge(machine.project.model, still, known(machine.rough), known(machine.good), 1.0)
    assert not found.is_better and "of motion" in found.reason


def test_a_map_by_chance_as_good_is_rarely_offered(machine: Machine) -> None:
    """The same map with flows changed by nothing that matters, 20 times: no offer."""
    rng, base = np.random.default_rng(1), known(machine.good)
    from dataclasses import replace

    for _ in range(20):
        edges = tuple(
            replace(e, theta=e.theta * (1 + 1e-5 * rng.standard_normal(e.theta.shape)))
            for e in base.flow_map.edges
        )
        other = KnownMap(replace(base.flow_map, edges=edges), base.beta_pa)
        assert not judge(machine.project.model, machine.unseen, base, other, 1.0).is_better


def test_the_first_map_is_offered_after_unseen_motion_only(
    machine: Machine, tmp_path: Path
) -> None:
    offering = Offering(machine.project, tmp_path)
    for piece in pieces(machine.known):  # before there is a candidate: never used
        assert offering.push(piece) is None
    offering.published(publication(machine.good), machine.good)
    judged = [found for piece in pieces(machine.unseen) if (found := offering.push(piece))]
    assert len(judged) == 1 and judged[0].seconds == pytest.approx(20.0, abs=0.5)
    assert judged[0].against == "no map" and offered.exists(tmp_path)
    made = offered.read(tmp_path)
    assert made.against is None and made.judgement["is_better"]
    assert "20 s of motion" in made.sentence() or "19 s" in made.sentence()
    np.testing.assert_array_equal(made.known.beta_pa, machine.good.beta_pa)
    assert "residual" in offered.as_text(tmp_path)
    offered.withdraw(tmp_path)
    assert offered.as_text(tmp_path) == ""


@pytest.mark.parametrize("held_is_good", [False, True])
def test_it_must_beat_the_held_one(machine: Machine, tmp_path: Path, held_is_good: bool) -> None:
    held, new = (machine.good, machine.rough) if held_is_good else (machine.rough, machine.good)
    hold(tmp_path, 4, machine.project, held)
    offering = Offering(machine.project, tmp_path)
    offering.published(publication(new), new)
    for piece in pieces(machine.unseen):
        offering.push(piece)
    assert offering.last is not None and offering.last.against == "held map"
    assert offered.exists(tmp_path) is not held_is_good
    if not held_is_good:
        assert offered.read(tmp_path).against == 4


def test_without_a_way_to_the_controller_nothing_is_judged(
    machine: Machine, tmp_path: Path
) -> None:
    from dataclasses import replace

    closed = machine.project.sections.publish.model_copy(update={"can_id": None})
    project = replace(machine.project, sections=replace(machine.project.sections, publish=closed))
    offering = Offering(project, tmp_path)
    offering.published(publication(machine.good), machine.good)
    for piece in pieces(machine.unseen):
        assert offering.push(piece) is None
    assert not offered.exists(tmp_path)


@pytest.mark.slow
def test_a_map_from_a_file_is_judged_on_a_trace(machine: Machine, tmp_path: Path) -> None:
    """`rtid apply --map FILE --against TRACE`: a dry run, from the records."""
    trace, path = machine.project.path.with_suffix(".parquet"), machine.project.path
    files = {}
    for name, solution, source in (
        ("rough", machine.rough, "other.blf"),
        ("good", machine.good, "other.blf"),
        ("own", machine.good, trace.name),
    ):
        files[name] = tmp_path / f"{name}.npz"
        told = provenance(solution, "m", machine.project.digest, source)
        write_map(files[name], publish(solution), told)
    (tmp_path / "state").mkdir()
    hold(tmp_path / "state", 1, machine.project, machine.rough)

    def plan(name: str, against: Path | None = trace) -> Plan:
        wish = Wish(map_file=files[name], against=against, dry_run=True, state=tmp_path / "state")
        return apply_map(path, wish, lambda plan: True)[0]

    assert "Judged on" in plan("good").why
    with pytest.raises(ApplyError, match="does not beat the held map"):
        plan("rough")
    with pytest.raises(RtidError, match="must be judged"):
        plan("good", None)
    assert int(plan("own").why.split(", ")[1].split(" ")[0]) <= 14  # its validation part alone
    document = tomlkit.parse(path.read_text("utf-8"))
    document.remove("record")
    whole = path.with_name("whole.toml")
    whole.write_text(tomlkit.dumps(document), "utf-8")
    wish = Wish(map_file=files["own"], against=trace, dry_run=True, state=tmp_path / "state")
    with pytest.raises(ApplyError, match="cannot judge it"):
        apply_map(whole, wish, lambda plan: True)
