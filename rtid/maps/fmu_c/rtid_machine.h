/* The learned machine: flows of its edges by the published map, and the pressures of its chambers.
 *
 * C99, no heap.  The numbers stand in rtid_model.h, which `rtid export` writes.
 */
#ifndef RTID_MACHINE_H
#define RTID_MACHINE_H

#include "rtid_model.h"

/* Where a variable stands in `real`, which is its value reference. */
enum {
    AT_TIME = 0,
    AT_SIGNAL = 1,                         /* signals of the model; of chambers: the state, Pa */
    AT_RATE = AT_SIGNAL + N_SIGNALS,       /* their rates over the step, per s */
    AT_BETA = AT_RATE + N_SIGNALS,         /* bulk modulus of each chamber, Pa */
    AT_LAG = AT_BETA + N_CHAMBERS,         /* s */
    AT_FLOW = AT_LAG + 1,                  /* of each edge, m3/s, with its 95 % interval */
    AT_LOW = AT_FLOW + N_EDGES,
    AT_HIGH = AT_LOW + N_EDGES,
    N_REAL = AT_HIGH + N_EDGES
};
enum { AT_STATUS = N_REAL, AT_RUN = AT_STATUS + N_EDGES, N_ALL = AT_RUN + 1 }; /* integers */
enum { INSIDE = 1, BEYOND = 2, OFF_GRID = 4, RAN_AWAY = 5 }; /* as rtid/kernels/free_run.py */

typedef struct {
    double real[N_REAL];
    int whole[N_EDGES + 1];
    double w[N_EDGES]; /* opening command behind the lag, V */
    double held[N_EDGES], begin[N_EDGES];
    double h;          /* next step of the integration, in intervals */
    int runs, is_old;  /* spools have a place; outputs are not those of the inputs */
} Machine;

void machine_reset(Machine *m);
void machine_outputs(Machine *m);
int machine_step(Machine *m, double dt); /* INSIDE, ..., RAN_AWAY */

#endif
