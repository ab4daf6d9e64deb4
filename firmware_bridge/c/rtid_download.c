#include "rtid_download.h"
#include "rtid_crc8.h"
#include "rtid_version.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#define CHUNK 6u
#define RUNNING 8u
#define ALL_BEGUN 7u

const char rtid_download_version[] = "rtid_download " RTID_C_VERSION;

typedef struct {
    rtid_download *d;
    const uint8_t *data;
    uint8_t (*answer)[8];
    int n;
} exchange;

/* ---- bytes ---- */

static uint16_t u16_of(const uint8_t *p) { return (uint16_t)(p[0] | ((uint32_t)p[1] << 8)); }

static uint32_t u32_of(const uint8_t *p)
{
    return u16_of(p) | ((uint32_t)u16_of(&p[2]) << 16);
}

static void put_u32(uint8_t *p, uint32_t x)
{
    for (uint32_t k = 0u; k < 4u; k++) {
        p[k] = (uint8_t)(x >> (8u * k));
    }
}

static float float_of(const uint8_t *p)
{
    const uint32_t bits = u32_of(p);
    float x;
    (void)memcpy(&x, &bits, sizeof x); /* MISRA 21.15: the bits of a number */
    return x;
}

/* CRC-8 SAE J1850 over the session and the first seven bytes, as in rtid_frames.c. */
static uint8_t crc8(uint16_t session, const uint8_t *data)
{
    uint8_t crc = crc8_step(0u, (uint8_t)(session & 0xFFu));
    crc = crc8_step(crc, (uint8_t)(session >> 8));
    for (unsigned k = 0u; k < 7u; k++) {
        crc = crc8_step(crc, data[k]);
    }
    return crc;
}

/* CRC-32 (IEEE 802.3) of one byte more, half a byte at a time; inverted at both ends. */
static uint32_t crc32_step(uint32_t crc, uint8_t byte)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u,
        0x4DB26158u, 0x5005713Cu, 0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
        0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    const uint32_t half = (crc >> 4) ^ table[(crc ^ byte) & 15u];
    return (half >> 4) ^ table[(half ^ ((uint32_t)byte >> 4)) & 15u];
}

/* ---- answers ---- */

static uint8_t *begin_answer(exchange *x, uint8_t op)
{
    uint8_t *out = x->answer[x->n];
    x->n++;
    (void)memset(out, 0, 8u);
    out[0] = op;
    return out;
}

static void end_answer(uint8_t *out, uint16_t session) { out[7] = crc8(session, out); }

static void reply(exchange *x, uint16_t session, uint8_t id, uint8_t reason)
{
    uint8_t *out = begin_answer(x, RTID_OP_REPLY);
    out[1] = x->data[0];
    out[2] = id;
    out[3] = reason;
    out[4] = (uint8_t)(x->d->rx.next & 0xFFu);
    out[5] = (uint8_t)(x->d->rx.next >> 8);
    end_answer(out, session);
}

static uint16_t bit(unsigned k) { return (uint16_t)(1u << k); }

static unsigned active(const rtid_download *d, unsigned k) { return ((unsigned)d->side >> k) & 1u; }

/* ---- an image ---- */

/* Where byte k of a little-endian number of `width` bytes lies in this machine's memory. */
static size_t native(size_t k, size_t width)
{
    const uint16_t one = 1;
    uint8_t first;
    (void)memcpy(&first, &one, 1u); /* MISRA 21.15: the order of bytes is asked for */
    return (first != 0u) ? k : ((k - (k % width)) + (width - 1u - (k % width)));
}

static size_t n_nodes(const rtid_download *d)
{
    return (size_t)d->rx.nu + d->rx.ns;
}

static size_t n_counts(const rtid_download *d) { return (size_t)d->rx.nu * d->rx.ns; }

/* ns = 0 says that nu numbers come, and no map. */
static size_t image_bytes(const rtid_download *d)
{
    const size_t cells = (d->rx.ns != 0u) ? ((d->rx.nu - 1u) * (d->rx.ns - 1u)) : 0u;
    return RTID_DOWNLOAD_HEAD + (4u * n_nodes(d)) + (2u * n_counts(d)) + cells;
}

static rtid_room *other_room(rtid_download *d)
{
    return &d->slots[d->rx.id].room[1u - active(d, d->rx.id)];
}

