"""A controller on a test bus: the firmware's C behind a thread that listens and answers.

    python -m tests.apply.neighbour udp_multicast:239.74.163.2

plays one for the commands of README.md, and says what it holds, until it is interrupted.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import can
import numpy as np
import tomlkit

import rtid.project
from firmware_bridge.sources.sockets import hear_one_group
from rtid.apply import offer as offered
from rtid.apply.judge import KnownMap
from rtid.apply.offer import Offer
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.project import Project, load
from tests.bridge.controller import Controller
from tests.flow_maps import orifice, solved

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"
CAN_ID, REPLY_ID, STATUS_ID = 0x700, 0x701, 0x702
Spoil = Callable[[bytes, bool], list[bytes]]


class Neighbour:
    """`heard`: all frames with the identifier of the download; `all`: also answers and notices."""

    def __init__(
        self, channel: str, controller: Controller, spoil: Spoil, interface: str = "virtual"
    ) -> None:
        self.channel, self.controller, self.heard = channel, controller, list[bytes]()
        self._spoil = spoil
        self.all: list[can.Message] = []
        self._stopped = threading.Event()
        self._bus = can.Bus(channel, interface=interface)
        hear_one_group(self._bus)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped.is_set():
            message = self._bus.recv(0.02)
            self.controller.now_ms += 1
            if message is None:
                continue
            if message.arbitration_id >= CAN_ID:
                self.all.append(message)
            if message.arbitration_id != CAN_ID:
                continue
            self.heard.append(bytes(message.data))
            for data in self._spoil(bytes(message.data), False):
                for answer in self.controller.push(data):
                    for got in self._spoil(answer, True):
                        self._bus.send(
                            can.Message(arbitration_id=REPLY_ID, is_extended_id=False, data=got)
                        )

    def stop(self) -> None:
        """End listening."""
        self._stopped.set()
        self._thread.join(2.0)
        self._bus.shutdown()


@contextmanager
def neighbour(
    controller: Controller | None = None,
    spoil: Spoil = lambda data, is_answer: [data],
    channel: str = "",
) -> Iterator[Neighbour]:
    """One on a bus of its own."""
    it = Neighbour(channel or f"apply-{uuid4().hex[:8]}", controller or Controller(), spoil)
    try:
        yield it
    finally:
        it.stop()


def project_file(folder: Path, **publish_keys: object) -> Path:
    """The example's project with a way to the controller."""
    document = tomlkit.parse(EXAMPLE.read_text("utf-8"))
    keys: dict[str, object] = {
        "can_id": CAN_ID, "reply_id": REPLY_ID, "error_percent": 0.5, "frames_per_s": 10_000,
        "least_interval_s": 0, "max_change_percent": 100,
    }  # fmt: skip
    document.add("publish", tomlkit.item(keys | publish_keys))
    path = folder / "cylinder.toml"
    path.write_text(tomlkit.dumps(document), "utf-8")
    return path


def learned(project: Project, seed: int = 0, factor: float = 1.0) -> FlowMap:
    """A map as learning might have made it, its flows times factor."""

    def flow(w: np.ndarray, dp: np.ndarray) -> np.ndarray:
        return factor * orifice(w, dp)

    return publish(solved(project.model, flow, np.random.default_rng(seed)))


def offer(
    folder: Path, project: Project, flow_map: FlowMap, against: int | None = None
) -> KnownMap:
    """What the daemon would have left in its folder."""
    known = KnownMap(flow_map, np.array([8.1e8, 8.3e8]))
    judgement = {
        "blocks": 25, "new_m3s": 1e-6, "held_m3s": 2e-6, "against": "held map",
        "gain_percent": 50.0, "t": 9.0,
    }  # fmt: skip
    folder.mkdir(exist_ok=True)
    made = Offer(known, np.array([1e6, 2e6]), against, judgement, {"project": project.name}, 1e9)
    offered.write(folder, made)
    return known


def loaded(folder: Path, **publish_keys: object) -> Project:
    """The project of `project_file`."""
    return load(project_file(folder, **publish_keys))


def main() -> None:
    """Play a controller until interrupted."""
    interface, _, channel = sys.argv[1].partition(":")
    it = Neighbour(channel, Controller(), lambda data, _: [data], interface)
    told = None
    try:
        while True:
            held = [it.controller.held(slot) for slot in range(5)]
            if held != told:
                told = held
                versions = [one[0] if one else None for one in held]
                print(f"versions held: {versions}, {len(it.heard)} frames heard", flush=True)
            time.sleep(0.2)
    except KeyboardInterrupt:
        it.stop()


if __name__ == "__main__":
    main()
