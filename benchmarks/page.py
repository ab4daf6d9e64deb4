"""What a user of the page waits for: opening, zooming, a click on a block.

`python -m benchmarks.page PROJECT TRACE [--rounds 5]`; needs Chromium.  Every round opens the page
anew, zooms in and out and clicks on blocks, so that a load that drifts hits all alike.  Wall time
ends when the browser has painted what was asked for; beside it stands the processor time of the
server and of all processes of the browser, which a loaded machine changes little.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

FLAGS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
SIZE = {"width": 1366, "height": 768}
REPEATS, SETTLE_S, PATIENCE_MS = 6, 0.2, 300_000
DONE = (
    "/Looking|Opening/.test((document.querySelector('#verdict h1') || {}).textContent || 'Opening')"
)
SOURCES = "[...Bokeh.documents[0].all_models].filter(m => m.type === 'ColumnDataSource'"
# set before the page is loaded: when the lines of the first view have been painted
OPENED = f"""() => {{
  let frames = 0;
  const poll = () => {{
    const drawn = window.Bokeh && Bokeh.documents[0] && document.body.dataset.ready &&
      {SOURCES} && m.tags.length && m.data.t.length > 100).length >= 4;
    if (drawn && ++frames === 3) {{ window.painted_ms = performance.now(); return; }}
    requestAnimationFrame(poll);
  }};
  requestAnimationFrame(poll);
}}"""
AFTER = "requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - begun)))"
ZOOM = f"""(factor) => new Promise((done) => {{
  const begun = performance.now();
  plots.move("compare", {{ factor }});
  {AFTER};
}})"""
CLICK = f"""(k) => new Promise((done) => {{
  const begun = performance.now();
  const plane = {SOURCES} && m.data.residual && m.data.residual.length)[k % 4];
  const all = {SOURCES} && m.data.x0 && !m.data.y0);  // one of each view
  const heard = () => {{
    for (const lit of all) lit.properties.data.change.disconnect(heard);
    {AFTER};
  }};
  for (const lit of all) lit.properties.data.change.connect(heard);
  plane.selected.indices = [Math.floor((0.37 * k % 1) * plane.data.residual.length)];
}})"""
Spent = tuple[float, dict[int, float]]


def spent_s(pid: int) -> float:
    """Processor time of a process, all its threads."""
    total = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            total += int(path.read_text().split()[0])
        except OSError:
            continue  # a thread that has just ended
    return total / 1e9


def browser_s() -> dict[int, float]:
    """Processor time of every process of the browser that this one has started."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
    pids, grown = {os.getpid()}, True
    while grown:
        more = {pid for pid, parent in parents.items() if parent in pids}
        grown, pids = not more <= pids, pids | more
    return {pid: spent_s(pid) for pid in pids if "chrom" in _name(pid)}


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text()
    except OSError:
        return ""


class Stopwatch:
    """Wall time as the browser tells it, processor time beside it, all in ms."""

    def __init__(self, server: int) -> None:
        self._server, self.times = server, defaultdict[str, list[float]](list)

    def note(self, name: str, wall_ms: float, since: Spent) -> None:
        """One more of a kind."""
        server, browser = self.now()
        spent = sum(s - since[1].get(pid, 0.0) for pid, s in browser.items())
        self.times[f"{name}, wall"].append(wall_ms)
        self.times[f"{name}, server"].append(1e3 * (server - since[0]))
        self.times[f"{name}, browser"].append(1e3 * spent)

    def now(self) -> Spent:
        """Processor seconds of the server and of every process of the browser."""
        return spent_s(self._server), browser_s()


def opened(browser: Browser, url: str) -> Page:
    """A fresh page of a browser that knows nothing."""
    context = browser.new_context(viewport=SIZE)  # type: ignore[arg-type]
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.add_init_script(f"({OPENED})()")
    page.goto(f"{url}#compare")
    return page


def one_round(browser: Browser, url: str, watch: Stopwatch) -> None:
    """Open, zoom, click."""
    since = watch.now()
    page = opened(browser, url)
    page.wait_for_function("() => window.painted_ms")
    watch.note("page usable", page.evaluate("() => window.painted_ms"), since)
    time.sleep(8)  # the other views are made meanwhile
    for view, name, script in (("1", "zoom", ZOOM), ("2", "click", CLICK)):
        page.keyboard.press(view)
        time.sleep(1.5)
        for k in range(REPEATS):
            since = watch.now()
            wall = page.evaluate(script, (0.5, 2.0)[k % 2] if name == "zoom" else k)
            time.sleep(SETTLE_S)
            watch.note(name, wall, since)
    page.context.close()
    time.sleep(3)


def main() -> None:
    """Measure and report."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("project")
    parser.add_argument("trace")
    parser.add_argument("--rounds", type=int, default=5)
    wanted = parser.parse_args()
    command = [sys.executable, "-u", "-m", "rtid", "ui", wanted.project, wanted.trace]
    server = subprocess.Popen(
        [*command, "--port", "0", "--no-open"], stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    url = next(m[0] for line in server.stdout if (m := re.search(r"http://\S+", line)))
    watch = Stopwatch(server.pid)
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        first = opened(browser, url)
        first.wait_for_function(f"() => !({DONE})")
        first.context.close()
        for k in range(wanted.rounds):
            one_round(browser, url, watch)
            print(f"round {k + 1}, load {os.getloadavg()[0]:.1f}", flush=True)
        browser.close()
    server.terminate()
    for name, times in watch.times.items():
        print(f"{name:24s} {median(times):6.0f} ms ({min(times):.0f} .. {max(times):.0f})")


if __name__ == "__main__":
    main()
