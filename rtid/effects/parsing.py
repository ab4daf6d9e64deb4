"""From text to the tree of an expression: a whitelist over Python's own grammar, nothing is run.

Python's `ast` only reads the text.  Numbers, known names, + - * / **, signs, brackets and calls of
the functions of `rtid.effects.tree` become a tree; everything else is refused with its place.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Collection
from typing import NoReturn

from rtid.effects.tree import FUNCTIONS, NAME, NEG, NUMBER, Node
from rtid.errors import RtidError
from rtid.units import nearest

MOST_CHARACTERS = 1000
MOST_DEPTH = 100
MOST_POWER = 8.0
CONSTANTS = {"pi": math.pi}
_BINARY: dict[type[ast.operator], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.Pow: "**",
}
_ALLOWED = "numbers, names, + - * / **, brackets and " + ", ".join(FUNCTIONS)


class ExpressionError(RtidError):
    """An expression that cannot be used: `reason`, and `column` (from 0) of the place in `text`."""

    exit_code = 2

    def __init__(self, text: str, column: int, reason: str, remedy: str) -> None:
        self.text, self.column, self.reason = text, column, reason
        super().__init__(f"{reason}\n  {text}\n  {' ' * column}^", remedy)

    @property
    def in_one_line(self) -> str:
        """Reason and place without the caret."""
        shown = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return f"{self.reason} (column {self.column + 1} of {shown!r})"


def parse(text: str, names: Collection[str] | None) -> tuple[str, Node]:
    """The text in one line and its tree; None allows any name.  ExpressionError says why not."""
    text = _one_line(text)
    return text, _Reader(text, names).node(_python_tree(text))


def _one_line(text: str) -> str:
    if len(text) > MOST_CHARACTERS:
        reason = f"the expression is longer than {MOST_CHARACTERS} characters"
        raise ExpressionError(text[:60] + "...", 0, reason, "split it into several effects")
    text = "".join(" " if c in "\r\n\t" else c for c in text).strip()
    if not text:
        raise ExpressionError("", 0, "the expression is empty", 'write e.g. "p_a - p_b"')
    for column, c in enumerate(text):
        if c == "#" or not c.isascii() or not c.isprintable():
            raise ExpressionError(text, column, f"{c!r} cannot be used here", f"use {_ALLOWED}")
    return text


def _python_tree(text: str) -> ast.expr:
    try:
        with warnings.catch_warnings(action="ignore"):  # Python's doubts about a style, e.g. 1if
            tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        column = min(max((error.offset or 1) - 1, 0), len(text))
        reason = f"not an expression: {error.msg}"
        raise ExpressionError(text, column, reason, f"use {_ALLOWED}") from None
    except (MemoryError, RecursionError, ValueError):
        raise ExpressionError(text, 0, "the expression is nested too deeply", "simplify") from None
    _refuse_depth(text, tree)
    return tree


def _refuse_depth(text: str, tree: ast.expr) -> None:
    level: list[ast.AST] = [tree]
    for _ in range(MOST_DEPTH):
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if not level:
            return
    reason = f"the expression is nested more than {MOST_DEPTH} deep"
    raise ExpressionError(text, 0, reason, "simplify it, or use brackets to balance a long sum")


class _Reader:
    """Turns Python's nodes into ours, refusing what is not on the list."""

    def __init__(self, text: str, names: Collection[str] | None) -> None:
        self.text, self.names = text, names

    def refuse(self, at: ast.expr, reason: str, remedy: str) -> NoReturn:
        raise ExpressionError(self.text, at.col_offset, reason, remedy)

    def node(self, tree: ast.expr) -> Node:
        if isinstance(tree, ast.Constant):
            return self._number(tree)
        if isinstance(tree, ast.Name):
            return self._name(tree)
        if isinstance(tree, ast.UnaryOp):
            return self._signed(tree)
        if isinstance(tree, ast.BinOp):
            return self._operator(tree)
        if isinstance(tree, ast.Call):
            return self._call(tree)
        what = type(tree).__name__
        self.refuse(tree, f"{what} is not allowed in an expression", f"use {_ALLOWED}")

    def _number(self, constant: ast.Constant) -> Node:
        value = constant.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(constant, f"{value!r} is not a number", "write a plain number")
        try:
            size = float(value)
        except OverflowError:
            size = math.inf
        if math.isinf(size):
            self.refuse(constant, "the number is too large", "write it as e.g. 1.5e6")
        return Node(NUMBER, value=size, column=constant.col_offset)

    def _name(self, tree: ast.Name) -> Node:
        name = tree.id
        if self.names is None or name in self.names:
            return Node(NAME, name=name, column=tree.col_offset)
        if name in CONSTANTS:
            return Node(NUMBER, value=CONSTANTS[name], column=tree.col_offset)
        if name in FUNCTIONS:
            self.refuse(tree, f"{name!r} is a function", f"write {name}(...)")
        self.refuse(tree, f"{name!r} is no known name", nearest(name, list(self.names)))

    def _signed(self, operation: ast.UnaryOp) -> Node:
        if isinstance(operation.op, ast.UAdd):
            return self.node(operation.operand)
        if isinstance(operation.op, ast.USub):
            return Node(NEG, (self.node(operation.operand),), column=operation.col_offset)
        self.refuse(operation, "only + and - may stand before a value", f"use {_ALLOWED}")

    def _operator(self, operation: ast.BinOp) -> Node:
        op = _BINARY.get(type(operation.op))
        if op is None:
            if isinstance(operation.op, ast.BitXor):
                self.refuse(operation, "^ is no operator here", "write a power as **")
            what = type(operation.op).__name__
            self.refuse(operation, f"the operator {what} is not allowed", f"use {_ALLOWED}")
        left, right = self.node(operation.left), self.node(operation.right)
        if op == "**":
            self._limit_power(operation.right, right)
        return Node(op, (left, right), column=operation.col_offset)

    def _limit_power(self, tree: ast.expr, power: Node) -> None:
        size = power.args[0] if power.op == NEG else power
        if size.op == NUMBER and size.value > MOST_POWER:
            reason = f"a power beyond {MOST_POWER:g} is not allowed"
            self.refuse(tree, reason, "use exp, or a smaller power")

    def _call(self, call: ast.Call) -> Node:
        if not isinstance(call.func, ast.Name):
            self.refuse(call, "only a function by its name can be called", f"use {_ALLOWED}")
        name = call.func.id
        if name not in FUNCTIONS:
            near = nearest(name, list(FUNCTIONS))
            self.refuse(call, f"{name!r} is no known function", near)
        if call.keywords or any(isinstance(arg, ast.Starred) for arg in call.args):
            self.refuse(call, f"{name} takes plain arguments only", f"write {name}(z)")
        return self._applied(call, name)

    def _applied(self, call: ast.Call, name: str) -> Node:
        """The call with its number of arguments checked; min and max take two or more."""
        wanted = FUNCTIONS[name][0]
        least_or_exact = len(call.args) == wanted
        if name in ("min", "max"):
            least_or_exact = len(call.args) >= wanted
        if not least_or_exact:
            reason = f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {len(call.args)}"
            self.refuse(call, reason, "count the commas")
        args = [self.node(arg) for arg in call.args]
        return _balanced(name, args, call.col_offset)


def _balanced(name: str, args: list[Node], column: int) -> Node:
    """The function over its arguments; min and max of many become a tree of pairs, not a chain.

    A chain of 400 would be 400 deep, and everything that walks a tree calls itself per level.
    """
    while len(args) > max(FUNCTIONS[name][0], 1):
        pairs = [args[k : k + 2] for k in range(0, len(args), 2)]
        args = [Node(name, tuple(p), column=column) if len(p) == 2 else p[0] for p in pairs]
    return Node(name, tuple(args), column=column)
