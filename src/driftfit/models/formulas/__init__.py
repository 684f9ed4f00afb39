"""Formulas of models, from text or from plain Python functions."""
