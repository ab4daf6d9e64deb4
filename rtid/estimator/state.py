"""The estimator's memory: five structured arrays built from a model, that copy, save and grow."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ascontiguousarray  # as `advance`, by its own name: looked up at each sample
from numpy.typing import NDArray

from rtid.estimator.limits import most_open, refuse_unfit
from rtid.kernels import housekeeping, layout
from rtid.kernels.engine import ROW_FLAG, advance
from rtid.kernels.recent import move_pairs
from rtid.model import (
    BASES,
    BOTH,
    COMMAND_ONLY,
    DROP_ONLY,
    PROPORTIONAL,
    SHAPES,
    Edge,
    Machine,
)
from rtid.plain import FloatArray, IntArray

RecordArray = NDArray[np.void]

# A closed block is silent when its state has decayed to this share.  The rows of the carry form are
# worse conditioned, and fade so fast that digits cost nothing.
RING_FLOOR = {layout.INTEGRAL: 1e-11, layout.CARRY: 1e-13, layout.RESTART: 1e-13}
FORMS = {"integral": layout.INTEGRAL, "carry": layout.CARRY, "restart": layout.RESTART}
# Where no pressure noise bounds it, the whitener forgets within this time.
MEMORY_S = 2.0
SETTLES = 4.0  # lags, with half their tolerance: 2 % are left of where a spool stood
FLOW_NOISE_FLOOR = 0.01  # least flow noise, share of the variance that the rated slope gives
FIRST_BLOCKS, FIRST_PAIRS = 64, 1024
MAX_CLOSED = layout.MAX_RECENT
MANY = 100  # samples of a run from which on one without a measured position is odd


@dataclass
class State:
    """engine (1,), cells (all grid cells), closed, blocks (visited), pairs (power of two)."""

    engine: RecordArray
    cells: RecordArray
    closed: RecordArray
    blocks: RecordArray
    pairs: RecordArray
    memory: NDArray[np.uint8] = field(init=False)

    def __post_init__(self) -> None:
        """Copy the arrays into one block of memory, for the kernel `advance`; keep views."""
        self._move([len(array) for array in self.arrays])

    def _move(self, lengths: list[int]) -> None:
        """Into new memory with tables of so many records, each as long as it is or longer."""
        old = self.arrays
        sizes = [n * array.itemsize for n, array in zip(lengths, old, strict=True)]
        ends = np.cumsum(sizes).tolist()
        self.memory = np.zeros(ends[-1], np.uint8)
        parts = zip(old, [0, *ends], ends, strict=False)
        views = [self.memory[start:end].view(array.dtype) for array, start, end in parts]
        self.engine, self.cells, self.closed, self.blocks, self.pairs = views
        for mine, array in zip(views, old, strict=True):
            if mine is self.pairs and len(mine) > len(array):
                move_pairs(self.engine, array, mine)
            else:
                mine[: len(array)] = array
        for name, table in zip(
            ("n_cells", "max_closed", "max_blocks", "max_pairs"), views[1:], strict=True
        ):
            self.engine[0][name] = len(table)

    def __reduce__(self) -> tuple[type[State], tuple[RecordArray, ...]]:
        """Pickle and deepcopy the arrays alone: views would part from the memory."""
        return State, self.arrays

    def advance(self, chunk: FloatArray) -> None:
        """Take samples (n, 2 + signals), rows [t_s, flags, values...]; tables grow as needed."""
        chunk = ascontiguousarray(chunk)  # or each layout in memory compiles the kernel anew
        rest = advance(self.memory, chunk)
        while rest:
            self.make_room()
            chunk = chunk[-rest:]
            rest = advance(self.memory, chunk)

    @property
    def arrays(self) -> tuple[RecordArray, RecordArray, RecordArray, RecordArray, RecordArray]:
        """The records in the order in which the kernels take them."""
        return self.engine, self.cells, self.closed, self.blocks, self.pairs

    @property
    def counters(self) -> dict[str, int]:
        """Samples, rows, and how often a sample was refused or a memory restarted, by reason."""
        return dict(zip(layout.COUNTERS, self.engine[0]["counters"].tolist(), strict=True))

    def make_room(self) -> None:
        """Double the table that is full, of blocks or of pairs; nothing else changes."""
        lengths = [len(array) for array in self.arrays]
        is_blocks = self.engine[0]["n_slots"] + layout.MAX_OPEN > len(self.blocks)
        lengths[3 if is_blocks else 4] *= 2
        self._move(lengths)

    def settle(self) -> None:
        """Bring all sums up to date, in place."""
        while not housekeeping.settle(self.engine, self.closed, self.blocks, self.pairs):
            self.make_room()

    def settled(self) -> State:
        """A copy in which all sums are complete; this state is not changed."""
        copy = self.copy()
        copy.settle()
        return copy

    def hold(
        self,
        cells: IntArray,
        theta: FloatArray,
        cov: FloatArray,
        compliance: FloatArray,
        terms: FloatArray,
    ) -> None:
        """Judge rows from now on by this map, in the state's units and bases.

        cells (m,): grid cells that are known, theta (m, 6), cov (m, 6, 6); compliance (chambers,)
        in units of the weights', terms (terms,) of their scales.
        """
        e = self.engine[0]
        self.cells["known"] = 0
        self.cells["known"][cells], self.cells["held"][cells] = 1, theta
        self.blocks["held_cov"][self.cells["slot"][cells]] = cov
        e["held_compliance"][: len(compliance)] = compliance
        e["held_terms"][: len(terms)] = terms

    def clear_sums(self) -> None:
        """Empty the sums of a settled state; it goes on with its memory of recent columns."""
        housekeeping.clear_sums(self.engine, self.blocks, self.pairs)

    def copy(self) -> State:
        """An independent copy that continues bit for bit like this one."""
        return State(*self.arrays)


@dataclass(frozen=True)
class Weights:
    """What weighs the rows, frozen per revision so that recursive = batch has a meaning.

    slopes (cells,): dQ/ddp in m3/s/Pa per grid cell, in the order of the edges; compliance
    (chambers,): 1 / beta in 1/Pa; lag_s: first-order lag of the spools; missed (cells,): variance
    rate of the flow that a block's terms miss, m6/s, none when not given.
    """

    slopes: FloatArray
    compliance: FloatArray
    lag_s: float
    missed: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Give every cell its value."""
        if not len(self.missed):
            object.__setattr__(self, "missed", np.zeros(len(self.slopes)))


