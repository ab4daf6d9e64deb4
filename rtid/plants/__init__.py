"""Output-error refit: plants with unmeasured states and nonlinear parameters, by their free run.

`refit(plant, record)` fits, `diagnose(plant, record)` also finds which effects are missing.
"""

from rtid.plants.fitted import PlantModel, refit
from rtid.plants.missing import PlantDiagnosis, diagnose
from rtid.plants.plant import (
    Input,
    Output,
    Plant,
    PlantError,
    PlantParameter,
    PlantRecord,
    PlantState,
)

__all__ = [
    "Input", "Output", "Plant", "PlantDiagnosis", "PlantError", "PlantModel", "PlantParameter",
    "PlantRecord", "PlantState", "diagnose", "refit",
]  # fmt: skip
