"""The sections of a project file as pydantic models, values in SI.

A key that holds a quantity ends in its unit, and any unit of the right dimension will do: the field
`area_m2` is written `area_cm2 = 19.63` or `area_mm2 = 1963`.  `rtid.project.sections` converts.
`None` stands for "estimate" where a field allows it, else for "not given".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from rtid.model import MOST_MODE

MAX_BORDERS = 10_000


@dataclass(frozen=True)
class Dimension:
    """Marks a field as a quantity of this dimension."""

    name: str


def _estimate(value: Any) -> Any:
    if isinstance(value, str) and value != "estimate":
        raise PydanticCustomError("estimate", 'must be a number or "estimate"')
    return None if value == "estimate" else value


def _piece(value: Any, index: int) -> list[float]:
    """One entry of a grid: a border, or {start, stop, step} with both ends included."""
    if _is_number(value):
        return [float(value)]
    if not isinstance(value, dict) or set(value) != {"start", "stop", "step"}:
        raise _grid_error(index, "must be a number or {start, stop, step}")
    if not all(_is_number(value[key]) for key in ("start", "stop", "step")):
        raise _grid_error(index, "start, stop and step must be numbers")
    start, stop, step = (float(value[key]) for key in ("start", "stop", "step"))
    count = (stop - start) / step if step > 0 else 0.0
    if not 0.5 < count < MAX_BORDERS:
        raise _grid_error(index, "needs step > 0, stop > start and a sane number of steps")
    n = round(count)
    if abs(count - n) > 1e-6 * n:
        raise _grid_error(index, "stop is not a whole number of steps away from start")
    return [start + (stop - start) * k / n for k in range(n + 1)]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _grid_error(index: int, problem: str) -> PydanticCustomError:
    return PydanticCustomError("grid", "{problem}", {"problem": problem, "index": index})


def _borders(value: Any) -> Any:
    """Borders from a list of numbers and pieces; the shared end of two pieces counts once."""
    if not isinstance(value, list):
        raise PydanticCustomError("grid", "must be a list of borders")
    borders: list[float] = []
    for index, entry in enumerate(value):
        piece = _piece(entry, index)
        if borders and isinstance(entry, dict) and math.isclose(piece[0], borders[-1]):
            piece = piece[1:]
        if borders and piece[0] <= borders[-1]:
            raise _grid_error(index, "is out of order: borders must increase")
        borders += piece
    if len(borders) < 2:
        raise PydanticCustomError("grid", "needs at least two borders")
    return tuple(borders)


def _pair(value: Any) -> Any:
    if not isinstance(value, list) or len(value) != 2:
        raise PydanticCustomError("pair", "must be a list of two numbers, [low, high]")
    return tuple(value)


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] >= value[1]:
        raise PydanticCustomError("order", "is reversed or empty: low must be below high")
    return value


def _increasing(value: tuple[float, ...]) -> tuple[float, ...]:
    for index, (left, right) in enumerate(pairwise(value)):
        if right <= left:
            raise _grid_error(index + 1, "is out of order: values must increase")
    return value


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


Estimable = Annotated[float | None, BeforeValidator(_estimate)]
Interval = Annotated[tuple[float, float], BeforeValidator(_pair), AfterValidator(_ordered)]
Borders = Annotated[tuple[float, ...], BeforeValidator(_borders)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_tuple), Field(min_length=2)]
Bank = Annotated[tuple[float, ...], BeforeValidator(_tuple), Field(min_length=1)]
Sign = Literal[1, -1]

LENGTH, AREA, VOLUME = Dimension("length"), Dimension("area"), Dimension("volume")
PRESSURE, TIME, FLOW = Dimension("pressure"), Dimension("time"), Dimension("flow")
COMMAND, FREQUENCY = Dimension("command"), Dimension("frequency")
VELOCITY = Dimension("velocity")


class Section(BaseModel):
    """Strict and frozen; the description of a required field is the remedy when it is missing."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ProjectSection(Section):
    """[project]: what the machine is called, and a file of Python code with effects of its own."""

    name: str = Field(min_length=1, description='name = "boom cylinder"')
    effects_module: str | None = None  # a Python file with effects; run only if trusted


