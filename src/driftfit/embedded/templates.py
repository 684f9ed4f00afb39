"""Texts of the files of an exported tracker: C, a self-test, a block of Simulink and ``README.md``."""

HEADER = """\
/* {what}

   Written by driftfit {version}: standalone C99 without heap and without global state. Compile with -ffp-contract=off:
   the double build then gives the same bits as driftfit. -DTRACKER_SINGLE computes in single precision. */
#ifndef DRIFTFIT_TRACKER_H
#define DRIFTFIT_TRACKER_H

#include <stdint.h>

#ifdef TRACKER_SINGLE
typedef float tracker_real;
#else
typedef double tracker_real;
#endif

#define TRACKER_PARAMETERS {n}
#define TRACKER_INPUTS {m}
/* theta: {names} */

/* The state of one stream, which the caller owns. Results: theta and var (the variances of theta, INFINITY for what the
   data have not distinguished yet). {known} */
typedef struct {{
{fields}
}} tracker_state;

typedef struct {{
    tracker_real y_hat;    /* prediction of y before it came; NAN where there is none */
    tracker_real e;        /* innovation y - y_hat; NAN where the sample was not used */
    tracker_real variance; /* of the innovation */
    int ok;                /* 1 where the sample was used */
}} tracker_step;

/* The state before the first sample. */
void tracker_init(tracker_state *s);

/* Take in one sample: y (NAN where it is missing) and TRACKER_INPUTS inputs. */
tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u);

/* What tracker_update would predict for these inputs; only *scratch is changed. */
tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u);

/* Forget what is known of theta and keep the past signals, as after maintenance. */
void tracker_reset(tracker_state *s);

#endif
"""

KNOWN = """Known of the next samples, and kept until changed: interval (nominal intervals since
   the sample before), noise (factor of the noise variance; INFINITY: do not use the sample) and drift (factor of the
   drift)."""
FIXED_RATE = """Samples come at a fixed rate and are all alike: one is left out by passing NAN,
   not by leaving out the call."""

SOURCE = """\
/* {what}; see tracker.h. */
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

"""

SCRATCH = """\
/* What steps work in: it carries nothing from one sample to the next. */
typedef struct {{
{fields}
}} scratch_fields;"""

AGAIN = """\
/* The first samples once more, without the fault codes that the gate has found among them. */
static void first_samples_again(tracker_state *s) {{
    tracker_step step;
    real rows[{rows}][{columns}], u[{m}];
    const int64_t kept = s->gate_kept, dropped = s->gate_replay - 1;
{kept}
    for (int k = 0; k < {rows}; k++) {{
        for (int j = 0; j < {columns}; j++) {{ rows[k][j] = s->gate_first[k * {columns} + j]; }}
    }}
    *s = START;
{restored}
    s->gate_decided = 1;
    for (int k = 0; k < kept; k++) {{
        const int64_t codes = (int64_t)rows[k][{codes}];
        const real y = codes % 2 == 1 ? R(NAN) : rows[k][{reading}];
        for (int64_t i = k == 0 ? -dropped : 0; i < (int64_t)rows[k][{times}]; i++) {{
            for (int j = 0; j < TRACKER_INPUTS; j++) {{
                u[j] = i < 0 || (codes >> (j + 1)) % 2 == 1 ? R(NAN) : rows[k][{inputs} + j];
            }}
{factors}
            {sample}
        }}
    }}
}}
"""

GATED = """
* A gate stands before the tracker: it leaves out fault codes, spikes and frozen readings. Once, after the first
  samples, it may take them in again without the codes among them: up to {rows} different samples, each as often as it
  came."""

