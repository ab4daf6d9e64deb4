/* Which release these sources are of; it stands in the version symbol of each part. */
#ifndef RTID_VERSION_H
#define RTID_VERSION_H

#define RTID_C_VERSION "0.1.0"

#endif
