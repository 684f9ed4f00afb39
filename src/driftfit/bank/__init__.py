"""Banks of hypotheses: the events that may happen at a sample, and the reductions of the tree of their histories."""
