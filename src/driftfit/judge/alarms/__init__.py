"""Alarms at a set rate of false alarms."""
