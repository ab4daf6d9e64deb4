"""What the live page costs: the daemon's loop with and without it, and the memory of its tab.

`python -m benchmarks.live_page [--slice 4] [--pairs 60] [--minutes 10] [--priority 60] [--busy 8]
[--pictures FOLDER]`

Daemon, machine (on the test bus) and page server are processes of their own, the page is open in
Chromium.  Slices without and with it alternate, because the host steals time at random: for the
slice without, page server and browser are stopped as they are (SIGSTOP), so that opening the page
is no part of what is measured.  Of each second the daemon tells the p99 of its work and of its
lateness; the ratio of the medians of two neighbouring slices is taken, its interval by resampling
pairs.  Beside it stands the processor time of server and browser.  Then the page stays open: the
script heap after a collection and the private memory of its process, sampled every ten seconds; the
growth is the slope after the first fifth.  Meanwhile the page is watched: how long one status
stands until the next is drawn, how long the curves stand still, how dense the scope is.  --busy: so
many processes that do nothing but compute run beside it all.  Whatever hangs, it ends after twice
the time it should.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import browser_s, spent_s
from rtid.daemon.status import StatusError, read
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.ui.live_scope import KEPT_S

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

FLAGS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
CHANNEL = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
SEED, SETTLE_S, SAMPLE_S, WARM = 3, 1.5, 10.0, 0.2
PATIENCE_S, END_S = 120.0, 30.0
UPDATES = "() => Number(document.querySelector('#seen').textContent)"
# gaps between two statuses that were drawn, and between two places of the curves, ms
WATCH = """() => {
  window.watched = { told: [], moved: [] };
  const last = {};
  const note = (name, value, now) => {
    if (last[name] && last[name][0] === value) return;
    if (last[name]) window.watched[name].push(now - last[name][1]);
    last[name] = [value, now];
  };
  const look = (now) => {
    const told = document.querySelector("#seen").textContent;
    note("told", told, now);
    const curves = document.querySelector("#live_scope .slide");
    note("moved", told + (curves && getComputedStyle(curves).transform), now);
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""
DRAWN = """() => ["#live_scope .scope", "#live_planes .plane", "#live_planes circle",
  "#live_health .scope", "#live_learning .card"]
  .map((one) => `${one} ${document.querySelectorAll(one).length}`).join(", ")"""
POINTS = (
    "() => document.querySelector('#live_scope polygon').getAttribute('points').split(' ').length"
)
BUSY = "while True: pass"
WIDTHS, PICTURE_HIGH = (390, 1280), 900
FloatArray = NDArray[np.float64]


def begin(stack: ExitStack, *arguments: str, heard: bool = False) -> subprocess.Popen[str]:
    """A command of rtid in a process of its own, ended with the stack."""
    command = [sys.executable, "-u", "-m", "rtid", *arguments]
    out = subprocess.PIPE if heard else subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL, text=True)
    stack.callback(end, process)
    return process


def end(process: subprocess.Popen[str]) -> None:
    """Ask it to end; a daemon that cannot on a loaded machine must not load the next run."""
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def machine(stack: ExitStack, folder: Path, seconds: float, priority: int) -> tuple[Path, str, int]:
    """A daemon that learns, and the page's server: state folder, address, its process."""
    run = simulate(draw(SEED), "rich", SEED, 2.0)
    project = write_run(folder / "m.parquet", run, SEED, "rich")[2]
    if priority:
        text = project.read_text("utf-8")
        head = "" if "[daemon]" in text else "\n[daemon]\n"
        project.write_text(text + f"{head}priority = {priority}\n", "utf-8")
    state = folder / "state"
    bus = ["--bus", f"udp_multicast:{CHANNEL}", "--test-bus"]
    begin(stack, "run", str(project), *bus, "--state", str(state))
    begin(stack, "simulate", "--plant", str(SEED), "--motion", "rich", "--duration", f"{seconds:g}",
          "--bus", "udp_multicast", "--channel", CHANNEL)  # fmt: skip
    page = begin(stack, "ui", str(project), "--state", str(state), "--port", "0",
                 "--no-open", heard=True)  # fmt: skip
    assert page.stdout is not None
    url = next(m[0] for line in page.stdout if (m := re.search(r"http://\S+", line)))
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        try:
            if read(state).estimate.samples > 5000:
                return state, url, page.pid
        except StatusError:
            pass
        time.sleep(0.5)
    raise SystemExit("the daemon has not learned anything")


def seconds_of(state: Path, seconds: float) -> FloatArray:
    """p99 of work and lateness (n, 2), us, of every second that the daemon tells of."""
    last, end = 0, time.monotonic() + seconds
    times: list[tuple[float, float]] = []
    while time.monotonic() < end or not times:  # a stalled daemon is waited for
        loop = read(state).loop
        if loop.ticks != last:
            last = loop.ticks
            times.append((loop.work_1s.p99_us, loop.lateness_1s.p99_us))
        time.sleep(0.25)
    return np.array(times)


@contextmanager
def asleep(server: int) -> Iterator[None]:
    """Stop page server and browser until the block ends."""
    pids = [server, *browser_s()]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def cost(state: Path, server: int, slice_s: float, pairs: int) -> FloatArray:
    """Medians of both p99 (pairs, without or with the open page, 2)."""
    shares, spent, awake_s = np.empty((pairs, 2, 2)), np.zeros(2), 0.0
    for k in range(pairs):
        for is_awake in (k % 2, 1 - k % 2):  # neither comes first always
            with nullcontext() if is_awake else asleep(server):
                time.sleep(SETTLE_S)
                before, begun = (spent_s(server), sum(browser_s().values())), time.monotonic()
                shares[k, is_awake] = np.median(seconds_of(state, slice_s), axis=0)
            if is_awake:
                awake_s += time.monotonic() - begun
                spent += (spent_s(server) - before[0], sum(browser_s().values()) - before[1])
        if k % 10 == 9:
            print(f"{k + 1} pairs, load {os.getloadavg()[0]:.1f}", flush=True)
    server_share, browser_share = 100 * spent / awake_s
    print(f"processor: page server {server_share:.1f} %, browser {browser_share:.1f} % of a core")
    return shares


def report_cost(shares: FloatArray) -> None:
    """Ratios with / without the page, and their intervals."""
    ratios = shares[:, 1] / shares[:, 0]
    rng = np.random.default_rng(0)
    again = np.median(ratios[rng.integers(0, len(ratios), (1000, len(ratios)))], axis=1)
    low, high = np.quantile(again, [0.025, 0.975], axis=0)
    for k, name in enumerate(("work", "lateness")):
        print(f"loop p99, {name}: without {np.median(shares[:, 0, k]):.0f} us, with "
              f"{np.median(shares[:, 1, k]):.0f} us, ratio {np.median(ratios[:, k]):.3f} "
              f"({low[k]:.3f} .. {high[k]:.3f})")  # fmt: skip


def private_mb(browser: Browser) -> float:
    """Memory that the largest tab has for itself."""
    answer = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")
    sizes = [0.0]
    for process in answer["processInfo"]:
        if process["type"] == "renderer":
            lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
            sizes.append(sum(int(x.split()[1]) for x in lines if x.startswith("Private")) / 1e3)
    return max(sizes)


def memory(browser: Browser, page: Page, url: str, minutes: float) -> tuple[float, FloatArray]:
    """Updates per second, and minutes, script heap and private memory (n, 3), MB."""
    page.goto(f"{url}#live")
    page.wait_for_selector("#live_learning progress")
    page.evaluate(WATCH)
    cdp = page.context.new_cdp_session(page)
    cdp.send("Performance.enable")
    begun, first = time.monotonic(), page.evaluate(UPDATES)
    rows: list[tuple[float, float, float]] = []
    while (now_s := time.monotonic() - begun) < 60 * minutes:
        cdp.send("HeapProfiler.collectGarbage")
        metrics = {m["name"]: m["value"] for m in cdp.send("Performance.getMetrics")["metrics"]}
        if len(rows) % 6 == 0 and rows:
            print(f"minute {rows[-1][0]:.0f}: {rows[-1][1]:.1f}, {rows[-1][2]:.0f} MB", flush=True)
        rows.append((now_s / 60, metrics["JSHeapUsedSize"] / 1e6, private_mb(browser)))
        page.wait_for_timeout(1e3 * SAMPLE_S)
    rate = (page.evaluate(UPDATES) - first) / (time.monotonic() - begun)
    return rate, np.array(rows)


def growth(sizes: FloatArray) -> tuple[float, float]:
    """Of script heap and private memory in 30 minutes, MB, after the first fifth.

    What a page frees at once comes and goes by 40 MB; what stays is the least of every minute.
    """
    kept = sizes[sizes[:, 0] >= WARM * sizes[-1, 0]]
    minutes = [kept[kept[:, 0] // 1 == k] for k in np.unique(kept[:, 0] // 1)]
    least = np.array([rows.min(axis=0) for rows in minutes])
    slopes = np.polyfit(least[:, 0], least[:, 1:], 1)[0]
    return float(30 * slopes[0]), float(30 * slopes[1])


def report_memory(rate: float, sizes: FloatArray) -> None:
    """In words."""
    heap, private = growth(sizes)
    low, high = sizes[:, 1:].min(axis=0), sizes[:, 1:].max(axis=0)
    print(f"tab, {sizes[-1, 0]:.0f} minutes at {rate:.1f} updates a second: script heap "
          f"{low[0]:.1f} .. {high[0]:.1f} MB, private {low[1]:.0f} .. {high[1]:.0f} MB; growth of "
          f"what stays {heap:+.2f} and {private:+.1f} MB in 30 minutes")  # fmt: skip


def report_watched(page: Page) -> None:
    """How the page moved since it was told to WATCH, and what is on it."""
    for name, gaps in page.evaluate("() => window.watched").items():
        middle, high, most = np.quantile(gaps, [0.5, 0.99, 1.0])
        print(f"{name}: {len(gaps)} times, every {middle:.0f} ms (median), p99 {high:.0f}, "
              f"longest {most:.0f} ms")  # fmt: skip
    dense_hz = page.evaluate(POINTS) / 2 / KEPT_S
    print(f"scope: {dense_hz:.1f} values a second and signal; drawn: {page.evaluate(DRAWN)}")


def pictures(page: Page, folder: Path) -> None:
    """Of the whole page, narrow and wide."""
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": PICTURE_HIGH})
        page.wait_for_timeout(1e3 * SETTLE_S)
        page.screenshot(path=folder / f"live_{width}.png", full_page=True)


def _too_late(number: int, frame: object) -> None:
    raise SystemExit("it took twice as long as it should: see what hangs")


def main() -> None:
    """Measure and report."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slice", type=float, default=4.0)
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--priority", type=int, default=60)
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--pictures", type=Path)
    wanted = parser.parse_args()
    needed_s = 2 * wanted.pairs * (wanted.slice + SETTLE_S) + 60 * wanted.minutes + PATIENCE_S
    signal.signal(signal.SIGALRM, _too_late)
    signal.alarm(round(2 * needed_s))
    with ExitStack() as stack, sync_playwright() as running:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        state, url, server = machine(stack, folder, 2 * needed_s, wanted.priority)
        for _ in range(wanted.busy):
            stack.callback(end, subprocess.Popen([sys.executable, "-c", BUSY], text=True))
        browser = running.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        page = browser.new_page()
        page.set_default_timeout(1e3 * PATIENCE_S)
        print(f"loop: {read(state).loop.rate_hz:g} Hz, {read(state).loop.scheduling}")
        if wanted.pairs:
            page.goto(f"{url}#live")
            page.wait_for_selector("#live_learning progress")
            report_cost(cost(state, server, wanted.slice, wanted.pairs))
        if wanted.minutes:
            report_memory(*memory(browser, page, url, wanted.minutes))
            report_watched(page)
        if wanted.pictures:
            pictures(page, wanted.pictures)
        browser.close()


if __name__ == "__main__":
    main()
