/* What the look-ups in floats (rtid_map.c) and in integers (rtid_map_fixed.c) have in common.
 *
 * A part of these two files and of no other.  Each includes it once, behind the types it is for:
 *
 *     table      the map: nu, ns, status
 *     number     a signed type for flows in counts and for shares of a cell
 *     ROUNDING   by how much a wanted flow may lie beyond the map's ends
 *
 * and defines along_s behind it.
 */
#ifndef RTID_MAP_SEARCH_H
#define RTID_MAP_SEARCH_H

/* A place among the nodes of one axis: between node[cell] and node[cell + 1]. */
typedef struct {
    unsigned cell;
    number share;
    bool outside;
} place;

/* A flow that is looked for, in the sign in which flows rise with the command. */
typedef struct {
    const table *map;
    const place *s;
    number sign, count;
} wanted;

/* A cell of n nodes: it is one already, and with this line any reader sees it, a prover too. */
static unsigned inner(unsigned cell, unsigned n) { return (cell < (n - 2u)) ? cell : (n - 2u); }

/* The flow at node k of u, between two nodes of s. */
static number along_s(const table *map, unsigned k, const place *s);

static number flow_at(const wanted *q, unsigned k) { return q->sign * along_s(q->map, k, q->s); }

static int status_of(const table *map, const place *u, const place *s)
{
    const size_t at = ((size_t)u->cell * (map->ns - 1u)) + s->cell;
    unsigned found = RTID_MAP_OUTSIDE;
    if ((!u->outside) && (!s->outside)) {
        found = map->status[at] & (uint8_t)~RTID_MAP_RISING;
    }
    return (int)found;
}

/* The first node always counts as below the wanted flow, the last never.  Where flows rise there is
 * one cell between a node below and one that is not; the command lies in it. */
static unsigned bisect(const wanted *q)
{
    unsigned low = 0u, high = q->map->nu - 1u;
    while ((high - low) > 1u) {
        const unsigned middle = (low + high) / 2u;
        if (flow_at(q, middle) < q->count) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

/* The same where flows may fall: false if there are several such cells. */
static bool scan(const wanted *q, unsigned *cell)
{
    unsigned crossings = 0u;
    bool was_below = true;
    for (unsigned k = 1u; k < q->map->nu; k++) {
        const bool is_below = (k < (q->map->nu - 1u)) && (flow_at(q, k) < q->count);
        if (was_below && !is_below) {
            *cell = k - 1u;
        }
        crossings += (was_below != is_below) ? 1u : 0u;
        was_below = is_below;
    }
    return crossings == 1u;
}

/* Whether one command alone gives the flow: the cell of u in which it lies.  Else the node of u
 * that comes closest, or the shut valve's.  Turns q to the sign in which flows rise, and holds it
 * to the map's ends. */
static bool search(wanted *q, unsigned *cell)
{
    const unsigned end = q->map->nu - 1u;
    number first = flow_at(q, 0u), last = flow_at(q, end);
    if (last < first) { /* as they do where dp < 0 */
        q->sign = -1;
        q->count = -q->count;
        first = -first;
        last = -last;
    }
    *cell = (q->count > last) ? end : 0u;
    if ((q->count < (first - ROUNDING)) || (q->count > (last + ROUNDING))) {
        return false;
    }
    q->count = (q->count < first) ? first : ((q->count > last) ? last : q->count);
    if ((q->map->status[q->s->cell] & RTID_MAP_RISING) != 0u) {
        *cell = bisect(q);
        return true;
    }
    if (scan(q, cell)) {
        return true;
    }
    *cell = 0u;
    return false;
}

#endif
