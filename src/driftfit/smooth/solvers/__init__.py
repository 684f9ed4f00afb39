"""How smoothers solve their problems: the problem, elimination from both ends, two filters that meet, rank, mixture."""
