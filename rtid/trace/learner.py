"""Learning from a live bus: frames as they arrive through the same Assembler and Estimator.

    frames -> Network -> Senders -> Assembler -> Frozen -> Averaged -> Estimator

A trace can be fed through python-can's virtual bus, at any pace; the recorded stamps are kept, so
the result equals the one from the log bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING
from uuid import uuid4

import can
import numpy as np

from firmware_bridge.assemble import Assembler
from firmware_bridge.averaged import Averaged
from firmware_bridge.catalog import Catalog
from firmware_bridge.config import CYCLE, Assembly
from firmware_bridge.frames import Frames, add_counts, empty, to_messages
from firmware_bridge.frozen import REASON as FROZEN
from firmware_bridge.frozen import Frozen, run_limit
from firmware_bridge.j1939 import Network
from firmware_bridge.playback import SEND_TIMEOUT_S, send
from firmware_bridge.samples import Samples
from firmware_bridge.senders import Senders
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import LiveSource
from rtid.effects.flow_sums import FlowSums
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.model import COMMAND, MODE, Machine
from rtid.plain import FloatArray

if TYPE_CHECKING:
    from rtid.effects.live import LiveFlow
    from rtid.effects.summed import RunningSum

QUIET_READS = 5  # the bus is over when its sender has ended and so many reads found nothing


class Learner:
    """Frames in, a growing estimate out: what the daemon and the bus replay have in common.

    `learns` = False keeps the samples, for a diagnosis, and leaves the estimate as it is.
    flows: of effects of the model that are evaluated beside the kernels; theirs are its last
    signals.
    """

    def __init__(
        self,
        model: Machine,
        catalog: Catalog,
        assembly: Assembly,
        flows: tuple[LiveFlow | RunningSum, ...] = (),
    ) -> None:
        self.assembler = Assembler(catalog, assembly)
        self.network = Network(catalog, assembly.messages)
        self.senders = Senders(self.assembler.declared)
        self.frozen = Frozen(_run_limits(model, assembly))
        self.averaged = Averaged(round(1e6 * assembly.average_s), assembly.ahead)
        self.estimator = Estimator(model)
        self.learns = True
        self.frames = 0
        self._bus = replace(model, signals=model.signals[: len(model.signals) - len(flows)])
        self._beside = FlowSums(flows)
        self._compile()

    def _compile(self) -> None:
        """Have all kernels compiled before the first frame: it would wait for seconds."""
        samples = self.assembler.push(self.senders.push(empty(0)))
        self.estimator.state.advance(
            np.empty((len(self.frozen.push(samples)), 2 + len(self.estimator.model.signals)))
        )
        self.estimator.solution()

    def push(self, frames: Frames) -> FloatArray:
        """Take frames in their order of arrival; the samples (n, 2 + signals), SI, they made."""
        self.frames += len(frames)
        return self._take(self.assembler.push(self.senders.push(self.network.push(frames))))

    def finish(self) -> FloatArray:
        """Take the last sample, which waited for its successor: (n, 2 + signals), SI."""
        return self._take(self.assembler.finish())

    def _take(self, samples: Samples) -> FloatArray:
        estimator = self.estimator
        samples = self.averaged.push(self.frozen.push(samples))
        if estimator.origin_us is None and len(samples):
            estimator.origin_us = int(samples.t_us[0])
        chunk = to_chunk(self._bus, samples, estimator.origin_us or 0)
        chunk = self._beside.with_flows(chunk)
        if self.learns:
            estimator.advance(chunk)
        elif estimator.history is not None:
            estimator.history.append(chunk)
        return chunk

    @property
    def counters(self) -> dict[str, int]:
        """Everything that was refused or restarted so far, by reason."""
        total = dict(self.assembler.counters)
        add_counts(total, {FROZEN: self.frozen.refused})
        add_counts(total, self.estimator.counters)
        return total


def _run_limits(model: Machine, assembly: Assembly) -> list[int]:
    """How often each signal of the assembly may repeat (0: any number)."""
    sources = 1 if assembly.mode == CYCLE else len(assembly.messages)
    declared = {signal.name: signal for signal in model.signals}
    limits = []
    for source in assembly.signals:
        signal = declared.get(source.name)
        steady = signal is None or source.constant is not None or signal.kind in (COMMAND, MODE)
        limits.append(
            0 if signal is None or steady else run_limit(signal.noise, signal.resolution, sources)
        )
    return limits


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
