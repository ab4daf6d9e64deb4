"""The guard of the good map: a fault that is there at a start is named, and never learned."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.samples import GAP
from rtid.compare.foretelling import (
    FALSE,
    Seconds,
    in_motion,
    level_of,
    rated_m3s,
    residuals,
    seconds,
    sigma_m3s,
)
from rtid.compare.suspects import causes
from rtid.daemon import guard as guards
from rtid.daemon import jobs
from rtid.daemon.analyst import Analyst
from rtid.daemon.first import against_first
from rtid.daemon.guard import Guard, State, candidate_of
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.published import publish
from rtid.plain import FloatArray
from rtid.sim.run import Run
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.snapshot import WATCH_FILE, Generations
from tests.campaign.guarding import FAULTS, Bench, Simulated, oil
from tests.faults.harness import fault_free, machine
from tests.replays import shared_replays  # noqa: F401


@pytest.fixture(scope="module")
def bench() -> Bench:
    """The machine of all fault tests; a leak as large as the rated flow at 3 MPa."""
    rate = rated_m3s(machine().project.model) / 3e6
    return Bench(SimulatedPlant(), machine().project, machine().catalog, 1, rate)


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a healthy minute has taught, as the baseline and as the newest snapshot."""
    folder = tmp_path_factory.mktemp("state")
    estimator: Estimator = machine().learned(machine().frames).estimator
    estimator.history = None
    generations = Generations(folder, machine().project.digest)
    generations.save(estimator)
    level = 0.003 * rated_m3s(machine().project.model)
    generations.save_baseline(estimator, {"level_m3s": [level, level]})
    return folder


def chunk_of(run: Run) -> FloatArray:
    samples = run.samples
    return to_chunk(machine().project.model, samples, int(samples.t_us[0]))


def test_a_leak_of_two_percent_is_told_from_a_healthy_machine_and_named(bench: Bench) -> None:
    """Of 12 s of motion each; the level is that of the healthy one's own."""
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    none = np.full(2, 0.01 * rated_m3s(model))
    healthy = in_motion(model, residuals(model, candidate, chunk_of(bench.run(12.0, 3))))
    level = level_of(seconds(model, healthy, none), sigma_m3s(model, none))
    assert (level > 0).all() and (level < 0.005 * rated_m3s(model)).all()
    judged = seconds(model, healthy, level)
    assert judged.foretold and judged.cusum[0] == 0.0
    sick = chunk_of(bench.faulty(FAULTS["leak of 2 %"], 0.0, 12.0, 3))
    judged = seconds(model, in_motion(model, residuals(model, candidate, sick)), level)
    assert judged.contradicts and not judged.foretold
    first = causes(model, candidate, sick, level)[0]
    assert first.text.startswith("a leak from a to b") and not first.of_sensor


def test_cold_oil_that_turns_laminar_earlier_is_a_healthy_day(bench: Bench) -> None:
    """At a low supply most of the flow passes at a low pressure: 20 K less take a tenth of it."""
    model, solution = machine().project.model, fault_free()
    candidate, level = candidate_of(solution, publish(solution)), 0.003 * rated_m3s(model)
    cold = replace(oil(bench.plant, -20.0), p_supply_pa=0.8 * bench.plant.p_supply_pa)
    rows = residuals(model, candidate, chunk_of(bench.run(12.0, 3, "dither", plant=cold)))
    judged = seconds(model, in_motion(model, rows), np.full(2, level))
    assert len(judged.t_s) >= 10 and (judged.squares.mean(axis=0) < 0.3).all()


@pytest.mark.parametrize("flag", [0, GAP])
def test_a_gap_speaks_against_no_sensor(bench: Bench, flag: int) -> None:
    """The bus was off for 8 of 20 s: what a velocity would have moved meanwhile, it has not."""
    model, chunk = machine().project.model, chunk_of(bench.run(20.0, 3))
    heard = np.concatenate([chunk[:8000], chunk[16000:]])
    heard[8000, 1] = int(heard[8000, 1]) | flag
    assert against_first(model, heard, fault_free()) == ()


