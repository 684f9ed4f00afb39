"""Parts that several trackers share: the start, square roots, noise levels, treatment of misleading readings."""
