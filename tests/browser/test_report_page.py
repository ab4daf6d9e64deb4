"""The report opens from disk in a browser that has no network, and every picture is drawn."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from PIL import Image

from rtid.project import load
from rtid.tell.report_file import Reported, report
from tests.browser.conftest import SIZE, record
from tests.browser.geometry import SIZES, assert_clear

if TYPE_CHECKING:
    from playwright.sync_api import Browser

LONG_ENOUGH_S = 30.0  # to have a part that the fit has not seen
MOST_BYTES, MOST_PAGES = 3_000_000, 4  # of the file, and of its print on A4
# every plot: how many lines or dots it draws, and how wide it is
DRAWN = """() => [...Bokeh.documents].flatMap(d => [...d.all_models])
  .filter(m => m.type === 'Figure')
  .map(m => [m.inner_width, ...m.renderers.map(r => (r.data_source.data.t || [0, 0]).length)])"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    folder = tmp_path_factory.mktemp("report")
    trace, project = record(folder, LONG_ENOUGH_S)
    return report(load(project), trace, folder / "r.html", pictures=folder / "stills")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_opens_with_the_network_off(browser: Browser, written: Reported, scheme: str) -> None:
    assert written.size <= MOST_BYTES
    context = browser.new_context(viewport=SIZE, color_scheme=scheme)  # type: ignore[arg-type]
    context.set_offline(True)
    page, asked, errors = context.new_page(), list[str](), list[str]()
    page.on("request", lambda r: asked.append(r.url))
    page.on("pageerror", lambda e: errors.append(str(e)))
    page.goto(written.path.as_uri())
    page.wait_for_selector("body[data-ready=yes]")
    plots = page.evaluate(DRAWN)
    assert len(plots) >= 8 + 2  # flow and residual, two chambers, before and after; dependences
    assert all(width > 140 for width, *_ in plots)  # four stand side by side
    assert sum(max(lines) > 500 for _, *lines in plots) == 8
    assert page.locator(".bars .bar").count() == 2
    assert_clear(page, "h1", ".figures", sizes=SIZES, schemes=(scheme,))
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert errors == []
    if scheme == "light":
        assert len(re.findall(rb"/Type\s*/Page\b", page.pdf())) <= MOST_PAGES
    context.close()


@pytest.mark.slow
def test_its_pictures_are_files_too(written: Reported) -> None:
    names = [path.name for path in written.pictures]
    drawn = ("errors", "evidence", "flows", "dependences", "maps", "slices", "ranking")
    assert names == [f"{name}.png" for name in drawn]
    for path in written.pictures:
        image = Image.open(path)
        assert image.width >= 1200
        assert len(image.convert("L").getcolors() or []) > 10
