"""The live page of a daemon that listens to a simulated machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from benchmarks.live_page import growth, memory
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.ui.server import Workbench
from tests.browser.conftest import Opened, open_page
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CHANNEL = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"  # one for each test worker
SEED = 3
SOAK_MINUTES, SHORT_S = 30.0, 8.0
MOST_MB = 20.0  # that a tab grows by in half an hour
START_S = 90.0  # of a cold daemon on a loaded machine
END_S = 60.0
UPDATES = "() => Number(document.querySelector('#seen').textContent)"
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
def machine(project: Path) -> Iterator[Path]:
    """A daemon and its machine on the test bus, in processes of their own; the state folder."""
    state = project.parent / "state"
    bus = ["--bus", f"udp_multicast:{CHANNEL}", "--test-bus", "--state", str(state)]
    run = [sys.executable, "-m", "rtid", "run", str(project), *bus]
    speak = [sys.executable, "-m", "rtid", "simulate", "--plant", str(SEED), "--motion", "rich"]
    speak += ["--duration", "2400", "--bus", "udp_multicast", "--channel", CHANNEL]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with ExitStack() as stack:
        for command in (run, speak):
            process = subprocess.Popen(command, **quiet)  # type: ignore[call-overload]
            stack.callback(end, process)
        yield state


@pytest.fixture(scope="module")
def live(project: Path, machine: Path) -> Iterator[Workbench]:
    with served(project=project, state=machine) as running:
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


@pytest.mark.soak
def test_half_an_hour_of_updates_leaves_the_tab_as_it_was(browser: Browser, opened: Opened) -> None:
    rate, found = memory(browser, opened.page, opened.bench.url, SOAK_MINUTES)
    heap_mb, private_mb = growth(found)
    assert rate > 0.8  # the page looks five times a second, the daemon tells once
    assert heap_mb <= MOST_MB
    assert private_mb <= MOST_MB


@pytest.mark.slow
def test_stale_is_shown_as_stale(
    browser: Browser, project: Path, machine: Path, tmp_path: Path
) -> None:
    """A status that is not renewed: the page greys and says how old it is."""
    status = machine / "status.json"
    end = time.monotonic() + START_S
    while not status.exists() and time.monotonic() < end:
        time.sleep(0.2)
    (tmp_path / "status.json").write_bytes(status.read_bytes())
    with served(project=project, state=tmp_path) as bench:
        for opened in open_page(browser, bench):
            opened.go("live")
            opened.page.wait_for_selector("#live_health .stale >> text=stale:")