static void store(rtid_download *d, size_t at, uint8_t byte)
{
    rtid_room *room = other_room(d);
    const size_t nodes = 4u * n_nodes(d), counts = 2u * n_counts(d);
    size_t behind = at - RTID_DOWNLOAD_HEAD;
    d->rx.got = crc32_step(d->rx.got, byte);
    if (at < RTID_DOWNLOAD_HEAD) {
        d->rx.head[at] = byte;
        return;
    }
    if (behind < nodes) {
        ((uint8_t *)room->nodes)[native(behind, 4u)] = byte;
    } else if (behind < (nodes + counts)) {
        ((uint8_t *)room->counts)[native(behind - nodes, 2u)] = byte;
    } else {
        room->status[behind - nodes - counts] = byte;
    }
}

static bool is_finite(float x) { return fabsf(x) <= FLT_MAX; }

static bool is_rising(const float *node, unsigned n)
{
    for (unsigned k = 0u; k < n; k++) {
        if (!is_finite(node[k]) || ((k > 0u) && !(node[k - 1u] < node[k]))) {
            return false;
        }
    }
    return true;
}

/* A limit of 0 is none; nodes are rounded to float32, which must not put them beyond. */
static bool is_beyond(float x, float limit)
{
    return limit > 0.0f && fabsf(x) > limit * 1.00001f;
}

static uint8_t judge_map(const rtid_download *d, const rtid_map *map)
{
    const size_t cells = (map->nu - 1u) * (map->ns - 1u), flows = n_counts(d);
    const float low = fabsf(map->s[0]), high = fabsf(map->s[map->ns - 1u]);
    const float far_s = low > high ? low : high;
    if (!is_rising(map->u, map->nu) || !is_rising(map->s, map->ns)) {
        return RTID_CONTENT;
    }
    if (!is_finite(map->scale) || !(map->scale > 0.0f) || !is_finite(map->safe)) {
        return RTID_CONTENT;
    }
    if (map->direction != 1 && map->direction != -1) {
        return RTID_CONTENT;
    }
    for (size_t k = 0u; k < cells; k++) {
        if ((map->status[k] & (uint8_t)~RTID_MAP_RISING) >= RTID_MAP_N_CELL_STATUS) {
            return RTID_CONTENT;
        }
    }
    for (unsigned j = 0u; j < (map->ns - 1u); j++) {
        if (((map->status[j] & RTID_MAP_RISING) != 0u) && (rtid_map_is_rising(map, j) == 0)) {
            return RTID_CONTENT;
        }
    }
    if (is_beyond(map->u[0], d->max_command) || is_beyond(map->u[map->nu - 1u], d->max_command)
        || is_beyond(far_s * far_s, d->max_dp)) {
        return RTID_LIMITS;
    }
    for (size_t k = 0u; k < flows; k++) {
        if (!is_finite(map->scale * map->q[k]) || is_beyond(map->scale * map->q[k], d->max_flow)) {
            return RTID_LIMITS;
        }
    }
    return RTID_DONE;
}

/* The whole image has arrived: see whether it is what was announced, and plausible. */
static uint8_t judge(rtid_download *d)
{
    const uint8_t *head = d->rx.head;
    rtid_slot *slot = &d->slots[d->rx.id];
    const unsigned side = 1u - active(d, d->rx.id);
    const rtid_room *room = &slot->room[side];
    rtid_map *map = &slot->map[side];
    const uint8_t kind = (d->rx.ns != 0u) ? RTID_KIND_MAP : RTID_KIND_NUMBERS;
    if (head[0] != kind || head[1] != d->rx.id || head[2] != d->rx.nu || head[3] != d->rx.ns) {
        return RTID_CONTENT;
    }
    slot->kind[side] = kind;
    slot->version[side] = d->rx.version;
    slot->crc[side] = d->rx.crc;
    slot->n_numbers[side] = d->rx.nu;
    if (kind == RTID_KIND_NUMBERS) {
        for (unsigned k = 0u; k < d->rx.nu; k++) {
            if (!is_finite(room->nodes[k])) {
                return RTID_CONTENT;
            }
        }
        return RTID_DONE;
    }
    map->u = room->nodes;
    map->s = &room->nodes[d->rx.nu];
    map->q = room->counts;
    map->status = room->status;
    map->nu = d->rx.nu;
    map->ns = d->rx.ns;
    map->direction = (int8_t)((head[4] == 1u) ? 1 : ((head[4] == 0xFFu) ? -1 : 0));
    map->scale = float_of(&head[8]);
    map->safe = float_of(&head[12]);
    return judge_map(d, map);
}

/* ---- operations: each answers once ---- */

