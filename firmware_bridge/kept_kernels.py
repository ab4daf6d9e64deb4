"""How a kept kernel is loaded: its machine code alone.

Before numba reads a kept kernel it makes its whole compiler ready, every type and function that
it knows (0.2 s and 45 MB at each start), and beside the code it reads the module that this was made
of, in case another kernel is linked with it.  Neither is needed to run: all that the code asks for
is the address of C functions, which its table of symbols names.  Where one has no address here, or
numba is not what it was, the kernel is loaded as numba would have it.

Source of the table's layout: System V ABI, ELF-64 object file format, figures 4-1 to 4-16.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

from llvmlite import binding as llvm
from numba.core import codegen as numba_codegen
from numba.core.registry import cpu_target
from numba.core.runtime import _nrt_python

ELF_64_LITTLE = b"\x7fELF\x02\x01"
SECTION, SYMBOL = struct.Struct("<IIQQQQIIQQ"), struct.Struct("<IBBHQQ")
SYMBOL_TABLE = 2
_NEEDED = ("enable_object_caching", "_set_compiled_object", "_finalize_final_module",
           "_shared_module", "_get_module_for_linking")  # fmt: skip


class _Kept(numba_codegen.JITCodeLibrary):  # type: ignore[misc]
    """A library whose module is read where another one is linked with it, and else not."""

    _shared_module: Any
    _unread = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, content = state
        known = symbols(content[0]) if kind == "object" else None
        if known is None or not all(map(llvm.address_of_symbol, known[1])):
            cpu_target.target_context.refresh()
            return super()._unserialize(codegen, state)
        self = codegen.create_library(name)
        code, self._unread = content
        codegen._engine._defined_symbols |= known[0]
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._finalize_final_module()
        return self

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None and self._unread:
            self._shared_module = llvm.parse_bitcode(self._unread)
        return super()._get_module_for_linking()


def symbols(code: bytes) -> tuple[set[str], set[str]] | None:
    """What a file of machine code defines and what it asks for; None: no ELF file of 64 bits."""
    if not code.startswith(ELF_64_LITTLE):
        return None
    (start,), (count,) = struct.unpack_from("<Q", code, 40), struct.unpack_from("<H", code, 60)
    sections = [SECTION.unpack_from(code, start + SECTION.size * k) for k in range(count)]
    defined: set[str] = set()
    asked: set[str] = set()
    for section in sections:
        if section[1] == SYMBOL_TABLE:
            for name, here in _global_symbols(code, section, sections[section[6]][4]):
                (defined if here else asked).add(name)
    return defined, asked


def _global_symbols(code: bytes, table: tuple[int, ...], names: int) -> Iterator[tuple[str, bool]]:
    """Each symbol that other files see, and whether it is defined in this one."""
    content = code[table[4] : table[4] + table[5]]
    for name, info, _, section, _, _ in SYMBOL.iter_unpack(content):
        if info >> 4:
            start = names + name
            yield code[start : code.index(b"\0", start)].decode(), section != 0


def _is_known() -> bool:
    """Whether numba's libraries and caches are still made of what is changed here."""
    library = numba_codegen.JITCodeLibrary(cpu_target.target_context.codegen(), "known")
    return (
        all(hasattr(library, name) for name in _NEEDED)
        and hasattr(library._codegen._engine, "_defined_symbols")
        and hasattr(_nrt_python, "c_helpers")
    )


KEPT = _Kept if _is_known() else None


def load_light(cache: Any) -> None:
    """Let one kernel's cache be read without making the compiler ready."""
    if KEPT is not None and hasattr(cache, "_load_overload"):
        _name_helpers()
        cache.load_overload = cache._load_overload


def _name_helpers() -> None:
    """Tell LLVM where numba's C functions are, under the names that numba gives them."""
    for name, address in _nrt_python.c_helpers.items():
        llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
