"""Cholesky factor and inverse by scipy's LAPACK, without the interpreter.

scipy's own wrappers hold it: 0.2 s of processor time for each of a rich map, seconds beside busy
processes, in which a snapshot that is to be saved by another thread would wait.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cython_lapack

from rtid.plain import FloatArray

_INT = ctypes.POINTER(ctypes.c_int)
_SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_char_p, _INT, ctypes.c_void_p, _INT, _INT)


def factorized(matrix: FloatArray) -> FloatArray:
    """The factor's upper triangle in place of that of a matrix (n, n), without unit.

    In Fortran order, changed in place.  Raises LinAlgError where it is not
    definite, ValueError where not finite.
    """
    return _called("dpotrf", np.asarray_chkfinite(matrix))


def inverted(upper: FloatArray) -> FloatArray:
    """The inverse's upper triangle, of a factor (n, n) as `factorized` gives, without unit.

    Changed in place.
    """
    return _called("dpotri", upper)


def _called(name: str, matrix: FloatArray) -> FloatArray:
    assert matrix.flags.f_contiguous and matrix.dtype == np.float64
    n, info = ctypes.c_int(len(matrix)), ctypes.c_int()
    size, failed = ctypes.byref(n), ctypes.byref(info)
    _routine(name)(b"U", size, matrix.ctypes.data, size, failed)
    if info.value:
        raise LinAlgError(f"{info.value}-th leading minor is not positive definite")
    return matrix


@cache
def _routine(name: str) -> Callable[..., Any]:
    """void name(char *uplo, int *n, double *a, int *lda, int *info)."""
    capsules: dict[str, object] = {**cython_lapack.__pyx_capi__}
    capsule, api = capsules[name], ctypes.pythonapi
    name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", api))
    address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
        ("PyCapsule_GetPointer", api)
    )
    return _SIGNATURE(address_of(capsule, name_of(capsule)))
