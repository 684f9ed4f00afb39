
/* A plan of TRACKER_HORIZON samples: what is wanted, what it may cost, and what was found. Matrices are by rows, one for
   each sample. tracker_plan_init chooses all inputs freely, with no limits; the outputs that are wanted are 0. */
#define TRACKER_HORIZON @h@
typedef struct {
    tracker_real target[@h@]; /* wanted outputs */
    tracker_real given[@hm@]; /* inputs that are known beforehand; NAN: to be chosen */
    tracker_real low[@m@]; /* limits of every input; an input that is outside returns by its moves */
    tracker_real high[@m@];
    tracker_real move[@m@]; /* largest change of every input in a sample */
    tracker_real effort; /* cost of a squared change of an input; a squared error of the output costs 1 */
    tracker_real caution; /* factor of the standard deviations of theta: 0 takes the estimate for the truth */
    tracker_real probe; /* what the first input may cost for what it teaches, as a share */
    tracker_real u[@hm@]; /* found: apply the first row, and plan again after the next sample */
    tracker_real y_hat[@h@]; /* expected outputs, and their standard deviations due to theta */
    tracker_real theta_std[@h@];
    /* working space */
@rest@
} tracker_plan;

void tracker_plan_init(tracker_plan *p);

/* Plan the next inputs; only *scratch and *p are changed. 0: planned; otherwise the inputs stay as they are, because
   1: the data do not determine all parameters yet, 2: outputs or inputs of the last samples are missing, or
   3: the inputs that are given leave none within limits and moves (these alone are not kept then). */
int tracker_control(const tracker_state *s, tracker_state *scratch, tracker_plan *p);