def test_a_proof_goes_on_behind_a_kill_whatever_it_had_seen(bench: Bench) -> None:
    """Nothing in motion yet, or what a program before has counted with other nuisances."""
    model, solution = machine().project.model, fault_free()
    candidate, chunk = candidate_of(solution, publish(solution)), chunk_of(bench.run(8.0, 3))
    level = np.full(2, 0.003 * rated_m3s(model))
    still, others = (Guard(model, candidate, level, "proving") for _ in range(2))
    at_rest = np.repeat(chunk[:1], 4000, axis=0)
    at_rest[:, 0] += 1e-3 * np.arange(4000)
    pushed(still, at_rest)
    pushed(others, chunk)
    assert others.progress["moved"] > 0
    earlier = others.progress
    earlier["rows"]["columns"] = np.array(earlier["rows"]["columns"])[..., :-1].tolist()
    for progress in (still.progress, earlier):
        again = Guard(model, candidate, level, "proving")
        again.resume(progress)
        assert pushed(again, chunk)[-1] == "proving"


def test_the_sequential_test_keeps_its_word() -> None:
    """At the border of what is healthy it cries wolf less often than it says; a fault it hears."""
    rng, spans, wolf = np.random.default_rng(4), 400, 0
    for _ in range(spans):
        squares = rng.chisquare(1, (500, 2))
        wolf += Seconds(np.arange(500.0), squares).contradicts
    assert wolf <= 1, "expected: 200,000 seconds at most once in a million"
    after = []
    for _ in range(50):
        squares = 4 * rng.chisquare(1, (60, 2))
        for n in range(1, 61):
            if Seconds(np.arange(float(n)), squares[:n]).contradicts:
                after.append(n)
                break
    assert len(after) >= 48 and np.median(after) < 30 and FALSE == 1e-6


def pushed(guard: Guard, chunk: FloatArray) -> list[State]:
    """The states of a guard, told of samples in pieces of 2 s."""
    pieces = np.array_split(chunk, round(len(chunk) / 2000))
    states: list[State] = []
    for piece in pieces:
        guard.push(piece)
        states.append(guard.state)
    return states


def test_a_second_that_two_pieces_share_is_counted_once(bench: Bench) -> None:
    """Pieces begin anywhere within a second."""
    model, solution = machine().project.model, fault_free()
    guard = Guard(model, candidate_of(solution, publish(solution)), None, "proven")
    pushed(guard, chunk_of(bench.run(13.3, 3)))
    assert 8 <= guard.progress["moved"] <= 13


def test_what_is_saved_is_trusted_once_the_motion_behind_it_shows_no_fault(
    bench: Bench, tmp_path: Path
) -> None:
    """After a kill it is what is published; what may hold a fault is not."""
    project, answers = machine().project, list[jobs.Answer]()
    learner, analyst = machine().learner(), Analyst(project, tmp_path, answers.append)
    generations = Generations(tmp_path, project.digest)

    def handed(number: int, publish: bool) -> jobs.Handover:
        copy = learner.estimator.copy(with_history=False)
        return jobs.Handover(number, copy, publish=publish, store=not publish)

    def until(end: int, begin: int) -> None:
        for frames in machine().frames[3000 * begin : 3000 * end].chunks(600):
            analyst.take(jobs.Batch(learner.push(frames), None))

    def baseline_s() -> float:
        estimator = generations.baseline(project.model).estimator
        assert estimator is not None
        return float(estimator.state.engine[0]["t_s"])

    until(20, 0)
    analyst.take(handed(1, publish=True))
    published_s = baseline_s()
    until(25, 20)
    saved = handed(2, publish=False)
    analyst.save(saved)
    until(27, 25)
    assert baseline_s() == published_s, "nothing has judged it yet"
    until(34, 27)
    saved_s = float(saved.estimator.state.engine[0]["t_s"])
    assert baseline_s() == saved_s > published_s
    guard = analyst._guard
    assert guard is not None
    guard.level = np.full(2, 0.003 * rated_m3s(project.model))
    sick = chunk_of(bench.faulty(FAULTS["leak of 10 %"], 0.0, 20.0, 3))
    sick[:, 0] += learner.estimator.state.engine[0]["t_s"] + 0.001 - sick[0, 0]
    analyst.save(handed(3, publish=False))
    for piece in np.array_split(sick, 40):
        analyst.take(jobs.Batch(piece, None))
    assert guard.state == "contradicted" and baseline_s() == saved_s
    said = [answer for answer in answers if isinstance(answer, jobs.Foretold)]
    assert [answer.state for answer in said] == ["contradicted", "named"], "looked at again"
    assert all("a leak from a to b" in answer.text for answer in said)
    analyst.close()
    assert baseline_s() == saved_s


