"""Output-error refit: plants with unmeasured states and nonlinear parameters, by their free run.

`refit(plant, record)` fits, `diagnose(plant, record)` also finds which effects are missing.
"""

from rtid.output_error.diagnosis import Diagnosis, diagnose
from rtid.output_error.model import Model, refit
from rtid.output_error.plant import Input, Output, Parameter, Plant, PlantError, Record, State

__all__ = [
    "Diagnosis",
    "Input",
    "Model",
    "Output",
    "Parameter",
    "Plant",
    "PlantError",
    "Record",
    "State",
    "diagnose",
    "refit",
]
