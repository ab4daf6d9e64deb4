"""What a new map will do to tracking, before it is sent: the controller on the learned machine.

The section `controller` of the project says how the map is used.  The learned machine with the
record's own load (`rtid.kernels.tracked`) follows the recorded reference under that controller,
once with the tables that it holds and once with the new ones.  What the machine's model misses on
the record is carried along as a flow.  DRAWS machines are drawn
from the map's and the bulk moduli's covariance, each with sensor noise of its own, every other one
with what the model misses at another time.  m is the median of log e over the draws, s its spread
(1.4826 times the median deviation, at least REPEATED).  Where the record holds a reference and was
made with the held map, it tells what the model gets wrong: b = log(recorded error) - m, and d, the
rms of recorded less foretold error over time, which no rms can be off by more than:

    held: exp(m + b +- t s) +- t d / 2,    new: exp(m + b/2 +- t s) +- t d / 2.

A draw under which a pressure runs away counts as one of infinite error; too many are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from firmware_bridge.lookup import Table
from rtid.apply.judge import KnownMap, candidate
from rtid.compare import CandidateMap, compare
from rtid.compare.motion import LEAST, smooth_position, smoothed
from rtid.effects.extra import with_extra_flow
from rtid.errors import RtidError
from rtid.estimator.flowmap import EdgeMap
from rtid.estimator.state import build
from rtid.estimator.windows import OVERLAP
from rtid.kernels.control_law import Mechanics, RobustLaw, resistance
from rtid.kernels.engine import GAP_FLAG
from rtid.kernels.tracked import ROLES, Steering, Tables, track
from rtid.model import Edge, Machine
from rtid.plain import BoolArray, FloatArray
from rtid.project import Project
from rtid.project.schema import ControllerSection
from rtid.units import range_of, with_unit

DRAWS = 16
T_975 = 2.131  # Student's t of DRAWS - 1 degrees of freedom
REPEATED = 0.02  # by so much of itself the error of a run differs from that of the next
LONGEST_S, SETTLED_S = 40.0, 0.5  # of the record that is run; its begin, which does not count
LEAST_S = 2.0
MOST_MOVED = 0.5  # of a cell's flow: where nothing is known, a valve still lets oil through


class NoTrackingError(RtidError):
    """Nothing can be foretold of this machine, controller or record; the text says why."""


@dataclass(frozen=True)
class ErrorInterval:
    """Root mean square of x less its reference, m: as foretold, and its 95 % interval."""

    rms_m: float
    low_m: float
    high_m: float

    def __str__(self) -> str:
        return f"{with_unit(self.rms_m, 'm')} ({range_of(self.low_m, self.high_m, 'm')})"


@dataclass(frozen=True)
class TrackingForecast:
    """Tracking over `seconds` of a record's reference.  held: None where no map is known there.

    recorded_m: what the record itself shows, None where it holds no reference.
    """

    seconds: float
    reference: str
    new: ErrorInterval
    held: ErrorInterval | None
    recorded_m: float | None

    @property
    def sentence(self) -> str:
        """What is foretold, in words."""
        before = "" if self.held is None else f"{self.held} with the held map, "
        recorded = ""
        if self.recorded_m is not None:
            recorded = f"; recorded: {with_unit(self.recorded_m, 'm')}"
        return (
            f"rms tracking error over {self.seconds:.0f} s of {self.reference}: {before}"
            f"{self.new} with the new one{recorded}"
        )

    def as_json(self) -> dict[str, object]:
        """All fields."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class FollowedPath:
    """A stretch of the record without a gap: samples (n, 2 + signals), path (n, 4), load_n (n,).

    path: x, v, a and jerk, SI.  recorded_m: (n,) x less its reference, None without one.
    """

    name: str
    samples: FloatArray
    path: FloatArray
    load_n: FloatArray
    recorded_m: FloatArray | None


