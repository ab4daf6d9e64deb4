"""A kernel cache that cannot be read must not keep the daemon from starting.

numba trusts what it finds: a damaged file ends in whatever its unpickling or the linker raise.
Then this process begins again, once, with an empty cache of its own, which goes when it ends.
"""

from __future__ import annotations

import atexit
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable
from typing import TypeVar

from rtid.daemon.log import logger

T = TypeVar("T")
AGAIN = "RTID_CACHE_AFRESH"  # the empty cache, in the second try
CACHE = "NUMBA_CACHE_DIR"
DAMAGE = (EOFError, pickle.UnpicklingError, AttributeError, IndexError, KeyError, ValueError,
          MemoryError, ImportError)  # fmt: skip


def compiled(make: Callable[[], T]) -> T:
    """What `make` makes; where a damaged cache may be the reason that it cannot, start afresh."""
    if own := os.environ.get(AGAIN):
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        return make()
    try:
        return make()
    except DAMAGE as error:
        fresh = tempfile.mkdtemp(prefix="rtid-cache-")
        logger.warning("compiled kernels cannot be loaded (%r): compiling again into %s; delete "
                       "the old cache", error, fresh)  # fmt: skip
        os.environ[AGAIN] = os.environ[CACHE] = fresh
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
