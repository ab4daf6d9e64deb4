#include "rtid_map.h"
#include "rtid_version.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

const char rtid_map_version[] = "rtid_map " RTID_C_VERSION;

/* MISRA 5.6: rtid_map_search.h, a part of each of the two look-ups, is for these types */
typedef rtid_map table;
typedef float number;
#define ROUNDING 0.01f /* counts */
#include "rtid_map_search.h"

static place locate(const float *node, unsigned n, float x)
{
    place at = {0u, 0.0f, (x < node[0]) || (x > node[n - 1u])};
    unsigned left = n - 1u;
    const float within = (x < node[0]) ? node[0] : ((x > node[n - 1u]) ? node[n - 1u] : x);
    while (left > 1u) { /* without a branch that depends on the numbers */
        const unsigned half = left / 2u;
        at.cell += (node[at.cell + half] <= within) ? half : 0u;
        left -= half;
    }
    at.cell = inner(at.cell, n);
    at.share = (within - node[at.cell]) / (node[at.cell + 1u] - node[at.cell]);
    return at;
}

static float root(float dp) { return dp < 0.0f ? -sqrtf(-dp) : sqrtf(dp); }

static float along_s(const table *map, unsigned k, const place *s)
{
    const int16_t *row = &map->q[((size_t)k * map->ns) + s->cell];
    const float left = row[0];
    return left + (s->share * ((float)row[1] - left));
}

static bool is_number(float x) { return (x - x) == 0.0f; }

int rtid_map_flow(const rtid_map *map, float u, float dp, float *q)
{
    place at_u, at_s;
    float low, high, opening;
    *q = 0.0f;
    if ((map == NULL) || !is_number(u) || !is_number(dp)) {
        return RTID_MAP_NONE;
    }
    opening = (float)map->direction * u;
    if (opening <= map->safe) {
        return RTID_MAP_SHUT;
    }
    at_u = locate(map->u, map->nu, opening);
    at_s = locate(map->s, map->ns, root(dp));
    low = along_s(map, at_u.cell, &at_s);
    high = along_s(map, at_u.cell + 1u, &at_s);
    *q = map->scale * (low + (at_u.share * (high - low)));
    return status_of(map, &at_u, &at_s);
}

int rtid_map_is_rising(const rtid_map *map, unsigned j)
{
    bool rises = true, falls = true;
    for (unsigned k = 1u; k < map->nu; k++) {
        const int16_t *before = &map->q[(((size_t)k - 1u) * map->ns) + j], *now = &before[map->ns];
        rises = rises && (before[0] <= now[0]) && (before[1] <= now[1]);
        falls = falls && (before[0] >= now[0]) && (before[1] >= now[1]);
    }
    return (rises || falls) ? 1 : 0;
}

int rtid_map_command(const rtid_map *map, float q, float dp, float *u)
{
    place at_u = {0u, 0.0f, false}, at_s;
    wanted flow = {map, &at_s, 1.0f, 0.0f};
    float low, high, width;
    *u = 0.0f;
    if ((map == NULL) || !is_number(q) || !is_number(dp)) {
        return RTID_MAP_NONE;
    }
    at_s = locate(map->s, map->ns, root(dp));
    flow.count = q / map->scale;
    if (!search(&flow, &at_u.cell)) {
        *u = (float)map->direction * map->u[at_u.cell];
        return RTID_MAP_NONE;
    }
    at_u.cell = inner(at_u.cell, map->nu);
    low = flow_at(&flow, at_u.cell);
    high = flow_at(&flow, at_u.cell + 1u);
    at_u.share = (high > low) ? ((flow.count - low) / (high - low)) : 0.0f;
    at_u.share = (at_u.share < 0.0f) ? 0.0f : ((at_u.share > 1.0f) ? 1.0f : at_u.share);
    width = map->u[at_u.cell + 1u] - map->u[at_u.cell];
    *u = (float)map->direction * (map->u[at_u.cell] + (at_u.share * width));
    return status_of(map, &at_u, &at_s);
}
