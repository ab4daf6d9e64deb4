"""A rate that is measured itself, y = f(u1) + ... + f(un): random rotors through the commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rtid.compare import sample_errors
from rtid.effects.filtering import filtered
from rtid.effects.flow_sums import FlowSums
from rtid.effects.laws.response import behind_s
from rtid.estimator.estimator import Estimator
from rtid.estimator.published import publish
from rtid.plain import FloatArray
from rtid.project import ProjectError, load
from rtid.study.on_board import on_board
from rtid.study.quick_rate import QuickRate, quick_rate
from rtid.study.study import Study
from rtid.trace.quick_source import open_source
from rtid.trace.reading import read_trace
from tests.replays import shared_replays  # noqa: F401
from tests.test_rate import said

STRANGERS = Path(__file__).parents[2] / "shared/data/strangers"
FULL, HZ, GRAVITY = 65535.0, 500.0, 9.80665
SEEDS = 0, pytest.param(1, marks=pytest.mark.long)


@dataclass(frozen=True)
class Rotors:
    """Four rotors of one map; place: where their lag stands, "behind" it, "before" it or ""."""

    place: str
    lag_s: float
    linear: float
    square: float
    noise: float
    colour_s: float
    knee: float = 1.0  # of the command, beyond which a rotor gives no more
    drift: float = 0.0  # of the thrust, a share of it per second

    @classmethod
    def drawn(cls, rng: np.random.Generator, place: str, knee: float = 1.0) -> Rotors:
        return cls(
            place, float(rng.uniform(0.03, 0.12)), float(rng.uniform(0.2, 1.0)),
            float(rng.uniform(2.4, 4.8)), float(rng.uniform(0.1, 0.4)),
            float(rng.choice([0.0, 0.005, 0.02])), knee,
        )  # fmt: skip

    def thrust(self, u: FloatArray) -> FloatArray:
        """What one rotor gives, m/s2, of commands from 0 to 65535."""
        w = np.minimum(u / FULL, self.knee)
        return np.asarray(0.3 * self.linear + self.linear * w + self.square * w * w)

    def recorded(
        self,
        path: Path,
        rng: np.random.Generator,
        seconds: float = 30.0,
        until_s: float = np.inf,
        rest_s: float = 0.0,
    ) -> Path:
        """A flight: steps of all rotors, and what keeps it upright.

        The gain drifts until until_s; before it all rests on a floor for rest_s.
        """
        n = round(HZ * seconds)
        steps = np.repeat(rng.uniform(-0.15, 0.15, n), round(0.7 * HZ))[:n]
        own = np.stack([_wander(rng, n, 0.15, 0.06) for _ in range(4)], axis=1)
        u = np.round(
            FULL * np.clip(0.6 + (steps + _wander(rng, n, 1.0, 0.08))[:, None] + own, 0, 1)
        )
        sent = _late(u, self.lag_s) if self.place == "before" else u
        drifted_s = np.minimum(np.arange(n) / HZ, until_s)
        y = self.thrust(sent).sum(axis=1) * (1.0 + self.drift * drifted_s)
        y = _late(y[:, None], self.lag_s)[:, 0] if self.place == "behind" else y
        rest = round(HZ * rest_s)
        u, y = np.pad(u, ((rest, 0), (0, 0))), np.pad(y, (rest, 0), constant_values=GRAVITY)
        n += rest
        y = (y + _wander(rng, n, self.colour_s, self.noise)) / GRAVITY
        rows = np.column_stack([np.arange(n) * round(1e6 / HZ), u, y])
        head = "t_us,motor_1,motor_2,motor_3,motor_4,acc_z_g"
        np.savetxt(path, rows, ["%d"] * 5 + ["%.6f"], ",", header=head, comments="")
        return path


def _wander(rng: np.random.Generator, n: int, memory_s: float, sd: float) -> FloatArray:
    """Noise of so long a memory (n,); white for none."""
    keep = float(np.exp(-1.0 / (HZ * memory_s))) if memory_s else 0.0
    white = rng.standard_normal(n)
    return sd * filtered((float(np.sqrt(1 - keep**2)), 0.0, 0.0), (1.0, -keep, 0.0), white)


def _late(values: FloatArray, lag_s: float) -> FloatArray:
    """Columns (n, m), held over each step, behind a first-order lag."""
    keep = float(np.exp(-1.0 / (HZ * lag_s)))
    taps = (0.0, 1.0 - keep, 0.0), (1.0, -keep, 0.0)
    return np.stack([filtered(*taps, v - v[0]) + v[0] for v in values.T], axis=1)


def looked_at(table: Path) -> QuickRate:
    return quick_rate(table, open_source(table, None), {})


def lag_of(quick: QuickRate) -> float:
    """The lag behind the map that is named, s; 0 for none."""
    sizes = [e.parameters for e in quick.diagnosis.found if e.effect == "map_lag"]
    return float(sizes[0]["time_constant"].value) if sizes else 0.0


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_a_lag_behind_the_map_is_found_whatever_the_noise(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([20, seed])
    plant = Rotors.drawn(rng, "behind", knee=0.75)
    quick = looked_at(plant.recorded(tmp_path / "flight.csv", rng))
    print(plant, [(e.effect, e.cannot_be_told_from) for e in quick.diagnosis.found])
    assert lag_of(quick) == pytest.approx(plant.lag_s, rel=0.05)
    assert [c.name for c in quick.pair.commands] == [f"motor_{k}" for k in (1, 2, 3, 4)]


@pytest.mark.long
@pytest.mark.parametrize("drift", [-0.004, 0.003])
def test_a_battery_that_empties_is_a_drift_of_the_gain(tmp_path: Path, drift: float) -> None:
    """Beside the lag, from the first half of a flight; none is named where there is none."""
    rng = np.random.default_rng([22, round(1e4 * abs(drift))])
    plant = replace(Rotors.drawn(rng, "behind", knee=0.75), drift=drift)
    for g in (drift, 0.0):
        table = replace(plant, drift=g).recorded(tmp_path / "flight.csv", rng, 60.0)
        found = {f.effect: f for f in looked_at(table).diagnosis.found}
        print(plant, g, found)
        assert found.keys() == ({"map_lag", "map_gain_drift"} if g else {"map_lag"})
        if g:
            rate = found["map_gain_drift"].parameters["rate"]
            assert rate.unit == "1/s" and abs(rate.value - drift) < 0.15 * abs(drift)


@pytest.mark.long
def test_what_is_left_of_the_samples_is_that_of_a_flight_behind_its_last_gain(
    tmp_path: Path,
) -> None:
    """A gain that falls in the first half alone, and rests on a floor: t went on, and so did it."""
    rng = np.random.default_rng(41)
    plant = replace(Rotors.drawn(rng, "", knee=0.75), drift=-0.004, noise=0.1, colour_s=0.0)
    table = plant.recorded(tmp_path / "flight.csv", rng, 60.0, until_s=30.0, rest_s=8.0)
    said("init", table, "-o", tmp_path / "flight.toml")
    project = tmp_path / "flight.toml"
    begun = project.read_text().partition("[[added]]")[0].partition("[record]")[0]
    spans = "identification_s = [0, 38]\nvalidation_s = [38, 68]\n"
    project.write_text(f"{begun}[record]\n{spans}")
    study = Study(project, table).add("map_gain_drift", force=True)
    comparison = Study(project, table).comparison()
    assert study.changes and "while" in said("replay", table, "-p", project)
    model, parts = comparison.replay.model, comparison.held[0].parts
    flying, resting = sample_errors(model, parts["identification"])
    assert (flying.given, resting.given) == (True, False)
    assert flying.duration_s == pytest.approx(30.0, abs=0.1)
    (flying,) = sample_errors(model, parts["validation"])
    print(flying)
    assert flying.sd < 1.1 * plant.noise and abs(flying.mean) < 0.3 * 0.004 * 15 * GRAVITY


def test_noise_does_not_make_the_lag_shorter(tmp_path: Path) -> None:
    """White noise as large as the motion itself: dy/dt is 500 times as noisy, and has no say."""
    plant = Rotors("behind", 0.07, 0.5, 3.0, 0.8, 0.0, knee=0.75)
    table = plant.recorded(tmp_path / "flight.csv", np.random.default_rng(2))
    said("init", table, "-o", tmp_path / "flight.toml")
    fit = Study(tmp_path / "flight.toml", table).tried("map_lag").after.fit
    assert behind_s(fit.revision.timings) == pytest.approx(plant.lag_s, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_a_lag_before_the_map_is_none_behind_it(tmp_path: Path, seed: int) -> None:
    """A map with a knee passes it at another instant: the two places are told apart."""
    rng = np.random.default_rng([21, seed])
    plant = replace(Rotors.drawn(rng, "before", knee=0.65), noise=0.05, colour_s=0.0)
    quick = looked_at(plant.recorded(tmp_path / "flight.csv", rng))
    (found,) = quick.diagnosis.found
    print(plant, found)
    assert found.effect.startswith("spool_lag")
    assert not any("map_lag" in other for other in found.cannot_be_told_from)


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_named_where_nothing_is_late(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([22, seed])
    plant = Rotors.drawn(rng, "")
    quick = looked_at(plant.recorded(tmp_path / "flight.csv", rng))
    print(plant, quick.diagnosis)
    assert quick.diagnosis.verdict == "matches" and not quick.diagnosis.found


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rotors, Path, Path]:
    """Rotors, their table, and the project that `init` writes of it."""
    folder, rng = tmp_path_factory.mktemp("rotors"), np.random.default_rng(3)
    plant = Rotors.drawn(rng, "behind", knee=0.75)
    table = plant.recorded(folder / "flight.csv", rng)
    assert "one map for all of them" in said("init", table, "-o", folder / "flight.toml")
    return plant, table, folder / "flight.toml"


def test_from_the_file_to_the_map_without_an_equation(
    flown: tuple[Rotors, Path, Path], tmp_path: Path
) -> None:
    """init, diagnose, add, compare, export: five commands."""
    plant, table, project = flown
    assert "Lag behind the map" in said("diagnose", table, "-p", project)
    words = said("add", "map_lag", table, "-p", project, "--force")
    assert "is part of the model" in words
    study = Study(project, table)
    w = FULL * np.linspace(0.45, 0.7, 11)
    error = study.map["f"].flow(w, np.zeros(11)) - plant.thrust(w)
    assert np.sqrt(np.mean(error**2)) < 0.04 * plant.thrust(w).max()
    held_out = study.standing.held_out
    assert held_out.rms_m3s < 0.7 * Study(_without(project), table).standing.held_out.rms_m3s
    assert "m/s2" in said("compare", table, "-p", project)
    said("export", table, tmp_path / "map.csv", "-p", project)
    lines = (tmp_path / "map.csv").read_text().splitlines()
    assert {line.split(",")[0] for line in lines[2:]} == {"f"}, "one map, once"
    said("report", table, "-p", project, "-o", tmp_path / "report.html")


def _without(project: Path) -> Path:
    """The same project without what was added."""
    bare = project.with_name("bare.toml")
    bare.write_text(project.read_text().partition("[[added]]")[0])
    return bare


def test_it_runs_on_board_in_the_recursive_core(flown: tuple[Rotors, Path, Path]) -> None:
    """The lag is linear in the equation: the same map, sample by sample."""
    plant, table, project = flown
    if "[[added]]" not in project.read_text():
        said("add", "map_lag", table, "-p", project, "--force")
    told: list[str] = []
    board = on_board(load(project), told.append)
    assert "is part of the equation" in told[0]
    trace = read_trace(board, table)
    estimator = Estimator(board.model)
    estimator.update(trace.samples)
    w = FULL * np.linspace(0.5, 0.7, 9)
    error = publish(estimator.solution())["f"].flow(w, np.zeros(9)) - plant.thrust(w)
    assert np.sqrt(np.mean(error**2)) < 0.04 * plant.thrust(w).max()


def test_a_gain_that_drifts_is_followed_on_board(tmp_path: Path) -> None:
    """The map of a battery that empties is that of now."""
    rng = np.random.default_rng(43)
    plant = replace(Rotors.drawn(rng, "", knee=0.75), drift=-0.004, noise=0.1, colour_s=0.0)
    table = plant.recorded(tmp_path / "flight.csv", rng, 60.0)
    project = tmp_path / "flight.toml"
    said("init", table, "-o", project)
    said("add", "map_gain_drift", table, "-p", project, "--force")
    told: list[str] = []
    board = on_board(load(project), told.append)
    assert "is followed" in told[0]
    samples = read_trace(board, table).samples
    w, errors = FULL * np.linspace(0.5, 0.7, 9), list[float]()
    for walk in (board.model.upkeep.gain_walk, 0.0):
        upkeep = replace(board.model.upkeep, gain_walk=walk)
        estimator = Estimator(replace(board.model, upkeep=upkeep))
        estimator.update(samples)
        now = plant.thrust(w) * (1.0 + plant.drift * 60.0)
        off = publish(estimator.solution())["f"].flow(w, np.zeros(9)) - now
        errors.append(float(np.sqrt(np.mean(off**2)) / now.max()))
    assert errors[0] < 0.02 and errors[1] > 2.0 * errors[0]


def test_the_sum_is_that_of_the_whole_whatever_the_pieces(flown: tuple[Rotors, Path, Path]) -> None:
    """Live samples come in pieces: the running sum is the same to the bit."""
    _, table, project = flown
    loaded = load(project)
    samples = read_trace(loaded, table).samples
    chunk = np.column_stack([1e-6 * samples.t_us, samples.flags, samples.values[:, :-1]])
    sums, pieces = FlowSums(loaded.flows), np.split(chunk[:1000], [1, 2, 300, 301])
    made = np.concatenate([sums.with_flows(piece) for piece in pieces])
    np.testing.assert_array_equal(made, FlowSums(loaded.flows).with_flows(chunk[:1000]))
    y, t_s = chunk[:1000, -1], chunk[:1000, 0]
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(t_s))])
    np.testing.assert_allclose(made[:, -1], whole, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda text: text.replace('measured = "x"', 'state = "x"\nmeasured = "x"'), "rate.state"),
        (lambda text: text.replace('measured = "x"', ""), "rate.state"),
        (lambda text: text.replace('measured = "x"', 'measured = "z"'), "rate.measured"),
        (lambda text: text.replace('"u4"]', '"u9"]'), "maps.f.commands[3]"),
        (lambda text: text.replace('"u4"]', '"u1"]'), "maps.f.commands[3]"),
        (lambda text: text.replace("[maps.f]", '[maps.f]\ncommand = "u1"'), "maps.f.command"),
        (
            lambda text: text.replace(
                'column = "motor_1"', 'column = "motor_1"\noffset = "estimate"'
            ),
            "signals.u1.offset",
        ),
        (lambda text: text + '\n[estimator]\nform = "carry"\n', "edges.f_u2"),
    ],
)
def test_what_is_wrong_with_a_project_is_said_with_its_place(
    flown: tuple[Rotors, Path, Path], tmp_path: Path, change: Callable[[str], str], place: str
) -> None:
    text = flown[2].read_text()
    file = tmp_path / "wrong.toml"
    file.write_text(change(text))
    assert file.read_text() != text
    with pytest.raises(ProjectError) as error:
        load(file)
    assert place in {problem.path for problem in error.value.problems}


@pytest.mark.long
@pytest.mark.skipif(not STRANGERS.is_dir(), reason="no measurements of others beside this tree")
def test_the_thrust_of_a_stranger_s_quadrotor(tmp_path: Path) -> None:
    """One map of four motors, and their lag behind it, in one command."""
    table = STRANGERS / "quadrotor_thrust.parquet"
    quick = looked_at(table)
    assert len(quick.pair.commands) == 4 and quick.pair.state.name == "acc_z_g"
    assert 0.055 < lag_of(quick) < 0.075
    assert all(f'effect = "{name}"' in quick.text for name in ("map_lag", "map_gain_drift"))
    project = tmp_path / "flight.toml"
    project.write_text(quick.text)
    comparison = Study(project, table).comparison()
    (flying, _) = sample_errors(comparison.replay.model, comparison.held[0].parts["validation"])
    print(flying)
    assert flying.given and flying.sd < 0.43 and flying.rms < 0.52  # m/s2, as were asked for
