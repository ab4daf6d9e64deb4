#include "rtid_map_fixed.h"
#include "rtid_version.h"

#include <stdbool.h>
#include <stddef.h>

#define ONE 65536 /* shares and counts have 16 bits behind the point */
#define MOST_FLOW 0x40000000

const char rtid_map_fixed_version[] = "rtid_map_fixed " RTID_C_VERSION;

/* MISRA 5.6: rtid_map_search.h, a part of each of the two look-ups, is for these types */
typedef rtid_map_fixed table;
typedef int64_t number;
#define ROUNDING 655 /* 0.01 counts */
#include "rtid_map_search.h"

static place locate(const int32_t *node, unsigned n, int32_t x)
{
    place at = {0u, 0, (x < node[0]) || (x > node[n - 1u])};
    unsigned left = n - 1u;
    int64_t width;
    const int32_t within = (x < node[0]) ? node[0] : ((x > node[n - 1u]) ? node[n - 1u] : x);
    while (left > 1u) {
        const unsigned half = left / 2u;
        at.cell += (node[at.cell + half] <= within) ? half : 0u;
        left -= half;
    }
    at.cell = inner(at.cell, n);
    width = (int64_t)node[at.cell + 1u] - node[at.cell];
    at.share = (((int64_t)within - node[at.cell]) * ONE) / width;
    return at;
}

/* Rounded quotient by a power of two, alike for both signs. */
static int64_t shared(int64_t x, int64_t power)
{
    return (x + ((x < 0) ? (-power / 2) : (power / 2))) / power;
}

/* sign(dp) sqrt |dp| in 64ths. */
static int32_t root(int32_t dp)
{
    const int64_t size = (dp < 0) ? -(int64_t)dp : (int64_t)dp;
    uint64_t found = 0u, rest = (uint64_t)size << 12;
    for (uint64_t bit = UINT64_C(1) << 42; bit != 0u; bit >>= 2) {
        if (rest >= (found + bit)) {
            rest -= found + bit;
            found = (found >> 1) + bit;
        } else {
            found >>= 1;
        }
    }
    found &= 0x3FFFFFu; /* the root of 2^43 has 22 bits */
    return (dp < 0) ? -(int32_t)found : (int32_t)found;
}

/* In counts times ONE. */
static int64_t along_s(const table *map, unsigned k, const place *s)
{
    const int16_t *row = &map->q[((size_t)k * map->ns) + s->cell];
    return ((int64_t)row[0] * ONE) + (s->share * ((int64_t)row[1] - row[0]));
}

int rtid_map_fixed_flow(const rtid_map_fixed *map, int32_t u, int32_t dp, int32_t *q)
{
    place at_u, at_s;
    int64_t low, high, count;
    int32_t opening;
    *q = 0;
    if (map == NULL) {
        return RTID_MAP_NONE;
    }
    opening = u;
    if (map->direction < 0) {
        opening = (u == INT32_MIN) ? INT32_MAX : -u;
    }
    if ((map->safe != INT32_MIN) && (opening <= map->safe)) {
        return RTID_MAP_SHUT;
    }
    at_u = locate(map->u, map->nu, opening);
    at_s = locate(map->s, map->ns, root(dp));
    low = along_s(map, at_u.cell, &at_s);
    high = along_s(map, at_u.cell + 1u, &at_s);
    count = low + shared(at_u.share * (high - low), ONE);
    *q = (int32_t)shared(count * map->scale, (int64_t)ONE * ONE);
    return status_of(map, &at_u, &at_s);
}

int rtid_map_fixed_command(const rtid_map_fixed *map, int32_t q, int32_t dp, int32_t *u)
{
    place at_u = {0u, 0, false}, at_s;
    wanted flow = {map, &at_s, 1, 0};
    int64_t low, high, w;
    *u = 0;
    if ((map == NULL) || (q >= MOST_FLOW) || (q <= -MOST_FLOW)) {
        return RTID_MAP_NONE;
    }
    at_s = locate(map->s, map->ns, root(dp));
    flow.count = (q * ((int64_t)ONE * ONE)) / map->scale;
    if (!search(&flow, &at_u.cell)) {
        *u = map->direction * map->u[at_u.cell];
        return RTID_MAP_NONE;
    }
    at_u.cell = inner(at_u.cell, map->nu);
    low = flow_at(&flow, at_u.cell);
    high = flow_at(&flow, at_u.cell + 1u);
    w = (high > low) ? (((flow.count - low) * ONE) / (high - low)) : 0;
    at_u.share = (w < 0) ? 0 : ((w > ONE) ? ONE : w);
    w = (int64_t)map->u[at_u.cell + 1u] - map->u[at_u.cell];
    *u = map->direction * (int32_t)(map->u[at_u.cell] + shared(at_u.share * w, ONE));
    return status_of(map, &at_u, &at_s);
}
