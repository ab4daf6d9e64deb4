"""Messages and signals once a second: rates, ages, gaps, ranges, and what that says of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.checks import REASONS
from rtid.daemon.status import MessageHealth, SignalHealth, SignalVerdict
from rtid.plain import BoolArray
from rtid.project import Project
from rtid.trace.learner import Learner

LATE = 1.5  # periods of silence that are late
SILENT_PERIODS, SILENT_S = 5, 0.5
DAMAGED = ("crc", "wrong_length")
SHARE = 0.01  # of damaged frames that is worth a word


class Ages:
    """When each message last had a good frame, on the loop's clock, ns; 0: never."""

    def __init__(self, messages: NDArray[np.void]) -> None:
        self._messages = messages
        self._good = messages["good"].copy()
        self.last_ns = np.zeros(len(messages), np.int64)

    def note(self, now_ns: int) -> None:
        """Frames have arrived."""
        fresh = self._messages["good"] != self._good
        self.last_ns[fresh] = now_ns
        self._good[fresh] = self._messages["good"][fresh]


class Health:
    """Judges messages and signals by what the learner counts; asked once a second."""

    def __init__(self, project: Project, learner: Learner) -> None:
        self._project, self._learner = project, learner
        self.ages = Ages(learner.assembler.messages)
        self._before_ns = 0
        self._before = learner.assembler.messages.copy()

    def take(self, now_ns: int) -> tuple[tuple[MessageHealth, ...], tuple[SignalHealth, ...]]:
        """The state of all, over the time since the last call; begins a new interval."""
        rows, frozen = self._learner.assembler.messages, self._learner.frozen
        now, extremes = rows.copy(), frozen.signals.copy()
        rows["gap_us"] = 0
        frozen.reset_extremes()
        span_s = max((now_ns - self._before_ns) * 1e-9, 1e-9) if self._before_ns else np.inf
        doubted = self._learner.senders.doubted
        messages = tuple(
            self._message(m, now[m], self._before[m], span_s, now_ns, bool(doubted[m]))
            for m in range(len(now))
        )
        self._before, self._before_ns = now, now_ns
        return messages, self._signals(messages, extremes, frozen.doubted)

    def _message(
        self, m: int, now: np.void, before: np.void, span_s: float, now_ns: int, doubted: bool
    ) -> MessageHealth:
        source = self._project.assembly.messages[m]
        last_ns = int(self.ages.last_ns[m])
        age_s = (now_ns - last_ns) * 1e-9 if last_ns else None
        rate_hz = float(now["good"] - before["good"]) / span_s
        refused = dict(zip(REASONS, now["refused"].tolist(), strict=True))
        news = now["refused"] - before["refused"]
        damaged = sum(int(news[REASONS.index(reason)]) for reason in DAMAGED)
        verdict = "ok"
        if age_s is None or age_s > max(SILENT_PERIODS * source.period_s, SILENT_S):
            verdict = "silent"
        elif doubted:
            verdict = "too_fast"
        elif damaged > SHARE * max(1.0, rate_hz * span_s):
            verdict = "damaged"
        elif rate_hz * source.period_s < 1 / LATE:
            verdict = "late"
        return MessageHealth(
            name=source.name,
            can_id=int(self._learner.assembler.declared["can_id"][m]) & 0x1FFF_FFFF,
            nominal_hz=1.0 / source.period_s,
            rate_hz=rate_hz,
            age_s=age_s,
            gap_s=max(float(now["gap_us"]) * 1e-6, age_s or 0.0),
            verdict=verdict,  # type: ignore[arg-type]
            refused={reason: n for reason, n in refused.items() if n},
        )

    def _signals(
        self, messages: tuple[MessageHealth, ...], rows: NDArray[np.void], frozen: BoolArray
    ) -> tuple[SignalHealth, ...]:
        by_name = {message.name: message for message in messages}
        declared = {signal.name: signal for signal in self._project.model.signals}
        health = []
        for row, is_frozen, source in zip(
            rows, frozen, self._project.assembly.signals, strict=True
        ):
            signal, message = declared[source.name], by_name.get(source.message)
            value = float(row["value"]) if np.isfinite(row["value"]) else None
            seen = np.isfinite(row["minimum"])
            low, high = float(row["minimum"]), float(row["maximum"])
            inside = not seen or (low >= signal.minimum and high <= signal.maximum)
            health.append(
                SignalHealth(
                    name=source.name,
                    kind=signal.kind,
                    unit=signal.unit,
                    message=source.message,
                    value=value,
                    minimum=low if seen else None,
                    maximum=high if seen else None,
                    rate_hz=message.rate_hz if message else 0.0,
                    age_s=message.age_s if message else None,
                    gap_s=message.gap_s if message else 0.0,
                    verdict=_verdict(message, bool(is_frozen), inside, bool(seen)),
                )
            )
        return tuple(health)


def _verdict(
    message: MessageHealth | None, frozen: bool, inside: bool, seen: bool
) -> SignalVerdict:
    if message is None:
        return "ok"  # a constant
    if message.verdict == "silent":
        return "silent"
    if frozen:
        return "frozen"
    if not seen:
        return "not_available"
    return "ok" if inside else "out_of_range"
