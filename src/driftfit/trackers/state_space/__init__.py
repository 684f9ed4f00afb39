"""The common part of the trackers of `StateSpace` models, and the steps of the particle filter."""
