/* What an S-function needs of Simulink, so that a test can compile and run it without. */
#include <stdlib.h>
typedef double real_T;
typedef int int_T;
typedef double mxArray;
enum { SS_DOUBLE, SS_SINGLE };
typedef struct {
    int parameters, inputs, outputs, works, input_width[2], output_width[3], contiguous[2], through[2], work_width[2];
    int type[2];
    mxArray parameter;
    real_T sample_time, offset;
    void *input[2], *output[3], *work[2];
} SimStruct;
#define ssSetNumSFcnParams(S, n) ((S)->parameters = (n))
#define ssGetNumSFcnParams(S) ((S)->parameters)
#define ssGetSFcnParamsCount(S) 1
#define ssGetSFcnParam(S, i) (&(S)->parameter + (i))
#define mxGetScalar(a) (*(a))
#define ssSetNumInputPorts(S, n) ((S)->inputs = (n), 1)
#define ssSetNumOutputPorts(S, n) ((S)->outputs = (n), 1)
#define ssSetInputPortWidth(S, i, n) ((S)->input_width[i] = (n))
#define ssSetInputPortDataType(S, i, t) ((S)->type[0] = (t))
#define ssSetInputPortRequiredContiguous(S, i, b) ((S)->contiguous[i] = (b))
#define ssSetInputPortDirectFeedThrough(S, i, b) ((S)->through[i] = (b))
#define ssSetOutputPortWidth(S, i, n) ((S)->output_width[i] = (n))
#define ssSetOutputPortDataType(S, i, t) ((S)->type[1] = (t))
#define ssSetNumDWork(S, n) ((S)->works = (n))
#define ssSetDWorkWidth(S, i, n) ((S)->work_width[i] = (n))
#define ssSetDWorkDataType(S, i, t) ((void)(t))
#define ssSetNumSampleTimes(S, n) ((void)(n))
#define ssSetSampleTime(S, i, t) ((S)->sample_time = (t))
#define ssSetOffsetTime(S, i, t) ((S)->offset = (t))
#define ssGetDWork(S, i) ((S)->work[i])
#define ssGetInputPortSignal(S, i) ((const void *)(S)->input[i])
#define ssGetOutputPortSignal(S, i) ((S)->output[i])
