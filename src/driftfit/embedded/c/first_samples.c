/* The first samples once more, without the fault codes that the gate has found among them. */
static void first_samples_again(tracker_state *s) {
    tracker_step step;
    scratch_fields scratch;
    real rows[@rows@][@columns@], u[@m@];
    const int64_t kept = s->gate_kept, dropped = s->gate_replay - 1;
@kept@
    for (int k = 0; k < @rows@; k++) {
        for (int j = 0; j < @columns@; j++) { rows[k][j] = s->gate_first[k * @columns@ + j]; }
    }
    *s = START;
@restored@
    s->gate_decided = 1;
    for (int k = 0; k < kept; k++) {
        const int64_t codes = (int64_t)rows[k][@codes@];
        const real y = codes % 2 == 1 ? R(NAN) : rows[k][@reading@];
        for (int64_t i = k == 0 ? -dropped : 0; i < (int64_t)rows[k][@times@]; i++) {
            for (int j = 0; j < TRACKER_INPUTS; j++) {
                u[j] = i < 0 || (codes >> (j + 1)) % 2 == 1 ? R(NAN) : rows[k][@inputs@ + j];
            }
@factors@
            @entry@(s, &scratch, y, u, &step.y_hat, &step.e, &step.variance, &step.ok);
        }
    }
}
