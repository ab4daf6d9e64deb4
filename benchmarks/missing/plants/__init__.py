"""Where records come from: one file per simulator, with `wishes(size)`."""

from __future__ import annotations

PLANTS = ("own_simulator", "exudyn_rig", "modelica_rig", "by_equations")
