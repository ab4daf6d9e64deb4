"""From the held command to the spools: play, a sticking pilot, dead time, lag, a fastest rate.

play     w = mean of 8 plays of widths 0.65 to 1.35 times the stated full width: rounded corners
pilot    holds its place until the command is `stick_v` away, then follows until it rests
delay    w(t) = u(t - d), exact also between samples
spool    w'' + 2 zeta wn w' + wn^2 (w - u) = 0, exact for a held u; without wn: first order
limit    w' = clip((u - w) / tau, -r, r), exact for a held u
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled

PLAYS = 8
PLAY_SPREAD = 0.35
PILOT_REST_V = 0.01  # per sample: slower than 10 V/s, the pilot sticks
PILOT_LAG = 0.1  # of the rate it feels, per sample
EDGE_SPEED = (0.97, 1.03, 1.0, 0.98, 1.02)  # natural frequencies of the five spools of one type
RATE_SPREAD = 1.0 / 3.0  # of that of the frequencies, by which their fastest rates are apart


@compiled
def play(u_v: float, width_v: float, plays: FloatArray) -> float:
    """Command behind the play, V; plays (PLAYS,) are moved in place."""
    total = 0.0
    for j in range(PLAYS):
        share = 1.0 + PLAY_SPREAD * (2.0 * j / (PLAYS - 1.0) - 1.0)
        half = 0.5 * share * width_v
        plays[j] = min(max(plays[j], u_v - half), u_v + half)
        total += plays[j]
    return total / PLAYS


@compiled
def sticking_pilot(u_v: float, stick_v: float, pilot: FloatArray) -> float:
    """Command behind the pilot, V; pilot (3,) = place, felt rate, 1 while free, in place."""
    pilot[1] += PILOT_LAG * (abs(u_v - pilot[0]) - pilot[1])
    if abs(u_v - pilot[0]) > stick_v:
        pilot[2] = 1.0
    elif pilot[1] < PILOT_REST_V:
        pilot[2] = 0.0
    if pilot[2] == 1.0:
        pilot[0] = u_v
    return pilot[0]


@compiled
def propagator(wn_radps: float, damping: float, h_s: float, p: FloatArray) -> None:
    """Fill p (4,) = (ww, wr, rw, rr) in place: deviation w - u and rate after h_s.

    The exact exponential of [[0, 1], [-wn^2, -2 zeta wn]] for any damping > 0.
    """
    decay = math.exp(-damping * wn_radps * h_s)
    split = damping * damping - 1.0
    s = wn_radps * math.sqrt(abs(split))
    if s * h_s < 1e-6:
        even, odd = 1.0, h_s
    elif split > 0.0:
        even, odd = math.cosh(s * h_s), math.sinh(s * h_s) / s
    else:
        even, odd = math.cos(s * h_s), math.sin(s * h_s) / s
    drag = damping * wn_radps * odd
    p[0], p[1] = decay * (even + drag), decay * odd
    p[2], p[3] = -decay * wn_radps * wn_radps * odd, decay * (even - drag)


@compiled
def spool_table(e: Any, lag_s: float, h_s: float, table: FloatArray) -> None:
    """Fill table (5, 4) in place with the propagators of the five spools over h_s."""
    table[:] = 0.0
    for edge in range(5):
        if e.whole.spool_radps > 0.0:
            propagator(
                e.whole.spool_radps * EDGE_SPEED[edge], e.whole.spool_damping, h_s, table[edge]
            )
        elif e.whole.spool_lag_s > 0.0 and lag_s > 0.0:
            wn = 1.0 / math.sqrt(lag_s * e.whole.spool_lag_s)
            propagator(wn, 0.5 * wn * (lag_s + e.whole.spool_lag_s), h_s, table[edge])
        elif lag_s + e.whole.spool_lag_s > 0.0:
            table[edge, 0] = math.exp(-h_s / (lag_s + e.whole.spool_lag_s))


@compiled
def move_spools(commands: FloatArray, table: FloatArray, w: FloatArray, rate: FloatArray) -> None:
    """Let the spools w (5,), V, with their rates (5,) go towards held commands (5,), in place."""
    for edge in range(5):
        off, r, p = w[edge] - commands[edge], rate[edge], table[edge]
        w[edge] = commands[edge] + p[0] * off + p[1] * r
        rate[edge] = p[2] * off + p[3] * r


@compiled
def limit_spools(
    most_vps: float, lag_s: float, commands: FloatArray, h_s: float, w: FloatArray
) -> None:
    """Let the spools w (5,), V, go towards held commands (5,) at no more than a rate, in place."""
    for edge in range(5):
        rate = most_vps * (1.0 + RATE_SPREAD * (EDGE_SPEED[edge] - 1.0))
        way = commands[edge] - w[edge]
        straight = min(h_s, max(abs(way) - rate * lag_s, 0.0) / rate)
        left = way - math.copysign(rate * straight, way)
        if straight < h_s:
            left *= math.exp((straight - h_s) / lag_s) if lag_s > 0.0 else 0.0
        w[edge] = commands[edge] - left


@compiled
def follow(
    e: Any,
    lag_s: float,
    commands: FloatArray,
    h_s: float,
    table: FloatArray,
    w: FloatArray,
    rate: FloatArray,
) -> None:
    """Let the spools go towards held commands (5,) over h_s, in place; table: of h_s."""
    if e.whole.spool_rate_vps > 0.0:
        limit_spools(e.whole.spool_rate_vps, lag_s, commands, h_s, w)
    else:
        move_spools(commands, table, w, rate)


@compiled
def travel(
    e: Any,
    lag_s: float,
    before: FloatArray,
    after: FloatArray,
    until_s: float,
    h_s: float,
    table: FloatArray,
    w: FloatArray,
    rate: FloatArray,
) -> None:
    """Move the spools w (5,), V, over h_s; the first until_s > 0 see the commands `before` (5,)."""
    if until_s >= h_s:
        follow(e, lag_s, before, h_s, table, w, rate)
    else:
        part = np.empty((5, 4))
        spool_table(e, lag_s, until_s, part)
        follow(e, lag_s, before, until_s, part, w, rate)
        spool_table(e, lag_s, h_s - until_s, part)
        follow(e, lag_s, after, h_s - until_s, part, w, rate)


@compiled
def acting(pilot_v: FloatArray, i: int, late: int) -> float:
    """Pilot command of pilot_v (n,) given `late` samples before sample i, or the first."""
    return pilot_v[max(i - late, 0)]
