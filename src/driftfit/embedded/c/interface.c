void tracker_init(tracker_state *s) {
    *s = START;
}

NOT_INLINED tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u) {
    tracker_step step;
    scratch_fields scratch;
    @entry@(s, &scratch, y, u, &step.y_hat, &step.e, &step.variance, &step.ok);
@again@    return step;
}

tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u) {
    *scratch = *s;
    return tracker_update(scratch, NAN, u);
}

void tracker_reset(tracker_state *s) {
@copies@
}
