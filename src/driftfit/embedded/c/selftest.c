/* Runs the tracker over recorded samples and compares every result with what driftfit gives. Exit status 0: all agree,
   in double precision bit for bit, in single precision within @bound@ of the largest usual result, or of the result
   itself if that is larger: a prediction before the first samples determine theta may be. */
#include "tracker.h"

#include <math.h>
#include <stdio.h>

#define SAMPLES @T@

static const double Y[SAMPLES] = {@y@};
static const double U[SAMPLES * @m@] = {@u@};
/* y_hat, e, variance, ok of every sample; then theta */
static const double STEPS[SAMPLES * 4] = {@steps@};
static const double THETA[TRACKER_PARAMETERS] = {@theta@};

static double worst = 0.0;
static int wrong = 0;

static void compare(double found, double expected, double scale) {
    int same = found == expected || (found != found && expected != expected);
    double away = same ? 0.0 : fabs(found - expected) / fmax(scale, fabs(expected));
    if (!(away <= worst)) worst = away;
    if (sizeof(tracker_real) == sizeof(double) ? !same : !(away <= @bound@)) wrong++;
}

int main(void) {
    tracker_state state;
    tracker_init(&state);
    for (int t = 0; t < SAMPLES; t++) {
        tracker_real u[@m@];
        for (int j = 0; j < @m@; j++) u[j] = (tracker_real)U[t * @m@ + j];
        tracker_step step = tracker_update(&state, (tracker_real)Y[t], u);
        compare((double)step.y_hat, STEPS[t * 4], @y_scale@);
        compare((double)step.e, STEPS[t * 4 + 1], @y_scale@);
        compare((double)step.variance, STEPS[t * 4 + 2], @s_scale@);
        if (step.ok != (int)STEPS[t * 4 + 3]) wrong++;
    }
    for (int i = 0; i < TRACKER_PARAMETERS; i++) compare((double)@last@, THETA[i], @theta_scale@);
    printf("%s: %d of %d results differ, the largest difference is %.3g of the largest result\n",
           wrong ? "FAILED" : "passed", wrong, SAMPLES * 4 + TRACKER_PARAMETERS, worst);
    return wrong ? 1 : 0;
}