SUPPORT = {
    "real_minimum": "static real real_minimum(real a, real b) { return b < a ? b : a; }",
    "real_maximum": "static real real_maximum(real a, real b) { return b > a ? b : a; }",
    "whole_minimum": "static int64_t whole_minimum(int64_t a, int64_t b) { return b < a ? b : a; }",
    "whole_maximum": "static int64_t whole_maximum(int64_t a, int64_t b) { return b > a ? b : a; }",
    "whole_abs": "static int64_t whole_abs(int64_t a) { return a < 0 ? -a : a; }",
    "real_square": "static real real_square(real a) { return a * a; }",
    "from_bits": """static double from_bits(int64_t bits) {
    union { int64_t whole; double number; } both;
    both.whole = bits;
    return both.number;
}""",
    "bits_of": """static int64_t bits_of(double number) {
    union { int64_t whole; double number; } both;
    both.number = number;
    return both.whole;
}""",
    "four": "typedef struct { real at[4]; } four;",
    "four_of": "static four four_of(real x) { four v = {{x, x, x, x}}; return v; }",
    "four_at": "static four four_at(const real *x) { four v = {{x[0], x[1], x[2], x[3]}}; return v; }",
    "four_plus": """static four four_plus(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] + b.at[i]; }
    return a;
}""",
    "four_times": """static four four_times(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] * b.at[i]; }
    return a;
}""",
    "four_reached": """static int64_t four_reached(four a, four b) {
    int64_t count = 0;
    for (int i = 0; i < 4; i++) { count += a.at[i] >= b.at[i]; }
    return count;
}""",
}
"""The functions that translated steps may call."""

README = """\
# {what}

`tracker.h`, `tracker.c`: the tracker in C99; `selftest.c`: recorded samples and the bits that they must give;
`tracker_sfun.c`: an S-function that makes it a Simulink block.

    cc -std=c99 -O2 -ffp-contract=off -o selftest tracker.c selftest.c -lm && ./selftest

* Parameters: {names}.
* State: {doubles} bytes in double precision, {singles} with `-DTRACKER_SINGLE`. No heap, no global state, no recursion.
* An update takes at most {ops}.
  Loops are counted at their longest, and of two branches the dearer.{ordinary}{gate}
* From the library: `sqrt` and `fabs` where they are used; with `-DTRACKER_SINGLE` also `expf` and `logf`.
* `-ffp-contract=off` keeps products and sums apart, which gcc in its default mode may fuse; never use `-ffast-math`.

```c
tracker_state state;
tracker_init(&state);
for (;;) {{
    tracker_step step = tracker_update(&state, y, u); /* then use state.theta, state.var, step.e */
}}
```

`driftfit.embedded.from_struct(model, tracker, bytes)` opens a state of the double build in Python, and
`to_struct(live)` gives the bytes back.
"""

SELFTEST = """\
/* Runs the tracker over recorded samples and compares every result with what driftfit gives. Exit status 0: all agree,
   in double precision bit for bit, in single precision within {bound} of the largest usual result, or of the result
   itself if that is larger: a prediction before the first samples determine theta may be. */
#include "tracker.h"

#include <math.h>
#include <stdio.h>

#define SAMPLES {T}

static const double Y[SAMPLES] = {{{y}}};
static const double U[SAMPLES * {m}] = {{{u}}};
/* y_hat, e, variance, ok of every sample; then theta */
static const double STEPS[SAMPLES * 4] = {{{steps}}};
static const double THETA[TRACKER_PARAMETERS] = {{{theta}}};

static double worst = 0.0;
static int wrong = 0;

static void compare(double found, double expected, double scale) {{
    int same = found == expected || (found != found && expected != expected);
    double away = same ? 0.0 : fabs(found - expected) / fmax(scale, fabs(expected));
    if (!(away <= worst)) worst = away;
    if (sizeof(tracker_real) == sizeof(double) ? !same : !(away <= {bound})) wrong++;
}}

int main(void) {{
    tracker_state state;
    tracker_init(&state);
    for (int t = 0; t < SAMPLES; t++) {{
        tracker_real u[{m}];
        for (int j = 0; j < {m}; j++) u[j] = (tracker_real)U[t * {m} + j];
        tracker_step step = tracker_update(&state, (tracker_real)Y[t], u);
        compare((double)step.y_hat, STEPS[t * 4], {y_scale});
        compare((double)step.e, STEPS[t * 4 + 1], {y_scale});
        compare((double)step.variance, STEPS[t * 4 + 2], {s_scale});
        if (step.ok != (int)STEPS[t * 4 + 3]) wrong++;
    }}
    for (int i = 0; i < TRACKER_PARAMETERS; i++) compare((double){last}, THETA[i], {theta_scale});
    printf("%s: %d of %d results differ, the largest difference is %.3g of the largest result\\n",
           wrong ? "FAILED" : "passed", wrong, SAMPLES * 4 + TRACKER_PARAMETERS, worst);
    return wrong ? 1 : 0;
}}
"""

