"""Parts of the exact smoother: the problem, elimination from both ends, two filters that meet, rank."""
