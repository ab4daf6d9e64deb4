"""The live page of a daemon that listens to a simulated machine."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from benchmarks.live_page import growth, memory
from rtid.daemon.acceptance import taken
from rtid.daemon.chronicle import FILE, Chronicle
from rtid.daemon.status import Advice, Alarm, ChamberStatus, EdgeHealth, Verdict, write
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.ui.server import Workbench
from tests.browser.conftest import Opened, open_page
from tests.browser.geometry import SIZES, assert_clear
from tests.ui.served import served
from tests.ui.test_live_page import status

if TYPE_CHECKING:
    from playwright.sync_api import Browser

Running = tuple[Path, Callable[[], None]]
CHANNEL = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"  # one for each test worker
SEED = 3
SOAK_MINUTES, SHORT_S = 30.0, 8.0
SPEAKS_S = 400.0, 2400.0  # the machine, of which each 100 s take 0.6 s to make; while it is soaked
MOST_MB = 20.0  # that a tab grows by in half an hour
START_S = 90.0  # of a cold daemon on a loaded machine
END_S = 60.0
UPDATES = "() => Number(document.querySelector('#seen').textContent)"
# what a page shows that gets no answer any more, without the line of the console about it
GONE = """() => { window.fetch = () => Promise.reject(); }"""
REFUSED = """() => {
  window.asked = 0;
  const refusal = new Response("", { status: 401 });
  window.fetch = () => { window.asked += 1; return Promise.resolve(refusal); };
}"""
SLID_S, LOOKS = 2.0, 10
PLACES = f"""() => new Promise((done) => {{
  const seen = new Set(), end = performance.now() + {1e3 * SLID_S};
  const look = (now) => {{
    const curves = document.querySelector("#live_scope .slide");
    seen.add(getComputedStyle(curves).transform + document.querySelector("#seen").textContent);
    if (now < end) requestAnimationFrame(look); else done(seen.size);
  }};
  requestAnimationFrame(look);
}})"""
MEMORY = "() => performance.memory.usedJSHeapSize / 1e6"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("live")
    run = simulate(draw(SEED), "rich", SEED, 2.0)
    return write_run(folder / "m.parquet", run, SEED, "rich")[2]


def end(process: subprocess.Popen[bytes]) -> None:
    """Ask it to end, and see to it where a loaded machine takes too long."""
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def machine(project: Path, request: pytest.FixtureRequest) -> Iterator[Running]:
    """A daemon and its machine on the test bus, in processes of their own.

    The state folder, and what ends both before the module does.
    """
    state = project.parent / "state"
    bus = ["--bus", f"udp_multicast:{CHANNEL}", "--test-bus", "--state", str(state)]
    run = [sys.executable, "-m", "rtid", "run", str(project), *bus]
    speak = [sys.executable, "-m", "rtid", "simulate", "--plant", str(SEED), "--motion", "rich"]
    is_soaked = any(item.get_closest_marker("soak") for item in request.session.items)
    speak += ["--duration", str(SPEAKS_S[is_soaked]), "--bus", "udp_multicast"]
    speak += ["--channel", CHANNEL]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with ExitStack() as stack:
        for command in (run, speak):
            process = subprocess.Popen(command, **quiet)  # type: ignore[call-overload]
            stack.callback(end, process)
        yield state, stack.close


@pytest.fixture(scope="module")
def live(project: Path, machine: Running) -> Iterator[Workbench]:
    with served(project=project, state=machine[0]) as running:
        yield running


@pytest.fixture
def opened(browser: Browser, live: Workbench) -> Iterator[Opened]:
    yield from open_page(browser, live)


def watched(opened: Opened, for_s: float) -> tuple[int, float]:
    """Updates that the page has drawn in a time, and by how many MB its tab has grown."""
    opened.go("live")
    page = opened.page
    page.wait_for_selector("#live_health >> text=is open", timeout=START_S * 1e3)
    page.wait_for_selector("#live_learning progress", timeout=START_S * 1e3)
    first, before = page.evaluate(UPDATES), page.evaluate(MEMORY)
    page.wait_for_timeout(for_s * 1e3)
    return page.evaluate(UPDATES) - first, page.evaluate(MEMORY) - before


def test_words_from_outside_are_shown_as_they_are(
    browser: Browser, project: Path, tmp_path: Path
) -> None:
    """Names of machine, channel, signals, messages, alarms and effects are never HTML."""
    evil, known = (
        "<img src=x onerror=alert(1)> [red]'\"&amp;</b><script>alert(1)</script>",
        status(),
    )
    told = replace(
        known,
        name=evil,
        now_unix_s=time.time() + 600.0,  # not stale while this is looked at
        bus=replace(known.bus, interface=evil, channel=evil, refused={evil: 1}),
        loop=replace(known.loop, causes={evil: 1}, scheduling=evil),
        signals=tuple(replace(one, name=evil, unit=evil) for one in known.signals),
        messages=tuple(replace(one, name=evil, refused={evil: 1}) for one in known.messages),
        alarms=tuple(replace(one, name=evil, text=evil) for one in known.alarms),
        store=replace(known.store, reason=evil),
        advice=Advice(known.now_unix_s, evil),
        verdict=Verdict(known.now_unix_s, evil, evil),
        estimate=replace(
            known.estimate,
            reason=evil,
            chambers=(ChamberStatus(evil, 1e9, 1e6),),
            edges=(EdgeHealth(evil, {evil: 3}),),
            refused={evil: 1},
        ),
    )
    write(tmp_path, told)
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go()
            opened.page.wait_for_selector("#live_health h2")
            words = opened.page.locator("#live").inner_text()
            assert words.count("<script>alert(1)</script>") >= 15
            assert opened.page.locator("#live img, #live script").count() == 0
            assert_clear(opened.page, "#live_health h2")


def test_a_repaired_machine_is_accepted_and_weeks_are_compared_in_three_clicks(
    browser: Browser, project: Path, tmp_path: Path
) -> None:
    now_s, known = time.time(), status()
    Chronicle(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / FILE)) as base:
        for days in range(14):
            beta = 1e9 if days > 7 else 8e8
            row = (now_s - 86_400.0 * (days + 0.1), "a", beta + 1e6 * (days % 2), 1e6)
            base.execute("INSERT INTO estimate VALUES (?, ?, ?, ?)", row)
        base.commit()
    changed = Alarm("plant_changed", "the map foretells no more", now_s - 60, None, "plant")
    write(tmp_path, replace(known, now_unix_s=now_s + 600.0, alarms=(changed,)))
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go()
            page = opened.page
            page.click("#live_health [data-do=accept]")
            page.wait_for_selector("#live_health >> text=for the new normal?")
            assert taken(tmp_path) is None
            assert_clear(page, "#live_health [data-do=sure]", sizes=SIZES[-1:])
            page.click("#live_health [data-do=sure]")
            page.wait_for_selector("#work >> text=asked the daemon to accept")
            request = taken(tmp_path)
            assert request is not None and request.reason == "on the page"
            page.wait_for_selector("#live_health >> text=bulk modulus a MPa")
            assert "more than both scatter" in page.locator("#live_health").inner_text()
            page.click("#live_health [data-do=days][data-name='1']")
            page.wait_for_selector("#days_0[aria-pressed=true]")


def test_the_page_of_a_machine_without_a_daemon_says_what_to_do(
    browser: Browser, project: Path, tmp_path: Path
) -> None:
    """`rtid ui machine.toml` before `rtid run`: the page says so, and where to look."""
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go()
            opened.page.wait_for_selector("#live_health >> text=No daemon has been heard")
            assert_clear(opened.page, "#live_health h2", "#live_health .key")
            opened.page.keyboard.press("1")
            opened.page.wait_for_selector("#cover >> text=No record is open")
            assert_clear(opened.page, "#cover h2", "#cover p")
            opened.page.evaluate(GONE)
            opened.page.wait_for_selector("#lost >> text=The server has gone")
            assert_clear(opened.page, "#lost", "#cover h2")


def test_a_page_that_another_server_refuses_says_where_to_go_and_asks_no_more(
    browser: Browser, project: Path, tmp_path: Path
) -> None:
    """A server that was started anew has another token: the page waited for it for ever."""
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go()
            opened.page.evaluate(REFUSED)
            opened.page.wait_for_selector("#lost >> text=open the address that it prints")
            opened.page.wait_for_timeout(1e3 * 4.0)  # longer than from one question to the next
            assert opened.page.evaluate("() => window.asked") == 1


# The daemon and its machine run on until the last test ends them: what needs them comes last.


@pytest.mark.slow
def test_the_page_follows_a_daemon(opened: Opened) -> None:
    updates, _ = watched(opened, SHORT_S)
    assert updates >= SHORT_S / 2  # the daemon tells once a second
    page = opened.page
    signals = page.locator("#live_health").inner_text()
    assert all(name in signals for name in ("p_a", "p_b", "p_supply", "u"))
    assert "Hz" in signals
    assert "blocks valid" in page.locator("#live_learning").inner_text()
    assert page.locator("#live_learning >> text=To learn more").count() == 1
    assert page.locator("#live_scope .scope polygon").count() >= 5  # command, pressures, position
    points = page.locator("#live_scope .scope polygon").first.get_attribute("points") or ""
    assert len(points.split()) >= 2 * 5 * SHORT_S  # ten values a second, less what is not told yet
    assert page.locator("#live_planes .plane circle").count() > 10
    places = (page.evaluate(PLACES) for _ in range(LOOKS))  # other tests draw beside
    assert any(n >= 10 * SLID_S for n in places)  # the curves slide between two statuses


@pytest.mark.soak
def test_half_an_hour_of_updates_leaves_the_tab_as_it_was(browser: Browser, opened: Opened) -> None:
    rate, found = memory(browser, opened.page, opened.bench.url, SOAK_MINUTES)
    heap_mb, private_mb = growth(found)
    assert rate > 0.8  # the page looks five times a second, the daemon tells once
    assert heap_mb <= MOST_MB
    assert private_mb <= MOST_MB


@pytest.mark.slow
def test_stale_is_shown_as_stale(
    browser: Browser, project: Path, machine: Running, tmp_path: Path
) -> None:
    """A status that is not renewed: the page greys and says how old it is."""
    (folder, stop), end = machine, time.monotonic() + START_S
    status = folder / "status.json"
    while not status.exists() and time.monotonic() < end:
        time.sleep(0.2)
    (tmp_path / "status.json").write_bytes(status.read_bytes())
    stop()  # nobody looks at them any more, and both are busy
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go("live")
            opened.page.wait_for_selector("#live_health .stale >> text=stale:")
            assert_clear(opened.page, "#live_health")