class SourceSection(Section):
    """[source]: where frames or tables come from.  `builtin:controller.dbc` is rtid's own DBC.

    average: windows over which all samples are averaged, 0 for as they come.
    """

    dbc: str | None = None
    time_column: str | None = None
    time_unit: str = "s"
    interface: str | None = None
    channel: str | None = None
    bitrate: int | None = Field(default=None, gt=0)
    fd: bool = False
    mode: Literal["cycle", "multirate"] | None = None
    average_s: Annotated[float, TIME] = Field(default=0.0, ge=0)


class MessageSection(Section):
    """[messages.NAME]: period and age of a CAN message, its end-to-end protection.

    `of`: which message of the DBC it is, where one comes from two senders or on two channels.
    """

    of: str | None = None
    period_s: Annotated[float | None, TIME] = Field(default=None, gt=0)
    offset_s: Annotated[Estimable, TIME] = 0.0
    tolerance_s: Annotated[float | None, TIME] = Field(default=None, gt=0)
    counter: str | None = None
    crc: str | None = None
    data_id: int = Field(default=0, ge=0, le=0xFFFF)
    channel: int | None = Field(default=None, ge=0)
    address: Annotated[int, Field(ge=0, le=0xFD)] | Literal["found", "any"] | None = None


class AngleTable(Section):
    """[signals.x.table]: joint angle, in the signal's unit, to cylinder position."""

    angle: Annotated[Numbers, AfterValidator(_increasing)] = Field(description="angle = [...]")
    position_m: Annotated[Numbers, LENGTH] = Field(description="position_mm = [...]")


class SignalSection(Section):
    """[signals.ROLE]: one column of the samples.  Numbers are in `unit`.

    noise_seen: what a record told of `noise = "estimate"`; on board, without a record, it is taken.
    late_rows: by how many rows a table writes it late.
    """

    message: str | None = None
    signal: str | None = None
    column: str | None = None
    unit: str | None = None
    kind: Literal["command", "pressure", "position", "velocity", "mode", "other"] | None = None
    hold: Literal["zero", "linear"] | None = None
    scale: float | None = None
    offset: Estimable = 0.0
    noise: Estimable = Field(default=None, ge=0)
    noise_seen: float | None = Field(default=None, ge=0)
    resolution: float | None = Field(default=None, ge=0)
    range: Interval | None = None
    constant: float | None = None
    table: AngleTable | None = None
    numbers: dict[str, Annotated[int, Field(ge=0, le=MOST_MODE)]] | None = None
    late_rows: int = Field(default=0, ge=0, description="late_rows = 1")


class GeometrySection(Section):
    """[geometry]: stroke, and which signal is the position (the only one, unless named).

    A motor that goes round for ever has no stroke: its chambers have a displacement.
    """

    stroke_m: Annotated[float | None, LENGTH] = Field(default=None, gt=0)
    position: str | None = None


class ChamberSection(Section):
    """[chambers.NAME]: area and dead volume, the volume left where the chamber is smallest.

    displacement: of a motor that goes round for ever, per turn; the dead volume is all of its side.
    """

    pressure: str = Field(description='pressure = "p_a", a pressure of [signals]')
    sign: Sign = Field(description="sign = 1 if the volume grows with x, -1 if it shrinks")
    area_m2: Annotated[float | None, AREA] = Field(default=None, gt=0)
    piston_diameter_m: Annotated[float | None, LENGTH] = Field(default=None, gt=0)
    rod_diameter_m: Annotated[float, LENGTH] = Field(default=0.0, ge=0)
    displacement_m3: Annotated[float | None, VOLUME] = Field(default=None, gt=0)
    dead_volume_m3: Annotated[float, VOLUME] = Field(gt=0, description="dead_volume_l = 0.6")

    def net_area_m2(self) -> float:
        """The area, given or from the diameters; not positive if the diameters are wrong.

        Of a motor its displacement, m3/rad.
        """
        if self.displacement_m3 is not None:
            return self.displacement_m3 / (2.0 * math.pi)
        if self.area_m2 is not None:
            return self.area_m2
        piston_m = self.piston_diameter_m or 0.0
        return math.pi / 4 * (piston_m**2 - self.rod_diameter_m**2)


