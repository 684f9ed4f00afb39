"""Tuning: settings of a tracker from a record."""
