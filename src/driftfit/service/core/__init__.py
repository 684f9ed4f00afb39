"""The engine: journal, units, their states, and results."""
