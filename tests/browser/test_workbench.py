"""From a record to the missing effect, added and taken back, as a user does it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rtid.maps.flashed import read_flashed
from rtid.project import load
from rtid.sim.random_plants import draw
from rtid.study.look import look
from rtid.study.study import Study
from rtid.ui.headline import work_line
from rtid.ui.server import Workbench
from rtid.ui.views import VIEWS
from tests.browser.conftest import DURATION_S, SEED, SIZE, Opened, open_page
from tests.browser.geometry import SIZES, assert_clear
from tests.ui.plugins import install, snippet
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.slow
NAMED = "#verdict button.main[data-do=add]"
PICTURES = ("compare", "where", "add", "map")
SAY = """(words) => { const place = document.querySelector("#work");
  place.innerHTML = `<span title="${words}">${words}</span>`; }"""
LONG = "wrote /a/b/c " * 40
# Written and measured in one go: the page, which is told every state anew, would put its own back.
MEASURED = """([name, line]) => {
  document.querySelector("#record").innerHTML = name;
  document.querySelector("#work").innerHTML = line;
  const cut = [...document.querySelectorAll("#work .acting > *")]
    .map(part => part.scrollWidth > part.clientWidth + 1);
  const ends = ["#work", "#work .acting button"]
    .map(place => document.querySelector(place).getBoundingClientRect())
    .map(box => [box.left, box.right]);
  return [cut, ends]; }"""
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


def free_run_fits(trace: Path, project: Path) -> list[str]:
    """What the titles of the chambers must tell: the free runs of the same record, fitted here."""
    parts = look(Study(project, trace).replay).parts.values()
    fits = [part.runs["free run"].fit_percent for part in parts]
    texts = [[f"{v:.1f} %" if v > -100 else "below -100 %" for v in both] for both in fits]
    return [
        f"{seen} identification, {unseen} held-out" for seen, unseen in zip(*texts, strict=True)
    ]


def test_a_record_opens_and_every_view_is_drawn(
    opened: Opened, recorded: tuple[Path, Path]
) -> None:
    opened.go()
    page = opened.page
    page.wait_for_selector("#compare canvas")
    page.wait_for_selector("#compare_says b")
    titles = page.evaluate(
        "() => [...Bokeh.documents[0].all_models].filter(m => m.type === 'Title').map(m => m.text)"
    )
    fits = [t for t in titles if "fit" in t]
    assert len(fits) == 2
    shown = [" ".join(title.split()) for title in fits]
    for title, fit in zip(shown, free_run_fits(*recorded), strict=True):
        assert f"free run - fit {fit}" in title, shown
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


@pytest.mark.long
def test_zooming_far_brings_every_sample(opened: Opened) -> None:
    """The page has the record in bins; what it looks at closely is asked for."""
    opened.go("compare")
    page = opened.page
    page.wait_for_selector("#compare canvas")
    step = (
        "Math.min(...[...Bokeh.documents[0].all_models].filter(m => m.tags.length === 3)"
        ".map(m => m.data.t).filter(t => t.length > 9).map(t => t[5] - t[4]).filter(s => s > 0))"
    )
    page.wait_for_function(f"() => {step} > 0.0011")
    for _ in range(6):
        page.keyboard.press("+")
    page.wait_for_function(f"() => Math.abs({step} - 0.001) < 1e-6")
    page.keyboard.press("0")
    page.wait_for_function(f"() => {step} > 0.0011")


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
    assert max(lit) > 2  # beside the two parts of the record
    words = page.locator("#where_says").inner_text()
    assert words.startswith(f"Block {edge},")
    page.keyboard.press("Escape")
    page.wait_for_selector("text=Click a block")


@pytest.mark.long
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
        "() => [...Bokeh.documents[0].all_models].filter(m => m.type === 'GlyphRenderer' &&"
        " m.glyph.type === 'Rect' && Object.keys(m.data_source.data).length === 2)"
        ".reduce((sum, m) => sum + m.data_source.data.x.length, 0)"
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
      if (isFinite(r) && (!best || Number(r) > best[0]))
        best = [Number(r), m.id, m.data.x[k], m.data.y[k]];
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
    assert_clear(page, NAMED, sizes=SIZES[-1:])
    the_evidence_can_be_looked_at(page)
    left = the_bar_falls(opened)
    assert project.read_bytes() == untouched  # nothing is written until it is asked for
    page.wait_for_function(
        "() => (document.querySelector('#verdict h1')?.textContent ?? 'Added') !== 'Added'"
    )
    page.click("#add_bars >> text=Undo")
    wait_for_bars(page, 1)
    assert project.read_bytes() == untouched
    page.click(NAMED)
    wait_for_bars(page, 2)
    page.click("#add_bars >> text=Save 1 to the project")
    page.wait_for_selector("#add_bars button[data-do=save]:disabled")
    assert [a.effect for a in load(project).sections.added] == ["internal_leakage_laminar"]
    page.click("#verdict >> text=Undo in the project")
    wait_for_bars(page, 1)
    page.wait_for_selector("#work >> text=as before the last change")
    assert project.read_bytes() == untouched
    page.click(NAMED)
    wait_for_bars(page, 2)
    page.click("#add_bars >> text=Save 1 to the project")
    page.wait_for_selector("#add_bars button[data-do=save]:disabled")
    the_map_is_released_within_8_kb(page, trace)
    page.reload()
    page.wait_for_selector("body[data-ready=yes]")
    page.wait_for_selector("#map.shown")
    page.keyboard.press("4")
    wait_for_bars(page, 2)
    assert errors(opened)[1] == pytest.approx(left, rel=0.02)


def wait_for_bars(page: Page, count: int) -> None:
    page.wait_for_function(f"() => document.querySelectorAll('{BARS}').length === {count}")


def the_evidence_can_be_looked_at(page: Page) -> None:
    """Where opens with the signal that explains most; Why shows regressor and best rival."""
    page.keyboard.press("2")
    page.wait_for_selector("#where.shown canvas")
    page.wait_for_function(
        "() => document.querySelector('#signal_select')?.value"
        " === 'Internal leakage, laminar (a-b)'"
    )
    shown = "m => m.type === 'Title' && m.text.startsWith('before: ')"
    page.wait_for_function(f"() => [...Bokeh.documents[0].all_models].some({shown})")
    page.select_option("#signal_select", "p_a - p_b")
    over = "m => m.type === 'Title' && m.text.startsWith('residual over p_a - p_b')"
    page.wait_for_function(f"() => [...Bokeh.documents[0].all_models].some({over})")
    page.keyboard.press("3")
    page.wait_for_selector("#why_ranking .card h2.found")
    assert "q_a = -C_il" in page.locator("#why_page pre").inner_text()
    page.wait_for_selector("#why canvas")
    seen = page.locator("#why_says").inner_text()
    assert seen.startswith("Over the regressor of Internal leakage, laminar (a-b)")
    assert "best rival" in seen
    assert_clear(page, "#why_says", sizes=SIZES)
    page.set_viewport_size({"width": 1024, "height": 768})
    page.wait_for_function(
        f"() => {{ const {{ lines, cut }} = ({FIGURES})(); return lines > 3 && !cut; }}"
    )
    page.set_viewport_size(SIZE)  # type: ignore[arg-type]


# of the figures above the plots that are seen: how many lines, and how many of them are cut off
FIGURES = """() => {
  let lines = 0, cut = 0;
  const pen = document.createElement("canvas").getContext("2d");
  const look = (views) => { for (const v of views) {
    const above = v.model.type === "Figure" && v.bbox.width > 0 ? v.model.above : [];
    for (const t of above.filter((t) => t.type === "Title")) {
      pen.font = `${t.text_font_style} ${t.text_font_size} ${t.text_font}`;
      for (const line of t.text.split("\\n")) {
        lines += 1;
        cut += pen.measureText(line).width > v.bbox.width - v.frame.bbox.left;
      }
    }
    look(v.child_views || []); } };
  look(Object.values(Bokeh.index.roots || Bokeh.index));
  return { lines, cut };
}"""


def the_bar_falls(opened: Opened) -> float:
    """From Compare to the bars of Add by one click; the held-out error behind it, %."""
    page = opened.page
    page.keyboard.press("4")
    page.wait_for_selector(BARS)
    before = errors(opened)
    assert len(before) == 1
    page.keyboard.press("1")
    page.click(NAMED)
    page.wait_for_selector("#add.shown")  # where the error can be seen to fall
    wait_for_bars(page, 2)
    page.wait_for_timeout(1200)  # the bar's own motion
    first, second = errors(opened)
    assert first == pytest.approx(before[0], rel=1e-3)
    assert second < 0.2 * first
    wide, narrow = widths(opened)
    assert narrow < 0.3 * wide
    return second


def the_map_is_released_within_8_kb(page: Page, trace: Path) -> None:
    page.keyboard.press("5")
    page.select_option("#room_select", "bytes")
    page.fill("#amount", "8192")
    page.keyboard.press("Tab")
    page.wait_for_selector("#map_release [data-do=release][data-amount='8192']")
    page.click("#map_release [data-do=release]")
    link = "#map_says a[download] >> text=.map.dcm"
    page.wait_for_selector(link)
    with page.expect_download() as taken:
        page.click(link)
    tables = read_flashed(Path(taken.value.path()).rename(trace.with_name("taken.dcm")))
    assert len(tables) == 4
    assert 4000 < sum(2 * (m.flow_m3s.size + len(m.u_v) + len(m.dp_pa)) for m in tables) <= 8192
    assert_clear(page, "#map_release")
    assert "released, date" in trace.with_suffix(".map.sheet.html").read_text("utf-8")


@pytest.mark.long
def test_a_data_sheet_is_held_beside_the_learned_map(
    browser: Browser, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    """Two clicks behind `rtid ui TRACE -p PROJECT --map sheet.csv`: the map, and the difference."""
    trace, project = recorded
    plant, w_v = draw(SEED), np.arange(0.0, 10.05, 0.1)
    gains = [1.1 * plant.flow(edge, w_v, 4e6) / 2e3 for edge in plant.edges]
    heads = ["abs_u_V", *(f"K_{edge.upper()}" for edge in plant.edges)]
    sheet = tmp_path / "sheet.csv"
    np.savetxt(
        sheet, np.column_stack([w_v, *gains]), "%.9g", ",", header=",".join(heads), comments=""
    )
    with served(project=project, trace=trace, sheet=sheet) as bench:
        for opened in open_page(browser, bench):
            opened.go()
            page = opened.page
            page.wait_for_selector("#compare canvas")
            page.click("nav >> text=Map")
            page.wait_for_function(TITLED, arg="dots: sheet")
            page.select_option("#second_select", "difference")
            page.wait_for_function(TITLED, arg="flow less sheet")


TITLED = """(words) => [...Bokeh.documents[0].all_models]
  .some((m) => m.type === "Title" && m.text.includes(words))"""


def test_the_view_of_another_package_is_a_tab_of_the_page(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one of docs/extending.md: nothing of rtid was touched for it."""
    code = snippet("A view on the page", "python")
    entry = "[rtid.views]\nbalance = my_view:Balance\n"
    install(tmp_path, "my_view", code, entry, monkeypatch)
    opened.go("balance")
    page = opened.page
    page.wait_for_selector("nav >> text=Balance")
    page.wait_for_selector("#balance.shown canvas")
    dots = page.evaluate(
        "() => [...Bokeh.documents[0].all_models].filter(m => m.data && m.data.mean)"
        ".map(m => m.data.mean.length)"
    )
    assert max(dots) > 1.25 * DURATION_S


