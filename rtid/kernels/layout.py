"""Memory layout of the estimator's state: plain structured arrays, one object to save or copy.

The sizes are fixed, so that one compiled kernel serves every machine.  A *column* is one regressor
of the joint regression; its state is a short vector d (see `information`).  Local columns, those
that move at every sample, are ordered

    [ y | shared (theta_beta per chamber, effects) | ring | 6 terms per open block ]

An edge has one open block in the Taylor basis, up to four where windows overlap.  `ring` are unit
vectors that stand for all closed blocks, whose states decay together.
"""

from __future__ import annotations

import numpy as np

MAX_CHAMBERS = 2
MAX_EDGES = 8
MAX_BORDERS = 129
MAX_SIGNALS = 24
MAX_SHARED = 24
MAX_OPEN = 20  # five edges, four windows of the lapped basis each
TERMS = 6  # Taylor terms of one block, eq. (6)
MAX_STATE = 4  # length of a column's state: chambers (integral form), 2 x chambers (carry form)
# 1 + MAX_SHARED + MAX_OPEN * TERMS + MAX_STATE, and so much more that rows share no cache set.
MAX_LOCAL = 152
MAX_RECENT = 64  # blocks that are open or still ring

NOTHING = MAX_SIGNALS  # the column of a signal that is not there: always zero

INTEGRAL, CARRY, RESTART = 0, 1, 2  # the forms of the regression
TAYLOR, LAPPED, BLENDED, PROPORTIONAL = 0, 1, 2, 3  # the bases of a map

# counters[...]: how often a sample was refused or an estimate restarted, by reason
COUNTERS = (
    "samples",
    "rows",
    "restart_gap",
    "not_finite",
    "out_of_range",
    "outside_grid",
    "block_changes",
    "restart_memory",
    "recovering",
    "outlier",
    "reopened",
)
SAMPLES, ROWS, RESTART_GAP, NOT_FINITE = range(4)
OUT_OF_RANGE, OUTSIDE_GRID, BLOCK_CHANGES, RESTART_MEMORY = range(4, 8)
RECOVERING, OUTLIER, REOPENED = range(8, 11)

_F, _I = np.float64, np.int64

