"""Alarms: what is on, since when, and what was on lately; each change is told once."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from rtid.daemon.status import Alarm

Kind = Literal["bus", "sensor", "plant", "store", "loop"]
KEPT = 20  # alarms that are over
QUIET_S = 1.0  # a cause that comes back within so long was not away


class Alarms:
    """The book of alarms; `tell(alarm)` hears each begin and end, from the thread that found it."""

    def __init__(
        self, tell: Callable[[Alarm], None], clock_s: Callable[[], float] = time.time
    ) -> None:
        self._tell, self._clock_s = tell, clock_s
        self._on: dict[str, Alarm] = {}
        self._gone_s: dict[str, float] = {}
        self._over: list[Alarm] = []

    def set(self, name: str, kind: Kind, text: str) -> None:
        """Raise it, or change its text and kind where it is on already."""
        self._gone_s.pop(name, None)
        present = self._on.get(name)
        if present is None:
            self._on[name] = Alarm(name, text, self._clock_s(), None, kind)
            self._tell(self._on[name])
        elif (present.text, present.kind) != (text, kind):
            self._on[name] = replace(present, text=text, kind=kind)

    def clear(self, name: str) -> None:
        """Its cause is gone; it is over when the cause stays away for QUIET_S."""
        if name not in self._on:
            return
        gone_s = self._gone_s.setdefault(name, self._clock_s())
        if self._clock_s() - gone_s >= QUIET_S:
            over = replace(self._on.pop(name), until_unix_s=gone_s)
            del self._gone_s[name]
            self._over = [over, *self._over][:KEPT]
            self._tell(over)

    def put(self, name: str, kind: Kind, text: str) -> None:
        """Raise it where there is a text, clear it where there is none."""
        if text:
            self.set(name, kind, text)
        else:
            self.clear(name)

    def keep(self, name: str, trace: str) -> None:
        """Note where the trace of an alarm lies."""
        if name in self._on:
            self._on[name] = replace(self._on[name], trace=trace)
        else:
            for k, alarm in enumerate(self._over):
                if alarm.name == name:
                    self._over[k] = replace(alarm, trace=trace)
                    return

    def has(self, name: str) -> bool:
        """Whether it is on."""
        return name in self._on

    @property
    def on(self) -> tuple[Alarm, ...]:
        """Those that are on."""
        return tuple(self._on.values())

    @property
    def all(self) -> tuple[Alarm, ...]:
        """Those that are on, then those that are over, the last first."""
        return (*self._on.values(), *self._over)
