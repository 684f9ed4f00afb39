void tracker_plan_init(tracker_plan *p) {
    for (int k = 0; k < @h@; k++) { p->target[k] = 0; }
    for (int i = 0; i < @hm@; i++) { p->given[i] = NAN; }
    for (int j = 0; j < @m@; j++) {
        p->low[j] = -INFINITY;
        p->high[j] = INFINITY;
        p->move[j] = INFINITY;
    }
    p->effort = 0;
    p->caution = @caution@;
    p->probe = 0;
}

int tracker_control(const tracker_state *s, tracker_state *scratch, tracker_plan *p) {
    scratch_fields work;
    tracker_real nothing[@m@];
    for (int j = 0; j < @m@; j++) { nothing[j] = NAN; }
    *scratch = *s;
@factors@
    for (int k = 0; k < @h@; k++) {
        tracker_update(scratch, NAN, nothing);
        @spread@;
    }
    *scratch = *s;
    return @call@;
}
