"""Two browsers at one workbench: one works, the other follows and may take over."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tests.browser.conftest import open_page
from tests.browser.geometry import assert_clear
from tests.ui.served import project_file, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FOLLOWS, LEADS = "#work .role >> text=following another browser", "#work .role >> text=1 following"
ALONE = "() => !document.querySelector('#work .role')"


def test_a_follower_is_seen_and_takes_over(browser: Browser, tmp_path: Path) -> None:
    with served(project=project_file(tmp_path)) as bench:
        for first in open_page(browser, bench):
            first.go()
            assert first.page.evaluate(ALONE)
            for second in open_page(browser, bench, is_another=True):
                second.go()
                second.page.wait_for_selector(FOLLOWS)
                first.page.wait_for_selector(LEADS)
                assert_clear(second.page, "#work .role button")
                second.page.click("#work >> text=Take over")
                second.page.wait_for_selector(LEADS)
                first.page.wait_for_selector(FOLLOWS)
                first.page.click("#work >> text=Take over")
                second.page.wait_for_selector(FOLLOWS)
                second.page.click("#work >> text=Take over")
                first.page.wait_for_selector(FOLLOWS)
            first.page.wait_for_function(ALONE)  # the writer has gone: the other one works


def test_two_tabs_of_one_browser_are_one(browser: Browser, tmp_path: Path) -> None:
    with served(project=project_file(tmp_path)) as bench:
        for first in open_page(browser, bench):
            first.go()
            tab = first.page.context.new_page()
            tab.goto(bench.url)
            tab.wait_for_selector("body[data-ready=yes]")
            assert tab.evaluate(ALONE) and first.page.evaluate(ALONE)
            assert bench.session.pages.total() == 2 and len(bench.session.pages) == 1
            tab.close()
