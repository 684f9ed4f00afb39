"""What several trackers share: the start, square roots, noise levels, readings that mislead."""