ENGINE = np.dtype(
    [
        # --- local columns, see `local`; first, and whole cache lines each ---
        ("d", _F, (MAX_STATE, MAX_LOCAL)),
        ("inc", _F, (MAX_CHAMBERS, MAX_LOCAL)),  # increments (integral) or start values (carry)
        ("end", _F, (MAX_CHAMBERS, MAX_LOCAL)),  # end values (carry)
        ("row", _F, (MAX_CHAMBERS, MAX_LOCAL)),
        ("gram", _F, (MAX_LOCAL, MAX_LOCAL)),
        # --- configuration, constant after `estimator.build` ---
        ("form", _I),
        ("n_chambers", _I),
        ("n_edges", _I),
        ("n_shared", _I),
        ("n_signals", _I),
        ("n_state", _I),
        ("x_column", _I),
        ("p_column", _I, (MAX_CHAMBERS,)),
        ("area_m2", _F, (MAX_CHAMBERS,)),  # signed: s_c A_c
        ("growth_m2", _F, (MAX_CHAMBERS,)),  # dV/dx: the same, 0 where the volume stays as it is
        ("v0_m3", _F, (MAX_CHAMBERS,)),
        ("x_var_m2", _F),
        ("p_var_pa2", _F, (MAX_CHAMBERS,)),
        ("compliance", _F, (MAX_CHAMBERS,)),  # nominal 1 / beta: weights and scale of theta_beta
        ("q_floor", _F, (MAX_CHAMBERS,)),  # least intensity of the flow noise, m6/s
        ("p_period_s", _F),  # sampling period of the pressures; 0: every sample
        ("source", _I, (MAX_EDGES,)),
        ("sink", _I, (MAX_EDGES,)),
        ("command", _I, (MAX_EDGES,)),
        ("is_sampled", _I, (MAX_EDGES,)),  # its command is a measurement: linear between samples
        ("mode_column", _I),
        ("modes", _I, (MAX_EDGES,)),  # bit m: the edge may open in mode m
        ("owner", _I, (MAX_EDGES,)),  # the edge whose map it has
        ("is_shared", _I, (MAX_EDGES,)),  # other edges have the same map
        ("map_basis", _I, (MAX_EDGES,)),
        ("masked", _I, (MAX_EDGES,)),
        ("mask", _F, (MAX_EDGES, TERMS)),  # 1 for the terms that the map has, eq. (15)
        ("direction", _F, (MAX_EDGES,)),
        ("safe_v", _F, (MAX_EDGES,)),
        ("sign", _F, (MAX_EDGES, MAX_CHAMBERS)),
        ("dp_var_pa2", _F, (MAX_EDGES,)),
        ("scale_m3s", _F, (MAX_EDGES,)),
        ("n_u", _I, (MAX_EDGES,)),
        ("n_dp", _I, (MAX_EDGES,)),
        ("first_cell", _I, (MAX_EDGES,)),
        ("u_border", _F, (MAX_EDGES, MAX_BORDERS)),
        ("dp_border", _F, (MAX_EDGES, MAX_BORDERS)),
        ("minimum", _F, (MAX_SIGNALS,)),
        ("maximum", _F, (MAX_SIGNALS,)),
        ("n_terms", _I),
        ("term_shape", _I, (MAX_SHARED,)),
        ("term_volume", _I, (MAX_SHARED,)),  # rate: -1 none, -2 of its argument alone, else chamber
        ("term_scale", _F, (MAX_SHARED,)),
        ("term_weight", _F, (MAX_SHARED, MAX_SIGNALS)),
        ("term_constant", _F, (MAX_SHARED,)),
        ("term_sign", _F, (MAX_SHARED, MAX_CHAMBERS)),
        ("term_theta", _F, (MAX_SHARED,)),  # read by `explain` alone
        ("hysteresis", _F),
        ("max_gap_s", _F),
        ("recovery_s", _F),
        ("settle_s", _F),  # until spools that were somewhere are where they are sent
        ("max_open", _I),  # blocks that can be open at once
        ("gate_sd", _F),  # innovations beyond are refused, in standard deviations; 0: none is
        ("gate_rows", _I),  # so many refused in a row: the plant has changed
        ("held_compliance", _F, (MAX_CHAMBERS,)),  # of the map held, in units of `compliance`
        ("held_terms", _F, (MAX_SHARED,)),
        ("ring_floor", _F),
        ("wn_rad_s", _F),
        ("zeta", _F),
        ("row_period_s", _F),
        ("lag_s", _F),
        ("n_cells", _I),  # sizes of the tables that follow this record in memory
        ("max_closed", _I),
        ("max_blocks", _I),
        ("max_pairs", _I),
        # --- state ---
        ("running", _I),
        ("t_s", _F),
        ("next_row_s", _F),
        ("dt_s", _F),  # step for which the filter and lag factors below hold
        ("lag_decay", _F),
        ("gauss_decay", _F, (2,)),  # of the lag, at the two Gauss points of the step
        ("ready_s", _F),  # nothing starts before
        ("gap", _F, (MAX_CHAMBERS,)),  # y less the map held: the whitener's state of the innovation
        ("gap_sd", _F, (MAX_CHAMBERS,)),  # standard deviation of the gap from the map held's own
        ("blind", _I),  # the map held does not know the open block
        ("admits_all", _I),  # the gate only judges, until another map is held
        ("refused", _I),  # innovations refused in a row
        ("break_due", _I),  # the next sample begins anew
        ("filter_a", _F, (2, 2)),
        ("filter_b", _F, (2, 2)),
        ("sample", _F, (3 + MAX_SIGNALS,)),  # the one being taken, and the values of the last
        ("values", _F, (1 + MAX_SIGNALS,)),
        ("w_v", _F, (MAX_EDGES,)),  # lagged opening command per edge
        ("cell", _I, (MAX_EDGES, 2)),  # current block of each edge; lapped: the first of its four
        ("home", _I, (MAX_EDGES, 2)),  # the block that holds the working point
        ("place", _I, (MAX_EDGES,)),  # its position among the open blocks, -1 when shut (Taylor)
        ("held_v", _F, (MAX_EDGES,)),  # opening command over the interval, and w_v at its start
        ("start_v", _F, (MAX_EDGES,)),
        ("ring", _I),  # first local column of the ring, and of the open blocks
        ("first", _I),
        ("width", _I),  # number of local columns in use, rounded up to whole vectors
        ("n_open", _I),
        ("open_edge", _I, (MAX_OPEN,)),
        ("open_slot", _I, (MAX_OPEN,)),
        ("open_cell", _I, (MAX_OPEN, 2)),
        ("open_recent", _I, (MAX_OPEN,)),  # its position among the recent blocks
        ("cov", _F, (MAX_CHAMBERS, MAX_CHAMBERS)),  # Kalman whitener: variance of the gap, m6
        ("innovation", _F, (3,)),  # S: upper triangle
        ("softness", _F, (MAX_CHAMBERS,)),  # what the rate terms store per pressure now, m3/Pa
        ("echo", _F, (MAX_CHAMBERS, 3)),  # pressure noise in the prediction of column -V dP
        ("moments", _F, (MAX_EDGES, 3)),  # of the opening command over the interval
        ("dp_pa", _F, (MAX_EDGES, 2)),  # at its start and end
        ("target", _I, (MAX_EDGES, 2)),  # the blocks that the working points are in
        ("phi", _F, (TERMS,)),
        ("phi_at", _F, (2, TERMS)),  # lapped: at the two Gauss points
        ("axis", _F, (2, 3)),
        ("ringing", _F, (MAX_STATE, TERMS * MAX_RECENT)),  # d of those that rang at the last rebase
        ("weighted", _F, (MAX_STATE, TERMS * MAX_RECENT)),
        ("left", _F, (MAX_STATE, TERMS)),
        ("own", _F, (MAX_STATE, TERMS)),
        ("basis", _F, (MAX_STATE, MAX_STATE)),
        ("ring_det", _F),  # determinant of the ring columns (carry: of one chamber)
        ("n_closed", _I),
        ("n_recent", _I),  # positions in use among the recent blocks, free ones between included
        ("n_young", _I),
        ("young", _I, (MAX_RECENT,)),  # positions of the blocks closed since, in their order
        ("n_slots", _I),
        ("n_pairs", _I),
        ("shared", _F, (1 + MAX_SHARED, 1 + MAX_SHARED)),
        ("noise_gram", _F, (MAX_CHAMBERS,)),
        ("rows", _F),  # pairs of rows in the sums
        ("counters", _I, (len(COUNTERS),)),
    ],
    align=True,
)

