"""Pictures of every view of the workbench, on the demo's worn machine: `make screenshots`.

With a second argument the first picture of README is made there.
"""

from __future__ import annotations

import asyncio
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from rtid.study.demo import prepare, wear
from rtid.ui.server import Workbench, start

FLAGS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
PATIENCE_MS = 300_000
VIEWS = ("compare", "where", "why", "add", "map", "live")
README = "workbench.png"
COLOURS = 200  # of README's picture: small files are carried in the repository


@contextmanager
def serving(trace: Path, project: Path) -> Iterator[Workbench]:
    """A workbench in a thread of its own."""
    begun: list[tuple[Workbench, Callable[[], object]]] = []
    ready = threading.Event()

    async def run() -> None:
        over, loop = asyncio.Event(), asyncio.get_running_loop()
        bench = start(project, trace)
        begun.append((bench, lambda: loop.call_soon_threadsafe(over.set)))
        ready.set()
        await over.wait()
        bench.stop()

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    ready.wait()
    yield begun[0][0]
    begun[0][1]()
    thread.join(10)


def shoot(page: Page, folder: Path, name: str) -> Path:
    """One picture, once the bars stand still."""
    page.wait_for_timeout(1500)
    path = folder / f"{name}.png"
    page.screenshot(path=path)
    print(f"wrote {path}")
    return path


def tour(page: Page, folder: Path) -> None:
    """Every view, before and after the missing effect is added."""
    shoot(page, folder, "0_opening")
    page.wait_for_selector("#compare canvas")
    shoot(page, folder, "1_compare_before")
    page.wait_for_selector("#verdict button.main")
    for k, view in enumerate(VIEWS, 1):
        page.keyboard.press(str(k))
        if view == "where":
            page.click("text=largest error")
        shoot(page, folder, f"{k}_{view}")
    page.keyboard.press("4")
    page.click("#verdict button.main")
    page.wait_for_selector("text=Residual per block")
    shoot(page, folder, "7_added")
    page.wait_for_function(
        "() => (document.querySelector('#verdict h1')?.textContent ?? 'Added') !== 'Added'"
    )
    shoot(page, folder, "8_added_and_diagnosed")
    page.keyboard.press("1")
    shoot(page, folder, "9_compare_after")
    page.keyboard.press("d")
    for k, view in enumerate(VIEWS, 1):
        page.keyboard.press(str(k))
        shoot(page, folder, f"dark_{k}_{view}")


def main(folder: Path, readme: Path | None) -> None:
    """Open the worn machine of the demo and look at everything."""
    folder.mkdir(parents=True, exist_ok=True)
    path = next(p for n in ("chromium", "chromium-browser", "google-chrome")
                 if (p := shutil.which(n)))  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        trace, project = wear(prepare(Path(name)))
        with serving(trace, project) as bench, sync_playwright() as running:
            browser = running.chromium.launch(executable_path=path, args=FLAGS)
            context = browser.new_context(viewport={"width": 1366, "height": 768})
            context.set_default_timeout(PATIENCE_MS)
            page = context.new_page()
            page.goto(bench.url)
            page.wait_for_selector("body[data-ready=yes]")
            tour(page, folder)
            browser.close()
    if readme is not None:
        image = Image.open(folder / "8_added_and_diagnosed.png").convert("RGB")
        image.quantize(COLOURS, dither=Image.Dither.NONE).save(readme / README, optimize=True)
        print(f"wrote {readme / README}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
