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
    return map->status[(size_t)u->cell * (map->ns - 1u) + s->cell];
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

int rtid_map_command(const rtid_map *map, float q, float dp, float *u)
{
    place at_u = {0, 0.0f, 0}, at_s;
    float first, last, before, count, sign;
    unsigned k, crossings = 0;
    *u = 0.0f;
    if (map == NULL || !is_number(q) || !is_number(dp))
        return RTID_MAP_NONE;
    at_s = locate(map->s, map->ns, root(dp));
    first = along_s(map, 0, &at_s);
    last = along_s(map, map->nu - 1u, &at_s);
    sign = last >= first ? 1.0f : -1.0f; /* the flow falls with the command where dp < 0 */
    count = sign * q / map->scale;
    first *= sign;
    last *= sign;
    if (count < first - ROUNDING || count > last + ROUNDING) {
        *u = map->direction * map->u[count > last ? map->nu - 1u : 0];
        return RTID_MAP_NONE;
    }
    count = count < first ? first : count > last ? last : count;
    /* A node is below if its flow is less than wanted; the first always is, the last never. */
    for (k = 1, before = first; k < map->nu; k++) {
        const float now = sign * along_s(map, k, &at_s);
        const int was_below = k == 1 || before < count;
        const int is_below = k < map->nu - 1u && now < count;
        if (was_below && !is_below) {
            at_u.cell = k - 1;
            at_u.share = now > before ? (count - before) / (now - before) : 0.0f;
        }
        crossings += was_below != is_below;
        before = now;
    }
    if (crossings != 1) {
        *u = map->direction * map->u[0];
        return RTID_MAP_NONE;
    }
    at_u.share = at_u.share < 0.0f ? 0.0f : at_u.share > 1.0f ? 1.0f : at_u.share;
    *u = map->u[at_u.cell] + at_u.share * (map->u[at_u.cell + 1] - map->u[at_u.cell]);
    *u *= map->direction;
    return status_of(map, &at_u, &at_s);
}
