"""A serial line for every test of this folder that asks for one."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.bridge.wire import Pty


@pytest.fixture
def line() -> Iterator[Pty]:
    pty = Pty()
    yield pty
    pty.unplug()