def foretell(
    model: Machine,
    stroke_m: float,
    section: ControllerSection,
    chunk: FloatArray,
    machine: KnownMap,
    beta_sd_pa: FloatArray,
    new: Mapping[str, Table],
    present: Mapping[str, Table] | None,
    seed: int = 0,
) -> TrackingForecast:
    """Tracking with the tables `new` and `present`, by edge, over a record.

    chunk (n, 2 + signals): SI; machine: what was learned, with beta_sd_pa (chambers,).  Raises
    NoTrackingError.
    """
    _refuse_unfit(model, section)
    mechanics = _mechanics(model, stroke_m, section)
    reference = reference_of(model, mechanics, section.reference, chunk)
    missed = _missed(model, candidate(model, machine), reference.samples)
    errors: dict[str, list[FloatArray]] = {"new": [], "held": []}
    both = {"new": new} if present is None else {"new": new, "held": present}
    for k in range(DRAWS):
        rng = np.random.default_rng([seed, k])
        drawn = _drawn(model, machine, beta_sd_pa, rng)
        noise = rng.standard_normal((len(reference.samples), len(model.signals)))
        later = 0 if k % 2 == 0 else int(rng.integers(len(missed)))  # as it was, or at another time
        moved = np.roll(missed, later, axis=0)
        for name, tables in both.items():
            errors[name].append(
                tracking_error(model, section, mechanics, drawn, tables, reference, moved, noise)
            )
    for name, runs in errors.items():
        _refuse_runaways(name, sum(not np.isfinite(run[-1]) for run in runs))
    counts = reference.samples[:, 0] > reference.samples[0, 0] + SETTLED_S
    shift, doubt = 0.0, 0.0
    recorded: float | None = None
    if reference.recorded_m is not None:
        recorded = _rms(reference.recorded_m[counts])
        if present is not None:
            shift = float(np.log(recorded) - np.median(_logs(errors["held"], counts)))
            doubt = _rms((reference.recorded_m - errors["held"][0])[counts])
    return TrackingForecast(
        float(np.ptp(reference.samples[:, 0])),
        reference.name,
        _interval(_logs(errors["new"], counts), 0.5 * shift, doubt),
        None if present is None else _interval(_logs(errors["held"], counts), shift, doubt),
        recorded,
    )


def _refuse_runaways(name: str, many: int) -> None:
    if many > DRAWS // 4:
        raise NoTrackingError(
            f"with the {name} map a pressure runs away in {many} of {DRAWS} machines that the data "
            "allow",
            "check kp_per_s, the mass and the reference in [controller], or learn from more motion",
        )


def told(
    project: Project,
    section: ControllerSection,
    chunk: FloatArray,
    machine: KnownMap,
    beta_sd_pa: FloatArray,
    new: Mapping[str, Table],
    present: Mapping[str, Table] | None,
) -> TrackingForecast | str:
    """What `foretell` says of a project's machine, or why it cannot; arguments as there.

    chunk (n, 2 + signals): SI; beta_sd_pa (chambers,).
    """
    stroke_m = project.sections.stroke_m
    try:
        return foretell(project.model, stroke_m, section, chunk, machine, beta_sd_pa, new, present)
    except NoTrackingError as error:
        return f"tracking is not foretold: {error}; {error.remedy}"


def _refuse_unfit(model: Machine, section: ControllerSection) -> None:
    where = "[controller]"
    if any(not chamber.pressure for chamber in model.chambers):
        raise NoTrackingError(f"{where}: a machine without pressures cannot be run", "drop it")
    if any(chamber.is_constant for chamber in model.chambers):
        raise NoTrackingError(f"{where}: a motor that goes round is not foretold", "drop it")
    if section.law == "robust" and len(model.chambers) < 2:
        raise NoTrackingError(f"{where}: law = 'robust' needs both chambers", "use 'feedforward'")
    roles = dict(zip(ROLES, _by_role(model), strict=True))
    for name in ROLES[::2] if len(model.chambers) == 1 else ROLES:
        if roles[name] is None:
            raise NoTrackingError(
                f"{where}: no edge moves oil {name} alone", "declare it, or drop it"
            )


def reference_of(
    model: Machine, mechanics: Mechanics, named: str | None, chunk: FloatArray
) -> FollowedPath:
    """The longest stretch of the record without a gap, its reference and its load.

    named: the signal that is followed, None for the recorded motion; chunk (n, 2 + signals): SI.
    The load is what the declared mass, gravity and friction do not say.  Raises NoTrackingError
    where the stretch is too short.
    """
    samples = _stretch(model, chunk)
    t_s = samples[:, 0]
    x = smooth_position(model, samples)
    wanted = x if named is None else _smooth(t_s, samples[:, 2 + model.column(named)])
    path = [wanted]
    for _ in range(3):
        path.append(np.gradient(path[-1], t_s))
    area = np.array([chamber.sign * chamber.area_m2 for chamber in model.chambers])
    columns = [2 + model.column(chamber.pressure) for chamber in model.chambers]
    force = _smooth(t_s, samples[:, columns] @ area)
    if mechanics.mass_kg:
        v = np.gradient(x, t_s)
        force -= mechanics.mass_kg * np.gradient(v, t_s) + resistance(mechanics, x, v)
    recorded = None
    if named is not None:
        recorded = x - wanted
    name = "the recorded motion" if named is None else f"the reference {named}"
    return FollowedPath(name, samples, np.stack(path, axis=1), force, recorded)


