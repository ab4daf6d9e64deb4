"""States of several projects in one folder, and points in time to go back to."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.project import Project, load
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace import points
from rtid.trace.points import MOST_POINTS, KeptPoint, points_of, surplus
from rtid.trace.snapshot import WATCH_FILE, Generations, save
from tests.command import ends, in_json
from tests.faults.harness import machine

DAY_S = 86_400.0
SWAPPED = {"PA": "PB", "PB": "PA"}


def rewritten(folder: Path, change: str) -> Project:
    """The machine's project with one thing changed in what feeds it."""
    text = machine().project.path.read_text("utf-8")
    dbc = (Path(points.__file__).parents[2] / "firmware_bridge/controller.dbc").read_text("utf-8")
    before = text
    if change == "swapped":
        text = text.replace('"PA"', '"?"').replace('"PB"', '"PA"').replace('"?"', '"PB"')
    elif change == "offset":
        text = text.replace("[signals.p_a]", "[signals.p_a]\noffset = 200000.0", 1)
    elif change == "sign of u":
        text = text.replace("[signals.u]", "[signals.u]\nscale = -1.0", 1)
    elif change == "mode":
        text = text.replace('mode = "cycle"', 'mode = "multirate"', 1)
    elif change == "dbc":
        wider = dbc.replace("SG_ PA : ", "SG_ PA : ", 1)
        at = wider.index("SG_ PA ")
        line = wider[at : wider.index("\n", at)]
        factor = line[line.index("(") + 1 : line.index(",", line.index("("))]
        wider = wider.replace(line, line.replace(f"({factor},", f"({1.01 * float(factor):.9g},"))
        assert wider != dbc
        (folder / "other.dbc").write_text(wider, "utf-8")
        text = text.replace("builtin:controller.dbc", "other.dbc")
    assert text != before
    path = folder / "machine.toml"
    path.write_text(text, "utf-8")
    return load(path)


@pytest.mark.parametrize("change", ["swapped", "offset", "sign of u", "mode", "dbc"])
def test_the_key_covers_what_gives_a_sample_its_meaning(change: str, tmp_path: Path) -> None:
    """The machine is the same, and fleets know it; what was learned from other samples is not."""
    other, mine = rewritten(tmp_path, change), machine().project
    assert other.digest != mine.digest
    if change in ("swapped", "offset", "sign of u"):  # the others are seen in the machine too
        assert other.machine_digest == mine.machine_digest


def test_a_comment_in_the_dbc_changes_no_key(tmp_path: Path) -> None:
    source = Path(points.__file__).parents[2] / "firmware_bridge/controller.dbc"
    (tmp_path / "other.dbc").write_text(source.read_text("utf-8") + '\nCM_ "another";\n', "utf-8")
    text = machine().project.path.read_text("utf-8").replace("builtin:controller.dbc", "other.dbc")
    (tmp_path / "machine.toml").write_text(text, "utf-8")
    assert load(tmp_path / "machine.toml").digest == machine().project.digest


def test_a_switch_of_projects_and_back_loses_nothing(tmp_path: Path) -> None:
    """A, then B, then A again: both of A's snapshots are there."""
    project = machine().project
    model = project.model
    first, other = Generations(tmp_path, project.digest), Generations(tmp_path, "other")
    written = [first.save(Estimator(model)).read_bytes() for _ in range(2)]
    fresh = other.restore(model)
    assert fresh.estimator is None and project.digest in fresh.text
    other.save(Estimator(model))
    again = Generations(tmp_path, project.digest)
    assert again.restore(model).estimator is not None
    assert [again.path(k).read_bytes() for k in (1, 2)] == written


def test_a_state_of_before_is_refused_with_the_reason_and_stays(tmp_path: Path) -> None:
    """Its key knew the machine alone: it may have been learned from swapped pressures."""
    project = machine().project
    old = tmp_path / "state-0.npz"
    save(old, Estimator(project.model), project.machine_digest)
    restored = Generations(tmp_path, project.digest).restore(project.model)
    assert restored.estimator is None and old.exists()
    (reason,) = restored.refused
    assert str(old) in reason and "offset" in reason


