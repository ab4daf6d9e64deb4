/* A log of candump on the host, as frames in memory: what a CAN driver would deliver. */
#ifndef CAN_LOG_H
#define CAN_LOG_H

#include "rtid_frames.h"

/* Frames of at most 8 bytes, in order; their number, 0 if there is no such file. */
size_t can_log_read(const char *name, rtid_frame *frames, size_t most);

#endif
