"""The nominal machine of a design: declared geometry, nominal or learned maps, load, controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtid.errors import RtidError
from rtid.estimator.orifice import root
from rtid.estimator.published import cell_terms
from rtid.estimator.state import Weights, build, nominal_weights, variance
from rtid.estimator.windows import OVERLAP
from rtid.excite.driving import STEP_S, SUPPLY, X_REF, Control, Piston, Places, drive
from rtid.kernels.engine import GAP_FLAG, ROW_FLAG
from rtid.model import VELOCITY, Edge, Machine
from rtid.plain import FloatArray

REST_SHARE = 0.3  # of the supply: pressure of the second chamber at rest
SETTLE_S = 1.0  # held before a motion, so that it begins at rest


class MachineError(RtidError):
    """The project describes no machine that a motion can be designed for."""


@dataclass(frozen=True)
class DrivenMachine:
    """theta (cells, 6) m3/s in Taylor terms; compliance (chambers,) 1/Pa; tank_pa constant.

    slopes (cells,): dQ/ddp in m3/s/Pa, by which rows are weighed.
    """

    model: Machine
    theta: FloatArray
    compliance: FloatArray
    piston: Piston
    control: Control
    stroke_m: float
    supply_pa: float
    tank_pa: float = 1e5

    @property
    def weights(self) -> Weights:
        """Weights of the rows from the nominal map: what `refined` will find."""
        flow = np.abs(self.theta[:, 0])
        span = np.concatenate([_span(edge) for edge in self.model.edges])
        slopes = np.where(flow > 0, flow / span, nominal_weights(self.model).slopes)
        return Weights(slopes, self.compliance, self.model.lag.nominal_s)

    @cached_property
    def places(self) -> Places:
        """Columns of the signals by role.  Raises MachineError where one is not there."""
        model = self.model
        chambers = [chamber.pressure for chamber in model.chambers]
        if not all(chambers):
            raise MachineError("a chamber has no pressure", "excite needs hydraulic chambers")
        if any(chamber.is_constant for chamber in model.chambers):
            raise MachineError("a motor that goes round for ever has no stroke", "excite needs one")
        commands = {edge.command for edge in model.edges}
        if len(commands) != 1:
            names = ", ".join(sorted(commands))
            raise MachineError(f"one signed command is needed, there are {names}")
        sources = {edge.source for edge in model.edges} - set(chambers)
        sinks = {edge.sink for edge in model.edges} - set(chambers)
        if len(sources) != 1 or len(sinks) != 1:
            raise MachineError("one supply and one tank are needed", "adapt [edges]")
        column = model.column
        pressures = [column(name) for name in chambers]
        return Places(
            column(commands.pop()),
            column(sources.pop()),
            column(sinks.pop()),
            column(model.position),
            (pressures[0], pressures[-1]),
        )

    def run(self, reference: FloatArray) -> FloatArray:
        """Noise-free samples (n, 2 + signals), SI, under a reference (n, 5), from rest.

        Raises MachineError where the command leaves the grids, or a pressure runs away.
        """
        lead = np.repeat(reference[:1], round(SETTLE_S / STEP_S), axis=0)
        whole = np.concatenate([lead, reference])
        n, state = len(whole), build(self.model.with_taylor_maps, self.weights)
        columns = len(self.model.signals)
        signals, sample = np.empty((n, columns)), np.zeros(2 + columns)
        sample[2 + self.places.tank] = self.tank_pa
        done = drive(
            state.engine, self.theta, self.compliance, OVERLAP, self.piston, self.control,
            self.places, whole, self._start(whole[0]), sample, signals,
        )  # fmt: skip
        if done < n:
            at_s = done * STEP_S - SETTLE_S
            raise MachineError(
                f"the nominal machine leaves its maps at {at_s:.2f} s",
                "wider grids, or less command",
            )
        return self._chunk(signals[len(lead) :])

    def measured(self, chunk: FloatArray, seed: int = 0) -> FloatArray:
        """Samples (n, 2 + signals), SI, with the declared sensor noise; commands are exact."""
        rng, noisy = np.random.default_rng([seed, 17]), chunk.copy()
        for j, signal in enumerate(self.model.signals):
            sd = np.sqrt(variance(self.model, signal.name))
            if sd > 0 and j != self.places.u:
                noisy[:, 2 + j] += sd * rng.standard_normal(len(chunk))
        return noisy

    def _start(self, row: FloatArray) -> FloatArray:
        """At rest with the load held: [P.., x, v]."""
        x, chambers, piston = row[X_REF], self.model.chambers, self.piston
        load = piston.load_n + piston.load_slope_npm * (x - piston.x_mid_m)
        if len(chambers) == 1:
            return np.array([load / (chambers[0].sign * chambers[0].area_m2), x, 0.0])
        a, b = (c.sign * c.area_m2 for c in chambers)
        p_b = REST_SHARE * row[SUPPLY]
        return np.array([(load - b * p_b) / a, p_b, x, 0.0])

    def _chunk(self, signals: FloatArray) -> FloatArray:
        """The kernel's view of samples; the first one begins a record."""
        chunk = np.empty((len(signals), 2 + signals.shape[1]))
        chunk[:, 0] = STEP_S * np.arange(len(signals))
        chunk[:, 1] = ROW_FLAG
        chunk[0, 1] = ROW_FLAG | GAP_FLAG
        chunk[:, 2:] = signals
        for j, signal in enumerate(self.model.signals):
            if signal.kind == VELOCITY:
                chunk[:, 2 + j] = np.gradient(signals[:, self.places.x], STEP_S)
        return chunk

    def signal(self, chunk: FloatArray, place: int) -> FloatArray:
        """One signal (n,) of samples (n, 2 + signals), SI."""
        return np.asarray(chunk[:, 2 + place])

    def pressures(self, chunk: FloatArray) -> FloatArray:
        """Chamber pressures (n, chambers), Pa, of samples (n, 2 + signals)."""
        columns = [2 + c for c in self.places.pressures[: len(self.model.chambers)]]
        return np.asarray(chunk[:, columns])


def rated_map(model: Machine) -> FloatArray:
    """Terms (cells, 6), m3/s, of Q = K(w) sqrt(dp), K linear to the rated flow at the grid's end.

    What is known where there is neither a data sheet nor anything learned.
    """
    parts = []
    for edge in model.edges:
        foot = edge.safe_band_v if np.isfinite(edge.safe_band_v) else edge.grid.u_v[0]

        def flow(
            w: FloatArray, dp: FloatArray, edge: Edge = edge, foot: float = foot
        ) -> FloatArray:
            rise = np.clip((w - foot) / (edge.grid.u_v[-1] - foot), 0.0, 1.0)
            return np.asarray(rise * edge.rated_q_m3s * root(dp) / root(np.array(edge.rated_dp_pa)))

        parts.append(cell_terms(edge.grid, flow))
    return np.concatenate(parts)


def _span(edge: Edge) -> FloatArray:
    """2 |dp| at each cell's centre, at least the cell's own height: (cells,)."""
    dp = edge.grid.dp_pa
    return np.tile(np.maximum(np.abs(dp[1:] + dp[:-1]), np.diff(dp)), edge.grid.shape[0])
