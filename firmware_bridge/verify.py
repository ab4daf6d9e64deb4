"""Whether the controller holds what was sent: version and CRC read back, flows asked at points.

A CRC that is read back is what the receiver has written down; a flow comes from the very map that
the firmware evaluates.  What a controller does with the map afterwards nobody can ask.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from firmware_bridge.download import ContradictedError, Session
from firmware_bridge.lookup import MAP, STATUS, Table, crc32, numbers_of, table_of
from firmware_bridge.protocol import Held

POINTS = 8  # per map, in cells drawn at random
CLOSE = 1e-5  # of a map's largest flow: the receiver computes in float32
REMEDY = "its maps are not to be relied on: look after the firmware, then apply again"


@dataclass(frozen=True)
class Verified:
    """slots: whose version and CRC are right; points: flows that were asked and are right.

    points = 0: the receiver does not know the question, and only says that it holds the maps.
    """

    slots: int
    points: int

    @property
    def is_whole(self) -> bool:
        """Whether the maps themselves have answered."""
        return self.points > 0


@dataclass(frozen=True)
class _Point:
    """u_v, dp_pa as float32 has them; status None: a node, where rounding may choose the cell."""

    u_v: float
    dp_pa: float
    expected: float
    status: int | None
    allowed: float


def verify(
    session: Session, images: Mapping[int, bytes], version: int | None, before: Mapping[int, bytes]
) -> Verified:
    """Read back what is active, and ask for flows.  Raises ContradictedError with the place.

    version: that they were sent with, None: any; before: images that may be active in their place.
    """
    for slot, data in images.items():
        active = session.held(slot)
        wanted = Held(active.version if version is None else version, crc32(data))
        if active != wanted or not active.version:
            raise ContradictedError(
                f"the controller said done, but holds version {active.version} with CRC "
                f"{active.crc:08x} in slot {slot}; sent was {wanted.version} with {wanted.crc:08x}",
                REMEDY,
            )
    return Verified(len(images), _asked(session, images, before))


def _asked(session: Session, images: Mapping[int, bytes], before: Mapping[int, bytes]) -> int:
    """How many points were asked and are right; 0 where the receiver does not know the question."""
    count = 0
    for slot, data in images.items():
        for point in _points(data, before.get(slot)):
            answer = session.flow(slot, point.u_v, point.dp_pa)
            if answer is None and not count:
                return 0
            if answer is None or not _fits(point, *answer):
                raise ContradictedError(_place(slot, point, answer), REMEDY)
            count += 1
    return count


def _fits(point: _Point, value: float, status: int) -> bool:
    is_close = abs(value - point.expected) <= point.allowed
    return is_close and point.status in (None, status)


def _place(slot: int, point: _Point, answer: tuple[float, int] | None) -> str:
    if answer is None:
        return f"the controller has answered, and then not what slot {slot} gives"
    word = STATUS[answer[1]] if answer[1] < len(STATUS) else str(answer[1])
    return (
        f"the controller said done, but slot {slot} gives {answer[0]:.6g} ({word}) at "
        f"{point.u_v:.4g} V, {point.dp_pa:.4g} Pa; what was sent gives {point.expected:.6g}"
    )


def _points(data: bytes, before: bytes | None) -> Iterator[_Point]:
    if data[0] != MAP:
        for k, number in enumerate(numbers_of(data)):
            yield _Point(k, 0.0, float(number), STATUS.index("valid"), 1e-6 * abs(number))
        return
    table = table_of(data)
    allowed = CLOSE * float(np.abs(table.flow_m3s).max())
    old = table_of(before) if before is not None and before[0] == MAP else None
    if old is not None:
        yield _most_changed(table, old, allowed)
    rng = np.random.default_rng()
    nu, ns = table.status.shape
    for i, j in zip(rng.integers(nu, size=POINTS), rng.integers(ns, size=POINTS), strict=True):
        w, s = (_within(node, k, rng) for node, k in ((table.w_v, i), (table.s, j)))
        u, dp = (float(np.float32(x)) for x in (table.direction * w, s * abs(s)))
        q, status = table.flow(u, dp)
        yield _Point(u, dp, float(q), int(status), allowed)


def _within(node: np.ndarray, k: int, rng: np.random.Generator) -> float:
    """A place between node k and the next, near to neither."""
    share = rng.uniform(0.2, 0.8)
    return float(node[k]) * (1.0 - share) + float(node[k + 1]) * share


def _most_changed(table: Table, old: Table, allowed: float) -> _Point:
    """The node where the old map would be told from the new one most easily."""
    w = table.w_v[:, None].astype(float)
    u, dp = np.broadcast_arrays(table.direction * w, table.dp_pa.astype(np.float32).astype(float))
    change = np.abs(table.flow(u, dp)[0] - old.flow(u, dp)[0])
    i, j = np.unravel_index(change.argmax(), change.shape)
    at = float(u[i, j]), float(dp[i, j])
    return _Point(*at, float(table.flow(*at)[0]), None, allowed)