# One record per cell of a grid: the slot of its block (-1 before the first visit), the nominal
# dQ/ddp, which weighs the pressure noise, the variance rate of the flow that the block's terms miss
# (m6/s), and the terms of the map held (in units of the edge's scale), if it knows the block.
CELL = np.dtype(
    [("slot", _I), ("slope", _F), ("missed", _F), ("known", _I), ("held", _F, (TERMS,))],
    align=True,
)

# Shapes of a shared term's argument z, see `rtid.model.Term`.
LINEAR, ROOT, HINGE, INVERSE = range(4)
FLOW, RATE = -1, -2  # term_volume where no chamber's volume multiplies

# One record per visited block.
BLOCK = np.dtype(
    [
        ("cell", _I),
        ("edge", _I),
        ("rows", _I),
        ("dwell_s", _F),
        ("last_s", _F),
        ("phi_sum", _F, (TERMS,)),  # integral of the Taylor terms over the time spent in the block
        ("surprise", _F),  # sum of squared innovations of the map held, per chamber and row
        ("judged", _F),  # number of those innovations
        ("held_cov", _F, (TERMS, TERMS)),  # covariance of the terms of the map held
        ("gram", _F, (TERMS, TERMS)),
        ("shared", _F, (TERMS, 1 + MAX_SHARED)),  # products with y and the shared columns
    ],
    align=True,
)

# One record per pair of blocks (low < high slot) that were ever recent together; open addressing.
PAIR = np.dtype([("key", _I), ("gram", _F, (TERMS, TERMS))], align=True)

# One record per recent block, see `recent`; young: closed since the last rebase.
FREE, OPEN, YOUNG, RINGING = range(4)
CLOSED = np.dtype(
    [
        ("status", _I),
        ("slot", _I),
        ("size", _F),  # of its state when it closed
        ("d", _F, (MAX_STATE, TERMS)),  # state, referred to the ring's origin
        ("through", _F, (MAX_STATE, TERMS)),  # ring x block while it was open
        ("w_start", _F, (MAX_STATE, MAX_STATE)),  # ring x ring when it closed, less later restarts
        ("shared_start", _F, (MAX_STATE, 1 + MAX_SHARED)),  # ring x shared when it closed
        ("gram", _F, (TERMS, TERMS * MAX_RECENT)),
    ],
    align=True,
)