def _stretch(model: Machine, chunk: FloatArray) -> FloatArray:
    """The longest stretch of samples (n, 2 + signals) without a gap, cut to LONGEST_S."""
    chunk = chunk.copy()
    values = chunk[:, 2:]
    for column in values.T:  # what came more slowly holds
        known = np.isfinite(column)
        last = np.maximum.accumulate(np.where(known, np.arange(len(column)), 0))
        column[:] = column[last]
    finite = np.asarray(np.isfinite(values).all(axis=1), bool)
    step = np.diff(chunk[:, 0])
    joined = finite[1:] & finite[:-1] & (step > 0) & (step <= model.gates.max_gap_s)
    joined &= (chunk[1:, 1].astype(int) & GAP_FLAG) == 0
    ends = np.flatnonzero(np.diff(np.concatenate([[False], joined, [False]])))
    stretches = ends.reshape(-1, 2)
    if len(stretches):
        first, last = stretches[np.argmax(chunk[stretches[:, 1], 0] - chunk[stretches[:, 0], 0])]
        part = chunk[first : last + 1]
        part = part[part[:, 0] <= part[0, 0] + LONGEST_S]
        if len(part) >= LEAST and np.ptp(part[:, 0]) >= LEAST_S:
            return np.ascontiguousarray(part)
    raise NoTrackingError(f"no {LEAST_S:g} s of the record without a gap", "name another record")


def _smooth(t_s: FloatArray, y: FloatArray) -> FloatArray:
    """A signal (n,) without its noise, in its own unit."""
    size = max(float(np.ptp(y)), 1e-12)
    return size * smoothed(t_s, y / size, np.isfinite(y))


def _missed(model: Machine, known: CandidateMap, samples: FloatArray) -> FloatArray:
    """What the model misses of the flow (n - 1, chambers), m3/s, H_f's lag taken out."""
    part = compare(model, known, samples)
    t_s = samples[:-1, 0] + 2.0 * model.filter.zeta / model.filter.wn_rad_s
    if not len(part.t_s):
        return np.zeros((len(t_s), len(model.chambers)))
    rest = np.nan_to_num(part.residual_m3s)
    return np.stack([np.interp(t_s, part.t_s, column) for column in rest.T], axis=1)


def tracking_error(
    model: Machine,
    section: ControllerSection,
    mechanics: Mechanics,
    machine: CandidateMap,
    tables: Mapping[str, Table],
    reference: FollowedPath,
    missed_m3s: FloatArray,
    noise: FloatArray,
) -> FloatArray:
    """The piston's x less its reference (n,), m; inf where a pressure of the machine runs away.

    missed_m3s (n - 1, chambers), noise (n, signals) in standard deviations.
    """
    larger, terms, samples = with_extra_flow(model, machine.terms, reference.samples, missed_m3s)
    state = build(larger.with_taylor_maps, machine.weights)
    state.engine[0]["term_theta"][: len(terms)] = terms
    sd = np.array([signal.noise for signal in model.signals])
    width = len(larger.signals)
    seen, steps = np.zeros((len(samples), width)), np.zeros(width)
    seen[:, : len(sd)] = noise * sd
    steps[: len(sd)] = [signal.resolution for signal in model.signals]
    states = np.zeros((len(samples), 4))
    for c, chamber in enumerate(model.chambers):
        states[0, c] = samples[:LEAST, 2 + model.column(chamber.pressure)].mean()
    states[0, 2:] = reference.path[0, :2]
    n = track(
        state.engine,
        machine.theta,
        machine.compliance,
        OVERLAP,
        _steering(model, section, mechanics, machine),
        _tables(model, tables),
        np.ascontiguousarray(samples),
        reference.path,
        reference.load_n,
        seen,
        steps,
        states,
    )
    if n < len(samples):
        return np.full(len(samples), np.inf)
    return np.asarray(states[:, 2] - reference.path[:, 0])


