"""Linear algebra of what a program calls stays on its thread, whatever its own settings are."""

from __future__ import annotations

from threadpoolctl import threadpool_info, threadpool_limits

from rtid.diagnose.diagnosis import searched
from rtid.diagnose.standing import fitted
from rtid.estimator.factor import on_one_thread
from rtid.estimator.published import publish


def threads() -> set[int]:
    """Of all libraries of linear algebra."""
    return {int(x["num_threads"]) for x in threadpool_info() if x["user_api"] == "blas"}


def test_it_is_one_thread_inside_and_the_callers_own_behind() -> None:
    """Two, where the program has asked for two."""
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert on_one_thread(threads)() == {1}
        assert threads() == before


def test_what_takes_long_has_it() -> None:
    """A fit, a diagnosis, a map: 3.9 s of processor time instead of 56 beside another process."""
    for function in (fitted, searched, publish):
        inner, wrapped = function, []
        while hasattr(inner, "__wrapped__"):
            wrapped.append(inner.__code__)
            inner = inner.__wrapped__
        assert on_one_thread(threads).__code__ in wrapped, function