def test_every_acceptance_keeps_what_was_before(tmp_path: Path) -> None:
    project = machine().project
    generations = Generations(tmp_path, project.digest)
    for _ in range(3):
        generations.save(Estimator(project.model))
        generations.set_aside("accept")
    assert len(points_of(generations.folder)) == 3


def test_points_thin_out_with_age_and_keep_to_their_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """One an hour for 100 days: the first and the last day stay, old ones lie farther apart."""
    kept: list[KeptPoint] = []
    for hour in range(24 * 100):
        now_s = 3600.0 * hour
        kept.append(KeptPoint(now_s, "publish", Path(), 5 << 20))
        gone = surplus(kept, now_s)
        kept = [point for point in kept if point not in gone]
    times = [point.unix_s for point in kept]
    steps = [b - a for a, b in pairwise(times)]
    assert len(kept) == MOST_POINTS and times[0] == 0.0 and times[-1] == now_s
    assert sum(now_s - t < DAY_S for t in times) >= 6 and max(steps) < 30 * DAY_S
    assert steps[1] > 10 * steps[-1]
    monkeypatch.setattr(points, "MOST_BYTES", 50 << 20)
    gone = surplus(kept, now_s)
    left = [replace(point) for point in kept if point not in gone]
    assert sum(point.size_bytes for point in left) <= 50 << 20 and left[0] == kept[0]


def test_at_standstill_nothing_is_written(tmp_path: Path) -> None:
    """Two more seconds without motion: the snapshot on the disk holds all that is known."""
    project = machine().project
    estimator, generations = Estimator(project.model), Generations(tmp_path, project.digest)
    estimator.history = None
    rest = simulate(SimulatedPlant(), "standstill", 1, 6.0).samples
    moved = simulate(SimulatedPlant(), "rich", 1, 2.0).samples
    estimator.advance(to_chunk(project.model, moved, int(moved.t_us[0])))
    chunk = to_chunk(project.model, rest, int(rest.t_us[0]))
    chunk[:, 0] += 10.0
    estimator.advance(chunk[:4000])  # what still rings of the motion dies away
    generations.save(estimator, if_changed=True)
    before = written(generations.folder)
    estimator.advance(chunk[4000:])
    generations.save(estimator, if_changed=True)
    assert written(generations.folder) == before
    generations.save(estimator)
    assert written(generations.folder) != before


def written(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*.npz")}


def test_a_point_is_gone_back_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`rtid history` tells its name, `rtid restore` makes it what the next start goes on with."""
    path = tmp_path / "machine.toml"
    path.write_bytes(machine().project.path.read_bytes())
    project = load(path)
    generations = Generations(tmp_path / "machine.state", project.digest)
    estimator = Estimator(project.model)
    estimator.history = None
    estimator.turns = 1  # to know it by
    generations.save(estimator)
    point = generations.keep("publish")
    assert point is not None
    estimator.turns = 2
    generations.save(estimator)
    (generations.folder / WATCH_FILE).write_text("{}")
    (told,) = in_json("history", "-p", str(path))["points"]
    assert (
        told["name"] == point.stem and told["reason"] == "publish" and told["key"] == project.digest
    )
    assert ends("restore", "-p", str(path), "nothing") == 3
    assert ends("restore", "-p", str(path), point.stem) == 0
    restored = Generations(tmp_path / "machine.state", project.digest).restore(project.model)
    assert restored.estimator is not None and restored.estimator.turns == 1
    assert not (generations.folder / WATCH_FILE).exists()
    assert [kept.reason for kept in points_of(generations.folder)] == ["publish", "restore"]
    capsys.readouterr()
    assert ends("history", "-p", str(path)) == 0
    assert point.stem in capsys.readouterr().out
