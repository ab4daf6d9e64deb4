"""Samples with the running integral that a measured rate is learned by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_bridge.averaged import Averaged
from firmware_bridge.samples import Samples
from rtid.effects.flow_sums import FlowSums
from rtid.estimator.chunk import to_chunk
from rtid.project import Project


def with_sums(project: Project, samples: Samples) -> Samples:
    """Averaged as the project asks, with a column for each of its running sums."""
    of = project.assembly
    samples = Averaged(round(1e6 * of.average_s), of.ahead).push(samples)
    flows, model = project.flows, project.model
    if not flows:
        return samples
    bus = replace(model, signals=model.signals[: -len(flows)])
    origin_us = int(samples.t_us[0]) if len(samples) else 0
    sums = FlowSums(flows).with_flows(to_chunk(bus, samples, origin_us))[:, -len(flows) :]
    names = (*samples.names, *(flow.signal.name for flow in flows))
    return replace(samples, names=names, values=np.hstack([samples.values, sums]))
