"""The system's Chromium with every request to another host blocked and counted."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.ui.server import Workbench
from tests.browser.geometry import assert_clear
from tests.left import PATIENCE_S
from tests.replays import shared_replays  # noqa: F401
from tests.ui.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

NAMES = ("chromium", "chromium-browser", "google-chrome")
# The address bar that nobody sees has two pages for each of ours, in processes of their own.  Only
# the last such flag counts: the others are Playwright's, without which it works less well.
UNWANTED = (
    *("WebUIOmniboxPopup", "WebUIOmniboxAimPopup", "WebUIOmniboxFullPopup"),
    *("AvoidUnnecessaryBeforeUnloadCheckSync", "DestroyProfileOnBrowserClose", "HttpsUpgrades"),
    *("HttpsFirstBalancedModeAutoEnable", "LensOverlay", "MediaRouter", "PaintHolding"),
    *("ThirdPartyStoragePartitioning", "AvoidCorsURLLoaderRestartOnRedirect"),
    *("OptimizationHints", "NetworkTimeServiceQuerying", "AimEnabled", "PreconnectToSearch"),
)
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    f"--disable-features={','.join(UNWANTED)}",
]
SIZE = {"width": 1366, "height": 768}
SEED, DURATION_S = 3, 20.0  # names the leak, and matches with it
PATIENCE_MS = 120_000  # cold kernels on a loaded machine
COOKIES: dict[str, list[Any]] = {}  # of the browser that has opened an address


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """Fail the test that leaves a thread behind: its browser, and a module's daemon, live on."""
    before = set(threading.enumerate())
    yield
    end_s = time.monotonic() + PATIENCE_S
    while left := [t.name for t in set(threading.enumerate()) - before if t.is_alive()]:
        assert time.monotonic() < end_s, f"left behind: {left}"
        time.sleep(0.05)


@dataclass
class Opened:
    """A page of the workbench, and what went wrong in it."""

    page: Page
    bench: Workbench
    elsewhere: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def go(self, view: str = "") -> None:
        """Open the page and wait until it can be used."""
        self.page.goto(self.bench.url + (f"#{view}" if view else ""))
        self.page.wait_for_selector("body[data-ready=yes]")


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright: pip install 'rtid[dev]'"
    )
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("needs Chromium: apt-get install chromium (the page itself is not tested here)")
    with playwright.sync_playwright() as running:
        launched = running.chromium.launch(executable_path=found, args=FLAGS)
        yield launched
        launched.close()


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Trace and project of a machine whose piston seal leaks."""
    return record(tmp_path_factory.mktemp("worn"), DURATION_S)


def record(folder: Path, duration_s: float) -> tuple[Path, Path]:
    """Let it move; its trace and project."""
    run = simulate(
        hide_wish(draw(SEED), "internal_leakage_laminar=strong"), "rich", SEED, duration_s
    )
    trace, _, project = write_run(folder / "worn.parquet", run, SEED, "rich")
    return trace, project


@pytest.fixture(scope="session")
def bench(recorded: tuple[Path, Path]) -> Iterator[Workbench]:
    trace, project = recorded
    with served(project=project, trace=trace) as running:
        yield running


@pytest.fixture
def opened(browser: Browser, bench: Workbench) -> Iterator[Opened]:
    yield from open_page(browser, bench)


def open_page(browser: Browser, bench: Workbench, is_another: bool = False) -> Iterator[Opened]:
    """A fresh context; at the end all of the page can be seen, at every width, light and dark.

    Nothing may have been asked of other hosts, and nothing failed.  To the workbench it is the
    browser of the tests before, unless it is another: that one follows while their pages are known.
    """
    context = browser.new_context(viewport=SIZE, color_scheme="light")  # type: ignore[arg-type]
    context.set_default_timeout(PATIENCE_MS)
    if not is_another:
        context.add_cookies(COOKIES.get(bench.url, []))
    own = bench.url.split("?")[0]
    one = Opened(context.new_page(), bench)

    def judge(route: Route) -> None:
        if route.request.url.startswith((own, "data:", "blob:")):
            route.continue_()
        else:
            one.elsewhere.append(route.request.url)
            route.abort()

    context.route("**/*", judge)
    one.page.on("pageerror", lambda error: one.errors.append(str(error)))
    one.page.on(
        "console", lambda line: one.errors.append(line.text) if line.type == "error" else None
    )
    one.page.on("websocket", lambda ws: _judge_socket(one, ws.url, own))
    yield one
    if not is_another:
        COOKIES[bench.url] = context.cookies()
    assert_clear(one.page)
    context.close()
    assert one.elsewhere == []
    assert one.errors == []


def _judge_socket(item: Opened, url: str, its_own: str) -> None:
    if not url.startswith(its_own.replace("http", "ws", 1)):
        item.elsewhere.append(url)
