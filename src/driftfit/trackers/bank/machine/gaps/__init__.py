"""Samples without an output: events in a gap, whose times the data cannot distinguish."""
