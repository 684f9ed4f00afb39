/* Drives the S-function as Simulink does: samples on standard input, theta and the last step of each on the output. */
#include <stdio.h>
int main(void) {
    SimStruct block = {0};
    tracker_real y, u[TRACKER_INPUTS + 1], theta[TRACKER_PARAMETERS], var[TRACKER_PARAMETERS], last[4];
    double read;
    block.parameter = 0.5;
    mdlInitializeSizes(&block);
    mdlInitializeSampleTimes(&block);
    block.input[0] = &y;
    block.input[1] = u;
    block.output[0] = theta;
    block.output[1] = var;
    block.output[2] = last;
    for (int i = 0; i < block.works; i++) block.work[i] = calloc((size_t)block.work_width[i], sizeof(real_T));
    mdlStart(&block);
    while (scanf("%lf", &read) == 1) {
        y = (tracker_real)(read + 1.0); /* an iteration of an algebraic loop comes first, with another y */
        for (int j = 0; j < TRACKER_INPUTS; j++) {
            double given = 0.0;
            if (scanf("%lf", &given) != 1) return 1;
            u[j] = (tracker_real)given;
        }
        mdlOutputs(&block, 0);
        y = (tracker_real)read;
        mdlOutputs(&block, 0);
        mdlUpdate(&block, 0);
        for (int i = 0; i < TRACKER_PARAMETERS; i++) printf("%.17g %.17g ", (double)theta[i], (double)var[i]);
        for (int i = 0; i < 4; i++) printf("%.17g ", (double)last[i]);
        printf("\n");
    }
    for (int i = 0; i < block.works; i++) free(block.work[i]);
    mdlTerminate(&block);
    return block.sample_time == 0.5 && block.through[0] ? 0 : 1;
}
