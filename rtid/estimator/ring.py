"""Ring buffer of raw samples: the last two minutes, for refits and for the diagnosis.

All memory is taken at the start.  A row overwrites the oldest one; nothing is allocated per sample.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rtid.errors import RtidError
from rtid.plain import FloatArray

SPAN_S = 120.0
ROWS_PER_S = 1000.0


class HistoryError(RtidError):
    """Rows of another width than the buffer's, or arrays that are no saved buffer."""


class History:
    """The samples of the last span_s seconds, at most span_s * rows_per_s of them.

    A row is that of the kernels, [t_s, flags, values of the signals...]: 2 + signals columns.
    """

    def __init__(
        self, signals: int, span_s: float = SPAN_S, rows_per_s: float = ROWS_PER_S
    ) -> None:
        if not (signals >= 0 and span_s > 0 and rows_per_s > 0):
            raise HistoryError("a history needs signals >= 0, span_s > 0 and rows_per_s > 0")
        self.span_s = float(span_s)
        self._rows = np.zeros((max(1, round(span_s * rows_per_s)), 2 + signals))
        self._next = 0  # where the next row goes
        self.seen = 0  # rows appended in all

    def __len__(self) -> int:
        """Rows held, those older than span_s included."""
        return min(self.seen, len(self._rows))

    @property
    def capacity(self) -> int:
        """Rows that the memory holds."""
        return len(self._rows)

    @property
    def overwritten(self) -> int:
        """Rows that newer ones have replaced."""
        return self.seen - len(self)

    @property
    def held_s(self) -> float:
        """Seconds from the oldest row to the newest; less than span_s if rows come too fast."""
        oldest = self._next if self.overwritten else 0
        return float(self._rows[self._next - 1, 0] - self._rows[oldest, 0]) if self.seen else 0.0

    def append(self, chunk: FloatArray) -> None:
        """Take rows (n, 2 + signals), SI, any n.  Raises HistoryError for another width."""
        n, rows, at = len(chunk), self._rows, self._next
        if chunk.ndim != 2 or chunk.shape[1] != rows.shape[1]:
            wanted = f"rows of {rows.shape[1]} columns, t_s and flags first"
            raise HistoryError(f"a chunk of shape {chunk.shape} does not fit", f"append {wanted}")
        self.seen += n
        capacity = len(rows)
        if n > capacity:
            chunk, n = chunk[-capacity:], capacity
        first = min(n, capacity - at)
        rows[at : at + first] = chunk[:first]
        if first < n:
            rows[: n - first] = chunk[first:]
        self._next = (at + n) % capacity

    def chunk(self, span_s: float | None = None) -> FloatArray:
        """The rows of the last span_s seconds in their order, a copy (n, 2 + signals).

        Rows from before a step back of the clock stay as long as they are not overwritten.
        """
        rows = self._rows
        if self.seen < len(rows):
            kept = rows[: self.seen].copy()
        else:
            kept = np.concatenate([rows[self._next :], rows[: self._next]])
        if not len(kept):
            return kept
        since = kept[-1, 0] - (self.span_s if span_s is None else span_s)
        old = np.flatnonzero(kept[:, 0] < since)
        return kept[old[-1] + 1 :] if len(old) else kept

    def clear(self) -> None:
        """Forget all rows."""
        self._next = self.seen = 0

    def to_arrays(self) -> dict[str, NDArray[np.float64 | np.int64]]:
        """Everything as plain arrays: rows (n, 2 + signals) SI, size (2,), span_s (1,)."""
        size = np.array([self.capacity, self.seen], np.int64)
        rows = self.chunk(np.inf)
        return {"rows": rows, "size": size, "span_s": np.array([self.span_s])}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[np.float64 | np.int64]]) -> History:
        """The buffer of rows (n, 2 + signals), SI, that `to_arrays` saved.  Raises HistoryError."""
        try:
            rows = np.asarray(arrays["rows"], np.float64)
            capacity, seen = np.asarray(arrays["size"], np.int64).tolist()
            span_s = float(arrays["span_s"][0])
            width = rows.shape[1] - 2
            if len(rows) != min(seen, capacity) or capacity < 1 or width < 0 or not span_s > 0:
                raise ValueError(f"{len(rows)} rows of {width} signals, {capacity} places")
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise HistoryError(f"no saved history ({error})", "start with an empty one") from error
        history = History(width, span_s, capacity / span_s)
        history.append(rows)
        history.seen = seen
        return history
