"""A diagnosis in plain values: what is missing, how large, how sure, what could not be seen.

`Diagnosis.as_json` follows the schema that `schema.md` describes; `summary` makes it of a search.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from rtid.diagnose.clean import Cut
from rtid.diagnose.verdict import is_foretold, is_immaterial
from rtid.diagnose.zeros import Zero
from rtid.estimator.validity import Doubt
from rtid.plain import Key, plain

SCHEMA = 1
NOBODY_LOOKED = "Not examined: the diagnosis has no column for it here."
MISLED = "not told: what else is missing bends the maps that would tell it"
NOT_CONFIRMED = "not confirmed: what the maps' blocks miss may look like it in this record"
LOOKS_LIKE = "no less than what is missing looks like: a part of it may be this"
NOISE_ALONE = "what the maps leave of it in this record is the noise of the pressures"
NO_SIZE = "not confirmed: the 95 % interval of its size, beside what was found, holds zero"
OVER = "over"  # beside a change: the time in which it is so large


@dataclass(frozen=True)
class Value:
    """One parameter of an effect: SI."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class HiddenInMap:
    """What leaving an effect out bends where the residual hardly shows it: shares, 1.

    own_flow: of the rms flow, None for a timing; maps: root mean square over the visits, of an
    edge's largest flow; beta: relative, of the chambers whose modulus leaves its interval;
    separates: what would keep it out of the maps; lag_s: by how much the spools' lag is off.
    """

    own_flow: float | None
    maps: dict[str, float]
    beta: dict[str, float]
    separates: tuple[str, ...]
    lag_s: float = 0.0


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was found, in the order of addition.

    hidden_in_map: None where the residual shows it; not_reached: what parameters are above that
    the record never came to, as a pump's flow.
    """

    effect: str
    where: str
    cannot_be_told_from: tuple[str, ...]
    parameters: dict[str, Value]
    p_value: float
    heldout_gain_pct: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float
    hidden_in_map: HiddenInMap | None = None
    not_reached: Mapping[str, Value] = field(default_factory=dict)

    @property
    def alike(self) -> tuple[Key, ...]:
        """Name and place of what it cannot be told from."""
        parts = [text.partition(" (") for text in self.cannot_be_told_from]
        return tuple((name, where.removesuffix(")") or self.where) for name, _, where in parts)


@dataclass(frozen=True)
class FittedEffect:
    """An effect that the project has added, as fitted to this record."""

    effect: str
    where: str
    parameters: dict[str, Value]


@dataclass(frozen=True)
class Unseen:
    """An effect that was not found: the smallest size that the record would have shown.

    detection_limit: of four standard deviations; named_from: the size from which on it would have
    been named, which must also matter; None where no possible one would.
    examined: False where this machine and record have no column for it: nobody looked.
    form: the numbers beside its size that the sizes are of, as the pressure at which a valve opens.
    seen: the size that the record shows and nothing confirms, None without one; moves_beta: by how
    much, relative, the size of what is seen and not named moves a modulus that is told without it,
    None where the modulus' 95 % interval holds that.
    """

    effect: str
    where: str
    detection_limit: float | None
    unit: str
    visible: bool
    reason: str
    examined: bool = True
    named_from: float | None = None
    form: Mapping[str, Value] = field(default_factory=dict)
    seen: Value | None = None
    moves_beta: float | None = None


@dataclass(frozen=True)
class Small:
    """An effect that is significant and changes next to nothing."""

    effect: str
    where: str
    heldout_share_of_rms_flow: float


@dataclass(frozen=True)
class Diagnosis:
    """Everything that `rtid diagnose` says; residuals are root mean squares behind H_f.

    disturbance: what the rows were weighed for beside the sensors' noise, rate per sqrt(Hz);
    beta_sd_pa: what the blocks miss is counted; NaN where something unknown bends the moduli.
    filtered_hz: cut-off of the logger's filter that may have left what has no name, Hz; 0 for none.
    map_sd_m3s: of what the maps foretell of the held-out part, by their own deviations.
    """

    verdict: str
    added: tuple[FittedEffect, ...]
    found: tuple[FoundEffect, ...]
    rho_before: float
    rho_after: float
    heldout_residual_before_m3s: float
    heldout_residual_after_m3s: float
    noise_floor_m3s: float
    rms_flow_m3s: float
    beta_pa: tuple[float, ...]
    lag_s: float
    lag_sd_s: float
    something_remains: bool
    held_out_judged: bool
    not_found: tuple[Unseen, ...]
    negligible: tuple[Small, ...]
    advice: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()
    cut: tuple[Cut, ...] = ()
    disturbance: float = 0.0
    zeros: tuple[Zero, ...] = ()
    beta_sd_pa: tuple[float, ...] = ()
    filtered_hz: float = 0.0
    map_sd_m3s: float = 0.0

    @property
    def is_slight(self) -> bool:
        """True where what is left beyond the sensors' noise is immaterial for the flow."""
        left, floor = self.heldout_residual_after_m3s, self.noise_floor_m3s
        return is_immaterial(left, floor, self.rms_flow_m3s)

    @property
    def foretells(self) -> bool:
        """True where little but noise is left of motion that did not teach the maps."""
        left, floor = self.heldout_residual_after_m3s, self.noise_floor_m3s
        of = left, floor, self.rms_flow_m3s, self.map_sd_m3s
        return not self.held_out_judged or is_foretold(*of)

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types; numbers that are not finite are null."""
        return {"schema": SCHEMA} | plain(asdict(self))