class RateSection(Section):
    """[rate]: a plant without pressures, d state / dt = sum of its [maps]: a signal of any kind.

    measured: that sum is measured itself, as an acceleration or a force is.  disturbance: what
    moves it beside, white, in the unit of the sum per sqrt(Hz); it is found in the record unless
    given.  ports: of a cylinder or a motor that a pump drives, the pressure behind each port and
    the sign of the command that puts it under pressure.
    """

    state: str | None = None
    measured: str | None = None
    disturbance: Estimable = Field(default=None, ge=0)
    ports: dict[str, Sign] = Field(default_factory=dict)

    @property
    def signal(self) -> str:
        """The signal that the equation is about."""
        return self.state or self.measured or ""


class MapSection(Section):
    """[maps.NAME]: a part f(command) of the rate, or f(command, over) of a second signal.

    commands: several that share the map, each of which adds its own f.  grid: borders of a command
    that is none, a velocity for instance, in its own unit.  over_grid is in the unit of that
    signal, rated, its usual size, in that of the state per second, or of what is measured.
    """

    command: str | None = None
    commands: Annotated[tuple[str, ...], BeforeValidator(_tuple)] = ()
    u_grid_v: Annotated[Borders | None, COMMAND] = None
    grid: Borders | None = None
    over: str | None = None
    over_grid: Borders | None = None
    rated: float = Field(gt=0, description="rated = 50, the usual size, state's unit per second")
    basis: Literal["taylor", "lapped", "blended", "proportional"] = "taylor"

    @property
    def all_commands(self) -> tuple[str, ...]:
        """The commands of the map."""
        return self.commands or (self.command or "",)


class EdgeDefaults(Section):
    """[edge_defaults]: what several metering edges have in common."""

    command: str | None = None
    u_grid_v: Annotated[Borders | None, COMMAND] = None
    dp_grid_pa: Annotated[Borders | None, PRESSURE] = None
    safe_band_v: Annotated[float | None, COMMAND] = None
    rated_flow_m3s: Annotated[float | None, FLOW] = Field(default=None, gt=0)
    rated_dp_pa: Annotated[float | None, PRESSURE] = Field(default=None, gt=0)
    basis: Literal["taylor", "lapped", "blended"] | None = None
    terms: Literal["both", "command", "drop"] | None = None


class EdgeSection(EdgeDefaults):
    """[edges.NAME]: a metering edge from the pressure `source` to the pressure `sink`."""

    source: str = Field(description='source = "p_supply", a pressure of [signals]')
    sink: str = Field(description='sink = "p_a", a pressure of [signals]')
    direction: Sign = Field(description="direction = 1 if it opens with u > 0, -1 with u < 0")
    reference_map: str | None = None


class PriorSection(Section):
    """[prior]: a map known before, relative to this file; see `rtid.maps.prior_map`."""

    map: str = Field(description='map = "older.npz", or a data sheet, or a folder of `rtid fleet`')
    error_percent: float | None = Field(default=None, gt=0, le=100)


class BetaSection(Section):
    """[beta]: effective bulk modulus, first guess and what is physically possible."""

    nominal_pa: Annotated[float, PRESSURE] = Field(default=800e6, gt=0)
    bounds_pa: Annotated[Interval, PRESSURE] = (100e6, 2000e6)


class FilterSection(Section):
    """[filter]: H_f of eq. (10)."""

    natural_frequency_hz: Annotated[float, FREQUENCY] = Field(default=10.0, gt=0)
    damping: float = Field(default=0.8, gt=0)
    rows_per_s: float = Field(default=50.0, gt=0)


class GatesSection(Section):
    """[gates]: when a row or a block is refused."""

    condition_limit: float = Field(default=1e8, gt=1)
    max_gap_s: Annotated[float | None, TIME] = Field(default=None, gt=0)
    hysteresis: float = Field(default=0.05, ge=0, lt=0.5)
    min_rows: int = Field(default=20, ge=6)
    max_sd_share: float = Field(default=0.001, gt=0, le=1)
    max_surprise: float = Field(default=3.0, gt=1)
    recovery_s: Annotated[float, TIME] = Field(default=0.0, ge=0)
    stale_s: Annotated[float | None, TIME] = Field(default=None, gt=0)


