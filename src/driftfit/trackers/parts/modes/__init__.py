"""Parallel filters with different drift or noise, for trackers that estimate both on-line."""
