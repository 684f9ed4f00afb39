"""How the tree of hypotheses is kept small, compiled: which leaves are kept, and which are merged."""
