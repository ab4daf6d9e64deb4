"""The methods: one file per library, with `METHODS`, a tuple of objects like `record.Method`."""

from __future__ import annotations

from importlib import import_module

from benchmarks.missing.record import Method

BASE = ("data_sheet", "rtid_methods", "least_squares")  # need nothing but rtid and its [dev]
FILES = (*BASE, "kalman", "output_error", "regressors", "sparse", "hybrid_ode", "of_equations")


def methods_of(files: tuple[str, ...]) -> dict[str, Method]:
    """The methods of some files by their names, in order."""
    found = [m for f in files for m in import_module(f"{__name__}.{f}").METHODS]
    return {method.name(): method for method in found}
