"""A status as Prometheus metrics (text exposition format 0.0.4).

For a scraper: `rtid status FOLDER --serve PORT` beside the daemon, or `--metrics` in a timer, into
node_exporter's textfile folder.  The daemon itself serves nobody.  `board.json` shows them.
"""

from __future__ import annotations

from collections.abc import Iterator

from rtid.daemon.status import Distribution, Status

Line = tuple[str, str, str, dict[str, str], float | None]  # name, kind, help, labels, value


def exposition(status: Status, age_s: float) -> str:
    """All metrics; age_s: seconds since the status was told."""
    text: list[str] = []
    described: set[str] = set()
    for name, kind, help_text, labels, value in _lines(status, age_s):
        if value is None:
            continue
        if name not in described:
            described.add(name)
            text += [f"# HELP rtid_{name} {help_text}", f"# TYPE rtid_{name} {kind}"]
        pairs = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
        text.append(f"rtid_{name}{{{pairs}}} {value:.10g}")
    return "\n".join(text) + "\n"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")


def _lines(status: Status, age_s: float) -> Iterator[Line]:
    machine = {"machine": status.name}
    loop, estimate, store = status.loop, status.estimate, status.store
    yield "status_age_seconds", "gauge", "Since the daemon last told", machine, age_s
    yield "frames_total", "counter", "Frames received", machine, status.bus.frames
    yield "samples_total", "counter", "Samples learned from", machine, estimate.samples
    yield "sample_age_seconds", "gauge", "Of the newest sample", machine, estimate.age_s
    yield "learning", "gauge", "1 while it learns", machine, float(estimate.state == "learning")
    yield "surprise", "gauge", "Of the map held, 1 is noise", machine, estimate.surprise
    yield "snapshot_age_seconds", "gauge", "Of the newest snapshot on disk", machine, store.age_s
    yield "not_saved", "gauge", "1 while not saved", machine, float(store.state == "NOT SAVED")
    yield "memory_bytes", "gauge", "Private memory", machine, 1e6 * status.rss_anon_mb
    yield "ticks_total", "counter", "Ticks of the loop", machine, loop.ticks
    for cause, count in loop.causes.items():
        labels = machine | {"cause": cause}
        yield "overruns_total", "counter", "Ticks that ended late", labels, count
    yield from _quantiles("tick_work", loop.work, machine)
    yield from _quantiles("tick_lateness", loop.lateness, machine)
    for reason, count in estimate.refused.items():
        labels = machine | {"reason": reason}
        yield "gates_total", "counter", "What gates counted", labels, count
    for message in status.messages:
        labels = machine | {"message": message.name}
        yield "message_rate_hertz", "gauge", "Good frames per second", labels, message.rate_hz
        yield "message_gap_seconds", "gauge", "Longest silence", labels, message.gap_s
    for chamber in estimate.chambers:
        labels = machine | {"chamber": chamber.name}
        yield "bulk_modulus_pascals", "gauge", "Effective", labels, chamber.beta_pa
        yield "bulk_modulus_sd_pascals", "gauge", "Its deviation", labels, chamber.beta_sd_pa
    if (said := status.verdict) is not None:
        labels = machine | {"verdict": said.verdict, "effects": " ".join(said.effects)}
        yield "verdict", "gauge", "1: the last diagnosis", labels, 1.0
    for edge in estimate.edges:
        for state, count in edge.blocks.items():
            labels = machine | {"edge": edge.name, "state": state}
            yield "blocks", "gauge", "Blocks of the maps", labels, count
    for alarm in status.on:
        labels = machine | {"alarm": alarm.name, "kind": alarm.kind}
        yield "alarm", "gauge", "1 while it is on", labels, 1.0


def _quantiles(name: str, distribution: Distribution, machine: dict[str, str]) -> Iterator[Line]:
    for share, value in (
        ("0.5", distribution.p50_us),
        ("0.99", distribution.p99_us),
        ("0.999", distribution.p999_us),
    ):
        labels = machine | {"quantile": share}
        yield f"{name}_seconds", "gauge", "Since the start", labels, 1e-6 * value
