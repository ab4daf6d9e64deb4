"""Maps sent from the page: the dry run is the question, and only what was read is sent."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtid.apply import offer as offered
from rtid.apply.plan import ApplyError
from rtid.apply.versions import Applied
from rtid.estimator.flowmap import FlowMap
from rtid.project import load
from rtid.tell.story import Story, Table
from rtid.ui.desk import Desk
from rtid.ui.sending import Sending, Way, foretell, send
from tests.apply.neighbour import Neighbour, learned, neighbour, offer, project_file
from tests.bridge.controller import Controller


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlowMap, FlowMap]:
    project = load(project_file(tmp_path_factory.mktemp("project")))
    return learned(project, 0), learned(project, 0, 1.1)


def way(folder: Path, there: Neighbour, **publish_keys: object) -> Way:
    path = project_file(folder, interface="virtual", channel=there.channel, **publish_keys)
    return Way(path, folder / "state", test_bus=True)


def silent(_done: int, _of: int) -> None:
    pass


def words(foretold: Sending) -> str:
    return " ".join(part for part in foretold.story.parts if isinstance(part, str))


def test_the_question_is_the_dry_run_and_sends_no_frame(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    with neighbour() as there:
        to = way(tmp_path, there)
        offer(tmp_path / "state", load(to.project), maps[0])
        asked = Desk(lambda text, share: None).foretell(to)
        assert there.all == []
    assert asked.may_go and asked.story.heading.startswith("Offered: on 25 s of motion")
    assert "holds no map" in words(asked) and "would be version 1:" in words(asked)
    (changes,) = [part for part in asked.story.parts if isinstance(part, Table)]
    assert changes.heads[1] == "largest L/min|" and changes.heads[-1] == "table %|"
    errors = [float(row[-1]) for row in changes.rows]
    assert len(errors) == 4 and all(0 < error <= 0.5 for error in errors)
    assert "<td" in asked.html() and asked.html().endswith("<p>Send it?</p>")


def test_what_was_read_is_sent(tmp_path: Path, maps: tuple[FlowMap, FlowMap]) -> None:
    heard: list[tuple[int, int]] = []
    with neighbour(Controller()) as there:
        to = way(tmp_path, there)
        for k, flow_map in enumerate(maps):
            offer(tmp_path / "state", load(to.project), flow_map, against=k or None)
            seen = foretell(to)
            said = send(to, seen, lambda done, of: heard.append((done, of)))
            assert isinstance(said, str) and said.startswith(f"active: version {k + 1};")
            held = there.controller.held(0)
            assert held is not None and held[0] == k + 1
        (changes,) = [part for part in seen.story.parts if isinstance(part, Table)]
        assert all(float(row[1]) != 0.0 for row in changes.rows)
    assert heard[-1][0] == heard[-1][1] > 0
    assert not offered.exists(tmp_path / "state")


def test_a_controller_that_tells_another_story_is_asked_about_anew(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    """It was switched off: the map that the records have is no longer there."""
    with neighbour(Controller()) as there:
        to = way(tmp_path, there)
        offer(tmp_path / "state", load(to.project), maps[0])
        send(to, foretell(to), silent)
        offer(tmp_path / "state", load(to.project), maps[1], against=1)
        seen = foretell(to)
        assert "holds version 1" in words(seen)
        there.controller = Controller()
        other = send(to, seen, silent)
        assert isinstance(other, Sending) and "holds no map" in words(other)
        assert there.controller.held(0) is None
        assert len(Applied(tmp_path / "state").rows()) == 1
        said = send(to, other, silent)
        assert isinstance(said, str) and said.startswith("active: version 2;")


def test_an_offer_that_came_meanwhile_is_not_sent_unread(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    with neighbour(Controller()) as there:
        to = way(tmp_path, there)
        offer(tmp_path / "state", load(to.project), maps[0])
        seen = foretell(to)
        offer(tmp_path / "state", load(to.project), maps[1])
        assert isinstance(send(to, seen, silent), Sending)
        assert there.controller.held(0) is None


def test_what_a_limit_forbids_cannot_be_said_yes_to(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    with neighbour(Controller()) as there:
        to = way(tmp_path, there, max_change_percent=1)
        offer(tmp_path / "state", load(to.project), maps[0])
        send(to, foretell(to), silent)
        offer(tmp_path / "state", load(to.project), maps[1], against=1)
        seen = foretell(to)
        assert not seen.may_go and "refused: " in seen.html() and "Send it?" not in seen.html()
        assert send(to, seen, silent) == ""
        held = there.controller.held(0)
        assert held is not None and held[0] == 1


def test_a_bus_that_anybody_may_write_to_needs_its_own_word(
    tmp_path: Path, maps: tuple[FlowMap, FlowMap]
) -> None:
    with neighbour() as there:
        to = way(tmp_path, there)
        offer(tmp_path / "state", load(to.project), maps[0])
        with pytest.raises(ApplyError, match="anybody may write"):
            send(Way(to.project, to.state), foretell(to), silent)
        assert there.all == []


def test_words_of_a_question_are_no_html() -> None:
    evil = "<img src=x onerror=alert(1)>"
    table = Table("", (evil,), [(evil,)])
    asked = Sending(Story(evil, (evil, table)), (evil,))
    assert "<img" not in asked.html() and asked.html().count("&lt;img") == 5
    assert Sending(Story("", ()), is_same=True).html().endswith("nothing to send.</p>")
