/* The same look-up as rtid_map.h in integers, for controllers without floating point.
 *
 * Commands in microvolts, pressure drops in Pa, flows in mm3/s (1 L/min = 16,667 mm3/s).  No heap,
 * no state, no library.  It agrees with the float look-up to 5e-5 of the map's largest flow
 * (tests/test_cfile.py); tables come from `rtid export ... maps.h`.
 */
#ifndef RTID_MAP_FIXED_H
#define RTID_MAP_FIXED_H

#include "rtid_map.h" /* what a flow stands on */

typedef struct {
    const int32_t *u;      /* nu opening commands, rising, uV */
    const int32_t *s;      /* ns signed roots of the pressure drop, rising, sqrt(Pa) / 64 */
    const int16_t *q;      /* as in rtid_map */
    const uint8_t *status; /* as in rtid_map */
    int32_t scale;         /* mm3/s per count, times 65,536 */
    int32_t safe;          /* uV; INT32_MIN: not declared */
    uint8_t nu, ns;
    int8_t direction;
} rtid_map_fixed;

/* As rtid_map_flow: q in mm3/s at u in uV and dp in Pa; what it stands on. */
int rtid_map_fixed_flow(const rtid_map_fixed *map, int32_t u, int32_t dp, int32_t *q);

/* As rtid_map_command: u in uV for q in mm3/s, less than 2^30; what it stands on. */
int rtid_map_fixed_command(const rtid_map_fixed *map, int32_t q, int32_t dp, int32_t *u);

extern const char rtid_map_fixed_version[];

#endif