class UpkeepSection(Section):
    """[upkeep]: what happens beside the update at fixed sample times; off unless every_s > 0."""

    every_s: Annotated[float, TIME] = Field(default=0.0, ge=0)
    forget_s: Annotated[float | None, TIME] = Field(default=None, gt=0)
    shared_forget_s: Annotated[float | None, TIME] = Field(default=None, gt=0)
    innovation_sd: float = Field(default=0.0, ge=0)
    innovation_rows: int = Field(default=100, ge=2)
    folds: int = Field(default=1, ge=1, le=20)
    history_s: Annotated[float, TIME] = Field(default=120.0, ge=0)


class LagSection(Section):
    """[dynamics.spool_lag]: first-order lag behind the command, with its tolerance.

    seen: what a record told of it; on board, without a record, it is taken.
    """

    nominal_s: Annotated[float, TIME] = Field(default=0.0, ge=0)
    tolerance_s: Annotated[float, TIME] = Field(default=0.0, ge=0)
    seen_s: Annotated[float | None, TIME] = Field(default=None, ge=0)


class DynamicsSection(Section):
    """[dynamics]: declared dynamics."""

    spool_lag: LagSection = LagSection()


class EstimatorSection(Section):
    """[estimator]: which exact form of the regression."""

    form: Literal["integral", "carry", "restart"] = "integral"
    recent_blocks: int = Field(default=64, ge=2, le=64)


class EffectSection(Section):
    """[effects.NAME]: a flow that somebody suspects, as a formula per unit of its coefficient.

    Every other key of the table with a list of numbers is a shape parameter with its bank.
    """

    flow: str = Field(description='flow = "p_a - p_b", m3/s per unit of the coefficient')
    unit: str = Field(description='unit = "m3/s/Pa", of the coefficient')
    chambers: dict[str, Sign] = Field(min_length=1, description="chambers = {a = -1, b = 1}")
    sign: Literal[1, 0, -1] = 1
    largest: float | None = Field(default=None, gt=0)
    title: str = ""
    shapes: dict[str, Bank] = Field(default_factory=dict)


class RecordSection(Section):
    """[record]: parts of a trace, seconds from its first sample; None = not set apart.

    records: others that one fit is made of, relative to this file; held_out: names of those, or
    patterns, that judge as a whole.
    """

    identification_s: Annotated[Interval | None, TIME] = None
    validation_s: Annotated[Interval | None, TIME] = None
    records: Annotated[tuple[str, ...], BeforeValidator(_tuple)] = ()
    held_out: Annotated[tuple[str, ...], BeforeValidator(_tuple)] = ()


class ExciteSection(Section):
    """[excite]: what a designed motion may do, the load and the position controller.

    stops: the mechanical ones, if the piston may be held against them; supply: range of its
    setpoint, None where it cannot be changed; offset: steps that may be added to the controller's
    command, 0 for none; load: force against growing x in mid-stroke; see: effects that are to
    become visible.
    The controller's u = deadband tanh(demand / blend) + volts_per_mps demand,
    demand = v_ref + kp (x_ref - x), with steps in the command's unit.
    """

    duration_s: Annotated[float, TIME] = Field(default=80.0, gt=0)
    stroke_m: Annotated[Interval, LENGTH] = Field(description="stroke_mm = [75, 425]")
    stops_m: Annotated[Interval | None, LENGTH] = None
    speed_mps: Annotated[float, VELOCITY] = Field(gt=0, description="speed_mps = 0.3")
    command_v: Annotated[float, COMMAND] = Field(gt=0, description="command_v = 9")
    command_rate_per_s: float = Field(default=50.0, gt=0)
    offset_v: Annotated[float, COMMAND] = Field(default=0.0, ge=0)
    pressure_pa: Annotated[Interval, PRESSURE] = Field(description="pressure_mpa = [0.1, 10]")
    supply_pa: Annotated[Interval | None, PRESSURE] = None
    usual_supply_pa: Annotated[float, PRESSURE] = Field(gt=0, description="usual_supply_mpa = 7")
    supply_pa_per_s: float = Field(default=5e6, gt=0)
    tank_pa: Annotated[float, PRESSURE] = 1e5
    may_shut: bool = True
    see: list[str] = []
    mass_kg: float = Field(gt=0, description="mass_kg = 400")
    load_n: float = 0.0
    load_slope_n_per_m: float = 0.0
    friction_n: float = Field(default=0.0, ge=0)
    friction_ns_per_m: float = Field(default=0.0, ge=0)
    kp_per_s: float = Field(gt=0, description="kp_per_s = 5")
    volts_per_mps: float = Field(gt=0, description="volts_per_mps = 26")
    deadband_v: Annotated[float, COMMAND] = Field(default=0.0, ge=0)
    blend_mps: Annotated[float, VELOCITY] = Field(default=4e-3, gt=0)


