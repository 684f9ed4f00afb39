"""Coarse meters."""
