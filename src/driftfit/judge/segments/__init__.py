"""Parts of `driftfit.judge.segment`: the breaks that correlated noise leaves, and their thresholds."""
