"""What a user sees, checked as boxes: nothing outside the window, cut, covered, or too pale.

`assert_clear` is for every test that opens a page: a page whose words are all there and cannot be
seen fails it.  The rules themselves are in geometry.js.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

SIZES = ((1920, 1080), (1440, 900), (1024, 768), (768, 1024), (390, 844))
SCHEMES = ("light", "dark")
PATIENCE_S, PAUSE_S = 5.0, 0.1  # for what still moves: plots that are laid out anew
DRAWN = """() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(
  () => setTimeout(() => requestAnimationFrame(done), 30))))"""
AREA = """(all) => all.map((one) => { const box = one.getBoundingClientRect();
  return Math.max(0, Math.min(box.right, innerWidth) - Math.max(box.left, 0)) *
         Math.max(0, Math.min(box.bottom, innerHeight) - Math.max(box.top, 0)); })"""


@cache
def _rules() -> str:
    return Path(__file__).with_suffix(".js").read_text("utf-8")


def faults(page: Page) -> list[str]:
    """What a user would complain of in the page as it is, a sentence each."""
    found: list[str] = page.evaluate(_rules())
    return found


def area(page: Page, selector: str) -> float:
    """Pixels of the window that the elements of a selector take up together."""
    return float(sum(page.eval_on_selector_all(selector, AREA)))


def assert_clear(
    page: Page,
    *wanted: str,
    sizes: Iterable[tuple[int, int]] = SIZES,
    schemes: tuple[str, ...] = SCHEMES,
) -> None:
    """At every size, light and dark, nothing is wrong, and what is wanted is in the window.

    The window has its own size again afterwards.
    """
    before, wrong = page.viewport_size, dict[str, list[str]]()
    for k, (width, height) in enumerate(sizes):
        page.set_viewport_size({"width": width, "height": height})
        for scheme in schemes if k % 2 == 0 else reversed(schemes):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            for fault in _settled(page, wanted):
                wrong.setdefault(fault, []).append(f"{width} {scheme}")
    page.emulate_media(color_scheme="light")
    if before:
        page.set_viewport_size(before)
    assert not wrong, "\n".join(f"{fault}  [{', '.join(at)}]" for fault, at in wrong.items())


def _settled(page: Page, wanted: tuple[str, ...]) -> list[str]:
    """Faults that stay for a while."""
    end = time.monotonic() + PATIENCE_S
    while True:
        page.evaluate(DRAWN)
        found = faults(page)
        found += [f"cannot be seen: {one}" for one in wanted if area(page, one) <= 0]
        if not found or time.monotonic() > end:
            return found
        page.wait_for_timeout(1e3 * PAUSE_S)
