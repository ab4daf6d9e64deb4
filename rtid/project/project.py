"""A loaded project: its sections, and the machine and bridge configuration built from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_bridge.catalog import Place
from firmware_bridge.config import Assembly
from rtid.effects import Effect
from rtid.effects.page import is_zero
from rtid.model import Machine
from rtid.project.added import AddedSection
from rtid.project.schema import (
    BetaSection,
    ChamberSection,
    ControllerSection,
    DaemonSection,
    DynamicsSection,
    EdgeDefaults,
    EdgeSection,
    EffectSection,
    EstimatorSection,
    ExciteSection,
    FilterSection,
    GatesSection,
    GeometrySection,
    MapSection,
    MessageSection,
    PriorSection,
    ProjectSection,
    PublishSection,
    RateSection,
    RecordSection,
    SignalSection,
    SourceSection,
    UpkeepSection,
)
from rtid.project.trust import NotTrustedError

if TYPE_CHECKING:
    from rtid.effects.live import LiveFlow
    from rtid.effects.summed import RunningSum


@dataclass(frozen=True)
class Sections:
    """The project file as read, values in SI; the keys of the dicts are the user's names."""

    project: ProjectSection
    source: SourceSection
    messages: dict[str, MessageSection]
    signals: dict[str, SignalSection]
    geometry: GeometrySection | None = None  # none of a plant without pressures
    chambers: dict[str, ChamberSection] = field(default_factory=dict)
    edges: dict[str, EdgeSection] = field(default_factory=dict)
    rate: RateSection | None = None
    maps: dict[str, MapSection] = field(default_factory=dict)
    edge_defaults: EdgeDefaults = field(default_factory=EdgeDefaults)
    modes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    beta: BetaSection = field(default_factory=BetaSection)
    filter: FilterSection = field(default_factory=FilterSection)
    gates: GatesSection = field(default_factory=GatesSection)
    upkeep: UpkeepSection = field(default_factory=UpkeepSection)
    dynamics: DynamicsSection = field(default_factory=DynamicsSection)
    estimator: EstimatorSection = field(default_factory=EstimatorSection)
    record: RecordSection = field(default_factory=RecordSection)
    daemon: DaemonSection = field(default_factory=DaemonSection)
    excite: ExciteSection | None = None
    controller: ControllerSection | None = None
    prior: PriorSection | None = None
    publish: PublishSection = field(default_factory=PublishSection)
    effects: dict[str, EffectSection] = field(default_factory=dict)
    added: tuple[AddedSection, ...] = ()

    @property
    def parts(self) -> tuple[AddedSection, ...]:
        """What of [[added]] is part of the fit: all but the zeros of sensors."""
        return tuple(a for a in self.added if not is_zero(a.effect))

    @property
    def zeros_pa(self) -> dict[str, float]:
        """What is taken out of the samples of each pressure sensor."""
        zeros = (a for a in self.added if is_zero(a.effect))
        return {a.where: next(iter(a.parameters.values())).value for a in zeros}

    @property
    def stroke_m(self) -> float:
        """The stroke; inf for a plant that has none."""
        return (self.geometry and self.geometry.stroke_m) or math.inf


@dataclass(frozen=True)
class Project:
    """Everything a command needs to know about the machine and where its signals come from.

    `assembly` serves a CAN trace, or a table if the project has no DBC; `table_assembly` serves a
    table, None unless every signal names a `column` or is constant.  `noise_unknown` and
    `offset_tolerance_s` list what the file leaves to be estimated.  `effects` are the user's own,
    of the file and of its trusted Python: candidates of the diagnosis, not part of the model;
    `untrusted` is Python that was not run; `flows` are signals that are
    made beside the kernels: a measured rate's integral and, on board, flows of added effects.
    `digest` is the restore key: it covers the machine and all that gives a sample its meaning;
    `machine_digest` the machine alone, as machines of one type share it.
    """

    path: Path
    sections: Sections
    model: Machine
    assembly: Assembly
    table_assembly: Assembly | None
    databases: tuple[Place, ...]
    reference_maps: dict[str, Path]
    noise_unknown: tuple[str, ...]
    offset_tolerance_s: dict[str, float]
    digest: str
    machine_digest: str
    effects: tuple[Effect, ...] = ()
    untrusted: Path | None = None
    flows: tuple[LiveFlow | RunningSum, ...] = ()

    @property
    def all_effects(self) -> tuple[Effect, ...]:
        """The user's own effects.  NotTrustedError where some are in Python that may not run."""
        if self.untrusted is not None:
            raise NotTrustedError(self.path, self.untrusted)
        return self.effects

    def model_with(self, noise: Mapping[str, float]) -> Machine:
        """The model with the noise of some signals (1 sigma, SI) replaced, e.g. by an estimate."""
        return self.model.with_noise(noise)

    @property
    def noise_unseen(self) -> tuple[str, ...]:
        """The signals whose noise no record has told yet: without one it is needed."""
        signals = self.sections.signals
        return tuple(name for name in self.noise_unknown if signals[name].noise_seen is None)

    @property
    def name(self) -> str:
        """What the machine is called."""
        return self.sections.project.name
