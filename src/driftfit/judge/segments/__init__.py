"""Parts of `driftfit.judge.segment`: breaks in correlated noise, weights, what a segment determines."""
