"""Banks of hypotheses: what may have happened at a sample, and how the tree of histories is kept small."""
