"""Stills of what was learned: coverage, maps, slices, and the model beside the measurement.

Importing this package imports matplotlib: do it where a picture is wanted, not before.
"""

from rtid.pictures.coverage import coverage
from rtid.pictures.maps import maps, slices
from rtid.pictures.residual import residual
from rtid.pictures.style import save

__all__ = ["coverage", "maps", "residual", "save", "slices"]
