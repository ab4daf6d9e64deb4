#include "rtid_map.h"

#include <math.h>
#include <stddef.h>

/* A place among the nodes of one axis: between node[cell] and node[cell + 1]. */
typedef struct {
    unsigned cell;
    float share;
    int outside;
} place;

#define ROUNDING 0.01f /* counts by which a flow may lie beyond the map's ends */

static place locate(const float *node, unsigned n, float x)
{
    place at = {0, 0.0f, x < node[0] || x > node[n - 1]};
    unsigned left = n - 1;
    x = x < node[0] ? node[0] : x > node[n - 1] ? node[n - 1] : x;
    while (left > 1) { /* without a branch that depends on the numbers */
        const unsigned half = left / 2;
        at.cell += node[at.cell + half] <= x ? half : 0;
        left -= half;
    }
    at.share = (x - node[at.cell]) / (node[at.cell + 1] - node[at.cell]);
    return at;
}

static float root(float dp) { return dp < 0.0f ? -sqrtf(-dp) : sqrtf(dp); }

/* The flow in counts at node k of u, between two nodes of s. */
static float along_s(const rtid_map *map, unsigned k, const place *s)
{
    const int16_t *row = map->q + (size_t)k * map->ns + s->cell;
    const float left = row[0];
    return left + s->share * ((float)row[1] - left);
}

static int status_of(const rtid_map *map, const place *u, const place *s)
{
    if (u->outside || s->outside)
        return RTID_MAP_OUTSIDE;
    return map->status[(size_t)u->cell * (map->ns - 1u) + s->cell] & ~RTID_MAP_RISING;
}

static int is_number(float x) { return x - x == 0.0f; }

int rtid_map_flow(const rtid_map *map, float u, float dp, float *q)
{
    place at_u, at_s;
    float low;
    *q = 0.0f;
    if (map == NULL || !is_number(u) || !is_number(dp))
        return RTID_MAP_NONE;
    u *= map->direction;
    if (u <= map->safe)
        return RTID_MAP_SHUT;
    at_u = locate(map->u, map->nu, u);
    at_s = locate(map->s, map->ns, root(dp));
    low = along_s(map, at_u.cell, &at_s);
    *q = map->scale * (low + at_u.share * (along_s(map, at_u.cell + 1, &at_s) - low));
    return status_of(map, &at_u, &at_s);
}

int rtid_map_is_rising(const rtid_map *map, unsigned j)
{
    int rises = 1, falls = 1;
    for (unsigned k = 1; k < map->nu; k++) {
        const int16_t *before = map->q + (size_t)(k - 1) * map->ns + j, *now = before + map->ns;
        rises &= before[0] <= now[0] && before[1] <= now[1];
        falls &= before[0] >= now[0] && before[1] >= now[1];
    }
    return rises || falls;
}

/* A flow that is looked for, in counts, in the sign in which flows rise with the command. */
typedef struct {
    const rtid_map *map;
    const place *s;
    float sign, count;
} wanted;

static float flow_at(const wanted *q, unsigned k) { return q->sign * along_s(q->map, k, q->s); }

/* The first node always counts as below the wanted flow, the last never.  Where flows rise there is
 * one cell between a node below and one that is not; the command lies in it. */
static unsigned bisect(const wanted *q)
{
    unsigned low = 0, high = q->map->nu - 1u;
    while (high - low > 1) {
        const unsigned middle = (low + high) / 2;
        if (flow_at(q, middle) < q->count)
            low = middle;
        else
            high = middle;
    }
    return low;
}

/* The same where flows may fall: 0 if there are several such cells, else 1. */
static int scan(const wanted *q, unsigned *cell)
{
    unsigned crossings = 0;
    int was_below = 1;
    for (unsigned k = 1; k < q->map->nu; k++) {
        const int is_below = k < q->map->nu - 1u && flow_at(q, k) < q->count;
        if (was_below && !is_below)
            *cell = k - 1;
        crossings += was_below != is_below;
        was_below = is_below;
    }
    return crossings == 1;
}

int rtid_map_command(const rtid_map *map, float q, float dp, float *u)
{
    place at_u = {0, 0.0f, 0}, at_s;
    wanted flow = {map, &at_s, 1.0f, 0.0f};
    float first, last, low, high;
    *u = 0.0f;
    if (map == NULL || !is_number(q) || !is_number(dp))
        return RTID_MAP_NONE;
    at_s = locate(map->s, map->ns, root(dp));
    first = flow_at(&flow, 0);
    last = flow_at(&flow, map->nu - 1u);
    if (last < first) { /* as they do where dp < 0 */
        flow.sign = -1.0f;
        first = -first;
        last = -last;
    }
    flow.count = flow.sign * q / map->scale;
    if (flow.count < first - ROUNDING || flow.count > last + ROUNDING) {
        *u = map->direction * map->u[flow.count > last ? map->nu - 1u : 0];
        return RTID_MAP_NONE;
    }
    flow.count = flow.count < first ? first : flow.count > last ? last : flow.count;
    if (map->status[at_s.cell] & RTID_MAP_RISING)
        at_u.cell = bisect(&flow);
    else if (!scan(&flow, &at_u.cell)) {
        *u = map->direction * map->u[0];
        return RTID_MAP_NONE;
    }
    low = flow_at(&flow, at_u.cell);
    high = flow_at(&flow, at_u.cell + 1);
    at_u.share = high > low ? (flow.count - low) / (high - low) : 0.0f;
    at_u.share = at_u.share < 0.0f ? 0.0f : at_u.share > 1.0f ? 1.0f : at_u.share;
    *u = map->u[at_u.cell] + at_u.share * (map->u[at_u.cell + 1] - map->u[at_u.cell]);
    *u *= map->direction;
    return status_of(map, &at_u, &at_s);
}
