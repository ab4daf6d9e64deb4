"""One page: fragments are escaped, unknown messages do nothing, a slow reader gets no queue."""

from __future__ import annotations

import json
from pathlib import Path

from bokeh.document import Document
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.ui.fragments import button, changed, cover, parsed, select, table
from rtid.ui.page import Page
from rtid.ui.session import Session
from tests.ui.test_session import FakeWorker

EVIL = "<img src=x onerror=\"alert('1')\">&"


class Ticking:
    """A live source that is new at every look."""

    def __init__(self) -> None:
        self.looks = 0

    def fragments(self) -> dict[str, str]:
        self.looks += 1
        return {"live_health": f"<p>{self.looks}</p>", "live_learning": ""}


def page() -> tuple[Page, Ticking]:
    session = Session(Path("m.toml"), None, FakeWorker())  # type: ignore[arg-type]
    session.open()
    live = Ticking()
    return Page(Document(), session, live), live  # type: ignore[arg-type]


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
    if asked.get("do") not in ("add", "drop", "undo", "save", "export"):
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
