"""`rtid apply` as a whole: asked, shown, limited, sent, written down, taken back."""

from __future__ import annotations

import json
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import lookup
from firmware_bridge.download import DownloadError, Image, Session, UnconfirmedError, download
from firmware_bridge.lookup import crc32
from firmware_bridge.protocol import LAST_VERSION, Op, Reason
from rtid.apply import offer as offered
from rtid.apply.offer import NoOfferError
from rtid.apply.plan import ApplyError
from rtid.apply.session import Plan, apply_map
from rtid.apply.versions import DONE, UNCONFIRMED, Applied, VersionRow
from rtid.apply.wish import Wish
from rtid.cli.exits import Exit
from rtid.estimator.flowmap import FlowMap
from rtid.project import Project, load
from tests.apply.neighbour import Neighbour, learned, loaded, neighbour, offer, project_file
from tests.bridge.controller import Controller, Line
from tests.bridge.downloads import SPOILS, damaging, losing
from tests.bridge.tables import a_table
from tests.command import ends, in_json
from tests.eighty import eighty  # noqa: F401


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlowMap, FlowMap]:
    project = loaded(tmp_path_factory.mktemp("project"))
    return learned(project, 0), learned(project, 0, 1.1)


def sent(
    path: Path, there: Neighbour, folder: Path, undo: bool = False, unknown: bool = False
) -> tuple[Plan, VersionRow | None]:
    wish = Wish(
        undo=undo, bus=f"virtual:{there.channel}", state=folder, test_bus=True,
        replace_unknown=unknown,
    )  # fmt: skip
    return apply_map(path, wish, lambda plan: True)


def until_closed(there: Neighbour, since: int = 0) -> set[int]:
    """What the controller was asked; CLOSE has no answer, and may be on its way still."""
    last_s = time.monotonic() + 5.0
    while Op.CLOSE not in (asked := {data[0] for data in there.heard[since:]}):
        assert time.monotonic() < last_s
        time.sleep(0.01)
    return asked


def held_slots(project: Project, controller: Controller) -> dict[int, int]:
    slots = range(len(project.model.edges) + 1)
    held = {slot: controller.held(slot) for slot in slots}
    return {slot: one[1] for slot, one in held.items() if one}


