"""The guard of the good map: faults in a run, while the daemon was down and before a kill.

`make campaign` runs the whole table on RTID_GUARD_MACHINES machines and 60 healthy restarts; the
machines' numbers are not those that the thresholds were derived with (1 to 3).
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rtid.daemon import jobs
from rtid.daemon.diagnoser import diagnose
from rtid.estimator.estimator import Estimator
from rtid.estimator.published import publish
from rtid.model import Term
from rtid.sim.bus import run_frames
from rtid.sim.run import Run, SimulationError
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.learner import Learner
from rtid.trace.snapshot import Generations
from tests.campaign.guarding import FAULTS, PIECE, Bench, Fault, Simulated, leak, oil
from tests.campaign.report import leave
from tests.faults.harness import map_drift

MACHINES = int(os.environ.get("RTID_GUARD_MACHINES", "3"))
RESTARTS = int(os.environ.get("RTID_GUARD_RESTARTS", "60"))
FIRST, AT_ONCE = 9000, 2
SELDOM_S = 30.0  # between two publications, where hours are gone through: they take the time
HEALTHY_S, BEFORE_S, FAULT_S, BEFORE_KILL_S, KILLED_S = 120.0, 40.0, 60.0, 2.0, 90.0
BEGUN = ("in a run", "while down", "before a kill")

pytestmark = pytest.mark.campaign


class Taught:
    """A machine and the state folder of a healthy run, ended in good order."""

    def __init__(self, folder: Path, bench: Bench) -> None:
        self.bench, self._folder = bench, folder
        self.state = folder / "state"
        daemon = Simulated(self.bench, self.state, 0.0)
        daemon.hear(self.bench.run(HEALTHY_S, bench.seed))
        daemon.stop()
        self.solution, self.published = daemon.solution, daemon.published

    @classmethod
    def of(cls, folder: Path, seed: int, publish_s: float = 10.0) -> Taught:
        """The machine of a number."""
        return cls(folder, Bench.of(folder, seed).publishing(publish_s))

    def again(self, name: str) -> Simulated:
        """Another start on a copy of the state."""
        copy = self._folder / name
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.state, copy)
        return Simulated(self.bench, copy, HEALTHY_S + 100.0)


class Begun:
    """One start that has heard a healthy time; each case goes on from there in its own process."""

    def __init__(self, taught: Taught, folder: Path) -> None:
        self._taught, self._bench, self._folder = taught, taught.bench, folder
        shutil.copytree(taught.state, folder / "state")
        os.chdir(folder / "state")  # what is forked goes on in a copy of it
        self._daemon = Simulated(taught.bench, Path(), HEALTHY_S + 100.0)
        self._daemon.hear(self._run(FAULTS["leak of 2 %"], BEFORE_S), to_s=BEFORE_S)

    def _run(self, fault: Fault, healthy_s: float) -> Run:
        seed = self._bench.seed + (500 if healthy_s else 501)
        return self._bench.faulty(fault, healthy_s, healthy_s + FAULT_S, seed)

    def row(self, name: str, how: str) -> Row:
        """What becomes of a fault; only once in a process.

        The drift is against what was published when the fault began, and for a restart against
        what was published when the run before ended.
        """
        fault, daemon = FAULTS[name], self._daemon
        begins_s, before = BEFORE_S if how == "in a run" else 0.0, daemon.published
        if how == "while down":
            before, daemon = self._taught.published, self._taught.again(f"down-{os.getpid()}")
        else:
            daemon.branched(self._folder / f"case-{os.getpid()}")
        if how == "before a kill":
            daemon.hear(self._run(fault, BEFORE_S), BEFORE_S, BEFORE_S + BEFORE_KILL_S)
            daemon = daemon.killed()
        ending = map_drift(before, daemon.published)  # what the end of the run alone has cost
        daemon.hear(self._run(fault, begins_s), begins_s)
        return Row(
            name,
            how,
            self._bench.seed,
            daemon.alarm_s - begins_s,
            map_drift(before, daemon.published),
            ending,
            any(word in daemon.text for word in fault.names),
            daemon.core.learner.learns and not daemon.is_held,
            daemon.text.partition(". ")[2][:200],
        )


@dataclass(frozen=True)
class Row:
    """moved, ending: relative drift of the published map, in all and at the end of the run."""

    name: str
    how: str
    machine: int
    alarm_s: float
    moved: float
    ending: float
    is_named: bool
    learns: bool
    text: str

    @property
    def is_good(self) -> bool:
        """Whether it is as it must be."""
        held = self.moved <= 0.01 and not self.learns
        return 0 <= self.alarm_s <= 60 and self.is_named and held

    def __str__(self) -> str:
        return (
            f"{'ok ' if self.is_good else 'BAD'} machine {self.machine}, {self.name}, {self.how}: "
            f"alarm after {self.alarm_s:.1f} s, drift {100 * self.moved:.2f} %, of the end alone "
            f"{100 * self.ending:.2f} %, learns {self.learns}, named {self.is_named}: {self.text}"
        )


def figure(rows: Sequence[Row]) -> str:
    """Alarms and drifts of one fault in a line."""
    said = [f"{sum(row.is_good for row in rows)} of {len(rows)} as they must"]
    for how in BEGUN:
        mine = [row for row in rows if row.how == how]
        alarms = ", ".join(f"{row.alarm_s:.1f}" for row in mine)
        drifts = ", ".join(f"{100 * row.moved:.2f}" for row in mine)
        ends = ", ".join(f"{100 * row.ending:.2f}" for row in mine)
        of_end = "" if how == BEGUN[0] else f" ({ends} by the end of the run alone)"
        said.append(f"{how}: alarm after {alarms} s, drift {drifts} %{of_end}")
    return "; ".join(said)


class Forked:
    """A case in a process that is forked for it."""

    def __init__(self, begun: Begun, name: str, how: str) -> None:
        context = multiprocessing.get_context("fork")
        theirs, self._ours = context.Pipe()
        self._process = context.Process(target=lambda: theirs.send(begun.row(name, how)))
        self._process.start()
        theirs.close()

    def row(self) -> Row:
        """What it has found, when it is done."""
        try:
            answer: Row = self._ours.recv()
            return answer
        finally:
            self._process.join()


def test_a_fault_is_never_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[Row] = []
    for k in range(MACHINES):
        monkeypatch.chdir(tmp_path)  # and back at the end
        taught = Taught.of(made(tmp_path / str(k)), FIRST + k)
        begun = Begun(taught, made(tmp_path / f"begun-{k}"))
        cases = [*itertools.product(FAULTS, BEGUN)]
        for n in range(0, len(cases), AT_ONCE):
            for case in [Forked(begun, *names) for names in cases[n : n + AT_ONCE]]:
                rows.append(case.row())
                print(rows[-1], flush=True)
        shutil.rmtree(tmp_path / f"begun-{k}")
        shutil.rmtree(tmp_path / str(k))
    basis = f"machines {FIRST} to {FIRST + MACHINES - 1}, rich motion, saved every 30 s"
    for name in FAULTS:
        said = figure([row for row in rows if row.name == name])
        leave(f"guard: {name}", said, "named within 60 s, drift 1 %, none learned", basis)
    assert all(row.is_good for row in rows), "\n".join(str(r) for r in rows if not r.is_good)


def test_what_a_kill_costs_at_any_second(tmp_path: Path) -> None:
    """What would be published after it, against what is published, whatever was saved last."""
    costs: list[float] = []
    for k in range(MACHINES):
        taught = Taught.of(made(tmp_path / str(k)), FIRST + k)
        project, daemon = taught.bench.project, taught.again("run")
        generations, seen = Generations(daemon.folder, project.digest), (0, 0)
        run = taught.bench.run(KILLED_S, taught.bench.seed + 502)
        for second in range(round(KILLED_S)):
            daemon.hear(run, second, second + 1)
            file = generations.baseline_path.stat()
            if seen != (seen := (file.st_ino, file.st_mtime_ns)):
                estimator = generations.baseline(project.model).estimator
                assert estimator is not None
                trusted = publish(estimator.solution())
            costs.append(map_drift(daemon.published, trusted))
        print(f"machine {FIRST + k}: {100 * max(costs):.2f} %", flush=True)
    said = f"median {100 * np.median(costs):.2f} %, largest {100 * max(costs):.2f} %"
    basis = f"{len(costs)} seconds, saved every 30 s, machines that have learned for 2 min"
    leave("guard: the map that a kill costs, at any second", said, "1 %", basis)
    assert max(costs) <= 0.01


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def healthy_day(taught: Taught, rng: np.random.Generator) -> Run:
    """Another day: oil, load, motion and supply."""
    warmer_k, supply, load = rng.uniform(-20, 20), rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.2)
    plant = oil(taught.bench.plant, warmer_k)
    constants = plant.constants._replace(gravity_n=load * plant.constants.gravity_n)
    plant = replace(plant, constants=constants, p_supply_pa=supply * plant.p_supply_pa)
    motion = str(rng.choice(["rich", "sweep", "moves", "dither", "load"]))
    seed = int(rng.integers(1 << 30))
    return taught.bench.run(60.0, seed, motion, plant=plant)


def unguarded(taught: Taught, daemon: Simulated, run: Run) -> Estimator:
    """What is learned of a run from the same state where no guard stands between."""
    project = taught.bench.project
    learner = Learner(project.model, taught.bench.catalog, project.assembly)
    learner.estimator = daemon.core.learner.estimator.copy(with_history=False)
    for piece in run_frames(run, start_us=START_US + round(1e6 * daemon.begin_s)).chunks(PIECE):
        learner.push(piece)
    return learner.estimator


def apart(plain: Estimator, guarded: Estimator) -> float:
    """Drift between the maps of two estimates; nought where all that they know is the same."""
    pairs = zip(plain.state.arrays, guarded.state.arrays, strict=True)
    if all(mine.tobytes() == others.tobytes() for mine, others in pairs):
        return 0.0
    return map_drift(publish(plain.solution()), publish(guarded.solution()))


def test_a_healthy_day_is_not_refused(tmp_path: Path) -> None:
    """Nor does the guard cost any of what is learned meanwhile."""
    rng, alarms, late, costs = np.random.default_rng(18), list[str](), list[float](), [0.0]
    seeds = range(FIRST + 100, FIRST + 100 + MACHINES)
    benches = [Taught.of(made(tmp_path / str(seed)), seed, SELDOM_S) for seed in seeds]
    while len(late) < RESTARTS:
        taught = benches[len(late) % len(benches)]
        try:
            run = healthy_day(taught, rng)
        except SimulationError:  # it cavitates: no healthy day of this machine
            continue
        daemon = taught.again("day")
        plain = unguarded(taught, daemon, run)
        daemon.hear(run)
        alarms += [daemon.text] if np.isfinite(daemon.alarm_s) else []
        late.append(daemon.learning_s)
        if np.isfinite(daemon.learning_s):
            costs.append(apart(plain, daemon.core.learner.estimator))
        print(f"restart {len(late)}: learns after {late[-1]:.1f} s, {100 * costs[-1]:.3f} % from "
              f"the map without a guard {daemon.text}", flush=True)  # fmt: skip
    waited = sum(not np.isfinite(late_s) for late_s in late)
    said = f"{len(alarms)} alarms in {len(late)} restarts; learning after {np.nanmedian(late):.0f}"
    said += f" s (median), {np.nanmax(late):.0f} s at most, {waited} not within 60 s; the map is "
    said += f"{100 * max(costs):.3f} % at most from the one without a guard"
    limit = "0 alarms, 60 s, 1.1 times the error without it"
    basis = f"{len(benches)} machines; oil +-20 K, load and supply +-20 %, five motions of 60 s"
    leave("guard: restarts of healthy machines", said, limit, basis)
    assert not alarms, alarms
    assert not waited and max(late) <= 60.0 and max(costs) < 0.01


def _gains(plant: SimulatedPlant, worn: float, edges: Sequence[int]) -> SimulatedPlant:
    valves = [
        replace(valve, gain=valve.gain * (1 + 0.1 * worn * (k in edges)))
        for k, valve in enumerate(plant.valves)
    ]
    return replace(plant, valves=tuple(valves))


LEAKY = 0.01  # of rated, of the new machine: found by a diagnosis, and added
WEAR: dict[str, Callable[[Bench, float], SimulatedPlant]] = {
    "all valves": lambda bench, worn: _gains(bench.plant, worn, range(5)),
    "one valve": lambda bench, worn: _gains(bench.plant, worn, [0]),
    "a leak": lambda bench, worn: leak(LEAKY + 0.1 * worn)(bench.plant, bench.rate),
}
OVER = "an hour of motion in ten hours, six restarts"
NUMBERS = (9300, 9301, 9302, 9311, 9312, 9310)  # of machines, of each of three laws


def _with_leak(bench: Bench) -> Bench:
    """A machine that leaks, with the leak as a term beside the maps, as `rtid add` leaves it."""
    ends = (("p_a", 1.0), ("p_b", -1.0)), (("a", -1), ("b", 1))
    term = Term("internal_leakage_laminar", *ends, LEAKY * bench.rate, sd=0.1)
    project, plant = bench.project, leak(LEAKY)(bench.plant, bench.rate)
    project = replace(project, model=replace(project.model, terms=(term,)))
    return replace(bench, project=project, plant=plant)


class Wearing:
    """Ten hours of a machine that wears: a minute of motion each ten minutes; restarts."""

    def __init__(self, folder: Path, name: str, seed: int) -> None:
        bench = Bench.of(folder, seed).publishing(SELDOM_S)
        self.taught = Taught(folder, _with_leak(bench) if name == "a leak" else bench)
        self._worn = partial(WEAR[name], bench)
        self.learns_s, self.name = list[float](), f"{name}, machine {seed}"
        daemon = self.taught.again("wears")
        for k in range(60):
            daemon.hear(self.taught.bench.run(60.0, 1000 + k, plant=self._worn((k + 1) / 60)))
            daemon.begin_s += 440.0  # behind the 100 s that `hear` leaves
            change = 100 * map_drift(self.taught.published, daemon.published)
            print(f"{self.name}, {k + 1} of 60: {change:.1f} % from the new one", flush=True)
            assert not np.isfinite(daemon.alarm_s), f"after {k + 1} of 60: {daemon.text}"
            if k % 10 == 9:
                self.learns_s.append(daemon.learning_s)
                self.followed, self.solution = daemon.published, daemon.solution
                begin_s = daemon.begin_s
                daemon.stop()
                daemon = daemon.killed()
                daemon.begin_s = begin_s

    def of_new_and_worn(self, folder: Path) -> tuple[float, float]:
        """How far the map of a daemon that knows the worn machine alone is from both maps."""
        worn = Simulated(self.taught.bench, folder, 0.0)
        worn.hear(self.taught.bench.run(HEALTHY_S, 2000, plant=self._worn(1.0)))
        new, followed = (
            map_drift(worn.published, m) for m in (self.taught.published, self.followed)
        )
        return new, followed


@pytest.mark.parametrize("seed", NUMBERS[: 2 * MACHINES])
@pytest.mark.parametrize("name", ["all valves", "one valve"])
def test_slow_wear_is_followed(name: str, seed: int, tmp_path: Path) -> None:
    """10 % in 10 h, a minute of motion each ten minutes; a restart each 100 minutes."""
    wearing = Wearing(made(tmp_path / "machine"), name, seed)
    changed, behind = wearing.of_new_and_worn(made(tmp_path / "worn"))
    said = f"0 alarms; the map has gone with it: {100 * behind:.2f} % from that of the worn "
    said += f"machine, the one of the new machine {100 * changed:.1f} %"
    said += f"; learning {max(wearing.learns_s):.0f} s at most after each of 6 restarts"
    leave(f"guard: wear of 10 % in 10 h, {wearing.name}", said, "followed, no alarm", OVER)
    assert behind < 0.25 * changed and max(wearing.learns_s) <= 60.0


@pytest.mark.parametrize("seed", NUMBERS[: 2 * MACHINES])
def test_a_leak_that_is_known_is_followed(seed: int, tmp_path: Path) -> None:
    """From 1 to 11 % of the rated flow in 10 h, learned beside the maps, which stay."""
    wearing = Wearing(made(tmp_path / "machine"), "a leak", seed)
    _, moved = wearing.of_new_and_worn(made(tmp_path / "worn"))
    share = float(LEAKY * wearing.solution.terms_theta[0])
    said = f"0 alarms; its size {100 * share:.2f} % of rated (11), the map moved by "
    said += f"{100 * moved:.2f} %; learning {max(wearing.learns_s):.0f} s at most after a restart"
    what = "guard: a leak learned beside the maps that grows from 1 to 11 % of rated in 10 h"
    leave(f"{what}, machine {seed}", said, "followed, no alarm", OVER)
    assert abs(share - 0.11) < 0.25 * 0.1 and moved < 0.25 * 0.1 and max(wearing.learns_s) <= 60.0


GROWN = (0.005, 0.01, 0.02)  # of rated


@pytest.mark.parametrize("seed", NUMBERS[:MACHINES])
def test_a_leak_that_no_term_holds_is_named_while_it_grows(seed: int, tmp_path: Path) -> None:
    """By the diagnosis of the last two minutes that the daemon makes each `diagnose_s`.

    The guard does not stand against it: the maps take up what they can of so slow a change.
    """
    bench, texts = Bench.of(tmp_path, seed), list[str]()
    for share in GROWN:
        run = bench.run(120.0, 77, plant=leak(share)(bench.plant, bench.rate))
        learner = Learner(bench.project.model, bench.catalog, bench.project.assembly)
        for piece in run_frames(run, start_us=START_US).chunks(PIECE):
            learner.push(piece)
        history = learner.estimator.history
        assert history is not None
        verdict = diagnose(jobs.Diagnose(bench.project.model, history.chunk()), bench.project)
        assert verdict.verdict is not None, verdict.reason
        texts.append(verdict.verdict.text)
        print(f"machine {seed}, {100 * share:g} %: {texts[-1]}", flush=True)
        assert any("leak" in effect for effect in verdict.verdict.effects), texts[-1]
    what = "guard: a leak that no term holds, while it grows"
    said = "named at 0.5, 1 and 2 % of rated by the diagnosis of two minutes in between"
    leave(f"{what}, machine {seed}", said, "said, never quarantined", "each `diagnose_s`")
