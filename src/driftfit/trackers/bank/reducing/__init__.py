"""How the tree of hypotheses is kept small, compiled: which leaves go on, and which become one."""
