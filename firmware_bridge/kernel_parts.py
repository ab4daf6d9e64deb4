"""Parts of kernels: functions that kernels call and Python does not.

numba optimises each function and makes machine code of it before its callers, which hold a copy of
it and do the same again: a part of a part of a kernel was optimised four times, and run once.  Here
a part stays as numba's front end wrote it until the kernel that it is linked into is optimised as a
whole.  Nor are the references of its arrays counted, with atomic operations at each call: what
Python handed to the kernel lives as long as the call.  So a part that allocates does not compile.

Both lean on what numba does not promise.  Where it is gone, a part compiles as any function does:
slower, with the same results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import binding as llvm
from numba import njit, types
from numba.core import codegen as numba_codegen
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUTargetOptions
from numba.core.registry import cpu_target
from numba.extending import is_jitted

from firmware_bridge.lean_compiler import OPTIONS

UNCOUNTED = {"_nrt": False} if hasattr(CPUTargetOptions, "_nrt") else {}
_NEEDED = ("finalize", "codegen", "_optimize_functions", "_raise_if_finalized", "_reload_init",
           "_final_module", "_get_module_for_linking", "_finalize_dynamic_globals", "_finalized",
           "_linking_libraries")  # fmt: skip


class _Linked(numba_codegen.JITCodeLibrary):  # type: ignore[misc]
    """A library that is only ever linked into others: no optimisation, no machine code."""

    def finalize(self) -> None:
        """Take in nothing: what this part calls is linked once, into the kernel."""
        self._raise_if_finalized()
        for library in self._called():
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True

    def _called(self) -> list[Any]:
        """The libraries of all that this part calls, each once."""
        called = dict.fromkeys(self._linking_libraries)
        for library in self._linking_libraries:
            called |= dict.fromkeys(library._called() if isinstance(library, _Linked) else ())
        return list(called)

    def _get_module_for_linking(self) -> Any:
        self._ensure_finalized()
        whole = self._alone().clone()
        for library in self._called():
            is_part = isinstance(library, _Linked)
            module = library._alone() if is_part else library._get_module_for_linking()
            whole.link_in(module, preserve=True)
        return whole

    def _alone(self) -> Any:
        """The code of the part itself, which others may hold as well."""
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = llvm.Linkage.linkonce_odr
        return self._final_module

    def get_pointer_to_function(self, name: str) -> int:
        """None: Python cannot call it."""
        return 0

    @property
    def codegen(self) -> Any:
        """What would write the address of an environment into machine code."""
        return _NoCode

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout


class _NoCode:
    @staticmethod
    def set_env(*_: Any) -> None:
        """There is no code that would read it."""


def _is_known() -> bool:
    """Whether numba's libraries are still made of what `_Linked` changes."""
    library = numba_codegen.JITCodeLibrary(cpu_target.target_context.codegen(), "known")
    return hasattr(library._codegen, "_library_class") and all(
        hasattr(library, name) for name in _NEEDED
    )


LINKED = _Linked if _is_known() else None


@contextmanager
def compiled_as(library: type | None) -> Iterator[None]:
    """Let numba, whose lock the caller holds, make libraries of this class; None: as it likes."""
    codegen = cpu_target.target_context.codegen()
    before = getattr(codegen, "_library_class", None)
    if library is not None and before is not None:
        codegen._library_class = library
    try:
        yield
    finally:
        if before is not None:
            codegen._library_class = before


def part(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a part with numba's options; forceinline=True inserts it where it is called.

    Tests may call it from Python: then it is compiled once more, as a function of its own.
    """
    inherited = {"forceinline": False}  # from its caller, if it is not said
    linked = inherited | UNCOUNTED | OPTIONS | options
    dispatcher = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **linked)(function)
    if is_jitted(dispatcher):  # not where NUMBA_DISABLE_JIT is set
        compiled, alone = dispatcher.compile, njit(**options)(function)

        def compile_linked(signature: Any) -> Any:
            with compiled_as(LINKED):  # once for all constants: LLVM puts them in where they are
                return compiled(tuple(types.unliteral(kind) for kind in signature))

        def compile_alone(*arguments: Any) -> Any:
            with global_compiler_lock, compiled_as(numba_codegen.JITCodeLibrary):
                return alone._compile_for_args(*arguments)  # compiles once for each signature

        def keep(result: Any) -> None:
            dispatcher.overloads[tuple(result.signature.args)] = result

        dispatcher.compile, dispatcher.add_overload = compile_linked, keep
        dispatcher._compile_for_args = compile_alone
    return dispatcher
