"""Banks of hypotheses: the events that may happen at a sample, and how the tree of their histories is kept small."""