static void on_open(exchange *x, uint32_t now_ms)
{
    rtid_download *d = x->d;
    const uint16_t session = u16_of(&x->data[1]);
    const bool is_taken = (d->session != 0u) && (d->session != session)
                          && ((now_ms - d->heard_ms) < RTID_DOWNLOAD_IDLE_MS);
    uint16_t nodes = 0xFFFFu, counts = 0xFFFFu;
    uint8_t *out;
    if ((session == 0u) || (x->data[3] != RTID_DOWNLOAD_FORMAT)) {
        reply(x, session, 0u, RTID_FORMAT);
        return;
    }
    if (is_taken) {
        reply(x, session, 0u, RTID_BUSY);
        return;
    }
    if (d->session != session) {
        d->rx.begun = 0;
        d->staged = 0;
        d->probe.asked = 0;
    }
    d->session = session;
    d->heard_ms = now_ms;
    for (unsigned k = 0u; k < d->n_slots; k++) {
        for (unsigned side = 0u; side < 2u; side++) {
            const rtid_room *room = &d->slots[k].room[side];
            nodes = room->n_nodes < nodes ? room->n_nodes : nodes;
            counts = room->n_counts < counts ? room->n_counts : counts;
        }
    }
    out = begin_answer(x, RTID_OP_ACCEPTS);
    out[1] = RTID_DOWNLOAD_FORMAT;
    out[2] = d->n_slots;
    out[3] = (uint8_t)(nodes & 0xFFu);
    out[4] = (uint8_t)(nodes >> 8);
    out[5] = (uint8_t)(counts & 0xFFu);
    out[6] = (uint8_t)(counts >> 8);
    end_answer(out, session);
}

/* What is active: HELD_VERSION and HELD_CRC; version 0 where there is nothing. */
static void on_query(exchange *x)
{
    rtid_download *d = x->d;
    const uint8_t id = x->data[1];
    uint32_t version = 0u, crc = 0u;
    uint8_t *out;
    if (id >= d->n_slots) {
        reply(x, d->session, id, RTID_SLOT);
        return;
    }
    if ((d->present & bit(id)) != 0u) {
        version = d->slots[id].version[active(d, id)];
        crc = d->slots[id].crc[active(d, id)];
    }
    out = begin_answer(x, RTID_OP_HELD_VERSION);
    out[1] = id;
    put_u32(&out[2], version);
    end_answer(out, d->session);
    out = begin_answer(x, RTID_OP_HELD_CRC);
    out[1] = id;
    put_u32(&out[2], crc);
    end_answer(out, d->session);
}

/* What an active map gives, or the number of that index; what it stands on. */
static uint8_t value_at(const rtid_download *d, unsigned id, float u, float dp, float *q)
{
    unsigned count = 0u;
    const float *numbers = rtid_download_numbers(d, id, &count);
    *q = 0.0f;
    if (numbers == NULL) {
        return (uint8_t)rtid_map_flow(rtid_download_map(d, id), u, dp, q);
    }
    if (!((u >= 0.0f) && (u < (float)count))) {
        return RTID_MAP_NONE;
    }
    *q = numbers[(unsigned)u];
    return RTID_MAP_VALID;
}

static void on_probe_command(rtid_download *d, const uint8_t *data)
{
    d->probe.id = data[1];
    d->probe.u = float_of(&data[2]);
    d->probe.number = data[6];
    d->probe.asked = 1;
}

/* The second half of a question: FLOW, from the very map that the firmware evaluates. */
static void on_probe_drop(exchange *x)
{
    rtid_download *d = x->d;
    const uint8_t id = x->data[1], number = x->data[6];
    uint32_t bits;
    uint8_t *out, stands_on;
    float q;
    if (id >= d->n_slots) {
        reply(x, d->session, id, RTID_SLOT);
        return;
    }
    if ((d->probe.asked == 0u) || (id != d->probe.id) || (number != d->probe.number)) {
        reply(x, d->session, id, RTID_ORDER);
        return;
    }
    d->probe.asked = 0;
    stands_on = value_at(d, id, d->probe.u, float_of(&x->data[2]), &q);
    (void)memcpy(&bits, &q, sizeof bits); /* MISRA 21.15: the bits of a number */
    out = begin_answer(x, RTID_OP_FLOW);
    out[1] = id;
    put_u32(&out[2], bits);
    out[6] = (uint8_t)(stands_on | ((uint32_t)number << 4));
    end_answer(out, d->session);
}