def _mechanics(model: Machine, stroke_m: float, section: ControllerSection) -> Mechanics:
    """What the controller knows of the machine; its bulk modulus comes with the map."""
    a, b = model.chambers[0], model.chambers[-1]
    v0_b_m3 = b.v0_m3 - b.area_m2 * stroke_m if b.sign < 0 else b.v0_m3
    return Mechanics(
        a.area_m2, b.area_m2, stroke_m, a.v0_m3, v0_b_m3, model.beta_nominal_pa,
        section.mass_kg or 0.0, section.load_n, section.load_slope_n_per_m, section.friction_n,
        viscous_nspm=section.friction_ns_per_m,
    )  # fmt: skip


def _steering(
    model: Machine, section: ControllerSection, mechanics: Mechanics, machine: CandidateMap
) -> Steering:
    law = RobustLaw(
        mechanics._replace(beta_pa=1.0 / float(machine.compliance[0])), section.kp_per_s,
        section.off_side_gain_per_s, section.off_side_pa, section.lead_s, 0.0,
    )  # fmt: skip
    rate = np.inf if section.rate_per_s is None else section.rate_per_s
    is_robust, at = section.law == "robust", model.column(model.position)
    return Steering(section.kp_per_s, section.ki_per_s2, rate, is_robust, law, at)


def _by_role(model: Machine) -> list[Edge | None]:
    """The edges of `kernels.tracked.ROLES`: the first that feeds or drains one chamber alone."""
    found: list[Edge | None] = []
    for sign in (-1, 1):
        for chamber in model.chambers[:2]:
            alone = [
                e
                for e in model.edges
                if e.sign(chamber) == sign and sum(abs(e.sign(c)) for c in model.chambers) == 1
            ]
            found.append(alone[0] if alone else None)
        found += [None] * (2 - len(model.chambers))
    return found


def _tables(model: Machine, tables: Mapping[str, Table]) -> Tables:
    """As the kernel takes them; a flow that falls with the command is held, to have an inverse."""
    edges = _by_role(model)
    given = [next(iter(tables.values())) if e is None else tables[e.name] for e in edges]
    return Tables(
        np.array([-1 if e is None else model.edges.index(e) for e in edges]),
        tuple(table.w_v.astype(float) for table in given),
        tuple(table.s.astype(float) for table in given),
        tuple(np.maximum.accumulate(table.flow_m3s, axis=0) for table in given),
    )


def _drawn(
    model: Machine, machine: KnownMap, beta_sd_pa: FloatArray, rng: np.random.Generator
) -> CandidateMap:
    """A machine that the data allow: within an edge, errors count as wholly correlated."""
    known = candidate(model, machine)
    moved = np.concatenate([
        _moved(edge, rng.standard_normal(6)) for edge in machine.flow_map.edges
    ])  # fmt: skip
    beta = machine.beta_pa + np.nan_to_num(beta_sd_pa) * rng.standard_normal(len(beta_sd_pa))
    low, high = model.beta_bounds_pa
    theta = known.theta + moved if len(moved) == len(known.theta) else known.theta
    return CandidateMap(
        "drawn", theta, 1.0 / np.clip(beta, low, high), known.status, known.weights, known.terms
    )


def _moved(edge: EdgeMap, z: FloatArray) -> FloatArray:
    """What z (6,) standard deviations move the terms of all cells (cells, 6) by, m3/s."""
    cov = np.nan_to_num(edge.cov.reshape(-1, 6, 6))
    size = np.maximum(np.trace(cov, axis1=1, axis2=2), 1e-30)[:, None, None]
    moved = np.linalg.cholesky(cov + 1e-9 * size * np.eye(6)) @ z
    flow = np.abs(edge.theta.reshape(-1, 6)[:, 0])
    most = MOST_MOVED * flow / np.maximum(np.abs(moved).sum(axis=1), 1e-30)
    return np.asarray(moved * np.minimum(1.0, most)[:, None])


def _rms(error_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(error_m**2)))


def _logs(errors_m: list[FloatArray], counts: BoolArray) -> FloatArray:
    """Logarithms of the rms errors of all draws (draws,)."""
    return np.log([max(_rms(error[counts]), 1e-12) for error in errors_m])


def _interval(log: FloatArray, shift: float, doubt_m: float) -> ErrorInterval:
    """Of the logarithms of the draws' errors (draws,); shift, doubt_m: see the head of the file."""
    middle = float(np.median(log))
    spread = max(1.4826 * float(np.median(np.abs(log - middle))), REPEATED)
    rms, low, high = np.exp(middle + shift + T_975 * spread * np.array([0.0, -1.0, 1.0]))
    wide = 0.5 * T_975 * doubt_m
    return ErrorInterval(float(rms), max(float(low) - wide, 0.0), float(high) + wide)
