"""Free run of a plant: Runge-Kutta of fourth order over sub-steps, many parameter sets at once.

Each instruction of the program works on all sets (lanes) side by side, so that a Jacobian costs
little more than a single run.  A held input (zero order) enters a sub-step of length h, delayed by
T, with its exact mean

    (1/h) * integral of u(s - T) over [t, t + h]

so that the run is a continuous function of T; an input of first order is taken at the stages.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtid.kernels.jit import kernel, part
from rtid.plants.program import OPCODE

ADD, SUB, MUL, DIV, POW = (OPCODE[op] for op in ("+", "-", "*", "/", "**"))
NEGATE, SQRT, SSQRT, ABS, SIGN = (OPCODE[op] for op in ("neg", "sqrt", "ssqrt", "abs", "sign"))
POS, EXP, LOG, SIN, COS = (OPCODE[op] for op in ("pos", "exp", "log", "sin", "cos"))
TANH, MIN, MAX = (OPCODE[op] for op in ("tanh", "min", "max"))
BEYOND = 1e12  # a state that is larger has left the range of any plant


@part
def _one(op: int, x: float, y: float) -> float:  # noqa: PLR0911
    """The operations that are seldom worth a loop of their own."""
    if op == POW:
        return x**y
    if op == SQRT:
        return np.sqrt(x)
    if op == SIGN:
        return np.sign(x)
    if op == EXP:
        return np.exp(x)
    if op == LOG:
        return np.log(x)
    if op == SIN:
        return np.sin(x)
    if op == COS:
        return np.cos(x)
    if op == TANH:
        return np.tanh(x)
    return np.hypot(x, y)


@part
def _execute(code: Any, r: Any) -> None:  # noqa: PLR0912
    """Carry out instructions (m, 4) on registers r (registers, lanes)."""
    lanes = range(r.shape[1])
    for k in range(len(code)):
        op, z, a, b = code[k, 0], code[k, 1], code[k, 2], code[k, 3]
        if op == ADD:
            for j in lanes:
                r[z, j] = r[a, j] + r[b, j]
        elif op == SUB:
            for j in lanes:
                r[z, j] = r[a, j] - r[b, j]
        elif op == MUL:
            for j in lanes:
                r[z, j] = r[a, j] * r[b, j]
        elif op == DIV:
            for j in lanes:
                r[z, j] = r[a, j] / r[b, j]
        elif op == NEGATE:
            for j in lanes:
                r[z, j] = -r[a, j]
        elif op == SSQRT:
            for j in lanes:
                r[z, j] = np.copysign(np.sqrt(abs(r[a, j])), r[a, j])
        elif op == ABS:
            for j in lanes:
                r[z, j] = abs(r[a, j])
        elif op == POS:
            for j in lanes:
                r[z, j] = max(r[a, j], 0.0)
        elif op == MIN:
            for j in lanes:
                r[z, j] = min(r[a, j], r[b, j])
        elif op == MAX:
            for j in lanes:
                r[z, j] = max(r[a, j], r[b, j])
        else:
            for j in lanes:
                r[z, j] = _one(op, r[a, j], r[b, j])


@part
def _found(t: Any, at: float, k: int) -> int:
    """Interval of t that holds the instant `at`, from the last one k; -1 before the first."""
    while k + 1 < len(t) and t[k + 1] <= at:
        k += 1
    while k >= 0 and t[k] > at:
        k -= 1
    return k


@part
def _volume(t: Any, u: Any, total: Any, i: int, at: float, k: int) -> float:
    """Integral of the held input i up to the instant, which is in interval k."""
    if k < 0:
        return u[0, i] * (at - t[0])
    return total[k, i] + u[k, i] * (at - t[k])


@part
def _linear(t: Any, u: Any, i: int, at: float, k: int) -> float:
    """Value of the input i at the instant in interval k, linear between samples."""
    if k < 0:
        return u[0, i]
    if k + 1 == len(t):
        return u[k, i]
    share = (at - t[k]) / (t[k + 1] - t[k])
    return u[k, i] + share * (u[k + 1, i] - u[k, i])


@part
def _late(
    t: Any,
    u: Any,
    total: Any,
    first_order: Any,
    delay: Any,
    at: Any,
    start: float,
    h: float,
    w: Any,
) -> None:
    """Delayed inputs w (3, inputs, lanes) at begin, middle and end of [start, start + h]."""
    for i in range(u.shape[1]):
        for j in range(delay.shape[1]):
            begin = start - delay[i, j]
            k = _found(t, begin, at[i, j])
            at[i, j] = k
            if first_order[i]:
                w[0, i, j] = _linear(t, u, i, begin, k)
                middle, end = begin + 0.5 * h, begin + h
                w[1, i, j] = _linear(t, u, i, middle, _found(t, middle, k))
                w[2, i, j] = _linear(t, u, i, end, _found(t, end, k))
                continue
            before = _volume(t, u, total, i, begin, k)
            end = begin + h
            after = _volume(t, u, total, i, end, _found(t, end, k))
            w[0, i, j] = w[1, i, j] = w[2, i, j] = (after - before) / h


@part
def _in_time(u: Any, first_order: Any, k: int, share: float, h: float, w: Any) -> None:
    """The same without delay: from `share` of the interval k on, over a share h of it."""
    for stage in range(3):
        along = share + 0.5 * stage * h
        for i in range(u.shape[1]):
            for j in range(w.shape[2]):
                here = u[k, i]
                w[stage, i, j] = here
                if first_order[i]:
                    w[stage, i, j] = here + along * (u[k + 1, i] - here)


@part
def _step(code: Any, rates: Any, r: Any, x: Any, w: Any, moves: bool, h: float, slope: Any) -> None:
    """One step of Runge-Kutta; x (states, lanes) is moved on.

    The inputs w are taken where one moves within a sample: else they stand in the registers r.
    """
    n, lanes = x.shape
    for stage in range(4):
        reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        for s in range(n):
            for j in range(lanes):
                r[s, j] = x[s, j] + (reach * slope[stage - 1, s, j] if stage else 0.0)
        if moves:
            for i in range(w.shape[1]):
                for j in range(lanes):
                    r[n + i, j] = w[(stage + 1) // 2, i, j]
        _execute(code, r)
        for s in range(n):
            for j in range(lanes):
                slope[stage, s, j] = r[rates[s], j]
    for s in range(n):
        for j in range(lanes):
            middle = slope[1, s, j] + slope[2, s, j]
            x[s, j] += h / 6.0 * (slope[0, s, j] + 2.0 * middle + slope[3, s, j])


@kernel
def free_run(
    rate_code: Any,
    rates: Any,
    output_code: Any,
    outputs: Any,
    r: Any,
    x: Any,
    t: Any,
    u: Any,
    total: Any,
    first_order: Any,
    delay: Any,
    step_s: float,
    y: Any,
    states: Any,
) -> None:
    """Outputs y (n, outputs, lanes) and states (n, states, lanes) from the states x at t[0].

    r: registers with parameters and numbers in place; u (n, inputs), total: its
    integral; delay (inputs, lanes).  Steps are at most step_s long.  A run that leaves every range
    is NaN from there on.
    """
    n_states, lanes = x.shape
    n_inputs = u.shape[1]
    w = np.zeros((3, n_inputs, lanes))
    at = np.zeros((n_inputs, lanes), np.int64)
    late = np.any(delay > 0.0)
    moves = late or np.any(first_order > 0.0)
    slope = np.empty((4, n_states, lanes))
    for k in range(len(t)):
        for i in range(n_inputs):
            for j in range(lanes):  # at a sample a held input is what acts from here on
                r[n_states + i, j] = u[k, i]
        for s in range(n_states):
            for j in range(lanes):
                r[s, j] = states[k, s, j] = x[s, j]
        _execute(output_code, r)
        for o in range(len(outputs)):
            for j in range(lanes):
                y[k, o, j] = r[outputs[o], j]
        if k + 1 == len(t):
            break
        sub_steps = max(1, int(np.ceil((t[k + 1] - t[k]) / step_s - 1e-6)))
        h = (t[k + 1] - t[k]) / sub_steps
        for m in range(sub_steps):
            if late:
                _late(t, u, total, first_order, delay, at, t[k] + m * h, h, w)
            elif moves:
                _in_time(u, first_order, k, m / sub_steps, 1.0 / sub_steps, w)
            _step(rate_code, rates, r, x, w, moves, h, slope)
        for s in range(n_states):
            for j in range(lanes):
                if not abs(x[s, j]) < BEYOND:
                    x[s, j] = np.nan


@kernel
def play(z: Any, width: Any, moved: Any) -> None:
    """Behind a gap: moved (n,) follows z (n,) with a gap of the full width."""
    last = z[0]
    for k in range(len(z)):
        last = min(max(last, z[k] - 0.5 * width), z[k] + 0.5 * width)
        moved[k] = last
