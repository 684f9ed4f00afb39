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
