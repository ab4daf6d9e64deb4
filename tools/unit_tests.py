"""pytest plugin of `make check`: what starts a process is no unit test, and time is limited.

Both are skipped with a line that says so.  Time is the processor's: other work does not count.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

STARTS = ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec", "os.system")
_running = False  # a test, and not the collection or what pytest itself starts


def pytest_addoption(parser: pytest.Parser) -> None:
    """When no further test begins."""
    most = "seconds of processor time of a worker"
    parser.addoption("--most", type=float, default=float("inf"), help=most)


def pytest_configure() -> None:
    """An audit hook stays for as long as the process lives."""
    sys.addaudithook(_refuse)


def _refuse(event: str, _arguments: tuple[Any, ...]) -> None:
    if _running and event in STARTS:
        pytest.skip("starts a process: left to make test")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Skip what comes too late."""
    if time.process_time() > item.config.getoption("--most"):
        pytest.skip("no time is left: left to make test")
    yield from _within()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """The test itself."""
    yield from _within()


def _within() -> Iterator[None]:
    global _running  # noqa: PLW0603  an audit hook knows nothing but its event
    _running = True
    try:
        yield
    finally:
        _running = False
