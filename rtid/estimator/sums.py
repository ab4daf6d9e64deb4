"""What rows add up to: accumulators that merge over time folds, days and machines of one type.

Products of all columns, sparse: a dense matrix for [y | shared], one record per visited block and
one tile per pair of blocks that were ever recent together.  Rows of one declaration and one set of
weights add up; the sum over parts is the sum over the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.state import RecordArray, State
from rtid.kernels.layout import TERMS
from rtid.kernels.normal import assemble
from rtid.plain import FloatArray, IntArray

# Fields of a block's record that add up; the time of the last visit is the latest.
ADDING = ("rows", "dwell_s", "phi_sum", "surprise", "judged", "gram", "shared")


@dataclass(frozen=True)
class Normal:
    """Normal equations in scaled units, without prior.

    gram (n, n), right (n,), square = y'y; noise (chambers,): what pressure noise adds on average to
    the diagonal of gram for -V dP; rows: pairs of rows.
    """

    gram: FloatArray
    right: FloatArray
    square: float
    noise: FloatArray
    rows: float


@dataclass(frozen=True)
class Sums:
    """Accumulated rows.

    shared (1 + n_shared, 1 + n_shared): products of [y | shared]; blocks (m,): records of
    `layout.BLOCK`; pairs (p, 2): places low < high in blocks, tiles (p, 6, 6): their products;
    noise (chambers,), rows as in `Normal`; compliance (chambers,): unit of theta_beta; innovation
    (3,): covariance of the last innovations.
    """

    shared: FloatArray
    blocks: RecordArray
    pairs: IntArray
    tiles: FloatArray
    noise: FloatArray
    rows: float
    compliance: FloatArray
    innovation: FloatArray

    @classmethod
    def of(cls, state: State) -> Sums:
        """Everything that a state has taken since it was last drained; the state is not changed."""
        return cls._read(state.settled())

    @classmethod
    def ended(cls, state: State) -> Sums:
        """Everything that a state has taken that nobody goes on with: settled in place, no copy."""
        state.settle()
        return cls._read(state)

    @classmethod
    def _read(cls, state: State) -> Sums:
        """Copy the tables of a settled state."""
        e = state.engine[0]
        n_c, size = int(e["n_chambers"]), 1 + int(e["n_shared"])
        used = state.pairs[state.pairs["key"] != 0]
        places = np.stack([(used["key"] >> 32) - 1, (used["key"] & 0xFFFFFFFF) - 1], axis=1)
        return cls(
            e["shared"][:size, :size].copy(),
            state.blocks[: int(e["n_slots"])].copy(),
            places,
            used["gram"].copy(),
            e["noise_gram"][:n_c].copy(),
            float(e["rows"]),
            e["compliance"][:n_c].copy(),
            e["innovation"].copy(),
        )

    @classmethod
    def drained(cls, state: State) -> Sums:
        """Take everything out of a state, which goes on with its memory of recent columns."""
        state.settle()
        sums = cls._read(state)
        state.clear_sums()
        return sums._touched()

    def _touched(self) -> Sums:
        """Without the blocks that no row has touched, and without empty pairs."""
        here = (self.blocks["gram"][:, 0, 0] > 0) | (self.blocks["dwell_s"] > 0)
        place = np.cumsum(here) - 1
        linked = self.tiles.any(axis=(1, 2)) & here[self.pairs].all(axis=1)
        pairs, tiles = place[self.pairs[linked]], self.tiles[linked]
        return replace(self, blocks=self.blocks[here], pairs=pairs, tiles=tiles)

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return len(self.shared) - 1

    @property
    def cells(self) -> IntArray:
        """Grid cell of each block (m,)."""
        return np.asarray(self.blocks["cell"])

    def __add__(self, other: Sums) -> Sums:
        """The sums over the rows of both.  Raises ValueError where their units differ."""
        if not np.array_equal(self.compliance, other.compliance):
            raise ValueError("sums of different weights do not add up: learn them with the same")
        at = self._places(other.cells)
        blocks = np.concatenate([self.blocks, other.blocks[at >= len(self.blocks)]])
        mine = at < len(self.blocks)
        for name in ADDING:
            blocks[name][at[mine]] += other.blocks[name][mine]
        blocks["last_s"][at] = np.maximum(blocks["last_s"][at], other.blocks["last_s"])
        pairs, tiles = _merged(
            np.concatenate([self.pairs, at[other.pairs]]),
            np.concatenate([self.tiles, other.tiles]),
        )
        return replace(
            self,
            shared=self.shared + other.shared,
            blocks=blocks,
            pairs=pairs,
            tiles=tiles,
            noise=self.noise + other.noise,
            rows=self.rows + other.rows,
            innovation=other.innovation if other.rows else self.innovation,
        )

    def __sub__(self, other: Sums) -> Sums:
        """The rows that came since `other`, which these hold as well."""
        blocks = other.blocks.copy()
        for name in ADDING:
            blocks[name] *= -1
        return self + replace(
            other, shared=-other.shared, blocks=blocks, tiles=-other.tiles, noise=-other.noise,
            rows=-other.rows, innovation=self.innovation,
        )  # fmt: skip

    def times(self, x: FloatArray) -> FloatArray:
        """The normal equations' matrix times x (n, k), in scaled units, without making it dense."""
        ns, cross = self.n_shared, self.crossed.reshape(len(self.blocks), TERMS, self.n_shared)
        top, rest = x[:ns], x[ns:].reshape(len(self.blocks), TERMS, x.shape[1])
        low, high = self.pairs.T
        product = self.blocks["gram"] @ rest + cross @ top
        np.add.at(product, low, self.tiles @ rest[high])
        np.add.at(product, high, self.tiles.swapaxes(1, 2) @ rest[low])
        first = self.shared[1:, 1:] @ top + np.einsum("bis,bik->sk", cross, rest)
        return np.concatenate([first, product.reshape(-1, x.shape[1])])

    def maps_alone(self) -> Sums:
        """What they say of the maps where every shared unknown is known."""
        return replace(self, shared=self.shared[:1, :1])

    @property
    def crossed(self) -> FloatArray:
        """Products of the maps' columns with those of the shared unknowns (6 m, n_shared)."""
        ns, m = self.n_shared, len(self.blocks)
        return np.asarray(self.blocks["shared"][:, :, 1 : 1 + ns].reshape(TERMS * m, ns))

    @property
    def right(self) -> FloatArray:
        """Their right-hand side (n,), in scaled units."""
        return np.concatenate([self.shared[1:, 0], self.blocks["shared"][:, :, 0].ravel()])

    def _places(self, cells: IntArray) -> IntArray:
        """Place of each cell among mine, those that I lack behind them in their order."""
        if not len(self.blocks):
            return np.arange(len(cells))
        order = np.argsort(self.cells)
        at = order[np.searchsorted(self.cells, cells, sorter=order).clip(0, len(order) - 1)]
        new = self.cells[at] != cells
        at[new] = len(self.blocks) + np.arange(new.sum())
        return np.asarray(at)

    def normal(self) -> Normal:
        """Dense normal equations, unknowns [shared | 6 terms of block 0 | 6 of block 1 | ...]."""
        n = self.n_shared + TERMS * len(self.blocks)
        gram, right = np.zeros((n, n)), np.zeros(n)
        assemble(self.shared, self.blocks, self.pairs, self.tiles, gram, right)
        return Normal(gram, right, float(self.shared[0, 0]), self.noise, self.rows)

    def with_normal(self, normal: Normal) -> Sums:
        """The same blocks with other normal equations, all pairs of blocks included."""
        ns, m = self.n_shared, len(self.blocks)
        shared, blocks = np.zeros_like(self.shared), self.blocks.copy()
        shared[0, 0], shared[1:, 1:] = normal.square, normal.gram[:ns, :ns]
        shared[1:, 0] = shared[0, 1:] = normal.right[:ns]
        tiles = normal.gram[ns:, ns:].reshape(m, TERMS, m, TERMS).swapaxes(1, 2)
        blocks["gram"] = tiles[np.arange(m), np.arange(m)]
        blocks["shared"][:, :, 0] = normal.right[ns:].reshape(m, TERMS)
        blocks["shared"][:, :, 1 : 1 + ns] = normal.gram[ns:, :ns].reshape(m, TERMS, ns)
        low, high = np.triu_indices(m, 1)
        linked = tiles[low, high].any(axis=(1, 2))
        low, high = low[linked], high[linked]
        return replace(
            self,
            shared=shared,
            blocks=blocks,
            pairs=np.stack([low, high], axis=1),
            tiles=tiles[low, high].copy(),
            noise=normal.noise,
            rows=normal.rows,
        )


def sums_of(learned: State | Sums) -> Sums:
    """The sums themselves, or those of a state."""
    return learned if isinstance(learned, Sums) else Sums.of(learned)


def normal_equations(learned: State | Sums) -> Normal:
    """Dense normal equations of everything seen so far; n = shared + 6 x visited blocks."""
    return sums_of(learned).normal()


def _merged(pairs: IntArray, tiles: FloatArray) -> tuple[IntArray, FloatArray]:
    """Pairs in the order low < high, each once, with the sums of their tiles."""
    turned = pairs[:, 0] > pairs[:, 1]
    pairs = np.where(turned[:, None], pairs[:, ::-1], pairs)
    tiles = np.where(turned[:, None, None], tiles.swapaxes(1, 2), tiles)
    keys, at = np.unique((pairs[:, 0] << 32) | pairs[:, 1], return_inverse=True)
    total = np.zeros((len(keys), TERMS, TERMS))
    np.add.at(total, at.reshape(-1), tiles)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1), total
