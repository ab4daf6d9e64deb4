"""From the equations of a plant to a list of instructions that one compiled kernel carries out.

Registers: states, inputs as recorded, parameters, numbers, then results.  What occurs twice is
computed once.  Nothing is compiled per plant: a diagnosis tries dozens of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rtid.effects.tree import FUNCTIONS, NAME, NEG, NUMBER, OPERATORS, Node, substituted
from rtid.plain import FloatArray, IntArray
from rtid.plants.plant import Plant

OPCODE = {name: k for k, name in enumerate([*OPERATORS, *FUNCTIONS])}


@dataclass(frozen=True)
class Program:
    """Instructions (m, 4): operation, target, first and second argument, for rates and outputs.

    rates, outputs: registers of the results; numbers: constants and their first register.
    """

    rate_code: IntArray
    rates: IntArray
    output_code: IntArray
    outputs: IntArray
    numbers: FloatArray
    first_number: int
    registers: int


class _Writer:
    """Gives every distinct tree a register."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = {name: k for k, name in enumerate(names)}
        self.numbers: dict[float, int] = {}
        self.code: list[tuple[int, int, int, int]] = []
        self.known: dict[Node, int] = {}

    def forget(self) -> None:
        """Begin a new list; results of the last one are not kept."""
        self.code, self.known = [], {}

    def register(self, node: Node) -> int:
        """Register of the tree's value; -1 - k for number k, whose place is not known yet."""
        if node.op == NUMBER:
            return -1 - self.numbers.setdefault(node.value, len(self.numbers))
        if node.op == NAME:
            return self.names[node.name]
        if node not in self.known:
            self.known[node] = self._result(node)
        return self.known[node]

    def _result(self, node: Node) -> int:
        exponent = node.args[1] if node.op == "**" else None
        if exponent is not None and exponent.op == NUMBER and exponent.value in (2.0, 3.0, 4.0):
            base = self.register(node.args[0])
            product = self._emit("*", base, base)
            for _ in range(int(exponent.value) - 2):
                product = self._emit("*", product, base)
            return product
        args = [self.register(arg) for arg in node.args]
        return self._emit(node.op, args[0], args[-1])

    def _emit(self, op: str, first: int, second: int) -> int:
        target = RESULTS + len(self.code)
        self.code.append((OPCODE[op], target, first, second))
        return target


RESULTS = 1 << 20  # registers of results until the number of constants is known


def compiled(plant: Plant) -> Program:
    """The instructions of a plant's equations."""
    names = [*(s.name for s in plant.states), *(i.name for i in plant.inputs)]
    names += [p.name for p in plant.parameters]
    acts = {i.name: i.acts for i in plant.inputs}
    writer = _Writer(names)
    # a state that an effect has added looks at the input as it is recorded, or at what acts
    rates = [writer.register(_seen(s.rate, s.follows, acts)) for s in plant.states]
    rate_code = writer.code
    writer.forget()
    outputs = [writer.register(substituted(o.value, acts)) for o in plant.outputs]
    first = len(names)
    last = first + len(writer.numbers)

    def placed(register: int) -> int:
        if register < 0:
            return first - 1 - register
        return last + register - RESULTS if register >= RESULTS else register

    def array(code: list[tuple[int, int, int, int]]) -> IntArray:
        rows = [(op, *(placed(r) for r in registers)) for op, *registers in code]
        return np.array(rows, np.int64).reshape(-1, 4)

    return Program(
        array(rate_code),
        np.array([placed(r) for r in rates], np.int64),
        array(writer.code),
        np.array([placed(r) for r in outputs], np.int64),
        np.array(list(writer.numbers), np.float64),
        first,
        last + max(len(rate_code), len(writer.code)),
    )


def _seen(rate: Node, follows: str, acts: dict[str, Node]) -> Node:
    return rate if follows else substituted(rate, acts)


assert NEG in OPCODE
