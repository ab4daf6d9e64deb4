"""Learning from a live bus: frames as they arrive through the same Assembler and Estimator.

A trace can be fed through python-can's virtual bus, at any pace; the recorded stamps are kept, so
the result equals the one from the log bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from uuid import uuid4

import can
import numpy as np

from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import Catalog
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames, empty, to_messages
from firmware_bridge.playback import SEND_TIMEOUT_S, send
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import LiveSource
from rtid.estimator.estimator import Estimator
from rtid.model import Model

QUIET_READS = 5  # the bus is over when its sender has ended and so many reads found nothing


class Learner:
    """Frames in, a growing estimate out: what the daemon and the bus replay have in common."""

    def __init__(self, model: Model, catalog: Catalog, assembly: Assembly) -> None:
        self.assembler = Assembler(catalog, assembly)
        self.estimator = Estimator(model)
        self.frames = 0
        self._compile()

    def _compile(self) -> None:
        """Have all kernels compiled before the first frame: it would wait for seconds."""
        self.assembler.push(empty(0))
        self.estimator.state.advance(np.empty((0, 2 + len(self.estimator.model.signals))))
        self.estimator.solution()

    def push(self, frames: Frames) -> None:
        """Take frames in their order of arrival."""
        self.frames += len(frames)
        self.estimator.update(self.assembler.push(frames))

    def finish(self) -> None:
        """Take the last sample, which waited for its successor."""
        self.estimator.update(self.assembler.finish())


def listen(
    source: LiveSource[can.Message], learner: Learner, is_over: Callable[[], bool]
) -> Iterator[Learner]:
    """Learn from a source until it is over and quiet; yields the learner after each batch."""
    with source:
        quiet_reads = 0
        while quiet_reads < QUIET_READS or not is_over():
            frames = source.read()
            quiet_reads = 0 if len(frames) else quiet_reads + 1
            if len(frames):
                learner.push(frames)
                yield learner
    learner.finish()


@contextmanager
def virtual_bus(frames: Frames, speed: float) -> Iterator[tuple[CanBus, Callable[[], bool]]]:
    """A virtual bus on which a thread sends frames at `speed` times their pace (inf: at once).

    Yields the receiving side and a function that tells whether everything was sent.
    """
    channel = f"rtid-{uuid4().hex[:8]}"
    receiver = CanBus("virtual", channel)
    sender = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    thread = threading.Thread(target=send, args=(sender, to_messages(frames), speed), daemon=True)
    thread.start()
    try:
        yield receiver, lambda: not thread.is_alive()
    finally:
        receiver.stop()
        thread.join(SEND_TIMEOUT_S)
        sender.shutdown()
