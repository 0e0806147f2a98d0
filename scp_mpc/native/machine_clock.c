/* The machine's clock, for callers with an operating system: the only file here that needs one. The
 * core itself is handed its clock; it is no part of an export.
 */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "scp_mpc.h"

SCP_API double scp_machine_clock(void *context);

/* Seconds since some time in the past. */
double scp_machine_clock(void *context) {
    struct timespec now;
    (void)context;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}
