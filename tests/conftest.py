"""What every test gets: no frame on a real bus, and the shared data where it is present."""

from __future__ import annotations

import gc
import io
import json
import os
import signal
import tempfile
from collections import Counter
from collections.abc import Iterator
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NoReturn

# Two test workers fill two cores already, and OpenBLAS' idle threads spin: a diagnosis of the tanks
# took 94 s of processor time instead of 28.  Before the first import of numba and of numpy.
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RTID_CACHE", "off")  # each test learns for itself

import can
import pyarrow.csv
import pytest
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus
from hypothesis import settings

from rtid.units import FLOW, show_flow_as
from tests.left import Here, left_since, of_this_run

# What a machine with other work does in 200 ms says nothing of the code.
settings.register_profile("untimed", settings.default, deadline=None)
settings.load_profile("untimed")

LONG_S = 8 * 3600.0  # the limit of what is meant to take hours
AGAIN_S = 5.0  # after its limit a test is ended as often as it begins anew, as hypothesis does
PAGES = "tests/browser/"
ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"


def pytest_configure(config: pytest.Config) -> None:
    """Before there is anything that the workers share."""
    of_this_run(config)


CASES = Counter[tuple[Path, str]]()  # collected so far of each parametrized test


def pytest_itemcollected(item: pytest.Item) -> None:
    """`first_of(n)`: what stands behind the first n cases of a parametrized test is long."""
    few = item.get_closest_marker("first_of")
    if few is not None:
        test = item.path, item.name.partition("[")[0]
        CASES[test] += 1
        if CASES[test] > few.args[0]:
            item.add_marker(pytest.mark.long)


@pytest.hookimpl(trylast=True)  # of those that are chosen
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Pages come first, which wait most, then modules with slow tests: none is left for the end.

    Every test has a time limit, `timeout` in pyproject.toml; the long ones have a longer one.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (not item.nodeid.startswith(PAGES), item.path not in slow))
    for item in items:
        if item.get_closest_marker("campaign") or item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.timeout(LONG_S))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `--dist loadfile` all tests of a module run in one worker, which makes once what they
    share; so do those of the page, with one browser and one learned record."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByPages(LoadFileScheduling):  # type: ignore[misc]  # xdist has no types
        def _split_scope(self, nodeid: str) -> Any:
            return PAGES if nodeid.startswith(PAGES) else super()._split_scope(nodeid)

    return ByPages(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Half a million objects last for the whole run: to look at all of them, each time that
    Python searches for garbage, took half a second."""
    gc.collect()
    gc.freeze()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note for the table of `make faults` whether a test passed; a skipped one is none."""
    path = os.environ.get("RTID_FAULTS")
    if path and not report.skipped and (report.when == "call" or report.failed):
        with open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps({"test": report.nodeid, "passed": report.passed}) + "\n")


@pytest.hookimpl(wrapper=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> Iterator[Any]:
    """Ring again: what catches the first alarm and goes on, or hangs while it ends, ends too."""
    found = yield
    if settings.method == "signal":
        signal.setitimer(signal.ITIMER_REAL, settings.timeout, AGAIN_S)
    return found


@pytest.fixture(autouse=True)
def nothing_left(own_folder: Path) -> Iterator[None]:
    """Fail the test that leaves a thread, a process, a socket or a file behind."""
    before = Here.now(own_folder, ROOT)
    yield
    left = left_since(before, own_folder, ROOT)
    assert not left, f"left behind: {'; '.join(left)}"


@pytest.fixture(scope="session")
def own_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of temporary files of this process and of those that it starts."""
    folder = tmp_path_factory.mktemp("tmp")
    pyarrow.csv.read_csv(io.BytesIO(b"t\n0\n"))  # from its first CSV on it keeps a pipe open
    resource_tracker.ensure_running()  # as does multiprocessing from its first process on
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder))
        patch.setenv(
            "XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config"))
        )  # what a test trusts, its user does not
        patch.setattr(tempfile, "tempdir", str(folder))
        yield folder


@pytest.fixture(scope="module", autouse=True)
def flows_are_flows() -> Iterator[None]:
    """Whatever a module's last plant has shown its flows as, the next module begins anew."""
    yield
    show_flow_as(FLOW)


@pytest.fixture(autouse=True)
def no_real_bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Fail the test that sends on anything but a virtual or udp_multicast bus, even in a thread.

    Yields the frames that were caught.
    """
    sent: list[str] = []
    opened = can.BusABC.__init__

    def spied_init(bus: can.BusABC, *args: Any, **kwargs: Any) -> None:
        opened(bus, *args, **kwargs)
        if not isinstance(bus, VirtualBus | UdpMulticastBus):
            vars(bus)["send"] = refused

    def refused(message: can.Message, *_args: Any, **_kwargs: Any) -> NoReturn:
        sent.append(str(message))
        raise AssertionError(f"a test sends on a real bus: {message}")

    monkeypatch.setattr(can.BusABC, "__init__", spied_init)
    yield sent
    assert not sent, f"sent on a real bus: {sent}"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the shared measurement data, beside the repository."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"needs the measurement data in {SHARED}, which is not here")
    return SHARED
