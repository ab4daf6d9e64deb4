"""The error of the export to a controller."""

from __future__ import annotations

from rtid.errors import RtidError


class ValveError(RtidError):
    """A machine that the estimator in C does not know; the text names every reason."""

    exit_code = 2
