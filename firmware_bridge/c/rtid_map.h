/* A learned flow map in the controller: Q(u, dp), how far it can be believed, and u = Q^-1(q, dp).
 *
 * C99, no heap, no state, float32; of the library nothing but sqrtf.  Bilinear between nodes in the
 * opening command w = direction * u and in s = sign(dp) sqrt |dp|, along which an orifice is linear:
 *
 *     Q(u, dp) = scale * sum over the four corners of weight(w, s) * q[corner]
 *
 * The tables come by download (rtid_download.h) or from a header that `rtid export` writes.
 * Python's evaluator of the same table is firmware_bridge/lookup.py (tests/bridge/test_c_map.py).
 */
#ifndef RTID_MAP_H
#define RTID_MAP_H

#include <stdint.h>

/* What a flow stands on; what is larger is believed less. */
enum {
    RTID_MAP_VALID = 0,        /* on data of this place */
    RTID_MAP_SHUT = 1,         /* at or below the declared safe band: zero */
    RTID_MAP_LEARNING = 2,     /* on few data */
    RTID_MAP_EXTRAPOLATED = 3, /* on the orifice law from other places */
    RTID_MAP_PRIOR = 4,        /* on what was declared */
    RTID_MAP_OUTSIDE = 5,      /* beyond the nodes: the value at their edge */
    RTID_MAP_NONE = 6          /* no map, no number, or no single command gives this flow */
};
#define RTID_MAP_N_CELL_STATUS 5u /* those that a cell may have */
#define RTID_MAP_RISING 0x80u /* with the status of the first cells: flows only rise (or only fall)
                                with the command at both nodes of s: then Q^-1 need not look at all */

typedef struct {
    const float *u;        /* nu opening commands, rising, V */
    const float *s;        /* ns signed roots of the pressure drop, rising, sqrt(Pa) */
    const int16_t *q;      /* nu x ns flows in counts, those of u[0] first */
    const uint8_t *status; /* (nu - 1) x (ns - 1) cells, RTID_MAP_VALID, ..., and RTID_MAP_RISING */
    float scale;           /* m3/s per count */
    float safe;            /* opening command up to which nothing passes; -FLT_MAX: not declared */
    uint8_t nu, ns;        /* at least 2 */
    int8_t direction;      /* 1 or -1 */
} rtid_map;

/* The flow in m3/s at a command in V and a pressure drop in Pa; what it stands on.  q is always a
 * finite number: 0 where there is none. */
int rtid_map_flow(const rtid_map *map, float u, float dp, float *q);

/* The command for a wanted flow; what it stands on.  RTID_MAP_NONE where no command or more than
 * one gives it: u is then the shut valve's, or the end of the nodes that comes closest.  For q = 0
 * it is the safe band, the largest command that surely passes nothing. */
int rtid_map_command(const rtid_map *map, float q, float dp, float *u);

/* Whether RTID_MAP_RISING holds between nodes j and j + 1 of s. */
int rtid_map_is_rising(const rtid_map *map, unsigned j);

extern const char rtid_map_version[];

#endif
