"""What stands in the plots, as the browser draws it: words that stand in each other, or are cut."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest
from pyarrow import array
from pyarrow.parquet import read_table, write_table

from tests.browser.conftest import Opened, open_page, record
from tests.browser.geometry import DRAWN, SIZES
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, pytest.mark.long]
TAU, HUM_HZ = 2.0 * np.pi, 11.0
DURATION_S = 40.0
# Every word that is written on a canvas since it was cleared, with its box in pixels of the window.
LISTEN = """() => {
  const paper = CanvasRenderingContext2D.prototype, { fillText, clearRect } = paper;
  window.written = new Map();
  paper.clearRect = function (...box) { window.written.delete(this.canvas);
    return clearRect.apply(this, box); };
  paper.fillText = function (words, x, y, ...more) {
    const size = this.measureText(words), turn = this.getTransform();
    const ends = [[x - size.actualBoundingBoxLeft, y - size.actualBoundingBoxAscent],
                  [x + size.actualBoundingBoxRight, y + size.actualBoundingBoxDescent]]
      .map(([a, b]) => turn.transformPoint(new DOMPoint(a, b)));
    const [xs, ys] = [ends.map(e => e.x), ends.map(e => e.y)];
    const all = window.written.get(this.canvas) || [];
    all.push([words, Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)]);
    window.written.set(this.canvas, all);
    return fillText.call(this, words, x, y, ...more); }; }"""
CLASHES = """() => { const said = [];
  for (const [canvas, all] of window.written) if (canvas.isConnected)
    all.forEach(([a, l, r, t, b], k) => all.slice(k + 1).forEach(([c, m, s, u, v]) => {
      const [wide, tall] = [Math.min(r, s) - Math.max(l, m), Math.min(b, v) - Math.max(t, u)];
      if (a.trim() && c.trim() && a !== c && wide > 1 && tall > 1)
        said.push(`${a} | ${c}`); }));
  return [window.written.size, said]; }"""


@pytest.fixture(scope="module")
def unexplained(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page of a record that no known effect explains: a pressure hums."""
    trace, project = record(tmp_path_factory.mktemp("hums"), DURATION_S)
    table = read_table(trace)
    at, t_s = table.column_names.index("p_a"), 1e-3 * np.arange(len(table))
    hums = array(table["p_a"].to_numpy() + 2e5 * np.sin(TAU * HUM_HZ * t_s))
    other = tmp_path_factory.mktemp("unexplained") / "hum.parquet"
    write_table(table.set_column(at, "p_a", hums), other)
    with served(project=project, trace=other) as bench:
        for opened in open_page(browser, bench):
            opened.page.add_init_script(f"({LISTEN})()")
            opened.go("why")
            opened.page.wait_for_selector("#why_says >> text=Most is left")
            yield opened.page


@pytest.mark.parametrize("size", [(1280, 720), *SIZES])
def test_the_words_at_the_ticks_do_not_stand_in_each_other(
    unexplained: Page, size: tuple[int, int]
) -> None:
    """The bands of frequency were one black line at 1280 px: `below 0.25` over `0.25 to 0.5`."""
    page = unexplained
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.wait_for_timeout(500)
    page.evaluate(DRAWN)
    canvases, clashes = page.evaluate(CLASHES)
    assert canvases >= 4 and clashes == []


def test_the_record_s_name_is_whole_where_there_is_room(opened: Opened) -> None:
    """280 px were kept for what goes on, while nothing went on."""
    opened.go()
    page = opened.page
    page.wait_for_selector("#verdict h1 >> text=/model|missing|cannot tell/")
    page.set_viewport_size({"width": 1280, "height": 720})
    page.evaluate("() => { document.querySelector('#work').replaceChildren(); }")
    page.evaluate("""() => { const name = document.querySelector('#record span');
      name.textContent = 'simulated cylinder · worn.blf · 110 s, 110,000 samples'; }""")
    cut = "r => r.scrollWidth > r.clientWidth"
    assert not page.eval_on_selector("#record", cut)
