"""One model of change: its test, its dates, what changed, and the sentences."""
