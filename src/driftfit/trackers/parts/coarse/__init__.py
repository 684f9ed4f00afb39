"""Coarse meters: what the errors of rounding of several readings have in common."""