class ControllerSection(Section):
    """[controller]: how the map is used; `rtid apply --dry-run` then foretells tracking.

    law: "feedforward", the inverse map of v_ref + kp (x_ref - x) + ki times its integral, or
    "robust", the adaptive robust controller of the paper with the gain kp, which needs the mass.
    reference: signal of the record that is followed, else the recorded position.  mass: without it
    the piston follows the recorded force.  rate: limit of a command, its unit per second; off_side:
    what keeps chamber B at its pressure; lead: how far ahead the robust law looks.
    """

    law: Literal["feedforward", "robust"] = "feedforward"
    reference: str | None = None
    kp_per_s: float = Field(gt=0, description="kp_per_s = 5")
    ki_per_s2: float = Field(default=0.0, ge=0)
    rate_per_s: float | None = Field(default=None, gt=0)
    mass_kg: float | None = Field(default=None, gt=0)
    load_n: float = 0.0
    load_slope_n_per_m: float = 0.0
    friction_n: float = Field(default=0.0, ge=0)
    friction_ns_per_m: float = Field(default=0.0, ge=0)
    off_side_pa: Annotated[float, PRESSURE] = Field(default=1.5e6, gt=0)
    off_side_gain_per_s: float = Field(default=80.0, ge=0)
    lead_s: Annotated[float, TIME] = Field(default=0.0, ge=0)


class DaemonSection(Section):
    """[daemon]: `rtid run`, its rates and what it keeps; `folder` is relative to the file."""

    rate_hz: Annotated[float, FREQUENCY] = Field(default=1000.0, ge=1, le=20_000)
    publish_s: Annotated[float, TIME] = Field(default=10.0, gt=0)
    store_s: Annotated[float, TIME] = Field(default=30.0, gt=0)
    diagnose_s: Annotated[float, TIME] = Field(default=600.0, gt=0)
    coach_s: Annotated[float, TIME] = Field(default=600.0, gt=0)
    max_age_s: Annotated[float, TIME] = Field(default=0.05, gt=0)
    priority: int = Field(default=0, ge=0, le=99)
    record_mb: int = Field(default=200, ge=0)
    folder: str | None = None


class PublishSection(Section):
    """[publish]: maps to the controller on `rtid apply`; without can_id nothing can be sent.

    Slots are the edges in the order of the file, then the bulk moduli.  max_change_percent is of
    one apply: the change of a flow that data stand behind, of the rated flow.  The others are of
    any map (`rtid.apply.bounds`): its flows, what its table is off by, its distance from the prior.
    """

    can_id: int | None = Field(default=None, ge=0, lt=1 << 29)
    reply_id: int | None = Field(default=None, ge=0, lt=1 << 29)
    status_id: int | None = Field(default=None, ge=0, lt=1 << 29)
    status: bool = False
    interface: str | None = None
    channel: str | None = None
    first_slot: int = Field(default=0, ge=0, le=15)
    frames_per_s: float = Field(default=1000.0, gt=0, le=10_000)
    error_percent: float = Field(default=0.1, gt=0, le=10)
    max_change_percent: float = Field(default=20.0, gt=0)
    max_flow_percent: float = Field(default=500.0, gt=0)
    max_error_percent: float = Field(default=2.0, gt=0)
    max_prior_percent: float = Field(default=50.0, gt=0)
    least_interval_s: Annotated[float, TIME] = Field(default=60.0, ge=0)
    judge_s: Annotated[float, TIME] = Field(default=30.0, ge=5)
    gain_percent: float = Field(default=1.0, gt=0, lt=100)
