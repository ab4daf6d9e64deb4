"""A kernel cache that cannot be read must not keep the daemon from starting.

numba trusts what it finds: a damaged file ends in whatever its unpickling or the linker raise.
Then this process begins again, once, with an empty cache of its own.
"""

from __future__ import annotations

import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from typing import TypeVar

from rtid.daemon.log import logger

T = TypeVar("T")
AGAIN = "RTID_CACHE_AFRESH"  # set in the second try
CACHE = "NUMBA_CACHE_DIR"
DAMAGE = (EOFError, pickle.UnpicklingError, AttributeError, IndexError, KeyError, ValueError,
          MemoryError, ImportError)  # fmt: skip


def compiled(make: Callable[[], T]) -> T:
    """What `make` makes; where a damaged cache may be the reason that it cannot, start afresh."""
    try:
        return make()
    except DAMAGE as error:
        if os.environ.get(AGAIN):
            raise
        fresh = tempfile.mkdtemp(prefix="rtid-cache-")
        logger.warning("compiled kernels cannot be loaded (%r): compiling again into %s; delete "
                       "the old cache", error, fresh)  # fmt: skip
        os.environ[AGAIN], os.environ[CACHE] = "1", fresh
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
