"""Streams: one sample at a time, bit for bit as a record."""
