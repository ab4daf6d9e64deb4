"""A flow map as the controller has it: a look-up table, its image on the wire, and its evaluation.

Between nodes in the opening command w = direction * u and in s = sign(dp) sqrt |dp|,

    Q(u, dp) = scale * sum over the four corners of weight(w, s) * counts[corner],

which is what firmware_bridge/c/rtid_map.c computes in float32; here in float64 from the same nodes.
The image is little-endian: kind, slot, nu, ns, direction, three zero bytes, scale and safe band
(float32), nodes of w and s (float32), counts (int16), statuses of the cells (one byte each).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# What a flow stands on, in the order of the codes of c/rtid_map.h.
STATUS = ("valid", "shut", "learning", "extrapolated", "prior", "outside", "none")
SHUT, OUTSIDE, NONE = STATUS.index("shut"), STATUS.index("outside"), STATUS.index("none")
CELL_STATUS = 5  # codes below can be a cell's
MOST_NODES = 255  # per axis
MOST_COUNT = 32_767
ROUNDING = 0.01  # counts by which a flow may lie beyond the ends
RISING = 0x80  # with the first cells' status: flows only rise, or only fall, with the command
NO_SAFE_BAND = -float(np.finfo(np.float32).max)
MAP, NUMBERS = 1, 2
HEAD = struct.Struct("<BBBBbxxxff")


class ImageError(ValueError):
    """Bytes that are no image, or a table that cannot become one; the text says why."""


@dataclass(frozen=True, eq=False)
class Table:
    """One edge's look-up table.

    w_v float32 (nu,) and s float32 (ns,) in sqrt(Pa): rising nodes; counts int16 (nu, ns), flows in
    units of `scale` m3/s; status uint8 (nu - 1, ns - 1), codes of STATUS; safe_band_v: opening
    command up to which nothing passes, NO_SAFE_BAND where none is declared.
    """

    w_v: NDArray[np.float32]
    s: NDArray[np.float32]
    counts: NDArray[np.int16]
    status: NDArray[np.uint8]
    scale: float
    safe_band_v: float
    direction: int

    def flow(self, u_v: ArrayLike, dp_pa: ArrayLike) -> tuple[FloatArray, NDArray[np.uint8]]:
        """Q (...), m3/s, at broadcast points, what it stands on; beyond the nodes as at their edge.

        NaN commands and pressures give 0 and "none".
        """
        u, dp = np.broadcast_arrays(np.asarray(u_v, float), np.asarray(dp_pa, float))
        known = np.isfinite(u) & np.isfinite(dp)
        w, s = np.where(known, self.direction * u, 0.0), _root(np.where(known, dp, 0.0))
        i, a, beyond_w = _locate(self.w_v, w)
        j, b, beyond_s = _locate(self.s, s)
        low, high = self._along_s(i, j, b), self._along_s(i + 1, j, b)
        is_open = known & (w > self.safe_band_v)
        status = np.where(beyond_w | beyond_s, OUTSIDE, self.status[i, j])
        status = np.where(known, np.where(is_open, status, SHUT), NONE)
        flow = np.where(is_open, self.scale * (low + a * (high - low)), 0.0)
        return flow, status.astype(np.uint8)

    def command(self, q_m3s: ArrayLike, dp_pa: ArrayLike) -> tuple[FloatArray, NDArray[np.uint8]]:
        """Command u (...), V, for a wanted flow, and what it stands on; see `rtid_map_command`."""
        q, dp = np.broadcast_arrays(np.asarray(q_m3s, float), np.asarray(dp_pa, float))
        known, shape = (np.isfinite(q) & np.isfinite(dp)).ravel(), q.shape
        q, dp = np.where(known, q.ravel(), 0.0), np.where(known, dp.ravel(), 0.0)
        j, b, beyond = _locate(self.s, _root(dp))
        nodes = np.arange(len(self.w_v))
        table = self._along_s(nodes[None, :], j[:, None], b[:, None])
        sign = np.where(table[:, -1] >= table[:, 0], 1.0, -1.0)
        table, count = table * sign[:, None], sign * q / self.scale
        first, last = table[:, 0], table[:, -1]
        possible = (count >= first - ROUNDING) & (count <= last + ROUNDING)
        wanted = np.clip(count, first, last)
        below = table < wanted[:, None]
        below[:, 0], below[:, -1] = True, False
        passing = below[:, :-1] & ~below[:, 1:]
        single = (below[:, :-1] != below[:, 1:]).sum(axis=1) == 1
        i, rows = passing.argmax(axis=1), np.arange(len(wanted))
        rise = table[rows, i + 1] - table[rows, i]
        share = np.where(rise > 0, (wanted - table[rows, i]) / np.where(rise > 0, rise, 1.0), 0.0)
        w_v = self.w_v.astype(float)
        w = w_v[i] + np.clip(share, 0.0, 1.0) * (w_v[i + 1] - w_v[i])
        w = np.where(possible & single, w, np.where(count > last + ROUNDING, w_v[-1], w_v[0]))
        status = np.where(beyond, OUTSIDE, self.status[i, j])
        status = np.where(possible & single & known, status, NONE)
        u = np.where(known, self.direction * w, 0.0)
        return u.reshape(shape), status.astype(np.uint8).reshape(shape)

    def _along_s(self, i: NDArray[np.intp], j: NDArray[np.intp], share: FloatArray) -> FloatArray:
        lower = self.counts[i, j].astype(float)
        return lower + share * (self.counts[i, j + 1] - lower)

    @property
    def dp_pa(self) -> FloatArray:
        """Pressure drops of the nodes (ns,)."""
        s = self.s.astype(float)
        return np.asarray(s * np.abs(s))

    @property
    def rising(self) -> NDArray[np.bool_]:
        """Between which nodes of s (ns - 1,) flows only rise, or only fall, with the command."""
        step = np.diff(self.counts.astype(int), axis=0)
        rises: NDArray[np.bool_] = np.all(step >= 0, axis=0)
        falls: NDArray[np.bool_] = np.all(step <= 0, axis=0)
        return np.asarray((rises[1:] & rises[:-1]) | (falls[1:] & falls[:-1]))

    @property
    def flow_m3s(self) -> FloatArray:
        """Flows at the nodes (nu, ns)."""
        return self.scale * self.counts.astype(float)


def _root(dp_pa: FloatArray) -> FloatArray:
    return np.asarray(np.sign(dp_pa) * np.sqrt(np.abs(dp_pa)))


def _locate(
    node: NDArray[np.float32], x: FloatArray
) -> tuple[NDArray[np.intp], FloatArray, NDArray[np.bool_]]:
    """Cell, share in it and whether it lies beyond the nodes, for points of any shape."""
    nodes = node.astype(float)
    inside = np.clip(x, nodes[0], nodes[-1])
    cell = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, len(nodes) - 2)
    share = (inside - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    return cell, share, np.asarray(inside != x)


def image_bytes(nu: int, ns: int) -> int:
    """Length of the image of a map."""
    return HEAD.size + 4 * (nu + ns) + 2 * nu * ns + (nu - 1) * (ns - 1)


def image(table: Table, slot: int) -> bytes:
    """The bytes that are sent.  ImageError for more than 255 nodes per axis."""
    nu, ns = table.counts.shape
    if nu > MOST_NODES or ns > MOST_NODES:
        raise ImageError(f"{nu} x {ns} nodes: at most {MOST_NODES} per axis")
    head = HEAD.pack(MAP, slot, nu, ns, table.direction, table.scale, table.safe_band_v)
    parts = (table.w_v.astype("<f4"), table.s.astype("<f4"), table.counts.astype("<i2"))
    status = table.status.copy()
    status[0] |= np.where(table.rising, RISING, 0).astype(np.uint8)
    return head + b"".join(part.tobytes() for part in parts) + status.tobytes()


def table_of(data: bytes) -> Table:
    """The table of an image.  ImageError if it is none."""
    if len(data) < HEAD.size:
        raise ImageError(f"{len(data)} bytes are no image")
    kind, _, nu, ns, direction, scale, safe = HEAD.unpack_from(data)
    counts_at = HEAD.size + 4 * (nu + ns)
    status_at = counts_at + 2 * nu * ns
    if kind != MAP or nu < 2 or ns < 2 or len(data) != image_bytes(nu, ns):
        raise ImageError(f"an image of kind {kind} with {nu} x {ns} nodes in {len(data)} bytes")
    nodes = np.frombuffer(data, "<f4", nu + ns, HEAD.size).astype(np.float32)
    counts = np.frombuffer(data, "<i2", nu * ns, counts_at).astype(np.int16).reshape(nu, ns)
    status = np.frombuffer(data, np.uint8, -1, status_at).reshape(nu - 1, ns - 1).copy()
    return Table(
        nodes[:nu], nodes[nu:], counts, status & np.uint8(RISING - 1), scale, safe, direction
    )


def numbers_image(numbers: ArrayLike, slot: int) -> bytes:
    """The image of a few plain numbers, such as bulk moduli."""
    values = np.asarray(numbers, "<f4").ravel()
    if not 1 <= len(values) <= MOST_NODES:
        raise ImageError(f"{len(values)} numbers: 1 to {MOST_NODES}")
    return HEAD.pack(NUMBERS, slot, len(values), 0, 0, 0.0, 0.0) + values.tobytes()


def numbers_of(data: bytes) -> FloatArray:
    """The numbers of an image (n,), units as sent.  ImageError if it is none."""
    if len(data) < HEAD.size or data[0] != NUMBERS or len(data) != HEAD.size + 4 * data[2]:
        raise ImageError(f"{len(data)} bytes are no image of numbers")
    return np.frombuffer(data, "<f4", -1, HEAD.size).astype(float)


def crc32(data: bytes) -> int:
    """The CRC-32 (IEEE 802.3) by which an image is known."""
    return zlib.crc32(data)
