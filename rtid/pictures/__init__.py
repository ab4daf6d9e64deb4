"""Stills of what was learned: coverage, maps, slices, and the model beside the measurement.

Importing this package imports matplotlib: do it where a picture is wanted, not before.
"""

from rtid.pictures.beside import beside
from rtid.pictures.correlation import correlogram, cusum
from rtid.pictures.coverage import coverage
from rtid.pictures.dependence import dependences
from rtid.pictures.maps import maps, slices
from rtid.pictures.pressure import pressures
from rtid.pictures.residual import residual
from rtid.pictures.style import save
from rtid.pictures.where import residual_map

__all__ = [
    "beside",
    "correlogram",
    "coverage",
    "cusum",
    "dependences",
    "maps",
    "pressures",
    "residual",
    "residual_map",
    "save",
    "slices",
]
