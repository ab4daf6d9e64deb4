"""One page: fragments are escaped, unknown messages do nothing, a slow reader gets no queue."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from pathlib import Path

from bokeh.document import Document
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.tell.html import button, changed, cover, parsed, select, table
from rtid.ui.browser_page import Page
from rtid.ui.shared import Session
from rtid.ui.turns import PAUSE_S, Turns
from tests.ui.test_security import done
from tests.ui.test_session import FakeWorker

EVIL = "<img src=x onerror=\"alert('1')\">&"


class Ticking:
    """A live source that is new at every look."""

    def __init__(self) -> None:
        self.looks = 0

    def hear(self) -> None:
        """A status is read whatever is looked at: the last minute is there when somebody looks."""

    def fragments(self, asking: object = None, follows: bool = False) -> dict[str, str]:
        self.looks += 1
        return {"live_health": f"<p>{self.looks}</p>", "live_learning": ""}


def page() -> tuple[Page, Ticking]:
    session = Session(Path("m.toml"), None, FakeWorker())  # type: ignore[arg-type]
    session.open()
    live = Ticking()
    turns = Turns(lambda _, do: do())
    turns.stop()
    return Page(Document(), session, live, turns), live  # type: ignore[arg-type]


def test_a_page_that_has_not_drawn_the_last_update_gets_no_other() -> None:
    shown, live = page()
    shown._take({"do": "view", "name": "live"})
    sent = []
    for _ in range(200):
        shown._beat()
        sent.append(shown._channel.parts.get("live_health"))
    assert len(set(sent)) == 1
    assert live.looks == 1
    shown._take({"do": "seen", "number": shown._channel.parts["seen"]})
    shown._beat()
    assert shown._channel.parts["live_health"] == "<p>2</p>"


def test_nothing_is_sent_to_a_page_that_looks_at_something_else() -> None:
    shown, live = page()
    shown._take({"do": "view", "name": "compare"})
    for _ in range(10):
        shown._beat()
    assert live.looks == 0


@given(st.text() | st.from_regex(r"\{.*\}"))
def test_whatever_a_page_asks_is_read_without_failing(asked: str) -> None:
    found = parsed(asked)
    assert all(isinstance(k, str) and isinstance(v, str) for k, v in found.items())


@settings(deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["do", "name", "effect", "factor", "share", "mode", "number"]),
        st.sampled_from(
            ["zoom", "pan", "nan", "1e999", "worst", "quantity", "live", "", "\0", "__"]
        ),
    )
)
def test_a_page_asks_for_nonsense_and_nothing_happens(asked: dict[str, str]) -> None:
    shown, _ = page()
    if asked.get("do") not in ("add", "drop", "undo", "save", "export", "release"):
        shown._take(parsed(json.dumps(asked)))
    assert shown.session.revisions == []


def test_words_are_escaped_wherever_they_stand() -> None:
    made = (
        button(EVIL, "add", effect=EVIL),
        select("part", [EVIL], EVIL, EVIL),
        table((EVIL,), []),
        cover(EVIL, [EVIL]),
    )
    for html in made:
        assert "<img" not in html


def test_only_what_has_changed_is_sent() -> None:
    old = {"a": "1", "b": "2"}
    assert changed(old, {"a": "1", "b": "3", "c": "4"}) == {"b": "3", "c": "4"}
    assert old == {"a": "1", "b": "3", "c": "4"}


def test_pages_take_turns_and_the_loop_is_free_between() -> None:
    later, done = list[tuple[float, Callable[[], None]]](), list[int]()
    turns = Turns(lambda seconds, do: later.append((seconds, do)))
    turns.stop()
    for k in range(3):
        turns.take(lambda k=k: done.append(k))  # type: ignore[misc]
    for k in range(3):
        ((seconds, do),) = later  # one at a time, and nothing else is asked for
        later.clear()
        assert done == list(range(k)) and seconds == (PAUSE_S if k else 0.0)
        do()
    assert done == [0, 1, 2] and not later
    turns.is_working = True
    turns.take(lambda: done.append(9))
    later.pop()[1]()
    assert 9 not in done, "what goes on beside the loop is waited for"
    turns.is_working = False
    later.pop()[1]()
    assert done.pop() == 9
    turns.take(lambda: done.append(3))
    later.pop()[1]()
    assert done[-1] == 3


def test_what_is_done_apart_leaves_the_loop_free_and_holds_the_next_step_back() -> None:
    looked, waited = list[bool](), list[bool]()

    async def main() -> None:
        turns = Turns(asyncio.get_running_loop().call_later)
        go_on = threading.Event()
        apart = asyncio.ensure_future(turns.apart(lambda: waited.append(go_on.wait(10.0))))
        await asyncio.sleep(0)
        turns.take(lambda: looked.append(turns.is_working))
        await asyncio.sleep(5 * PAUSE_S)  # the loop is free, and the step waits
        assert not looked
        go_on.set()
        await apart
        while not looked:
            await asyncio.sleep(PAUSE_S)
        turns.stop()

    done(main())
    assert (looked, waited) == ([False], [True])


def test_a_page_that_is_open_while_the_server_stops_draws_nothing() -> None:
    """It said "cannot schedule new futures after shutdown", with a traceback, at each Ctrl-C."""
    drawn = list[int]()

    async def main() -> None:
        turns = Turns(asyncio.get_running_loop().call_later)
        turns.stop()
        await turns.apart(lambda: drawn.append(1))

    done(main())
    assert not drawn


def test_a_follower_changes_nothing_until_it_takes_over() -> None:
    shown, _ = page()
    session = shown.session
    session.join(7)
    session.take_over(7)
    jobs = session.worker.jobs  # type: ignore[attr-defined]
    for what in ("add", "drop", "undo", "save", "export", "release"):
        shown._take({"do": what, "effect": "leak", "where": "a-b"})
    assert not jobs and "following another browser" in shown._channel.parts["work"]
    shown._take({"do": "take_over"})
    shown._take({"do": "save"})
    assert [job[0] for job in jobs] == ["save"]
    assert "1 following" in shown._channel.parts["work"]
