"""What each alarm says: one sentence that names the part and what follows, "" where all is well."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rtid.daemon.status import TO_DECIDE, MessageHealth, SignalHealth, Verdict

CAUSES = {
    "late": "woken too late",
    "preempted": "kept from the processor",
    "work": "long work",
    "backlog": "catching up after a stall",
    "handover": "copying the estimate",
    "upkeep": "upkeep of the estimate",
    "swap": "taking an earlier estimate up",
}
MESSAGES = {  # verdict: what is said of the message, and how to go on
    "silent": "no good frame comes; is its sender switched off, or the identifier wrong?",
    "late": "comes more slowly than declared; is the bus overloaded, or the period wrong?",
    "damaged": "frames arrive damaged (CRC or length); look at cable, termination and DBC",
}


def _have(names: list[str], singular: str, many: str) -> str:
    return f"{', '.join(names)} {singular if len(names) == 1 else many}"


def second_sender(names: list[str]) -> str:
    """Messages that come faster than declared."""
    if not names:
        return ""
    return (
        f"{_have(names, 'comes', 'come')} faster than declared: a second sender, or a wrong "
        "period? Nothing is learned until that has ended"
    )


def several_channels(taken: Mapping[str, int]) -> str:
    """Messages that come on several channels, and which one is taken."""
    if not taken:
        return ""
    named = ", ".join(f"{name} (taken from {channel})" for name, channel in taken.items())
    return f"comes on several channels: {named}; declare `channel` for the right one"


def frozen(names: list[str]) -> str:
    """Signals that repeat as noise never would."""
    if not names:
        return ""
    return (
        f"{_have(names, 'does', 'do')} not move as sensor noise would: frozen? Nothing is learned "
        "until the value moves again"
    )


def bus_down(where: str) -> str:
    """The bus has failed."""
    return f"{where} has failed and is being opened again; nothing is learned meanwhile"


def helper_failed(times: int) -> str:
    """The analyst had to be started again."""
    often = "once" if times == 1 else f"{times} times"
    return (
        f"the process that solves and saves has ended {often} and was started again; its reason "
        "stands in the log"
    )


def message(verdict: str, health: Iterable[MessageHealth]) -> str:
    """Messages of one verdict of `MESSAGES`."""
    names = [m.name for m in health if m.verdict == verdict]
    return f"{', '.join(names)}: {MESSAGES[verdict]}" if names else ""


def signals(health: Iterable[SignalHealth]) -> str:
    """Signals outside what the project file declares, or without a value."""
    said = [_signal(s) for s in health if s.verdict in ("out_of_range", "not_available")]
    return "; ".join(said)


def _signal(health: SignalHealth) -> str:
    if health.verdict == "not_available":
        return f"{health.name} has no value: its sender says that it is not available"
    return (
        f"{health.name} leaves its declared range, it went from {health.minimum:g} to "
        f"{health.maximum:g} "
        f"{health.unit} within a second; such samples are not learned"
    )


def plant_changed(verdict: Verdict | None, cause: str = "") -> str:
    """The map no longer foretells the motion.

    cause: a sentence on it without its full stop; verdict: of the change, as far as there is one.
    """
    text = "the machine no longer does what the map says; learning is suspended"
    if cause:
        return f"{text}. {cause}.{TO_DECIDE}"
    if verdict is None:
        return f"{text}, a diagnosis follows"
    return f"{text}. {verdict.text}{TO_DECIDE}"


def overload(lost: int, ticks: int, causes: Mapping[str, int]) -> str:
    """So many of the last ticks were lost; what the overruns among them came from."""
    why = sorted(causes.items(), key=lambda cause: -cause[1])
    words = ", ".join(f"{CAUSES.get(cause, cause)} ({n})" for cause, n in why)
    return (
        f"{lost} of the last {ticks} ticks were lost{': ' * bool(words)}{words}; frames wait, and "
        "what is published comes late. Give the daemon more of the processor (daemon.priority) "
        "or a lower rate (daemon.rate_hz)"
    )
