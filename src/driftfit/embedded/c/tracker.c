/* @what@; see tracker.h. */
#include "tracker.h"

#include <math.h>

typedef tracker_real real;

#define R(x) ((real)(x))
#ifdef TRACKER_SINGLE
#define WIDE(wide, narrow) ((real)(narrow))
#define R_SQRT(x) sqrtf(x)
#define R_ABS(x) fabsf(x)
#else
#define WIDE(wide, narrow) ((real)(wide))
#define R_SQRT(x) sqrt(x)
#define R_ABS(x) fabs(x)
#endif

#if defined(__GNUC__) /* a copy of tracker_update in tracker_predict would cost code, and a call per sample */
#define NOT_INLINED __attribute__((noinline))
#else
#define NOT_INLINED
#endif