static uint8_t refusal_of_begin(const rtid_download *d)
{
    const rtid_slot *slot = &d->slots[d->rx.id];
    const unsigned now = active(d, d->rx.id);
    const rtid_room *room = &slot->room[1u - now];
    const bool is_map = d->rx.ns != 0u;
    if (d->rx.version == 0u) {
        return RTID_VERSION;
    }
    if (((d->present & bit(d->rx.id)) != 0u) && (d->rx.version <= slot->version[now])) {
        return RTID_VERSION;
    }
    if ((d->rx.nu < 1u) || (is_map && ((d->rx.nu < 2u) || (d->rx.ns < 2u)))) {
        return RTID_SIZE;
    }
    if (d->rx.total != image_bytes(d) || n_nodes(d) > room->n_nodes
        || n_counts(d) > room->n_counts) {
        return RTID_SIZE;
    }
    return RTID_DONE;
}

static void on_begin(exchange *x)
{
    rtid_download *d = x->d;
    const uint8_t op = x->data[0], id = x->data[1];
    uint8_t reason;
    if (id >= d->n_slots) {
        reply(x, d->session, id, RTID_SLOT);
        return;
    }
    if (op == RTID_OP_BEGIN_SIZE) {
        d->rx.begun = 1u;
        d->rx.id = id;
        d->rx.nu = x->data[2];
        d->rx.ns = x->data[3];
        d->rx.total = u16_of(&x->data[4]) | ((uint32_t)x->data[6] << 16);
        d->rx.next = 0;
        d->rx.got = 0xFFFFFFFFu;
        d->staged &= (uint16_t)~bit(id);
        return;
    }
    if (((d->rx.begun & 1u) == 0u) || (id != d->rx.id) || ((d->rx.begun & RUNNING) != 0u)) {
        if (op == RTID_OP_BEGIN_CRC) {
            reply(x, d->session, id, RTID_ORDER);
        }
        return;
    }
    if (op == RTID_OP_BEGIN_VERSION) {
        d->rx.version = u32_of(&x->data[2]);
        d->rx.begun |= 2u;
        return;
    }
    d->rx.crc = u32_of(&x->data[2]);
    d->rx.begun |= 4u;
    reason = (d->rx.begun == ALL_BEGUN) ? refusal_of_begin(d) : RTID_ORDER;
    d->rx.begun = (reason == RTID_DONE) ? RUNNING : 0u;
    reply(x, d->session, id, reason);
}

static void on_data(rtid_download *d, const uint8_t *data)
{
    const size_t first = (size_t)d->rx.next * CHUNK;
    if ((d->rx.begun != RUNNING) || (first >= d->rx.total)
        || ((data[0] & 0x7Fu) != (d->rx.next & 0x7Fu))) {
        d->repeated++;
        return;
    }
    for (size_t k = 0u; (k < CHUNK) && ((first + k) < d->rx.total); k++) {
        store(d, first + k, data[1u + k]);
    }
    d->rx.next++;
}

static void on_end(exchange *x)
{
    rtid_download *d = x->d;
    const uint8_t id = x->data[1];
    uint8_t reason = RTID_DONE;
    if ((id < d->n_slots) && ((d->staged & bit(id)) != 0u) && (d->rx.id == id)) {
        reply(x, d->session, id, RTID_DONE); /* the first answer was lost */
        return;
    }
    if ((d->rx.begun != RUNNING) || (id != d->rx.id)) {
        reason = RTID_ORDER;
    } else if (((size_t)d->rx.next * CHUNK) < d->rx.total) {
        reason = RTID_INCOMPLETE;
    } else {
        d->rx.begun = 0;
        reason = (~d->rx.got == d->rx.crc) ? judge(d) : RTID_WRONG_CRC;
        if (reason == RTID_DONE) {
            d->staged |= bit(id);
        }
    }
    reply(x, d->session, id, reason);
}

