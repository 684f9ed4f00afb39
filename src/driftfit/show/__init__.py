"""Summaries, pictures and reports."""