def nominal_weights(model: Machine) -> Weights:
    """Weights from the declared values alone: what a start without data has."""
    compliance = np.full(len(model.chambers), 1.0 / model.beta_nominal_pa)
    slopes = np.concatenate([np.zeros(0), *(_edge_slopes(edge) for edge in model.maps)])
    return Weights(slopes, compliance, model.lag.nominal_s)


def tell_unmarked(flags: NDArray[Any]) -> None:
    """Warn where none of many samples' flags (n,) has ROW, a share of none: they teach nothing."""
    if len(flags) < MANY or (flags.astype(np.uint8) & ROW_FLAG).any():
        return
    text = f"none of {len(flags)} samples has the flag ROW (firmware_bridge.samples)"
    warnings.warn(
        f"{text}: nothing is learned; set it where the position was measured", stacklevel=3
    )


def build(model: Machine, weights: Weights | None = None) -> State:
    """Empty state for a model; nominal weights when none are given.

    Raises ValueError for a model that the kernels cannot hold.
    """
    refuse_unfit(model)
    weights = weights or nominal_weights(model)
    cells = np.zeros(len(weights.slopes), layout.CELL)
    cells["slope"], cells["missed"] = weights.slopes, weights.missed
    engine = np.zeros(1, layout.ENGINE)
    _configure(engine[0], model)
    engine[0]["compliance"][: len(model.chambers)] = weights.compliance
    engine[0]["lag_s"] = weights.lag_s
    housekeeping.clear(engine, cells)
    _know_terms(engine[0], model)
    return State(
        engine,
        cells,
        np.zeros(min(MAX_CLOSED, model.recent_blocks), layout.CLOSED),
        np.zeros(FIRST_BLOCKS, layout.BLOCK),
        np.zeros(FIRST_PAIRS, layout.PAIR),
    )


