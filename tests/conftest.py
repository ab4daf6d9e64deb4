"""What every test gets: no frame on a real bus, and the shared data where it is present."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import can
import pytest
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus

# Two test workers fill two cores already, and OpenBLAS' idle threads spin: a diagnosis of the tanks
# took 94 s of processor time instead of 28.  Read at the first import of numba and of numpy.
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SHARED = Path(__file__).parents[1].parent / "shared"


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
