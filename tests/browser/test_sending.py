"""Maps to a controller on a bus, from the live page: read, then said yes to."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.daemon.status import write
from rtid.project import load
from tests.apply.neighbour import Neighbour, learned, offer, project_file
from tests.bridge.controller import Controller
from tests.browser.conftest import open_page
from tests.browser.geometry import SIZES, assert_clear
from tests.ui.served import served
from tests.ui.test_live_page import status

if TYPE_CHECKING:
    from playwright.sync_api import Browser

GROUP = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
APPLY, SURE = "#live_health [data-do=apply]", "#live_health [data-do=sure]"


def test_the_offer_is_read_and_sent_in_two_clicks(browser: Browser, tmp_path: Path) -> None:
    project, state = (
        project_file(tmp_path, interface="udp_multicast", channel=GROUP),
        tmp_path / "s",
    )
    offer(state, load(project), learned(load(project)))
    write(state, replace(status(), now_unix_s=time.time() + 600.0))
    there = Neighbour(GROUP, Controller(), lambda data, _: [data], "udp_multicast")
    try:
        with served(project=project, state=state, test_bus=True) as bench:
            for opened in open_page(browser, bench):
                opened.go()
                page = opened.page
                for second in open_page(browser, bench, is_another=True):
                    second.go()
                    second.page.wait_for_selector(f"{APPLY}:disabled")
                page.click(APPLY)
                page.wait_for_selector("#live_health >> text=would be version 1")
                assert there.all == []
                assert_clear(page, "#live_health .card h2")
                assert_clear(page, SURE, sizes=SIZES[:-1])  # a telephone scrolls to it
                page.click("#live_health [data-do=not_sure]")
                page.wait_for_selector(APPLY)
                page.click(APPLY)
                page.click(SURE)
                page.wait_for_selector("#work >> text=active: version 1")
                held = there.controller.held(0)
                assert held is not None and held[0] == 1
                page.click(APPLY)
                page.wait_for_selector("#work >> text=no map is offered")
    finally:
        there.stop()
