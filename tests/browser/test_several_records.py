"""A project whose fit is made of several records, on the page as in the shell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from rtid.study.study import Study
from rtid.units import show_flow_as
from tests.browser.conftest import open_page
from tests.test_rate import Crane, said
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow


@pytest.mark.long
def test_the_page_shows_all_records_of_a_project(browser: Browser, tmp_path: Path) -> None:
    """It learned from the first alone, cut where the others stand."""
    rng = np.random.default_rng(30)
    crane = Crane.drawn(rng)
    days = [crane.recorded(tmp_path / f"day{k}.csv", rng, seconds=110.0) for k in range(3)]
    project = tmp_path / "jib.toml"
    judged = json.loads(said("quick", *days, "--save", project, "--json"))
    assert [Path(r["path"]).name for r in judged["records"]] == ["day0.csv", "day1.csv", "day2.csv"]
    study = Study(project, days[0])
    wanted = [100 * error.left / error.flow for error in study.record_errors]
    try:
        with served(project=project, trace=days[0]) as bench:
            for opened in open_page(browser, bench):
                opened.go()
                page = opened.page
                page.wait_for_selector("#compare_says >> text=Of each record")
                says = page.locator("#compare_says").inner_text()
                first, second, third = wanted
                assert (
                    f"day0.csv {first:.2g} %, day1.csv {second:.2g} %, "
                    f"day2.csv {third:.2g} % (held out)"
                ) in says
                assert "day0.csv, day1.csv, day2.csv" in page.locator("#record").inner_text()
                page.wait_for_selector("#verdict h1 >> text=/model|missing/")
    finally:
        show_flow_as("m3/s")


def test_several_records_without_a_project_make_one(browser: Browser, tmp_path: Path) -> None:
    """`rtid ui A B` said "more than one trace or project"; `rtid quick A B` took both."""
    rng = np.random.default_rng(31)
    crane = Crane.drawn(rng)
    days = [crane.recorded(tmp_path / f"day{k}.csv", rng, seconds=110.0) for k in range(2)]
    try:
        with served(project=None, trace=days[0], more=days[1:]) as bench:
            for opened in open_page(browser, bench):
                opened.go()
                page = opened.page
                page.click("#arrival_told [data-do=keep]")
                page.wait_for_selector("#compare_says >> text=Of each record")
                assert "day0.csv, day1.csv" in page.locator("#record").inner_text()
    finally:
        show_flow_as("m3/s")
