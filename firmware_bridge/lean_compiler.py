"""numba's compiler with less to do: the same code comes out of it, in half of the time.

Most of what a cold start waits for is Python, not LLVM.  An element of a record's array, as in
`e.d[0, k]`, becomes 55 instructions, which LLVM reduces to two: shape and strides, known as they
are, go through memory.  Each `+` is looked up among all types that numba knows, five times.  And of
25 passes over a function half do nothing for what kernels are made of.  Here elements, fields and
loops are written as they end, signatures of arithmetic are remembered, and idle passes are left out
where nothing is allocated.

`pipeline_class` is numba's own way to change its compiler; what its parts do is not promised.  With
a numba that was not tried, `OPTIONS` is empty: kernels compile slower, with the same results.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from math import prod
from typing import Any, ClassVar

from llvmlite.ir import Constant
from numba import version_info
from numba.core import cgutils, ir, lowering, typed_passes, types
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import LoweringPass, PassManager, _pass_registry, register_pass
from numba.core.datamodel import default_manager
from numba.core.postproc import PostProcessor

TRIED = {(0, 68)}  # versions of numba with which `tests/bridge/test_lean_compiler.py` passes
NUMBERS = (types.Integer, types.Float, types.Boolean)
TUPLE, RANGE = types.BaseTuple, types.RangeIteratorType  # type: ignore[attr-defined]
_NAMES = ("add sub mul truediv floordiv mod lt le gt ge eq ne and_ or_ xor lshift rshift neg pos "
          "iadd isub imul itruediv ifloordiv imod")  # fmt: skip
ARITHMETIC = {getattr(operator, name) for name in _NAMES.split()}
ELEMENTS = {operator.getitem, operator.setitem}
ARRAY = "meminfo", "parent", "nitems", "itemsize", "data", "shape", "strides"
ITEMS, ITEM_BYTES, DATA, SHAPE, STRIDES = range(2, 7)  # of them
LOOP = "iter", "stop", "step", "count"
# What no kernel has: closures, inlined or literal functions, array expressions, with, objects.
_IDLE = ("WithLifting InlineClosureLikes RewriteSemanticConstants RewriteDynamicRaises "
         "MakeFunctionToJitFunction InlineInlinables FindLiterallyCalls LiteralUnroll "
         "LiteralPropagationSubPipelinePass InlineOverloads NopythonRewrites "
         "NoPythonSupportedFeatureValidation DumpParforDiagnostics")  # fmt: skip
_NEEDED = ("typeof", "loadvar", "getvar", "storevar", "_alloca_var", "_blk_local_varmap",
           "_singly_assigned_vars", "lower_expr", "lower_inst", "lower_assign", "lower_binop",
           "lower_getitem", "lower_setitem")  # fmt: skip


def _is_plain(kind: Any) -> bool:
    """An array of contiguous items, as arguments or fields of a record are."""
    return type(kind) in (types.Array, types.NestedArray) and kind.layout == "C" and kind.ndim > 0


def _indices(kind: Any) -> Sequence[Any]:
    """The types of an index or a tuple of them; none where not all are integers."""
    kinds = kind.types if isinstance(kind, TUPLE) else (kind,)
    return kinds if all(isinstance(k, types.Integer) for k in kinds) else ()


def _alignment(kind: Any) -> int | None:
    return None if kind.aligned else 1


class _Lower(lowering.Lower):  # type: ignore[misc]
    """Elements, fields and loops as they end; the rest as numba has it."""

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Fields of records, elements at constant places, steps of a loop."""
        kind = self.typeof(expr.value.name) if "value" in expr._kws else None
        if expr.op == "getattr" and isinstance(kind, types.Record):
            return self._field(resty, kind, expr)
        if expr.op == "iternext" and isinstance(kind, RANGE):
            return self._next(resty, self.loadvar(expr.value.name))
        if expr.op == "static_getitem" and _is_plain(kind) and expr.index_var is not None:
            signature = self.fndesc.calltypes[expr]
            if signature is not None:
                return self.lower_getitem(resty, expr, expr.value, expr.index_var, signature)
        return super().lower_expr(resty, expr)

    def _field(self, resty: Any, record: Any, expr: Any) -> Any:
        context, builder = self.context, self.builder
        kind, start = record.typeof(expr.attr), record.offset(expr.attr)
        is_array = isinstance(kind, types.NestedArray)
        item = context.get_data_type(kind.dtype if is_array else kind)
        place = cgutils.get_record_member(builder, self.loadvar(expr.value.name), start, item)
        if is_array:
            field = self._of_known_shape(kind, kind.shape, kind.strides, place)
        else:
            field = context.unpack_value(builder, kind, place, _alignment(record))
        return context.cast(builder, field, kind, resty)

    def _of_known_shape(
        self, kind: Any, shape: Sequence[int], strides: Sequence[int], place: Any
    ) -> Any:
        """An array that nobody owns: all but its place is a constant."""
        members = self.context.get_value_type(kind).elements
        values = [Constant(member, None) for member in members]
        for k, number in ((ITEMS, prod(shape)), (ITEM_BYTES, strides[-1])):
            values[k] = members[k](number)
        for k, sizes in ((SHAPE, shape), (STRIDES, strides)):
            values[k] = Constant(members[k], [members[k].element(size) for size in sizes])
        whole = Constant(self.context.get_value_type(kind), values)
        return self.builder.insert_value(whole, place, DATA)

    def _next(self, resty: Any, loop: Any) -> Any:
        """The next of a range, and whether there is one."""
        builder = self.builder
        at, step, left = (builder.extract_value(loop, k) for k in (0, 2, 3))
        count, value = builder.load(left), builder.load(at)
        is_valid = builder.icmp_signed(">", count, count.type(0))
        with builder.if_then(is_valid):
            builder.store(builder.sub(count, count.type(1), flags=["nsw"]), left)
            builder.store(builder.add(value, step), at)
        pair = Constant(self.context.get_value_type(resty), None)
        return builder.insert_value(builder.insert_value(pair, value, 0), is_valid, 1)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """An element, or a row of a record's array."""
        kind, kinds = self.typeof(value.name), _indices(signature.args[1])
        gone = len(kinds)
        is_row = isinstance(kind, types.NestedArray) and kind.ndim > gone
        if not self._is_simple(kind, kinds) or (gone < kind.ndim and not is_row):
            return super().lower_getitem(resty, expr, value, index, signature)
        place = self._place(kind, self.loadvar(value.name), index, signature.args[1])
        if is_row:
            shape, strides = kind.shape[gone:], kind.strides[gone:]
            item = self._of_known_shape(signature.return_type, shape, strides, place)
        else:
            item = self.context.unpack_value(self.builder, kind.dtype, place, _alignment(kind))
        return self.context.cast(self.builder, item, signature.return_type, resty)

    def lower_setitem(self, target: Any, index: Any, value: Any, signature: Any) -> Any:
        """A number into an element."""
        kind, (_, index_kind, given) = self.typeof(target.name), signature.args
        kinds = _indices(index_kind)
        is_number = isinstance(given, NUMBERS) and isinstance(getattr(kind, "dtype", 0), NUMBERS)
        if not self._is_simple(kind, kinds) or len(kinds) < kind.ndim or not is_number:
            return super().lower_setitem(target, index, value, signature)
        array, number = self.loadvar(target.name), self._cast(value, given)
        place = self._place(kind, array, index, index_kind)
        number = self.context.cast(self.builder, number, given, kind.dtype)
        self.context.pack_value(self.builder, kind.dtype, number, place, _alignment(kind))
        return None

    def _is_simple(self, kind: Any, kinds: Sequence[Any]) -> bool:
        is_known = _is_plain(kind) and 0 < len(kinds) <= kind.ndim
        return is_known and not self.context.enable_boundscheck

    def _cast(self, variable: Any, kind: Any) -> Any:
        value = self.loadvar(variable.name)
        return self.context.cast(self.builder, value, self.typeof(variable.name), kind)

    def _place(self, kind: Any, array: Any, index: Any, index_kind: Any) -> Any:
        """Pointer to the element, or the first of a row; a negative index counts from the end."""
        builder, given = self.builder, self._cast(index, index_kind)
        if isinstance(index_kind, TUPLE):
            parts = [builder.extract_value(given, k) for k in range(len(index_kind))]
        else:
            parts = [given]
        place = None
        for k in range(kind.ndim):
            size = self._size(kind, array, k)
            place = builder.mul(place, size) if place is not None else None
            if k < len(parts):
                at = self._wrapped(parts[k], _indices(index_kind)[k], size)
                place = builder.add(place, at) if place is not None else at
        return builder.gep(builder.extract_value(array, DATA), [place])

    def _size(self, kind: Any, array: Any, k: int) -> Any:
        if isinstance(kind, types.NestedArray):
            return self.context.get_constant(types.intp, kind.shape[k])
        return self.builder.extract_value(array, [SHAPE, k])

    def _wrapped(self, at: Any, kind: Any, size: Any) -> Any:
        builder = self.builder
        at = self.context.cast(builder, at, kind, types.intp if kind.signed else types.uintp)
        if not kind.signed or (isinstance(at, Constant) and at.constant >= 0):
            return at
        is_negative = builder.icmp_signed("<", at, at.type(0))
        return builder.select(is_negative, builder.add(at, size), at)

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        """Arithmetic of numbers: no constants that it would treat apart."""
        kinds = [self.typeof(side.name) for side in (expr.lhs, expr.rhs)]
        if op not in ARITHMETIC or not all(isinstance(kind, NUMBERS) for kind in kinds):
            return super().lower_binop(resty, expr, op)
        context, signature = self.context, self.fndesc.calltypes[expr]
        function = context.typing_context.resolve_value_type(op)
        sides = self._cast(expr.lhs, signature.args[0]), self._cast(expr.rhs, signature.args[1])
        known = _signature(context.typing_context, function, signature.args)
        result = context.get_function(function, known)(self.builder, sides)
        return context.cast(self.builder, result, signature.return_type, resty)

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        """A compiled function has no value: whoever calls it knows it by its type."""
        if isinstance(ty, types.Dispatcher) and isinstance(inst.value, (ir.Global, ir.FreeVar)):
            return Constant(self.context.get_value_type(ty), None)
        return super().lower_assign(ty, inst)

    def lower_inst(self, inst: Any) -> Any:
        """No deletion where no references are counted."""
        if isinstance(inst, ir.Del) and not self.context.enable_nrt:
            if inst.value not in self._blk_local_varmap:
                self._singly_assigned_vars.discard(inst.value)
            return None
        is_static = isinstance(inst, ir.StaticSetItem) and inst.index_var is not None
        if is_static and _is_plain(self.typeof(inst.target.name)):
            signature = self.fndesc.calltypes[inst]
            return self.lower_setitem(inst.target, inst.index_var, inst.value, signature)
        return super().lower_inst(inst)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Into a variable: what it held needs no release where no references are counted."""
        if self.context.enable_nrt:
            super().storevar(value, name, argidx)
            return
        self._alloca_var(name, self.typeof(name))
        if name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))


_SIGNATURES: dict[Any, Any] = {}


def _signature(context: Any, function: Any, kinds: Sequence[Any]) -> Any:
    """Of arithmetic or an element: it hangs on the types alone."""
    key = function._code, *[kind._code for kind in kinds]
    if key not in _SIGNATURES:
        _SIGNATURES[key] = context.resolve_function_type(function, tuple(kinds), {})
    return _SIGNATURES[key]


class _Remembering:
    """numba's knowledge of types, which forgets what it has found."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, kinds: Sequence[Any], named: Any) -> Any:
        """Signature of a call."""
        key = function.typing_key if isinstance(function, types.Function) else None
        is_sum = key in ARITHMETIC and all(isinstance(kind, NUMBERS) for kind in kinds)
        is_item = key in ELEMENTS and _is_plain(kinds[0]) and len(_indices(kinds[1])) > 0
        if named or not (is_sum or (is_item and all(isinstance(k, NUMBERS) for k in kinds[2:]))):
            return self._context.resolve_function_type(function, kinds, named)
        return _signature(self._context, function, kinds)


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(typed_passes.NativeLowering):  # type: ignore[misc]
    _name = "lean_lowering"

    @property
    def lowering_class(self) -> type:
        return _Lower


