"""Parts of the exact smoother: the problem, elimination, two filters that meet, rank."""
