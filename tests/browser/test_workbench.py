"""From a record to the missing effect, added and taken back, as a user does it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtid.mapfiles import read_map
from rtid.project import load
from tests.browser.conftest import DURATION_S, Opened, open_page
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow
NAMED = "#verdict button.main[data-do=add]"
BARS = "#add_bars .bar:not(.foretold)"


def errors(opened: Opened) -> list[float]:
    """Held-out error of every revision, in per cent, as its bar says."""
    found = opened.page.eval_on_selector_all(BARS, "bars => bars.map(b => b.dataset.error)")
    return [float(value) for value in found]


def widths(opened: Opened) -> list[float]:
    return [
        float(w)
        for w in opened.page.eval_on_selector_all(
            BARS, "bars => bars.map(b => b.getBoundingClientRect().width)"
        )
    ]


def test_a_record_opens_and_every_view_is_drawn(opened: Opened) -> None:
    opened.go()
    page = opened.page
    page.wait_for_selector("#compare canvas")
    page.wait_for_selector("#compare_says b")
    titles = page.evaluate(
        "() => [...Bokeh.documents[0].all_models].filter(m => m.type === 'Title').map(m => m.text)"
    )
    fits = [t for t in titles if "fit" in t]
    assert len(fits) == 2
    wanted = re.compile(r"free run - fit -?[\d.]+ % identification, -?[\d.]+ % held-out")
    assert all(wanted.search(title) for title in fits)
    for key, view in (("2", "where"), ("3", "why"), ("4", "add"), ("5", "map"), ("6", "live")):
        page.keyboard.press(key)
        page.wait_for_selector(f"#{view}.shown")
        if view in ("where", "add", "map"):
            page.wait_for_selector(f"#{view} canvas")
    page.wait_for_selector("#live_health >> text=No daemon has been heard")


def test_the_horizon_is_switched_and_the_title_says_so(opened: Opened) -> None:
    opened.go("compare")
    page = opened.page
    page.click("#compare_tools >> text=0.1 s ahead")
    page.wait_for_function(
        "() => [...Bokeh.documents[0].all_models]"
        ".some(m => m.type === 'Title' && m.text.includes('0.1 s ahead'))"
    )
    page.wait_for_selector("#compare_tools [aria-pressed=true] >> text=0.1 s ahead")


def test_zooming_draws_what_is_seen_anew(opened: Opened) -> None:
    opened.go("compare")
    page = opened.page
    page.wait_for_selector("#compare canvas")
    spans = (
        "[...Bokeh.documents[0].all_models].filter(m => m.type === 'ColumnDataSource' &&"
        " m.tags.length && m.data.t.length > 100).map(m => m.data.t[m.data.t.length - 1] -"
        " m.data.t[0])"
    )
    whole = f"() => {spans}.filter(s => s > {0.9 * DURATION_S}).length >= 12"
    page.wait_for_function(whole)
    for _ in range(3):
        page.keyboard.press("+")
    page.wait_for_function(f"() => {spans}.filter(s => s < {0.2 * DURATION_S}).length >= 12")
    page.keyboard.press("2")  # the next view shows the same time
    page.wait_for_selector("#where.shown")
    page.wait_for_function(f"() => {spans}.filter(s => s < {0.2 * DURATION_S}).length >= 14")
    page.keyboard.press("1")
    page.keyboard.press("0")
    page.wait_for_function(whole)


def test_the_block_with_the_largest_error_lights_its_spans(opened: Opened) -> None:
    """Clicked on the plane itself, at the place that the page says holds most."""
    opened.go("where")
    page = opened.page
    page.wait_for_selector("#where_says b")
    page.wait_for_selector("#where canvas")
    edge, i, j = page.evaluate(LARGEST)
    at = page.evaluate(PLACE, [edge, i, j])
    page.mouse.click(at["x"], at["y"])
    page.wait_for_selector("text=these spans are marked")
    lit = page.evaluate(
        "() => [...Bokeh.documents[0].all_models].filter(m => m.data && m.data.x0 && m.data.x1"
        " && !m.data.y0).map(m => m.data.x0.length)"
    )
    assert max(lit) > 0
    words = page.locator("#where_says").inner_text()
    assert words.startswith(f"Block {edge},")
    page.keyboard.press("Escape")
    page.wait_for_selector("text=Click a block")


def test_a_time_span_outlines_its_blocks(opened: Opened) -> None:
    opened.go("where")
    page = opened.page
    page.wait_for_selector("#where_says b")
    page.keyboard.press("s")
    page.wait_for_selector("#where_tools [data-mode=span][aria-pressed=true]")
    box = page.evaluate(STRIP)
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 0.5 * box["height"], steps=5)
    page.mouse.up()
    page.wait_for_selector("#where_says >> text=the valves were in")
    count = int(re.findall(r"(\d+) blocks", page.locator("#where_says").inner_text())[0])
    outlined = page.evaluate(
        "() => [...Bokeh.documents[0].all_models].filter(m => m.type === 'ColumnDataSource' &&"
        " m.data.x && m.data.y && Object.keys(m.data).length === 2)"
        ".reduce((sum, m) => sum + m.data.x.length, 0)"
    )
    assert 1 <= outlined == count
    page.keyboard.press("Escape")
    page.keyboard.press("z")


STRIP = """() => {
  const find = (views) => { for (const v of views) {
    if (v.model.type === "Figure" && v.model.title.text.startsWith("residual of chamber")) return v;
    const inner = find(v.child_views || []); if (inner) return inner; } };
  const view = find(Object.values(Bokeh.index.roots || Bokeh.index));
  const box = view.canvas_view.el.getBoundingClientRect(), frame = view.frame.bbox;
  return { x: box.x + frame.x, y: box.y + frame.y, width: frame.width, height: frame.height };
}"""
LARGEST = """() => {
  let best = null;
  for (const m of Bokeh.documents[0].all_models) {
    if (!m.data || !m.data.residual) continue;
    m.data.residual.forEach((r, k) => {
      if (!best || parseFloat(r) > best[0]) best = [parseFloat(r), m.id, m.data.x[k], m.data.y[k]];
    });
  }
  for (const f of Bokeh.documents[0].all_models)
    if (f.type === "Figure" && f.renderers.some(r => r.data_source && r.data_source.id === best[1]))
      return [f.title.text.split(":")[0], best[2], best[3]];
}"""
PLACE = """([edge, x, y]) => {
  const find = (views) => { for (const v of views) {
    if (v.model.type === "Figure" && v.model.title.text.startsWith(edge + ":")) return v;
    const inner = find(v.child_views || []); if (inner) return inner; } };
  const view = find(Object.values(Bokeh.index.roots || Bokeh.index));
  const box = view.canvas_view.el.getBoundingClientRect();
  return { x: box.x + view.frame.x_scale.compute(x), y: box.y + view.frame.y_scale.compute(y) };
}"""


def test_from_the_verdict_to_the_falling_bar_and_back(
    opened: Opened, recorded: tuple[Path, Path]
) -> None:
    """Verdict, Add, the bar falls, undo, add, save, export, reload: the project file last."""
    trace, project = recorded
    untouched = project.read_bytes()
    opened.go()
    page = opened.page
    page.wait_for_selector(NAMED)
    assert "Internal leakage" in page.locator("#verdict").inner_text()
    page.keyboard.press("3")
    page.wait_for_selector("#why_ranking .card h2.found")
    assert "q_a = -C_il" in page.locator("#why_page pre").inner_text()
    page.keyboard.press("4")
    page.wait_for_selector(BARS)
    before = errors(opened)
    assert len(before) == 1
    page.keyboard.press("1")
    page.click(NAMED)
    page.wait_for_selector("#add.shown")  # where the error can be seen to fall
    page.wait_for_function(f"() => document.querySelectorAll('{BARS}').length === 2")
    page.wait_for_timeout(1200)  # the bar's own motion
    first, second = errors(opened)
    assert first == pytest.approx(before[0], rel=1e-3)
    assert second < 0.2 * first
    wide, narrow = widths(opened)
    assert narrow < 0.3 * wide
    assert project.read_bytes() == untouched  # nothing is written until it is asked for
    page.wait_for_function("() => document.querySelector('#verdict h1').textContent !== 'Added'")
    page.click("#add_bars >> text=Undo")
    page.wait_for_function(f"() => document.querySelectorAll('{BARS}').length === 1")
    assert project.read_bytes() == untouched
    page.click(NAMED)
    page.wait_for_function(f"() => document.querySelectorAll('{BARS}').length === 2")
    page.click("#add_bars >> text=Save 1 to the project")
    page.wait_for_selector("#add_bars button[data-do=save]:disabled")
    assert [a.effect for a in load(project).sections.added] == ["internal_leakage_laminar"]
    page.keyboard.press("5")
    page.click("#map_tools >> text=export json")
    page.wait_for_selector("#work >> text=.map.json")
    flowmap, provenance = read_map(trace.with_suffix(".map.json"))
    assert len(flowmap.edges) == 4
    assert provenance["source"] == trace.name
    page.reload()
    page.wait_for_selector("body[data-ready=yes]")
    page.wait_for_selector("#map.shown")
    page.keyboard.press("4")
    page.wait_for_function(f"() => document.querySelectorAll('{BARS}').length === 2")
    assert errors(opened)[1] == pytest.approx(second, rel=0.02)


def test_a_record_that_cannot_be_read_is_said_in_words(
    browser: Browser, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    trace = tmp_path / "empty.parquet"
    trace.write_bytes(b"")
    with served(project=recorded[1], trace=trace) as bench:
        for failed in open_page(browser, bench):
            failed.page.goto(bench.url)
            failed.page.wait_for_selector("#cover >> text=This record cannot be shown")
            assert "empty.parquet" in failed.page.locator("#cover").inner_text()


def test_keys_and_the_dark_page(opened: Opened) -> None:
    opened.go()
    page = opened.page
    page.keyboard.press("d")
    assert page.evaluate("() => document.documentElement.classList.contains('dark')")
    page.keyboard.press("?")
    assert page.locator("#keys[open]").count() == 1
    page.keyboard.press("Escape")
    page.keyboard.press("d")
    assert not page.evaluate("() => document.documentElement.classList.contains('dark')")


def test_nothing_is_cut_off_at_1366_by_768(opened: Opened) -> None:
    opened.go()
    page = opened.page
    page.wait_for_selector("#compare canvas")
    page.evaluate(
        "() => { document.querySelector('#work').innerHTML = 'wrote /a/b/c '.repeat(40) }"
    )
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate("() => document.documentElement.scrollHeight <= innerHeight")
    inside = page.evaluate(
        "() => document.querySelector('#help').getBoundingClientRect().right <= innerWidth"
    )
    assert inside
