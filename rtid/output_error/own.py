"""Effects that only a plant by equations can have, beside those of the catalogue."""

from __future__ import annotations

from rtid.effects import Effect, Parameter, Symbol

LINEAR_OUTFLOW = Effect(
    name="linear_outflow",
    title="Linear outflow",
    kind="generic",
    places=("state",),
    summary="The outflow of a store does not quite follow its declared law, mostly the square "
    "root of the level: a laminar part adds a term in proportion to the level; a narrow or bent "
    "outlet, whose losses grow with the flow, takes such a term away.",
    equation=("ddt(h) = h_in - k_l * (h - h_a)",),
    symbols=(
        Symbol("h", "m", "level, in the unit of the state"),
        Symbol("h_a", "m", "level at which nothing flows"),
        Symbol("h_in", "m/s", "all other terms of the level's rate"),
    ),
    parameters=(
        Parameter(
            "coefficient", "1/s", "k_l", -1.0, 1.0, 0, "outflow per level beyond the declared law"
        ),
    ),
    signals=("state", "input"),
    signature="The free run empties too slowly from high levels and too fast from low ones, or the "
    "other way round; it settles right in the middle only.",
    confounders=("offset", "overflow", "dead_zone", "external_leakage_turbulent"),
    separates="Let the store empty from full with the input off: the curve of level over time "
    "shows the law of the outflow alone.",
    visible_when="The level takes high and low values, each long enough to settle.",
    invisible=False,
    reference="Merritt, Hydraulic Control Systems (1967), orifices: laminar and turbulent flow.",
)
EFFECTS = {LINEAR_OUTFLOW.name: LINEAR_OUTFLOW}
