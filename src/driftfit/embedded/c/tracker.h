/* @what@

   Written by driftfit @version@: standalone C99 without heap and without global state. Compile with -ffp-contract=off:
   the double build then gives the same bits as driftfit. -DTRACKER_SINGLE computes in single precision. */
#ifndef DRIFTFIT_TRACKER_H
#define DRIFTFIT_TRACKER_H

#include <stdint.h>

#ifdef TRACKER_SINGLE
typedef float tracker_real;
#else
typedef double tracker_real;
#endif

#define TRACKER_PARAMETERS @n@
#define TRACKER_INPUTS @m@
/* theta: @names@ */

/* The state of one stream, which the caller owns. Results: theta and var (the variances of theta, INFINITY for what the
   data have not distinguished yet). @known@ */
typedef struct {
@fields@
} tracker_state;

typedef struct {
    tracker_real y_hat;    /* prediction of y before it came; NAN where there is none */
    tracker_real e;        /* innovation y - y_hat; NAN where the sample was not used */
    tracker_real variance; /* of the innovation */
    int ok;                /* 1 where the sample was used */
} tracker_step;

/* The state before the first sample. */
void tracker_init(tracker_state *s);

/* Take in one sample: y (NAN where it is missing) and TRACKER_INPUTS inputs. */
tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u);

/* What tracker_update would predict for these inputs; only *scratch is changed. */
tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u);

/* Forget what is known of theta and keep the past signals, as after maintenance. */
void tracker_reset(tracker_state *s);
@control@
#endif
