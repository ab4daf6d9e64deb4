"""The loop's numbers as status, and the status as one line of text."""

from __future__ import annotations

from pathlib import Path

from rtid.daemon.histogram import EDGES_US, Histogram
from rtid.daemon.loop import Loop
from rtid.daemon.status import Distribution, LoopHealth, Status
from rtid.project import Project


def distribution(histogram: Histogram, whole: bool) -> Distribution:
    """Quantiles, with the bins where `whole`."""
    return Distribution(
        histogram.count,
        histogram.quantile_us(0.5),
        histogram.quantile_us(0.99),
        histogram.quantile_us(0.999),
        histogram.max_us,
        EDGES_US if whole else (),
        tuple(histogram.counts) if whole else (),
    )


def loop_health(loop: Loop | None, project: Project, scheduling: str, locked: bool) -> LoopHealth:
    """The loop since its start and since the last call."""
    rate_hz = project.sections.daemon.rate_hz
    if loop is None:
        return LoopHealth(rate_hz, scheduling=scheduling, memory_locked=locked)
    recent, total = loop.last_second, loop.total
    return LoopHealth(
        rate_hz=rate_hz,
        ticks=total.ticks,
        overruns=total.overruns,
        skipped=total.skipped,
        causes=dict(total.causes),
        lateness=distribution(total.lateness, whole=True),
        work=distribution(total.work, whole=True),
        lateness_1s=distribution(recent.lateness, whole=False),
        work_1s=distribution(recent.work, whole=False),
        scheduling=scheduling,
        memory_locked=locked,
    )


def resident_mb() -> float:
    """Private memory of this process (RssAnon), MB."""
    for line in Path("/proc/self/status").read_text("ascii").splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1000
    return 0.0


def line(status: Status) -> str:
    """Rates, ages, gaps, tick and wake-up, gates, blocks: what an engineer looks at first."""
    loop, estimate = status.loop, status.estimate
    messages = " ".join(
        f"{m.name}={m.rate_hz:.0f}Hz" + ("" if m.verdict == "ok" else f"({m.verdict})")
        for m in status.messages
    )
    gap_ms = 1e3 * max((m.gap_s for m in status.messages), default=0.0)
    age = "-" if estimate.age_s is None else f"{1e3 * estimate.age_s:.0f}ms"
    work, late = loop.work_1s, loop.lateness_1s
    parts = [
        f"{messages} age={age} gap={gap_ms:.0f}ms",
        f"tick={work.p50_us:.0f}/{work.p99_us:.0f}/{work.max_us:.0f}us",
        f"wake={late.p50_us:.0f}/{late.p99_us:.0f}/{late.max_us:.0f}us overruns={loop.overruns}",
        f"{estimate.state} samples={estimate.samples}",
    ]
    if blocks := estimate.blocks:
        parts.append("blocks " + " ".join(f"{k}={n}" for k, n in blocks.items()))
    if estimate.chambers and estimate.chambers[0].beta_pa:
        parts.append(
            "beta="
            + "/".join(f"{(c.beta_pa or 0.0) / 1e6:.0f}" for c in estimate.chambers)
            + f"MPa rho={estimate.rho or 0.0:.2f}"
        )
    refused = {k: n for k, n in estimate.refused.items() if n and k not in ACCEPTED}
    if refused:
        parts.append("gates " + " ".join(f"{k}={n}" for k, n in sorted(refused.items())))
    if status.store.state == "NOT SAVED":
        parts.append("NOT SAVED")
    if status.on:
        parts.append("ALARM " + " ".join(alarm.name for alarm in status.on))
    return " | ".join(parts)


ACCEPTED = ("samples", "rows", "block_changes")  # counters that are no refusals
