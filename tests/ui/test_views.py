"""The table of views: all of the page's own are in it, and one of another package joins them."""

from __future__ import annotations

import tomllib
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from rtid.ui.desk_views import DeskViews
from rtid.ui.views import VIEWS, Failed, ViewRow, made, places_of, table
from tests.ui.plugins import install, snippet
from tests.ui.served import project_file, served

HEADING = "A view on the page"


@pytest.fixture
def balance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ViewRow:
    """The view of docs/extending.md, installed: one file and one row."""
    named = tomllib.loads(snippet(HEADING, "toml"))["project"]["entry-points"]["rtid.views"]
    lines = "".join(f"{name} = {where}\n" for name, where in named.items())
    code = snippet(HEADING, "python")
    install(tmp_path, "my_view", code, f"[rtid.views]\n{lines}", monkeypatch)
    return table()["balance"]


def bench(rows: int = 200) -> Any:
    """What a page gives its views, of a record with two chambers."""
    left = np.arange(2.0 * rows).reshape(rows, 2) / 6e4
    look = SimpleNamespace(parts={"identification": SimpleNamespace(
        equation=SimpleNamespace(residual_m3s=left))})  # fmt: skip
    return SimpleNamespace(look=look)


def page_at(url: str) -> str:
    """The page of a browser that opens the printed address, which gives it its cookie."""
    where = urlsplit(url)
    connection = HTTPConnection(where.netloc, timeout=30)
    connection.request("GET", f"/?{where.query}")
    welcome = connection.getresponse()
    welcome.read()
    cookie = (welcome.getheader("Set-Cookie") or "").partition(";")[0]
    connection.request("GET", "/", headers={"Cookie": cookie})
    answer = connection.getresponse().read().decode()
    connection.close()
    return answer


def test_the_view_of_another_package_has_a_tab_and_its_places_in_the_served_page(
    balance: ViewRow, tmp_path: Path
) -> None:
    with served(project=project_file(tmp_path)) as running:
        html = page_at(running.url)
    assert 'data-view="balance"' in html
    assert html.index('data-view="live"') < html.index('data-view="balance"')
    assert 'class="view plain" id="balance"' in html
    for place in ("balance_tools", "balance_says"):
        assert f'id="{place}"' in html
    assert all(f'id="{view}" role="tabpanel"' in html for view in VIEWS)


def test_it_draws_what_is_left_of_the_newest_revision(balance: ViewRow) -> None:
    newest = bench()
    view = made(balance, newest)
    view.refresh()
    plot = view.roots["plot"]
    (dots,) = [r.data_source for r in plot.renderers if "mean" in r.data_source.data]
    assert len(dots.data["x"]) == 10
    np.testing.assert_allclose(dots.data["mean"] - dots.data["x"], 1.0)
    newest.look = bench(400).look
    view.refresh()
    assert len(dots.data["x"]) == 20


def test_one_that_fails_says_so_in_its_own_place_and_the_page_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "raise OSError('<no licence>')"
    entries = "[rtid.views]\nbroken = broken_view:View\ncompare = broken_view:View\n"
    install(tmp_path, "broken_view", code, entries, monkeypatch)
    rows = table()
    assert list(rows) == [*VIEWS, "broken", "own_compare"]  # nobody takes the place of the page's
    assert rows["compare"] is VIEWS["compare"]
    view = made(rows["broken"], bench())
    assert isinstance(view, Failed)
    assert "&lt;no licence&gt;" in view.fragments()["says"]
    assert [place.name for place in places_of("broken", rows["broken"])] == ["broken_says"]


TROUBLE = """
from rtid.ui.views import PageView

class View(PageView):
    places = ("tools", "plot")
    is_well = True

    def __init__(self, bench):
        super().__init__(bench)
        self.actions = {"finer": lambda asked: self.fail()}
        self.roots = bench.roots

    def fail(self):
        if not self.is_well:
            raise ValueError("no <x>")

    refresh = fail

    def fragments(self):
        self.fail()
        return {"tools": "a button"}
"""


def test_one_that_fails_later_says_so_and_is_well_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever it is asked: to refresh, for its words, to act; where it failed is printed once."""
    install(tmp_path, "ill_view", TROUBLE, "[rtid.views]\nworn-bore = ill_view:View\n", monkeypatch)
    row = table()["worn_bore"]  # a name that the page can have
    assert row.places == ("tools", "plot", "says")
    view = made(row, SimpleNamespace(roots={}))  # type: ignore[arg-type]
    assert view.fragments() == {"tools": "a button"}
    view._view.is_well = False  # type: ignore[attr-defined]
    for ask in (view.refresh, lambda: view.actions["finer"]({}), view.fragments):
        ask()
        assert view.fragments() == {"says": "ill_view:View failed: ValueError: no &lt;x&gt;"}
    assert capsys.readouterr().err.count("ValueError: no <x>") == 1
    view._view.is_well = True  # type: ignore[attr-defined]
    view.refresh()
    assert view.fragments() == {"tools": "a button"}
    lost = made(row, SimpleNamespace(roots={"curve": None}))  # type: ignore[arg-type]
    assert lost.fragments() == {"says": "ill_view:View: no place for curve; `places` has plot"}


def test_a_word_that_two_views_act_on_is_that_of_the_view_looked_at() -> None:
    asked: list[str] = []
    desk = DeskViews.__new__(DeskViews)
    views: Any = {
        name: SimpleNamespace(actions={"finer": lambda _, n=name: asked.append(n)}, fragments=dict)
        for name in "ab"
    }
    desk._views = views
    desk._put, desk._looked_at = lambda parts: None, "b"
    desk.take("finer", {})
    assert asked == ["b"]