def test_a_record_that_cannot_be_read_is_said_in_words(
    browser: Browser, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    trace = tmp_path / '<img src=x onerror=alert(1)> [red]"empty.parquet'
    trace.write_bytes(b"")
    with served(project=recorded[1], trace=trace) as bench:
        for failed in open_page(browser, bench):
            failed.page.goto(bench.url)
            failed.page.wait_for_selector("#cover >> text=This record cannot be shown")
            assert_clear(failed.page, "#cover h2", "#cover p")
            assert trace.name in failed.page.locator("#cover").inner_text()
            assert trace.name in failed.page.locator("#record").inner_text()
            assert failed.page.locator("img").count() == 0


def test_keys_and_the_dark_page(opened: Opened) -> None:
    opened.go()
    page = opened.page
    page.keyboard.press("d")
    assert page.evaluate("() => document.documentElement.classList.contains('dark')")
    page.keyboard.press("?")
    assert_clear(page, "#keys h2", "#keys button")
    page.keyboard.press("Escape")
    page.keyboard.press("d")
    assert not page.evaluate("() => document.documentElement.classList.contains('dark')")


def test_every_view_can_be_seen_at_every_width(opened: Opened) -> None:
    """The rules are in geometry.js; a wide page needs no scrolling."""
    opened.go()
    page = opened.page
    page.wait_for_selector("#verdict h1 >> text=/model|missing|cannot tell/")
    for key, view in enumerate(VIEWS, 1):
        page.keyboard.press(str(key))
        drawn = f"#{view} canvas" if view in PICTURES else f"#{view} .card, #{view} table"
        page.wait_for_selector(drawn)
        page.evaluate(SAY, LONG)
        assert_clear(page, f"#{view}", "#verdict h1", "#record", "#help")
        assert page.evaluate("() => document.documentElement.scrollHeight <= innerHeight")


@pytest.fixture(scope="module")
def judged(browser: Browser, bench: Workbench) -> Iterator[Page]:
    """One page with a verdict for all widths: at the end it is looked at in each of them."""
    for opened in open_page(browser, bench):
        opened.go()
        opened.page.wait_for_selector("#verdict h1 >> text=/model|missing|cannot tell/")
        yield opened.page


@pytest.mark.parametrize("width", [390, 800, 1024, 1280, 1920])
def test_stop_and_words_stand_beside_a_long_record_s_name(judged: Page, width: int) -> None:
    """At 1280 px the name took the room of both, and Stop was three dots; at 1024 it was gone."""
    page = judged
    page.set_viewport_size({"width": width, "height": 800})
    working: Any = SimpleNamespace(
        trouble=("", ""), doing="learning", can_stop=True, share=0.5, note=""
    )
    name = f'<span title="{LONG}">{LONG}</span>'
    cut, ((least, most), (left, right)) = page.evaluate(MEASURED, [name, work_line(working)])
    assert cut == [False] * 3
    assert least <= left < right <= most + 1
