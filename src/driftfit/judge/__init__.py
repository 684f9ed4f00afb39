"""Judging a run: verdict, diagnosis, segments, alarms, comparison with simpler methods."""