/* All maps of the mask, or none. */
static void on_commit(exchange *x)
{
    rtid_download *d = x->d;
    const uint16_t mask = u16_of(&x->data[1]);
    const uint32_t version = u32_of(&x->data[3]);
    uint8_t reason = RTID_DONE;
    bool is_done = (d->staged & mask) == 0u; /* the first answer was lost */
    for (unsigned k = 0u; k < RTID_DOWNLOAD_SLOTS; k++) {
        const unsigned side = (k < d->n_slots) ? active(d, k) : 0u;
        if ((mask & bit(k)) == 0u) {
            continue;
        }
        if (k >= d->n_slots) {
            reason = RTID_SLOT;
        } else if (((d->present & bit(k)) == 0u) || (d->slots[k].version[side] != version)) {
            is_done = false;
        } else {
            /* it is active already */
        }
        if ((reason == RTID_DONE) && ((d->staged & bit(k)) != 0u)
            && (d->slots[k].version[1u - side] != version)) {
            reason = RTID_VERSION;
        }
    }
    if ((mask == 0u)
        || ((reason == RTID_DONE) && (!is_done) && ((d->staged & mask) != mask))) {
        reason = RTID_ORDER;
    }
    if ((reason == RTID_DONE) && (!is_done) && (d->hold != 0u)) {
        reason = RTID_NOT_NOW;
    }
    if ((reason == RTID_DONE) && (!is_done)) {
        d->present |= mask;
        d->staged &= (uint16_t)~mask;
        d->rx.begun = 0;
        d->side = (uint16_t)(d->side ^ mask); /* now, and all at once */
    }
    reply(x, d->session, 0, reason);
}

int rtid_download_push(rtid_download *d, uint32_t now_ms, const uint8_t *data, uint8_t length,
                       uint8_t answer[RTID_DOWNLOAD_ANSWERS][8])
{
    exchange x = {d, data, answer, 0};
    const bool is_open = (length == 8u) && (data[0] == RTID_OP_OPEN);
    if ((length != 8u) || (crc8(is_open ? 0u : d->session, data) != data[7])) {
        d->damaged++;
        return 0;
    }
    if (is_open) {
        on_open(&x, now_ms);
        return x.n;
    }
    if (d->session == 0u) {
        d->strange++;
        return 0;
    }
    d->heard_ms = now_ms;
    if ((data[0] & RTID_OP_DATA) != 0u) {
        on_data(d, data);
    } else if (data[0] == RTID_OP_QUERY) {
        on_query(&x);
    } else if (data[0] == RTID_OP_PROBE_COMMAND) {
        on_probe_command(d, data);
    } else if (data[0] == RTID_OP_PROBE_DROP) {
        on_probe_drop(&x);
    } else if ((data[0] >= RTID_OP_BEGIN_SIZE) && (data[0] <= RTID_OP_BEGIN_CRC)) {
        on_begin(&x);
    } else if (data[0] == RTID_OP_POLL) {
        reply(&x, d->session, data[1],
              ((d->rx.begun == RUNNING) && (d->rx.id == data[1])) ? RTID_DONE : RTID_ORDER);
    } else if (data[0] == RTID_OP_END) {
        on_end(&x);
    } else if (data[0] == RTID_OP_COMMIT) {
        on_commit(&x);
    } else if (data[0] == RTID_OP_CLOSE) {
        reply(&x, d->session, 0, RTID_DONE);
        d->session = 0;
        d->rx.begun = 0;
        d->staged = 0;
    } else {
        d->strange++;
    }
    return x.n;
}

const rtid_map *rtid_download_map(const rtid_download *d, unsigned k)
{
    const unsigned side = (k < d->n_slots) ? active(d, k) : 0u;
    if ((k >= d->n_slots) || ((d->present & bit(k)) == 0u)
        || (d->slots[k].kind[side] != RTID_KIND_MAP)) {
        return NULL;
    }
    return &d->slots[k].map[side];
}

const float *rtid_download_numbers(const rtid_download *d, unsigned k, unsigned *count)
{
    const unsigned side = (k < d->n_slots) ? active(d, k) : 0u;
    *count = 0u;
    if ((k >= d->n_slots) || ((d->present & bit(k)) == 0u)
        || (d->slots[k].kind[side] != RTID_KIND_NUMBERS)) {
        return NULL;
    }
    *count = d->slots[k].n_numbers[side];
    return d->slots[k].room[side].nodes;
}

int rtid_notice_read(const uint8_t *data, uint8_t length, rtid_notice *notice)
{
    if ((length != 8u) || (crc8(0u, data) != data[7])) {
        return 0;
    }
    if (data[0] == RTID_OP_STATUS) {
        notice->learning = data[1] & 0x0Fu;
        notice->verdict = data[1] >> 4;
        notice->alarms = data[2];
        notice->progress = data[3];
        notice->valid = data[4];
        notice->flags = data[5];
        notice->counter = data[6];
        return RTID_OP_STATUS;
    }
    if (data[0] == RTID_OP_BETA) {
        notice->chamber = data[1];
        notice->beta = 1e5f * (float)u16_of(&data[2]); /* bar */
        notice->beta_sd = 1e5f * (float)u16_of(&data[4]);
        return RTID_OP_BETA;
    }
    return 0;
}
