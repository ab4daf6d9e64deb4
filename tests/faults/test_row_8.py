"""Fault 8: a wrong unit or a swapped signal in the project file, on the running daemon.

That all 12 kinds are found and named is shown on traces in tests/test_check.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.faults.conftest import Figure
from tests.faults.process import daemon, sender

pytestmark = pytest.mark.faults


def in_kpa(text: str) -> str:
    before, _, after = text.partition("[signals.p_a]")
    return before + "[signals.p_a]" + after.replace('unit = "Pa"', 'unit = "kPa"\nscale = 1.0', 1)


def swapped(text: str) -> str:
    return text.replace('"PA"', '"P?"').replace('"PB"', '"PA"').replace('"P?"', '"PB"')


@pytest.mark.parametrize(("edit", "name"), [(in_kpa, "p_a"), (swapped, "chambers")])
def test_row_8_wrong_project(
    edit: Callable[[str], str], name: str, tmp_path: Path, figure: Figure
) -> None:
    with daemon(tmp_path, edit=edit) as running:
        running.wait(lambda s: s.pid > 0)
        with sender(running.group, 60.0, speed=3.0):
            running.wait(lambda s: s.bus.frames > 0)
            after_s = running.wait(lambda s: s.has("implausible"), 60)
            found = running.status()
        running.process.kill()
    assert found is not None
    text = next(a.text for a in found.alarms if a.name == "implausible")
    figure(8, f"alarm that names the signal ({name}) after", after_s, 60, "s")
    assert name in text
