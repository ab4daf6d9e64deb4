#include "rtid_map_fixed.h"

#include <stddef.h>

#define ONE 65536        /* shares and counts have 16 bits behind the point */
#define ROUNDING 655     /* 0.01 counts by which a flow may lie beyond the map's ends */
#define MOST_FLOW (1 << 30)

typedef struct {
    unsigned cell;
    int64_t share; /* of ONE */
    int outside;
} place;

static place locate(const int32_t *node, unsigned n, int32_t x)
{
    place at = {0, 0, x < node[0] || x > node[n - 1]};
    unsigned left = n - 1;
    x = x < node[0] ? node[0] : x > node[n - 1] ? node[n - 1] : x;
    while (left > 1) {
        const unsigned half = left / 2;
        at.cell += node[at.cell + half] <= x ? half : 0;
        left -= half;
    }
    at.share = ((int64_t)x - node[at.cell]) * ONE / ((int64_t)node[at.cell + 1] - node[at.cell]);
    return at;
}

/* Rounded quotient by a power of two, alike for both signs. */
static int64_t shared(int64_t x, int64_t power)
{
    return (x + (x < 0 ? -power / 2 : power / 2)) / power;
}

/* sign(dp) sqrt |dp| in 64ths. */
static int32_t root(int32_t dp)
{
    const uint64_t x = (uint64_t)(dp < 0 ? -(int64_t)dp : dp) << 12;
    uint64_t found = 0, rest = x;
    for (uint64_t bit = UINT64_C(1) << 42; bit != 0; bit >>= 2) {
        if (rest >= found + bit) {
            rest -= found + bit;
            found = (found >> 1) + bit;
        } else
            found >>= 1;
    }
    return dp < 0 ? -(int32_t)found : (int32_t)found;
}

/* The flow at node k of u, between two nodes of s, in counts times ONE. */
static int64_t along_s(const rtid_map_fixed *map, unsigned k, const place *s)
{
    const int16_t *row = map->q + (size_t)k * map->ns + s->cell;
    return (int64_t)row[0] * ONE + s->share * ((int64_t)row[1] - row[0]);
}

static int status_of(const rtid_map_fixed *map, const place *u, const place *s)
{
    if (u->outside || s->outside)
        return RTID_MAP_OUTSIDE;
    return map->status[(size_t)u->cell * (map->ns - 1u) + s->cell] & ~RTID_MAP_RISING;
}

int rtid_map_fixed_flow(const rtid_map_fixed *map, int32_t u, int32_t dp, int32_t *q)
{
    place at_u, at_s;
    int64_t low, high, count;
    *q = 0;
    if (map == NULL)
        return RTID_MAP_NONE;
    u = map->direction < 0 ? (u == INT32_MIN ? INT32_MAX : -u) : u;
    if (map->safe != INT32_MIN && u <= map->safe)
        return RTID_MAP_SHUT;
    at_u = locate(map->u, map->nu, u);
    at_s = locate(map->s, map->ns, root(dp));
    low = along_s(map, at_u.cell, &at_s);
    high = along_s(map, at_u.cell + 1, &at_s);
    count = low + shared(at_u.share * (high - low), ONE);
    *q = (int32_t)shared(count * map->scale, (int64_t)ONE * ONE);
    return status_of(map, &at_u, &at_s);
}

typedef struct {
    const rtid_map_fixed *map;
    const place *s;
    int64_t sign, count;
} wanted;

static int64_t flow_at(const wanted *q, unsigned k) { return q->sign * along_s(q->map, k, q->s); }

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

int rtid_map_fixed_command(const rtid_map_fixed *map, int32_t q, int32_t dp, int32_t *u)
{
    place at_u = {0, 0, 0}, at_s;
    wanted flow = {map, &at_s, 1, 0};
    int64_t first, last, low, high, w;
    *u = 0;
    if (map == NULL || q >= MOST_FLOW || q <= -MOST_FLOW)
        return RTID_MAP_NONE;
    at_s = locate(map->s, map->ns, root(dp));
    first = flow_at(&flow, 0);
    last = flow_at(&flow, map->nu - 1u);
    if (last < first) {
        flow.sign = -1;
        first = -first;
        last = -last;
    }
    flow.count = flow.sign * q * ((int64_t)ONE * ONE) / map->scale;
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
    w = high > low ? (flow.count - low) * ONE / (high - low) : 0;
    at_u.share = w < 0 ? 0 : w > ONE ? ONE : w;
    w = (int64_t)map->u[at_u.cell + 1] - map->u[at_u.cell];
    *u = map->direction * (int32_t)(map->u[at_u.cell] + shared(at_u.share * w, ONE));
    return status_of(map, &at_u, &at_s);
}