def test_the_map_that_arrives_is_the_one_that_was_learned(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    path, folder = project_file(tmp_path, error_percent=0.1), tmp_path / "state"
    project, controller = load(path), Controller()
    offer(folder, project, maps[0])
    with neighbour(controller) as there:
        plan, row = sent(path, there, folder)
    assert row is not None and row.outcome == DONE and row.version == 1
    rng, worst = np.random.default_rng(0), 0.0
    for slot, edge in enumerate(project.model.edges):
        grid = edge.grid
        w = rng.uniform(grid.u_v[0], grid.u_v[-1], 20_000)
        dp = rng.uniform(grid.dp_pa[0], grid.dp_pa[-1], 20_000)
        q, _ = controller.flow(slot, edge.direction * w, dp)
        off = np.abs(q - maps[0][edge.name].flow(w, dp)).max() / edge.rated_q_m3s
        worst = max(worst, float(off))
        told = plan.prepared.sampled[slot].error_max_m3s / edge.rated_q_m3s
        assert off < 1.2 * told + 1e-5
    print(f"\ncontroller against the published map: {100 * worst:.3f} % of the rated flow")
    assert worst < 1e-3
    np.testing.assert_allclose(controller.numbers(4), [8.1e8, 1e6, 8.3e8, 2e6], rtol=1e-6)
    assert not offered.exists(folder), "an offer is for one apply"


def test_nothing_is_sent_before_yes(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    """Before that only the questions what it has room for, and what it holds."""
    path, folder = project_file(tmp_path), tmp_path / "state"
    offer(folder, load(path), maps[0])
    with neighbour() as there:
        wish = Wish(bus=f"virtual:{there.channel}", state=folder, test_bus=True)
        plan, row = apply_map(path, wish, lambda plan: False)
        asked = until_closed(there)
    assert row is None and not plan.objections
    assert asked == {Op.OPEN, Op.QUERY, Op.CLOSE}
    assert Applied(folder).rows() == [] and Applied(folder).contents() == []


def test_a_dry_run_sends_no_frame_at_all(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    offer(folder, load(path), maps[0])
    with neighbour() as there:
        wish = Wish(bus=f"virtual:{there.channel}", state=folder, dry_run=True)
        plan, row = apply_map(path, wish, lambda plan: True)
        assert there.all == []
    assert row is None and len(plan.review.differences) == 4


def test_difference_apply_and_undo(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    project = load(path)
    with neighbour(controller) as there:
        offer(folder, project, maps[0])
        first = sent(path, there, folder)[0]
        before = held_slots(project, controller)
        assert not first.review.holds and np.isnan(first.review.differences[0].largest_m3s)
        offer(folder, project, maps[1], against=1)
        second, row = sent(path, there, folder)
        assert row is not None and (row.version, row.content) == (2, 2)
        for one, edge in zip(second.review.differences, project.model.edges, strict=True):
            grid, at_w = edge.grid, edge.direction * one.u_v
            at_dp = np.clip(one.dp_pa, grid.dp_pa[0], grid.dp_pa[-1])
            exact = maps[1][edge.name].flow(at_w, at_dp) - maps[0][edge.name].flow(at_w, at_dp)
            assert one.largest_m3s == pytest.approx(float(exact), abs=0.01 * edge.rated_q_m3s)
            w, dp = np.meshgrid(
                np.linspace(grid.u_v[0], grid.u_v[-1], 150),
                np.linspace(grid.dp_pa[0], grid.dp_pa[-1], 150),
            )
            anywhere = np.abs(maps[1][edge.name].flow(w, dp) - maps[0][edge.name].flow(w, dp))
            assert abs(one.largest_m3s) > anywhere.max() - 0.01 * edge.rated_q_m3s
            assert 0 < one.rms_m3s < abs(one.largest_m3s)
            assert abs(one.believed_m3s) <= abs(one.largest_m3s) and 0 < one.valid < 1
        assert held_slots(project, controller) != before

        back, row = sent(path, there, folder, undo=True)
        assert row is not None and (row.version, row.content) == (3, 1)
        assert held_slots(project, controller) == before
        assert back.review.differences[0].largest_m3s == pytest.approx(
            -second.review.differences[0].largest_m3s
        )
        with pytest.raises(ApplyError, match="nothing to go back to"):
            sent(path, there, folder, undo=True)
    with sqlite3.connect(folder / "history.sqlite") as database:
        rows = database.execute("SELECT version, content, outcome, told FROM applied").fetchall()
    assert [row[:3] for row in rows] == [(1, 1, DONE), (2, 2, DONE), (3, 1, DONE)]
    assert json.loads(rows[1][3])["edges"][0]["largest_m3s"] is not None


def test_undo_twice_goes_back_twice(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    project, seen = load(path), []
    with neighbour(controller) as there:
        for k, flow_map in enumerate((maps[0], maps[1], learned(project, 3))):
            offer(folder, project, flow_map, against=k or None)
            sent(path, there, folder)
            seen.append(held_slots(project, controller))
        for wanted in (seen[1], seen[0]):
            sent(path, there, folder, undo=True)
            assert held_slots(project, controller) == wanted


def test_a_controller_that_was_switched_off_gets_its_map_again(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    with neighbour(controller) as there:
        wish = Wish(again=True, bus=f"virtual:{there.channel}", state=folder, test_bus=True)
        offer(folder, load(path), maps[0])
        with pytest.raises(ApplyError, match="nothing was ever sent"):
            apply_map(path, wish, lambda plan: True)
        sent(path, there, folder)
        assert apply_map(path, wish, lambda plan: True)[0].is_same
        held = held_slots(load(path), controller)
        there.controller = Controller()
        row = apply_map(path, wish, lambda plan: True)[1]
        assert row is not None and (row.version, row.content) == (2, 1)
        assert held_slots(load(path), there.controller) == held
        with pytest.raises(ApplyError, match="nothing to go back to"):
            sent(path, there, folder, undo=True)


def test_limits(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    folder, controller = tmp_path / "state", Controller()
    path = project_file(tmp_path)
    project = load(path)
    with neighbour(controller) as there:
        offer(folder, project, maps[0])
        sent(path, there, folder)
        until_closed(there)
        before, told = held_slots(project, controller), len(there.heard)
        path = project_file(tmp_path, max_change_percent=2.0, least_interval_s=300)
        offer(folder, project, maps[1], against=1)
        plan, row = sent(path, there, folder)
        assert row is None and held_slots(project, controller) == before
        text = " ".join(plan.objections)
        assert "max_change_percent is 2" in text and "least_interval_s is 300" in text
        assert until_closed(there, told) == {Op.OPEN, Op.QUERY, Op.CLOSE}


def test_the_same_map_is_not_sent_again(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    with neighbour() as there:
        offer(folder, load(path), maps[0])
        sent(path, there, folder)
        offer(folder, load(path), maps[0], against=1)
        plan, row = sent(path, there, folder)
    assert plan.is_same and row is None


def test_maps_of_somebody_else(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    """What the controller holds was sent from another folder: nobody knows what would change."""
    path, controller = project_file(tmp_path), Controller()
    with neighbour(controller) as there:
        offer(tmp_path / "theirs", load(path), maps[0])
        sent(path, there, tmp_path / "theirs")
        offer(tmp_path / "theirs", load(path), maps[1], against=1)
        sent(path, there, tmp_path / "theirs")  # their versions are ahead of ours
        offer(tmp_path / "ours", load(path), maps[0])
        plan, row = sent(path, there, tmp_path / "ours")
        assert row is None and "not sent from here" in plan.objections[0]
        with pytest.raises(ApplyError, match="nothing to go back to"):
            sent(path, there, tmp_path / "ours", undo=True)
        plan, row = sent(path, there, tmp_path / "ours", unknown=True)
        assert row is not None and row.version == 3


def test_an_offer_that_was_judged_against_another_map(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    with neighbour() as there:
        offer(folder, load(path), maps[0])
        sent(path, there, folder)
        offer(folder, load(path), maps[1], against=None)
        with pytest.raises(ApplyError, match="controller holds 1"):
            sent(path, there, folder)


def test_without_an_offer(tmp_path: Path) -> None:
    path = project_file(tmp_path)
    with neighbour() as there, pytest.raises(NoOfferError, match="no map is offered"):
        sent(path, there, tmp_path / "state")


@pytest.mark.parametrize("name", SPOILS)
def test_over_a_bad_bus(tmp_path: Path, maps: tuple[FlowMap, FlowMap], name: str) -> None:
    """The lines of tests/bridge/downloads.py, on a virtual bus and in real time."""
    path, folder, controller = project_file(tmp_path, error_percent=5), tmp_path / "s", Controller()
    make, share = SPOILS[name]
    offer(folder, load(path), maps[0])
    with neighbour(controller, make(share, 1)) as there:
        plan, row = sent(path, there, folder)
        chunks = sum(-(-len(data) // 6) for data in plan.prepared.images.values())
        print(f"\n{name}: {len(there.heard) / chunks:.2f} frames heard per chunk")
    assert row is not None and held_slots(load(path), controller) == row.crcs


def test_nobody_on_the_bus(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    offer(folder, load(path), maps[0])
    wish = Wish(bus="virtual:nobody-here", state=folder, test_bus=True)
    with pytest.raises(DownloadError, match="does not answer"):
        apply_map(path, wish, lambda plan: True)
    assert Applied(folder).rows() == [] and offered.exists(folder)


def test_over_a_bus_that_loses_and_damages(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    spoil, damage = losing(0.02, 1), damaging(0.01, 2)

    def both(data: bytes, is_answer: bool) -> list[bytes]:
        return [out for kept in spoil(data, is_answer) for out in damage(kept, is_answer)]

    with neighbour(controller, both) as there:
        offer(folder, load(path), maps[0])
        plan, row = sent(path, there, folder)
    assert row is not None
    wanted = {slot: crc32(data) for slot, data in plan.prepared.images.items()}
    assert held_slots(load(path), controller) == wanted
    assert controller.counts[0] > 0, "damaged frames came, and were refused"


def test_a_controller_that_dies_in_the_middle(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    project = load(path)
    left = [10**6]

    def dies(data: bytes, is_answer: bool) -> list[bytes]:
        left[0] -= 1
        return [data] if left[0] > 0 else []

    with neighbour(controller, dies) as there:
        offer(folder, project, maps[0])
        sent(path, there, folder)
        before = held_slots(project, controller)
        offer(folder, project, maps[1], against=1)
        left[0] = 400
        with pytest.raises(DownloadError, match=r"does not answer|has not taken"):
            sent(path, there, folder)
        assert held_slots(project, controller) == before
        assert [row.version for row in Applied(folder).rows()] == [1]
        assert Applied(folder).contents() == [1] and offered.exists(folder)
        left[0] = 10**6
        controller.now_ms += 5000
        assert sent(path, there, folder)[1] is not None


def test_a_confirmation_that_is_lost(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()

    def lost(data: bytes, is_answer: bool) -> list[bytes]:
        return [] if is_answer and data[:2] == bytes([Op.REPLY, Op.COMMIT]) else [data]

    with neighbour(controller, lost) as there:
        offer(folder, load(path), maps[0])
        with pytest.raises(UnconfirmedError):
            sent(path, there, folder)
        rows = Applied(folder).rows()
        assert [row.outcome for row in rows] == [UNCONFIRMED]
        with pytest.raises(NoOfferError):  # the controller has said by then that it holds it
            sent(path, there, folder)
        assert [row.outcome for row in Applied(folder).rows()] == [UNCONFIRMED, DONE]


def test_not_at_standstill(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    controller.hold(True)
    with neighbour(controller) as there:
        offer(folder, load(path), maps[0])
        with pytest.raises(DownloadError) as refused:
            sent(path, there, folder)
    assert refused.value.reason == Reason.NOT_NOW and "standstill" in refused.value.remedy


def test_two_applies_at_once(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder = project_file(tmp_path), tmp_path / "state"
    offer(folder, load(path), maps[0])
    with neighbour() as there:

        def meanwhile(plan: Plan) -> bool:
            with pytest.raises(ApplyError, match="under way"):
                sent(path, there, folder)
            return False

        wish = Wish(bus=f"virtual:{there.channel}", state=folder, test_bus=True)
        apply_map(path, wish, meanwhile)


def test_somebody_else_comes_while_you_think(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    path, folder, controller = project_file(tmp_path), tmp_path / "state", Controller()
    offer(folder, load(path), maps[0])
    theirs = Image(lookup.image(a_table(), 2))

    def meanwhile(plan: Plan) -> bool:
        other = Session(Line(controller, time_s=1e3))
        other.open()
        download(other, {2: theirs}, 1)
        other.close()
        return True

    with neighbour(controller) as there:
        wish = Wish(bus=f"virtual:{there.channel}", state=folder, test_bus=True)
        with pytest.raises(ApplyError, match="meanwhile"):
            apply_map(path, wish, meanwhile)
    assert controller.held(2) == (1, theirs.crc) and controller.held(0) is None


@pytest.mark.usefixtures("eighty")
def test_the_command(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap], capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = project_file(tmp_path), tmp_path / "cylinder.state"
    offer(folder, load(path), maps[0])
    with neighbour() as there:
        call = ["apply", str(path), "--bus", f"virtual:{there.channel}", "--test-bus"]
        assert ends(*call) == Exit.USAGE  # nobody can be asked
        assert "--yes" in capsys.readouterr().err
        assert ends(*call, "--yes") == Exit.OK
        out = capsys.readouterr().out
        assert "holds no map" in out and "active: version 1" in out and "on data" in out
        offer(folder, load(path), maps[1], against=1)
        assert ends(*call, "--json", "--yes") == Exit.OK
        told = json.loads(capsys.readouterr().out)
        assert told["applied"]["version"] == 2 and len(told["edges"]) == 4
        assert ends(*call, "--undo", "--yes") == Exit.OK
        capsys.readouterr()
        assert ends("apply", path, "--log") == Exit.OK
        listed = capsys.readouterr().out.splitlines()
        assert "version 3, the maps of version 1: done, by " in listed[2]
        assert listed[3:] == [f"Next: rtid status {path}"]
        assert [row["version"] for row in in_json("apply", path, "--log")] == [1, 2, 3]
        assert ends(*call, "--yes") == Exit.NEGATIVE  # no offer
        assert "no map is offered" in capsys.readouterr().err
        assert ends("apply", path, "--bus", f"virtual:{there.channel}") == Exit.USAGE


def test_the_project_file_must_declare_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = project_file(tmp_path)
    path.write_text(path.read_text().replace("can_id = 1792\n", ""))
    assert ends("apply", path) == Exit.USAGE
    assert "publish.can_id" in capsys.readouterr().err
    path.write_text(path.read_text().replace("reply_id = 1793\n", ""))
    assert ends("apply", path) == Exit.USAGE
    assert "nothing can be sent" in capsys.readouterr().err
    assert ends("apply", project_file(tmp_path, can_id=0x120)) == Exit.USAGE
    assert "that of ValveCommand" in capsys.readouterr().err
    assert ends("apply", project_file(tmp_path, status=True)) == Exit.USAGE
    assert "publish.status_id" in capsys.readouterr().err
    assert ends("apply", project_file(tmp_path, first_slot=12)) == Exit.USAGE
    assert "publish.first_slot" in capsys.readouterr().err


@pytest.mark.parametrize("dry_run", [False, True])
def test_no_map_is_newer_than_the_last_version(
    dry_run: bool, tmp_path: Path, maps: tuple[FlowMap, FlowMap], capsys: pytest.CaptureFixture[str]
) -> None:
    """The controller, or a folder of this machine, has come to the end of the numbers."""
    path, folder = project_file(tmp_path), tmp_path / "state"
    project, controller = load(path), Controller()
    offer(folder, project, maps[0])
    session = Session(Line(controller))
    session.open()
    foreign = Image(lookup.image(a_table(), 0))
    download(session, {0: foreign}, LAST_VERSION)
    session.close()
    if dry_run:
        (folder / "applied" / f"v{LAST_VERSION}").mkdir(parents=True)
    with neighbour(controller) as there:
        arguments = ["apply", str(path), "--bus", f"virtual:{there.channel}", "--state"]
        arguments += [str(folder), "--test-bus", "--yes", "--replace-unknown"]
        assert ends(*arguments, *["--dry-run"] * dry_run) == 3
    said = capsys.readouterr().err
    assert f"version {LAST_VERSION}: no map can be newer" in said and "Traceback" not in said
    assert controller.held(0) == (LAST_VERSION, foreign.crc)
