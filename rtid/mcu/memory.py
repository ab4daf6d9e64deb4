"""The memory of the estimator in C as numpy records: its size, and its contents read back.

The layout is that of rtid_estimator.h on every machine where int64_t and double are aligned to
eight bytes, as on 64-bit hosts and under the ARM EABI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtid.estimator.sums import Normal
from rtid.kernels.layout import COUNTERS, OUTLIER, TERMS
from rtid.mcu.c_tables import Sizes
from rtid.plain import FloatArray

COUNTS = (*COUNTERS[:OUTLIER], "no_room", "busy")  # as far as no row is judged by a map held
_I2, _U1, _U2, _U4, _U8, _I8 = np.int16, np.uint8, np.uint16, np.uint32, np.uint64, np.int64


Field = tuple[Any, ...]


def _record(fields: Sequence[Field]) -> np.dtype[np.void]:
    return np.dtype(list(fields), align=True)


# rtid_estimator_map
MAP = _record(
    [
        ("theta", np.float64, (TERMS,)),
        ("mean_m3s", np.float64),
        ("mean_sd_m3s", np.float64),
        ("condition", np.float64),
        ("status", _U1),
    ]
)


@dataclass(frozen=True)
class Layout:
    """Records of rtid_estimator.h for one declaration; single: with RTID_ESTIMATOR_FLOAT32."""

    sizes: Sizes
    single: bool = False

    @property
    def _real(self) -> Any:
        return np.float32 if self.single else np.float64

    @property
    def _sum(self) -> Any:
        return _record([("high", np.float32), ("low", np.float32)]) if self.single else np.float64

    @property
    def sample(self) -> np.dtype[np.void]:
        """rtid_estimator_sample."""
        values = ("values", self._real, (self.sizes.signals,))
        return _record([("t_us", _I8), ("row", _U1), ("gap", _U1), values])

    @property
    def block(self) -> np.dtype[np.void]:
        """rtid_estimator_block."""
        place = [("edge", _I2), ("u", _I2), ("dp", _I2), ("rows", _U8)]
        times = [("dwell_us", _I8), ("last_us", _I8)]
        return _record([*place, *times, ("phi", self._sum, (TERMS,))])

    @property
    def owed(self) -> np.dtype[np.void]:
        """rtid_estimator_owed."""
        real, total, n = self._real, self._sum, self.sizes
        visit: list[Field] = [("slot", _I2), ("status", _U1), ("memory", _U2), ("epoch", _U4)]
        visit += [("fade", real), ("start", real), ("d", real, (TERMS,))]
        visit += [("left", total, (TERMS,)), ("ring", total), ("shared", total, (2 + n.terms,))]
        opened = [(name, _I2) for name in ("edge", "slot", "visit", "u", "dp")]
        fields: list[Field] = [("local", total, (self._width, self._width))]
        fields += [("memory", _U2)]
        fields += [(name, _I2) for name in ("n_open", "n_line", "n_paid", "last_begun")]
        fields += [("epoch", _U4), ("open", _record(opened), (n.open,))]
        return _record(
            [*fields, ("visit", _record(visit), (n.visits,)), ("line", _I2, (n.visits,))]
        )

    @property
    def _width(self) -> int:
        return 3 + self.sizes.terms + TERMS * self.sizes.open

    @property
    def estimator(self) -> np.dtype[np.void]:
        """rtid_estimator."""
        real, total, n = self._real, self._sum, self.sizes
        edge = [(name, real) for name in ("w", "m1", "var", "mt", "dp0", "dp1")]
        edge += [(name, _I2) for name in ("u", "dp", "to_u", "to_dp", "place")]
        fields: list[Field] = [("d", real, (self._width,)), ("width", _I2), ("faded", real)]
        fields += [("owed", self.owed)]
        fields += [(name, real) for name in ("cov", "echo")] + [("noise", total)]
        fields += [(name, _I8) for name in ("t_us", "ready_us", "dt_us")]
        fields += [("values", real, (n.signals + 1,)), ("dt_s", real), ("lag_decay", real)]
        fields += [("running", _U1), ("edge", _record(edge), (n.edges,))]
        fields += [(name, _I2) for name in ("n_closed", "n_slots", "tiles")]
        fields += [("slot", _I2, (n.cells,)), ("block", self.block, (n.blocks,))]
        fields += [("sums", total, (n.sums,))]
        if not self.single:
            kept_sums = TERMS * (2 + n.terms) + TERMS * (TERMS + 1) // 2
            fields += [("lost", np.float64, (n.blocks, kept_sums))]
        return _record([*fields, ("counts", _U8, (len(COUNTS),))])

    @property
    def work(self) -> np.dtype[np.void]:
        """rtid_estimator_work."""
        n = self.sizes
        fields: list[Field] = [("matrix", np.float64, (n.sums,))]
        fields += [(name, np.float64, (n.unknowns,)) for name in ("scale", "theta", "basis")]
        fields += [(name, np.float64) for name in ("noise", "rows", "cov_change")]
        fields += [("now_us", _I8), ("n_slots", _I2), ("owed", self.owed)]
        fields += [("block", self.block, (n.blocks,))]
        return _record([*fields, ("map", MAP, (n.blocks,))])

    @property
    def solution(self) -> np.dtype[np.void]:
        """rtid_estimator_solution."""
        shared = (1 + self.sizes.terms,)
        fields = [("shared", np.float64, shared), ("shared_sd", np.float64, shared)]
        numbers = [(name, np.float64) for name in ("rho", "leverage")]
        return _record([*fields, *numbers, ("raised", _U2), ("finite", _U1)])

    def normal(self, memory: np.void, matrix: FloatArray) -> Normal:
        """The normal equations of `estimator` and its settled sums: a triangle (sums,), scaled."""
        n = 1 + 1 + self.sizes.terms + TERMS * int(memory["n_slots"])
        whole = np.zeros((n, n))
        whole[np.tril_indices(n)] = matrix[: n * (n + 1) // 2]
        whole += np.tril(whole, -1).T
        noise = np.array([float(self._number(memory["noise"]))])
        rows = float(memory["counts"][COUNTS.index("rows")])
        return Normal(whole[1:, 1:].copy(), whole[1:, 0].copy(), float(whole[0, 0]), noise, rows)

    def _number(self, total: np.ndarray | np.void) -> FloatArray:
        """Sums as they were added up: the high part and what it rounded off."""
        if not self.single:
            return np.asarray(total, float)
        return np.asarray(total["high"], float) + np.asarray(total["low"], float)
