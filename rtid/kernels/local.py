"""Local columns, those that move at every sample, and their products: the cost of every row.

Products stand in the lower triangle of e.gram.  e is the record of `layout.ENGINE` and is changed
in place.
"""

from __future__ import annotations

from typing import Any

from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import MAX_LOCAL, TERMS

LANES = 4  # rows of the products are padded to whole vectors; the padding is kept at zero


@inlined
def set_open(e: Any, n: int) -> None:
    """Let n blocks be open; the width of the rows follows."""
    e.n_open = n
    e.width = min(MAX_LOCAL, (e.first + TERMS * n + LANES - 1) // LANES * LANES)


@inlined
def add_products(e: Any, n_rows: int) -> None:
    """gram += row' row over the n_rows local rows: the only work that every row costs."""
    width = e.width
    row_a, row_b = e.row[0], e.row[1]
    if n_rows == 1:
        for i in range(width):
            a, target = row_a[i], e.gram[i]
            for j in range((i | (LANES - 1)) + 1):
                target[j] += a * row_a[j]
    else:
        for i in range(width):
            a, b, target = row_a[i], row_b[i], e.gram[i]
            for j in range((i | (LANES - 1)) + 1):
                target[j] += a * row_a[j] + b * row_b[j]


@part
def clear_open(e: Any, k: int) -> None:
    """Zero the columns of open block k, states and products."""
    first, n = e.first + TERMS * k, e.width
    for j in range(first, first + TERMS):
        for s in range(e.n_state):
            e.d[s, j] = 0.0
        for i in range(n):
            e.gram[i, j] = 0.0
            e.gram[j, i] = 0.0


@part
def remove_open(e: Any, k: int) -> None:
    """Take the closed and cleared block k out of the open ones; the last one takes its place."""
    e.place[e.open_edge[k]] = -1
    last = e.n_open - 1
    if k < last:
        to, source, gram = e.first + TERMS * k, e.first + TERMS * last, e.gram
        for i in range(TERMS):
            for s in range(e.n_state):
                e.d[s, to + i] = e.d[s, source + i]
            for j in range(to):
                gram[to + i, j] = gram[source + i, j]
            for j in range(to + TERMS, source):
                gram[j, to + i] = gram[source + i, j]
            for j in range(TERMS):
                gram[to + i, to + j] = gram[source + i, source + j]
        e.open_edge[k], e.open_slot[k] = e.open_edge[last], e.open_slot[last]
        e.open_recent[k] = e.open_recent[last]
        e.open_cell[k, 0], e.open_cell[k, 1] = e.open_cell[last, 0], e.open_cell[last, 1]
        e.place[e.open_edge[k]] = k
    clear_open(e, last)
    set_open(e, last)
