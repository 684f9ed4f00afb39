"""Tuning: estimate the settings of a tracker from a record."""