@pytest.mark.long
@pytest.mark.parametrize(("name", "said"), [("u reversed", "u"), ("x reversed", "x")])
def test_samples_with_a_wrong_sign_prove_no_map(bench: Bench, name: str, said: str) -> None:
    """Also where they fall on hardly any cell that the map knows."""
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    guard = Guard(model, candidate, np.full(2, 0.003 * rated_m3s(model)), "proving", 0.9)
    states = pushed(guard, chunk_of(bench.faulty(FAULTS[name], 0.0, 20.0, 3)))
    assert states[-1] == "contradicted" and "proven" not in states
    assert any(f"{said} has the wrong sign" in cause.text for cause in guard.causes()), (
        guard.causes(),
        guard.against,
    )
    unknown = replace(candidate, status=np.full_like(candidate.status, "learning"))
    guard = Guard(model, unknown, guard.level, "proving", 0.0)
    assert pushed(guard, chunk_of(bench.faulty(FAULTS[name], 0.0, 16.0, 3)))[-1] == "contradicted"
    assert any(text.startswith(f"{said}: ") for text in guard.against)


def test_what_a_map_does_not_know_proves_it_only_where_that_is_usual(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that keeps out of all that was ever visited is not the one that was learned."""
    monkeypatch.setattr(guards, "ENOUGH", 6)
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    unknown = replace(candidate, status=np.full_like(candidate.status, "learning"))
    chunk, level = chunk_of(bench.run(16.0, 3)), np.full(2, 0.003 * rated_m3s(model))
    assert pushed(Guard(model, unknown, level, "proving", 0.0), chunk)[-1] == "proven"
    assert pushed(Guard(model, unknown, level, "proving", 0.9), chunk)[-1] == "proving"


def test_swapped_pressures_at_a_start_are_named_and_never_learned(
    bench: Bench, state: Path, tmp_path: Path
) -> None:
    """The baseline goes on being published; after a kill nothing is learned either."""
    folder = tmp_path / "state"
    shutil.copytree(state, folder)
    daemon = Simulated(bench, folder, 100.0)
    before = daemon.published
    assert daemon.core.is_proving
    daemon.hear(bench.faulty(FAULTS["pressures swapped"], 0.0, 16.0, 5))
    assert daemon.alarm_s <= 16.0 and "p_a and p_b are swapped" in daemon.text
    assert not daemon.core.learner.learns
    assert all(
        np.array_equal(a.theta, b.theta)
        for a, b in zip(before.edges, daemon.published.edges, strict=True)
    )
    learned = daemon.core.learner.estimator.state.engine[0]["t_s"]
    assert learned < 100.0, "what was learned since the start is taken back"
    assert (folder / machine().project.digest / WATCH_FILE).exists()
    daemon = daemon.killed()
    daemon.hear(bench.faulty(FAULTS["pressures swapped"], 0.0, 0.4, 5))
    assert "p_a and p_b are swapped" in daemon.text and not daemon.core.learner.learns


def test_a_healthy_machine_goes_on_learning(bench: Bench, state: Path, tmp_path: Path) -> None:
    """Also where the run before had ended with the alarm: it has been mended."""
    folder = tmp_path / "state"
    shutil.copytree(state, folder)
    (folder / machine().project.digest / WATCH_FILE).write_text("{}")
    daemon = Simulated(bench, folder, 100.0)
    daemon.hear(bench.run(0.4, 5))
    assert not np.isfinite(daemon.learning_s), "not proven yet"
    daemon.hear(bench.run(26.0, 5))
    assert daemon.learning_s <= 26.0
    assert not (folder / machine().project.digest / WATCH_FILE).exists()


@pytest.mark.long
def test_a_suspicion_goes_back_to_the_newest_estimate_before_it(tmp_path: Path) -> None:
    """The baseline is older; an alarm of a sensor, which may be as old as it likes, goes there."""
    learner, answers = machine().learner(), list[jobs.Answer]()
    analyst = Analyst(machine().project, tmp_path, answers.append)
    newest = []
    for number, frames in enumerate(machine().frames[:96_000].chunks(24_000), 1):
        learner.push(frames)
        newest.append(float(learner.estimator.state.engine[0]["t_s"]))
        copy = learner.estimator.copy(with_history=False)
        analyst.take(jobs.Handover(number, copy, publish=True, store=False))
        if number == 2:  # known by now: what comes has to prove itself before it is the baseline
            assert analyst._guard is not None
            analyst._guard.level = np.full(2, 0.003 * rated_m3s(machine().project.model))
    for before_s, expected in [(newest[3], newest[2]), (-np.inf, newest[1])]:
        analyst.take(jobs.Recall(4, before_s))
        recalled = [answer for answer in answers if isinstance(answer, jobs.Recalled)][-1]
        assert recalled.estimator.state.engine[0]["t_s"] == expected


@pytest.mark.long
def test_a_proof_goes_on_where_a_kill_has_ended_it(
    bench: Bench, state: Path, tmp_path: Path
) -> None:
    """In runs of 12 s, each too short for a proof; baseline and snapshots stay as they are."""
    folder = tmp_path / "state"
    shutil.copytree(state, folder)
    generations = Generations(folder, machine().project.digest)
    files = {path: path.read_bytes() for path in generations.folder.glob("*.npz")}
    daemon = Simulated(bench, folder, 100.0)
    daemon.hear(bench.run(12.0, 5))
    daemon.stop()
    assert daemon.core.is_proving and generations.shadow_path.exists()
    assert {path: path.read_bytes() for path in files} == files
    learned = daemon.core.learner.estimator.counters["samples"]
    daemon = daemon.killed()
    assert daemon.core.learner.estimator.counters["samples"] == learned
    daemon.hear(bench.run(12.0, 6))
    assert daemon.learning_s <= 12.0
    daemon.stop()
    assert not generations.shadow_path.exists()


@pytest.mark.parametrize("gain", [1.0, 1.1])
def test_a_later_map_is_the_baseline_only_where_it_foretells_as_well(
    bench: Bench, tmp_path: Path, gain: float
) -> None:
    """What was learned of two oils may foretell neither: held against it, any day is a fault."""
    project, answers = machine().project, list[jobs.Answer]()
    analyst, solution = Analyst(project, tmp_path, answers.append), fault_free()
    held = candidate_of(solution, publish(solution))
    guard = Guard(project.model, held, np.full(2, 0.003 * rated_m3s(project.model)), "proven")
    learned: Estimator = machine().learned(machine().frames[:3000]).estimator
    later = replace(held, theta=gain * held.theta)
    analyst._guard = guard
    analyst._next = jobs.Handover(2, learned, publish=True, store=False), later
    chunk = chunk_of(bench.run(30.0, 3))
    chunk[:, 0] += learned.state.engine[0]["t_s"] + 0.001 - chunk[0, 0]
    for piece in np.array_split(chunk, 15):
        analyst.take(jobs.Batch(piece, None))
    assert guard.state == "proven"
    assert guard._candidate is (later if gain == 1.0 else held)
    assert analyst._baseline is (learned if gain == 1.0 else None)


@pytest.mark.long
def test_what_waited_to_be_trusted_waits_on_after_a_kill(
    bench: Bench, state: Path, tmp_path: Path
) -> None:
    """Else the baseline of a machine that is killed each half minute would never grow younger."""
    folder, project = tmp_path / "state", machine().project
    shutil.copytree(state, folder)
    generations = Generations(folder, project.digest)
    estimator = generations.restore(project.model).estimator
    assert estimator is not None
    last_s = estimator.state.engine[0]["t_s"]
    chunk = chunk_of(bench.run(5.0, 7))
    chunk[:, 0] += last_s + 0.001 - chunk[0, 0]
    estimator.advance(chunk)
    level = [0.003 * rated_m3s(project.model)] * 2
    generations.await_trust(generations.save(estimator, notes={"level_m3s": level}))
    daemon = Simulated(bench, folder, 100.0)
    daemon.hear(bench.run(26.0, 5))  # it is killed before its own first snapshot is due
    kept = generations.baseline(project.model)
    assert kept.estimator is not None and kept.notes["level_m3s"] == level
    assert kept.estimator.state.engine[0]["t_s"] == chunk[-1, 0]


@pytest.mark.long
def test_a_cause_that_healthy_samples_hide_is_named_later(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suspicion may begin before the fault: what came behind the alarm shows it alone."""
    monkeypatch.setattr(guards, "AGAIN", 4)
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    guard = Guard(model, candidate, np.full(2, 0.002 * rated_m3s(model)), "proven")
    chunk = chunk_of(bench.faulty(FAULTS["leak of 2 %"], 8.0, 24.0, 3))
    pieces = np.array_split(chunk, 12)
    alarm = next(k for k, piece in enumerate(pieces) if guard.push(piece))
    assert guard.state == "contradicted" and guard.later_causes() is None, "too early"
    for piece in pieces[alarm + 1 :]:
        guard.push(piece)
    causes = guard.later_causes()
    assert causes and "a leak from a to b" in causes[0].text


@pytest.mark.long
def test_a_command_that_turns_its_sign_in_a_run_is_named(bench: Bench) -> None:
    """The machine keeps out of all that the map knows: the causes must not wait for it."""
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    guard = Guard(model, candidate, np.full(2, 0.003 * rated_m3s(model)), "proven")
    chunk = chunk_of(bench.faulty(FAULTS["u reversed"], 8.0, 32.0, 3))
    named: list[str] = []
    for piece in np.array_split(chunk, 16):
        if guard.push(piece) and guard.state == "contradicted":
            named = [*(cause.text for cause in guard.causes()), *guard.against]
        elif not named and (causes := guard.later_causes()) is not None:
            named = [*(cause.text for cause in causes), *guard.against]
    assert any(words in text for text in named for words in FAULTS["u reversed"].names), named
    begin_s = chunk[0, 0] + 8.0
    assert begin_s - 6.0 <= guard.since_s <= begin_s + 1.0, "what was learned before is kept"


@pytest.mark.long
def test_a_lost_baseline_yields_to_a_shadow_that_foretells(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A healthy machine works where nothing is known: it is not kept in the shadow for ever."""
    monkeypatch.setattr(guards, "ENOUGH", 24)
    monkeypatch.setattr(guards, "PROOF", 7)
    project = machine().project
    corner = Estimator(project.model)  # knows next to nothing, and says that this is unusual
    corner.history = None
    corner.origin_us, chunk = 0, chunk_of(bench.run(3.0, 8, "dither"))
    corner.advance(chunk)
    generations = Generations(tmp_path, project.digest)
    generations.save(corner)
    level = [0.003 * rated_m3s(project.model)] * 2
    generations.save_baseline(corner, {"level_m3s": level, "known_share": 0.9})
    daemon = Simulated(bench, tmp_path, 100.0)
    daemon.hear(bench.run(52.0, 3))
    assert daemon.learning_s <= 52.0 and not np.isfinite(daemon.alarm_s)
    daemon.stop()
    assert generations.baseline(project.model).notes["known_share"] > 0.1


def test_samples_without_a_row_are_no_motion(bench: Bench) -> None:
    """A suspect may turn all volumes negative: then it says nothing, and nothing fails."""
    model, solution = machine().project.model, fault_free()
    candidate = candidate_of(solution, publish(solution))
    chunk = chunk_of(bench.run(2.0, 3))
    chunk[:, 2 + model.column(model.position)] -= 10.0
    for piece in (chunk[:2], chunk):
        rows = in_motion(model, residuals(model, candidate, piece))
        assert not len(rows.t_s) and not len(seconds(model, rows, np.ones(2)).t_s)
