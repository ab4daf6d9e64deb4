/* The controller's end of the map download: frames in, answers out, maps changed all at once.
 *
 * C99, no heap, no state but what the caller hands in.  The protocol is in
 * firmware_bridge/download.md; the sender is firmware_bridge/download.py.
 *
 * Each map has room on two sides.  A download fills the side that is not active; only a COMMIT for
 * maps that have arrived whole, with the right CRC-32 and plausible, changes sides: one write of
 * `side` for all maps together.  Nothing else ever changes an active map.
 *
 * Use: zero a rtid_download, set slots, n_slots and the limits; for each frame with the identifier
 * of the download call rtid_download_push and send the answers; evaluate rtid_download_map(d, k).
 * Where evaluation runs in another task or interrupt, it must be done with a map before the next
 * download's first DATA frame can arrive: fetch the map anew in every cycle.
 */
#ifndef RTID_DOWNLOAD_H
#define RTID_DOWNLOAD_H

#include <stdint.h>

#include "rtid_map.h"

#define RTID_DOWNLOAD_FORMAT 1u
#define RTID_DOWNLOAD_SLOTS 16u /* at most */
#define RTID_DOWNLOAD_ANSWERS 2
#define RTID_DOWNLOAD_IDLE_MS 2000u /* a sender that is silent for longer has lost its session */
#define RTID_DOWNLOAD_HEAD 16u

/* Kinds of images. */
enum { RTID_KIND_MAP = 1, RTID_KIND_NUMBERS = 2 };

/* First byte of a frame to the controller; RTID_OP_DATA + (chunk modulo 128) for data. */
enum {
    RTID_OP_OPEN = 0x01,
    RTID_OP_QUERY = 0x02,
    RTID_OP_BEGIN_SIZE = 0x03,
    RTID_OP_BEGIN_VERSION = 0x04,
    RTID_OP_BEGIN_CRC = 0x05,
    RTID_OP_POLL = 0x06,
    RTID_OP_END = 0x07,
    RTID_OP_COMMIT = 0x08,
    RTID_OP_CLOSE = 0x09,
    RTID_OP_PROBE_COMMAND = 0x0A, /* what does the active map give at this command ... */
    RTID_OP_PROBE_DROP = 0x0B,    /* ... and this pressure drop? */
    RTID_OP_DATA = 0x80
};

/* First byte of an answer. */
enum {
    RTID_OP_ACCEPTS = 0x41,
    RTID_OP_REPLY = 0x42,
    RTID_OP_HELD_VERSION = 0x43,
    RTID_OP_HELD_CRC = 0x44,
    RTID_OP_FLOW = 0x45
};

/* First byte of a notice that rtid sends unasked, if it is armed. */
enum { RTID_OP_STATUS = 0x61, RTID_OP_BETA = 0x62 };

/* Reasons in a REPLY. */
enum {
    RTID_DONE = 0,
    RTID_BUSY = 1,       /* another session is open */
    RTID_FORMAT = 2,     /* another version of this protocol, or an unknown kind of image */
    RTID_SLOT = 3,       /* there is no such map */
    RTID_VERSION = 4,    /* not newer than the active one, or not the one that has arrived */
    RTID_SIZE = 5,       /* does not fit, or the numbers contradict each other */
    RTID_ORDER = 6,      /* something is missing before this frame */
    RTID_INCOMPLETE = 7, /* chunks are missing: send from `next` on */
    RTID_WRONG_CRC = 8,  /* all has arrived, but not what was sent: begin again */
    RTID_CONTENT = 9,    /* no plausible map */
    RTID_LIMITS = 10,    /* beyond the controller's limits */
    RTID_NOT_NOW = 11    /* the machine is in no state to change maps */
};

/* Memory for one image: nodes of both axes (or numbers), flows and as many statuses. */
typedef struct {
    float *nodes;
    int16_t *counts;
    uint8_t *status;
    uint16_t n_nodes, n_counts;
} rtid_room;

typedef struct {
    rtid_room room[2];
    rtid_map map[2]; /* from here on: the download's own */
    uint32_t version[2], crc[2];
    uint8_t kind[2], n_numbers[2];
} rtid_slot;

typedef struct {
    rtid_slot *slots;
    uint8_t n_slots;
    uint8_t hold; /* set while no map may become active: COMMIT is answered RTID_NOT_NOW */
    float max_command, max_dp, max_flow; /* V, Pa, m3/s of an acceptable map; 0: any */

    /* From here on: the download's own, all zero at the start. */
    volatile uint16_t side; /* bit k: which side of slot k is active */
    uint16_t present;       /* bit k: slot k has an active image */
    uint16_t staged;        /* bit k: slot k's other side is whole and may be committed */
    uint16_t session;       /* 0: none */
    uint32_t heard_ms;      /* last frame of the session */
    struct {
        uint32_t version, crc, got; /* got: CRC-32 so far, inverted */
        uint32_t total;             /* bytes */
        uint16_t next;              /* chunk that is wanted next */
        uint8_t id, nu, ns, begun;  /* begun: bits 0..2 for the three BEGIN frames, 3: running */
        uint8_t head[RTID_DOWNLOAD_HEAD];
    } rx;
    struct {
        float u;                   /* V, or which of the numbers */
        uint8_t id, number, asked; /* asked: the drop is still to come */
    } probe;
    uint32_t damaged, strange, repeated; /* frames with a wrong CRC; of no session; not wanted */
} rtid_download;

/* Take one frame; the number of answers, each 8 bytes, that are to be sent. */
int rtid_download_push(rtid_download *d, uint32_t now_ms, const uint8_t *data, uint8_t length,
                       uint8_t answer[RTID_DOWNLOAD_ANSWERS][8]);

/* The active map of slot k, NULL if there is none. */
const rtid_map *rtid_download_map(const rtid_download *d, unsigned k);

/* The active numbers of slot k, NULL if there are none: bulk modulus and its standard deviation of
 * each chamber in turn, Pa. */
const float *rtid_download_numbers(const rtid_download *d, unsigned k, unsigned *count);

/* How rtid is, if the project file lets it tell: once a second, see download.md. */
typedef struct {
    uint8_t learning; /* 0 waiting, 1 learning, 2 held, 3 suspended, 4 stopped */
    uint8_t alarms, progress, valid; /* alarms that are on; percent; percent of the blocks */
    uint8_t flags;                   /* bit 0: estimate is stale; 1: a map is offered */
    uint8_t counter;                 /* one more with every STATUS: rtid is alive */
    uint8_t verdict; /* 0 none, 1 matches, 2 missing, 3 ambiguous, 4 unknown, 5 too little data */
    uint8_t chamber; /* of a RTID_OP_BETA frame */
    float beta, beta_sd; /* Pa; 0: not known */
} rtid_notice;

/* Read a notice; its first byte, or 0 if it is none. */
int rtid_notice_read(const uint8_t *data, uint8_t length, rtid_notice *notice);

extern const char rtid_download_version[];

#endif