def _edge_slopes(edge: Edge) -> FloatArray:
    """dQ/ddp at each cell's centre for Q = K(w) sqrt(dp), K rising linearly to its rated value."""
    u, dp = edge.grid.u_v, edge.grid.dp_pa
    w, pressure = 0.5 * (u[1:] + u[:-1]), np.abs(0.5 * (dp[1:] + dp[:-1]))
    foot = edge.safe_band_v if np.isfinite(edge.safe_band_v) else u[0]
    gain = (
        edge.rated_q_m3s / np.sqrt(edge.rated_dp_pa) * np.clip((w - foot) / (u[-1] - foot), 0.02, 1)
    )
    floor = 0.5 * np.diff(dp)
    return np.outer(gain, 0.5 / np.sqrt(np.maximum(pressure, floor))).ravel()


def _configure(e: np.void, model: Machine) -> None:
    e["form"] = FORMS[model.form]
    n_chambers = len(model.chambers)
    e["n_chambers"], e["n_edges"] = n_chambers, len(model.edges)
    e["n_shared"], e["n_signals"] = n_chambers + len(model.terms), len(model.signals)
    _configure_terms(e, model)
    e["n_state"] = n_chambers * (1 if model.form == "integral" else 2)
    for j, signal in enumerate(model.signals):
        e["minimum"][j], e["maximum"][j] = signal.minimum, signal.maximum
    e["x_column"] = model.column(model.position)
    e["x_var_m2"] = variance(model, model.position)
    for c, chamber in enumerate(model.chambers):
        e["p_column"][c] = _column(model, chamber.pressure)
        e["p_var_pa2"][c] = variance(model, chamber.pressure) * model.pressure_share
        e["area_m2"][c], e["v0_m3"][c] = chamber.sign * chamber.area_m2, chamber.v0_m3
        e["growth_m2"][c] = chamber.growth_m2
    for i, (edge, first) in enumerate(zip(model.edges, model.first_cells, strict=True)):
        _configure_edge(e, model, i, edge, first)
    for i, owner in enumerate(model.owners):
        e["owner"][i] = owner
        e["is_shared"][i] = model.owners.count(owner) > 1
    e["q_floor"][:n_chambers] = flow_noise_floor(model)
    e["mode_column"], e["max_open"] = _column(model, model.mode), most_open(model)
    e["hysteresis"], e["max_gap_s"] = model.gates.hysteresis, model.gates.max_gap_s
    e["recovery_s"] = model.gates.recovery_s
    e["settle_s"] = SETTLES * (model.lag.nominal_s + 0.5 * model.lag.tolerance_s)
    e["ring_floor"] = RING_FLOOR[int(e["form"])]
    e["wn_rad_s"], e["zeta"] = model.filter.wn_rad_s, model.filter.zeta
    e["row_period_s"] = 1.0 / model.filter.rows_per_s
    e["p_period_s"] = model.pressure_period_s


