"""The exact smoother inside: the problem, elimination, two filters that meet, rank."""