@register_pass(mutates_CFG=True, analysis_only=False)
class _Inference(typed_passes.NopythonTypeInference):  # type: ignore[misc]
    _name = "lean_inference"

    def run_pass(self, state: Any) -> Any:
        """Find the types with what was found before."""
        context = state.typingctx
        state.typingctx = _Remembering(context)
        try:
            return super().run_pass(state)
        finally:
            state.typingctx = context


class _Passes(PassManager):  # type: ignore[misc]
    """One pass after the other; what each was given is not written down as text."""

    def run(self, state: Any) -> None:
        """Change the state of one compilation, pass by pass."""
        for kind, _ in self.passes:
            step = _pass_registry.get(kind)
            step.pass_inst.analysis = self._analysis
            step.pass_inst.run_initialization(state)
            is_changed = step.pass_inst.run_pass(state)
            step.pass_inst.run_finalizer(state)
            if is_changed and step.mutates_CFG and not isinstance(step.pass_inst, LoweringPass):
                PostProcessor(state.func_ir).run()


class Compiler(CompilerBase):  # type: ignore[misc]
    """The compiler of kernels and their parts."""

    _passes: ClassVar[dict[bool, _Passes]] = {}

    def define_pipelines(self) -> list[Any]:
        """All of numba's passes where a function may allocate, and else those that do something."""
        is_whole = bool(self.state.flags.nrt)
        if self.state.flags.debuginfo or self.state.func_id.is_generator:
            return [DefaultPassBuilder.define_nopython_pipeline(self.state)]
        if is_whole not in self._passes:
            whole, passes = DefaultPassBuilder.define_nopython_pipeline(self.state), _Passes("lean")
            idle = set() if is_whole else set(_IDLE.split())
            passes.passes = [
                (REPLACED.get(kind, kind), what)
                for kind, what in whole.passes
                if kind.__name__ not in idle
            ]
            passes.finalize()
            self._passes[is_whole] = passes
        return [self._passes[is_whole]]


REPLACED = {typed_passes.NativeLowering: _Lowering, typed_passes.NopythonTypeInference: _Inference}


def _is_known() -> bool:
    """Whether this numba was tried, and its compiler is made of what is changed here."""
    if version_info.short not in TRIED:
        return False
    lower = lowering.Lower
    names = {*dir(lower), *lower._find_singly_assigned_variable.__code__.co_names}
    array, loop = types.Array(types.float64, 1, "C"), types.range_iter64_type
    fields = [tuple(default_manager[kind]._fields) for kind in (array, loop)]
    return names.issuperset(_NEEDED) and fields == [ARRAY, LOOP]


OPTIONS: dict[str, Any] = {"pipeline_class": Compiler} if _is_known() else {}
