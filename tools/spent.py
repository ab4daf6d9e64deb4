"""pytest plugin of `make test`: processor time of each test, with that of its processes.

The ten that take most stand at the end of a run, beside the whole, so that growth is seen.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Generator
from typing import Any

import pytest

SLOWEST = 10
WHOLE = "spent_s"  # in what a worker of xdist hands over at its end
MARK = pytest.StashKey[float]()  # processor time of this process at the last report, s
SPENT = defaultdict[str, float](float)  # by test, s
WORKERS: list[float] = []  # each from its start to its end, s


def own_s(times: os.times_result) -> float:
    """Processor time of this process so far."""
    return times.user + times.system


def used_s() -> float:
    """The same with the processes that it has waited for."""
    times = os.times()
    return own_s(times) + times.children_user + times.children_system


def pytest_collection_finish(session: pytest.Session) -> None:
    """What the collection took is no test's."""
    session.config.stash[MARK] = used_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, Any]:
    """Note on the report, which goes from a worker to the terminal, what came since the last."""
    report = yield
    now_s = used_s()
    report.spent_s = now_s - item.config.stash.get(MARK, now_s)
    item.config.stash[MARK] = now_s
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add it up by test."""
    SPENT[report.nodeid] += getattr(report, "spent_s", 0.0)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell the terminal what a worker took in all."""
    handed: dict[str, float] | None = getattr(session.config, "workeroutput", None)
    if handed is not None:
        handed[WHOLE] = used_s()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take it; a worker that broke down has told nothing."""
    WORKERS.append(getattr(node, "workeroutput", {}).get(WHOLE, 0.0))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The whole, and the slowest."""
    if len(SPENT) <= SLOWEST:
        return
    # The workers are children of the terminal's process, and have told what they took.
    whole_s = sum(WORKERS) + own_s(os.times()) if WORKERS else used_s()
    tests_s = sum(SPENT.values())
    terminalreporter.section(f"{whole_s:.0f} s of processor time, {tests_s:.0f} of them in tests")
    for name, spent_s in sorted(SPENT.items(), key=lambda item: -item[1])[:SLOWEST]:
        terminalreporter.write_line(f"{spent_s:7.1f} s {spent_s / tests_s:5.1%}  {name}")
