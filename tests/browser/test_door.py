"""From nothing to the missing effect: file, verdict, project, effect, in five clicks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from pyarrow.parquet import read_table, write_table

from rtid.model import PRESSURE
from rtid.project import load
from rtid.ui.server import Workbench
from tests.browser.conftest import open_page
from tests.browser.geometry import assert_clear
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workbench]:
    """`rtid ui` with nothing, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    with served(project=None) as running:
        yield running


def test_from_a_file_alone_to_the_missing_effect(
    browser: Browser, door: Workbench, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    for opened in open_page(browser, door):
        opened.go()
        page = opened.page
        page.wait_for_selector("text=There is none.")
        page.set_input_files("#arrival_file", recorded[0])
        page.wait_for_selector("#arrival_signals .curve[data-name=p_a] polygon")
        page.wait_for_selector("#arrival_told h3.found >> text=Something is missing")
        page.fill("#size_bore", "52")
        page.fill("#size_rod", "35")
        page.keyboard.press("Tab")
        page.wait_for_selector("#arrival_drawing >> text=bore 52 mm, rod 35 mm, stroke 500 mm?")
        assert page.input_value("#size_bore") == "52", "what was typed stays"
        assert_clear(page)
        page.click("#arrival_told [data-do=judge]")
        page.click("#arrival_told [data-do=keep]")
        project = tmp_path / "worn.toml"
        page.click("#verdict [data-do=add][data-effect=internal_leakage_laminar]")
        page.click("#verdict [data-do=save]")
        page.wait_for_selector("#work >> text=worn.toml")
        loaded = load(project)
        assert "internal_leakage_laminar" in {s.effect for s in loaded.sections.added}
        assert loaded.sections.chambers["a"].piston_diameter_m == pytest.approx(0.052)


@pytest.mark.long
def test_a_role_and_the_sizes_in_six_clicks(
    browser: Browser, door: Workbench, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    """A signal whose name says nothing; its small curve is clicked."""
    table = read_table(recorded[0])
    names = ["Sensor_17" if name == "p_a" else name for name in table.column_names]
    write_table(table.rename_columns(names), tmp_path / "nameless.parquet")
    for opened in open_page(browser, door):
        opened.go()
        page = opened.page
        page.click("#arrival_files [data-do=file][data-name='nameless.parquet']")
        page.wait_for_selector("#arrival_signals .curve[data-name=Sensor_17] polygon")
        page.click("#arrival_signals [data-do=role][data-name=p_a]")
        page.click("#arrival_signals .curve[data-name=Sensor_17]")
        page.wait_for_selector("#arrival_signals [data-do=role][data-name=p_a] >> text=Sensor_17")
        page.fill("#size_bore", "52")
        page.fill("#size_rod", "35")
        page.keyboard.press("Tab")
        page.click("#arrival_told [data-do=judge]")
        page.wait_for_selector("#arrival_told h3.found >> text=Something is missing")
        page.click("#arrival_told [data-do=keep]")
        page.wait_for_selector("#verdict [data-do=add][data-effect=internal_leakage_laminar]")
        loaded = load(tmp_path / "nameless.toml")
        assert loaded.sections.chambers["a"].piston_diameter_m == pytest.approx(0.052)
        assert {s.name for s in loaded.model.signals if s.kind == PRESSURE} >= {"p_a", "p_b"}