def _configure_edge(e: np.void, model: Machine, i: int, edge: Edge, first_cell: int) -> None:
    e["source"][i], e["sink"][i] = _column(model, edge.source), _column(model, edge.sink)
    e["command"][i], e["direction"][i] = model.column(edge.command), edge.direction
    e["is_sampled"][i] = not model.signals[model.column(edge.command)].is_held
    e["modes"][i] = sum(1 << m for m in edge.modes) if edge.modes else -1
    e["map_basis"][i] = BASES.index(edge.basis)
    e["mask"][i] = fitted_terms(edge)
    e["masked"][i] = not e["mask"][i].all()
    e["safe_v"][i], e["scale_m3s"][i] = edge.safe_band_v, edge.rated_q_m3s
    e["dp_var_pa2"][i] = variance(model, edge.source) + variance(model, edge.sink)
    nu, nd = edge.grid.shape
    e["n_u"][i], e["n_dp"][i], e["first_cell"][i] = nu, nd, first_cell
    e["u_border"][i, : nu + 1], e["dp_border"][i, : nd + 1] = edge.grid.u_v, edge.grid.dp_pa
    for c, chamber in enumerate(model.chambers):
        e["sign"][i, c] = edge.sign(chamber)


def flow_noise_floor(model: Machine) -> FloatArray:
    """Least intensity of the flow noise (chambers,), m6/s.

    A share of what the rated slope of the noisiest edge gives, and what is declared as disturbance;
    where neither is there, what lets the whitener forget within MEMORY_S.
    """
    least, period = np.zeros(len(model.chambers)), model.pressure_period_s or 1e-3
    for c, chamber in enumerate(model.chambers):
        for edge in model.edges:
            if edge.sign(chamber) != 0:
                slope = 0.5 * edge.rated_q_m3s / edge.rated_dp_pa
                noise = variance(model, edge.source) + variance(model, edge.sink)
                least[c] = max(least[c], FLOW_NOISE_FLOOR * slope**2 * noise * period)
        least[c] += chamber.disturbance**2
        if least[c] == 0.0:
            row_noise = chamber.area_m2**2 * variance(model, model.position)
            least[c] = row_noise * period / MEMORY_S**2
    return least


def _configure_terms(e: np.void, model: Machine) -> None:
    e["n_terms"] = len(model.terms)
    names = [chamber.name for chamber in model.chambers]
    for k, term in enumerate(model.terms):
        e["term_shape"][k], e["term_scale"][k] = SHAPES.index(term.shape), term.scale
        e["term_volume"][k] = layout.FLOW
        if term.rate:
            e["term_volume"][k] = names.index(term.volume) if term.volume else layout.RATE
        e["term_constant"][k] = term.constant
        for name, weight in term.weights:
            e["term_weight"][k, model.column(name)] = weight
        for name, sign in term.signs:
            e["term_sign"][k, names.index(name)] = sign


def _know_terms(e: np.void, model: Machine) -> None:
    """What is known of the terms beforehand: a row (theta - 1) / sd for each."""
    shared, first = e["shared"], 1 + len(model.chambers)
    for k, term in enumerate(model.terms, first):
        shared[np.ix_((0, k), (0, k))] += term.sd**-2


def _column(model: Machine, name: str) -> int:
    return model.column(name) if name else layout.NOTHING


def variance(model: Machine, name: str) -> float:
    """Declared sensor noise and quantisation of a signal, SI squared; 0 for NONE."""
    if not name:
        return 0.0
    signal = model.signals[model.column(name)]
    return signal.noise**2 + signal.resolution**2 / 12.0


# Which of the terms [1, xi, eta, xi^2, eta^2, xi eta] a map has.
MASKS = {
    BOTH: np.ones(layout.TERMS),
    COMMAND_ONLY: np.array([1.0, 1.0, 0.0, 1.0, 0.0, 0.0]),
    DROP_ONLY: np.array([1.0, 0.0, 1.0, 0.0, 1.0, 0.0]),
}


def fitted_terms(edge: Edge) -> FloatArray:
    """1 for each of six terms (6,) that a map has in its own basis, else 0; dimensionless."""
    along_u = np.array([1.0, 0.0, 1.0, 0.0, 1.0, 0.0]) if edge.basis == PROPORTIONAL else 1.0
    return np.asarray(MASKS[edge.terms] * along_u)