SFUNCTION = """\
/* A Simulink block around tracker.c: mex -I. CFLAGS='$CFLAGS -std=c99 -ffp-contract=off' tracker_sfun.c tracker.c

   Parameter: the sample time. Inputs: y, and the inputs u of that sample. Outputs: theta, its variances, and
   [y_hat, e, variance of e, ok]. mdlOutputs, which Simulink may call more than once for a sample, works on a copy of
   the state, and mdlUpdate keeps it. In a loop pass an input that was applied before y through a Unit Delay. */
#define S_FUNCTION_NAME tracker_sfun
#define S_FUNCTION_LEVEL 2

#include "simstruc.h"
#include "tracker.h"

#ifdef TRACKER_SINGLE
#define REAL_TYPE SS_SINGLE
#else
#define REAL_TYPE SS_DOUBLE
#endif
#define PORTS (TRACKER_INPUTS > 0 ? 2 : 1)
#define WORDS ((int)((sizeof(tracker_state) + sizeof(real_T) - 1) / sizeof(real_T)))

static void mdlInitializeSizes(SimStruct *S) {
    const int outputs[3] = {TRACKER_PARAMETERS, TRACKER_PARAMETERS, 4};
    ssSetNumSFcnParams(S, 1);
    if (ssGetNumSFcnParams(S) != ssGetSFcnParamsCount(S)) {
        return;
    }
    if (!ssSetNumInputPorts(S, PORTS) || !ssSetNumOutputPorts(S, 3)) {
        return;
    }
    for (int port = 0; port < PORTS; port++) {
        ssSetInputPortWidth(S, port, port == 0 ? 1 : TRACKER_INPUTS);
        ssSetInputPortDataType(S, port, REAL_TYPE);
        ssSetInputPortRequiredContiguous(S, port, 1);
        ssSetInputPortDirectFeedThrough(S, port, 1);
    }
    for (int port = 0; port < 3; port++) {
        ssSetOutputPortWidth(S, port, outputs[port]);
        ssSetOutputPortDataType(S, port, REAL_TYPE);
    }
    ssSetNumDWork(S, 2); /* the state, and its copy */
    for (int work = 0; work < 2; work++) {
        ssSetDWorkWidth(S, work, WORDS);
        ssSetDWorkDataType(S, work, SS_DOUBLE);
    }
    ssSetNumSampleTimes(S, 1);
}

static void mdlInitializeSampleTimes(SimStruct *S) {
    ssSetSampleTime(S, 0, mxGetScalar(ssGetSFcnParam(S, 0)));
    ssSetOffsetTime(S, 0, 0.0);
}

#define MDL_START
static void mdlStart(SimStruct *S) {
    tracker_init((tracker_state *)ssGetDWork(S, 0));
}

static void mdlOutputs(SimStruct *S, int_T tid) {
    tracker_state *copy = (tracker_state *)ssGetDWork(S, 1);
    const tracker_real *y = (const tracker_real *)ssGetInputPortSignal(S, 0);
    const tracker_real none = 0;
    const tracker_real *u = PORTS == 2 ? (const tracker_real *)ssGetInputPortSignal(S, PORTS - 1) : &none;
    tracker_real *theta = (tracker_real *)ssGetOutputPortSignal(S, 0);
    tracker_real *var = (tracker_real *)ssGetOutputPortSignal(S, 1);
    tracker_real *last = (tracker_real *)ssGetOutputPortSignal(S, 2);
    tracker_step step;
    (void)tid;
    *copy = *(const tracker_state *)ssGetDWork(S, 0);
    step = tracker_update(copy, y[0], u);
    for (int i = 0; i < TRACKER_PARAMETERS; i++) {
        theta[i] = copy->theta[i];
        var[i] = copy->var[i];
    }
    last[0] = step.y_hat;
    last[1] = step.e;
    last[2] = step.variance;
    last[3] = (tracker_real)step.ok;
}

#define MDL_UPDATE
static void mdlUpdate(SimStruct *S, int_T tid) {
    (void)tid;
    *(tracker_state *)ssGetDWork(S, 0) = *(const tracker_state *)ssGetDWork(S, 1);
}

static void mdlTerminate(SimStruct *S) {
    (void)S;
}

#ifdef MATLAB_MEX_FILE
#include "simulink.c"
#else
#include "cg_sfun.h"
#endif
"""
