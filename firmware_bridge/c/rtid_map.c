#include "rtid_map.h"

#include <math.h>
#include <stddef.h>

typedef rtid_map table;
typedef float number;
#define ROUNDING 0.01f /* counts */
#include "rtid_map_search.h"

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

static float along_s(const table *map, unsigned k, const place *s)
{
    const int16_t *row = map->q + (size_t)k * map->ns + s->cell;
    const float left = row[0];
    return left + s->share * ((float)row[1] - left);
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

int rtid_map_command(const rtid_map *map, float q, float dp, float *u)
{
    place at_u = {0, 0.0f, 0}, at_s;
    wanted flow = {map, &at_s, 1.0f, 0.0f};
    float low, high;
    *u = 0.0f;
    if (map == NULL || !is_number(q) || !is_number(dp))
        return RTID_MAP_NONE;
    at_s = locate(map->s, map->ns, root(dp));
    flow.count = q / map->scale;
    if (!search(&flow, &at_u.cell)) {
        *u = map->direction * map->u[at_u.cell];
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
